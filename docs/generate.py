"""Write the generated blocks of the pages anew from the bundles of ``reports/measured``.

    python docs/generate.py [PAGE ...]

A block begins with ``<!-- KIND``, a description in TOML and ``-->``, and ends with ``<!-- end -->``.
``bundles`` are names of files in folders of ``reports/measured``, without ".zip.xz"; the records of all of
them make one report. The kinds and their keys:

``verdict``  a section of the report: its conclusion, its table and its conditions
    section  a name of SECTIONS
    where    a query of the rows that it sees
    show     "conclusion" or "table": that alone
    lines    first cells of the rows that the table has; default: all
``table``    means of the table ``results``
    where    a query; default: BY_ITSELF
    rows     columns that a row stands for; "model": the method with its options
    across   columns whose values set columns of the block apart
    columns  names of VALUES
    spread   true: standard deviations over seeds
    change   a name of VALUES: its difference to the first row is a further column
``chart``    a chart of ``bench report``
    chart    its file there
    keep     column -> values; rows with others are left out
    image    file of the SVG, relative to the page
    alt      text that stands for the picture
``paper``    a table of the paper, measured over published values
    table    its name in reports/paper/published
``claims``   how many of the paper's claims hold
    quiet    bundles of a machine with nothing beside: they decide checks that the others have no values for
    file     in ``reports/measured``: every check
``csv``      a table that a program wrote; lines that begin with "#" are its caption
    file     in ``reports/measured``
``bundles``  every bundle with its page and content
"""

from __future__ import annotations

import csv
import math
import re
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from econgs_bench.bench.results.bundle import zip_of
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.store.store import Store
from econgs_bench.methods.registry import Registry
from econgs_bench.reports import comparability
from econgs_bench.reports.charts import svg
from econgs_bench.reports.clocks import CLOCKS, Clocks
from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import records
from econgs_bench.reports.sections import order
from econgs_bench.reports.sections.answers import section as answers
from econgs_bench.reports.sections.economy import section as economy
from econgs_bench.reports.sections.ladders import conclusion as ladders
from econgs_bench.reports.sections.ladders import table as ladder_table
from econgs_bench.reports.sections.ladders.table import climbed
from econgs_bench.reports.sections.order import chart_sections
from econgs_bench.reports.sections.paper.claims import UNKNOWN, VERDICTS, Verdict, tally
from econgs_bench.reports.sections.paper.documents import to_markdown
from econgs_bench.reports.sections.paper.tables import paper_tables
from econgs_bench.reports.sections.paper.values import PaperTable
from econgs_bench.reports.sections.paper.verdicts import checked, to_csv
from econgs_bench.reports.sections.races import section as races
from econgs_bench.reports.sections.rates import section as rates
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.sections.unseen import section as unseen
from econgs_bench.reports.sections.volumes import section as volumes
from econgs_bench.reports.statistics import Views
from econgs_bench.reports.style import MISSING, PAPER, TITLES, label, signed
from econgs_bench.reports.tables.protocols import by_scene_choice
from econgs_bench.reports.tables.table import Table

ROOT = Path(__file__).resolve().parents[1]
MEASURED = ROOT / "reports" / "measured"
BUNDLE = ".zip.xz"
BLOCK = re.compile(
    r"(<!-- (verdict|table|chart|paper|claims|csv|bundles)\b(.*?)-->\n).*?(<!-- end -->)", re.DOTALL
)
METHODS = (
    "3dgs", "3dgs-mcmc", "vq-3dgs", "3dgs-coded", "scaffold-gs", "hac", "hac-plus", "ivr-gs", "veg",
    "plenoxels", "ccnerf", "econgs", "mesh", "sz3", "zfp",
)  # fmt: skip
"""Order of rows: by family, ECoNGS-R after those that learn."""
BY_ITSELF = "kind == 'basic' and rate.isna()"
FEWER_SEEDS = {1: ("¹", "one seed"), 2: ("²", "two seeds"), 3: ("³", "three seeds"), 4: ("⁴", "four seeds")}
"""Number of seeds -> mark behind a row where other rows of the table have more, and its meaning."""


def geometric(values: pd.Series) -> float:
    """Geometric mean, as the answers of a report have it."""
    return math.exp(float(values.astype(float).map(math.log).mean()))


class Value(NamedTuple):
    """A column of a table: the column of ``results`` behind it, and how scenes make one number."""

    title: str
    column: str
    factor: float
    over_scenes: str | Callable[[pd.Series], float]
    form: str


VALUES = {
    "psnr": Value("PSNR [dB]", "psnr", 1, "mean", ".2f"),
    "psnr_fg": Value("foreground PSNR [dB]", "psnr_fg", 1, "mean", ".2f"),
    "ssim": Value("SSIM", "ssim", 1, "mean", ".4f"),
    "missing": Value("missing alpha [%]", "missing", 100, "mean", ".1f"),
    "fps": Value("FPS", "fps", 1, "mean", ",.0f"),
    "fps_each": Value("FPS", "fps", 1, geometric, ",.0f"),
    "seconds_each": Value("training [s]", "train_seconds", 1, geometric, ",.1f"),
    "cpu": Value("processor time of training [s]", "cpu_seconds", 1, "sum", ",.0f"),
    "minutes": Value("training [min]", "train_seconds", 1 / 60, "sum", ",.1f"),
    "mib": Value("size [MiB]", "size_bytes", 2**-20, "sum", ",.2f"),
    "mib_each": Value("size [MiB]", "size_bytes", 2**-20, geometric, ",.3f"),
    "primitives": Value("primitives", "primitives", 1, "sum", ",.0f"),
}


@cache
def tables(bundles: tuple[str, ...]) -> dict[str, pd.DataFrame]:
    """The tables of a run store that holds the records of these bundles."""
    with tempfile.TemporaryDirectory() as folder:
        for bundle in bundles:
            (path,) = MEASURED.rglob(bundle + BUNDLE)
            with zip_of(path) as archive:
                names = [name for name in archive.namelist() if not name.startswith("tables/")]
                archive.extractall(folder, names)
        return build_tables(Store(Path(folder)), Registry().specs, write=False)


def _ladders(page: Page) -> Section:
    """Where each method breaks first, in sentences, and the first break of each method on each ladder."""
    rungs = ladder_table.of_report(page.report)
    climbs = climbed(rungs[rungs["variant"] == ""])
    own = ladders.by_method(climbs)
    methods = sorted({climb["method"] for climb in climbs}, key=METHODS.index)
    answer = [ladders.verdict(own[method, ""]) for method in methods]
    rows = []
    for ladder in dict.fromkeys(climb["ladder"] for climb in climbs):
        each = {climb["method"]: climb for climb in climbs if climb["ladder"] == ladder}
        name = f"**{ladder}**: {next(iter(each.values()))['purpose']}"
        rows.append([name, *(_first_break(each.get(method)) for method in methods)])
    heads = ("ladder", *(TITLES.get(name, name) for name in methods))
    return Section("ladders", "", answer, tables=[Table("", heads, rows)])


def _first_break(climb: dict[str, Any] | None) -> str:
    if climb is None:
        return MISSING
    if climb["failure"] is None:
        return "holds" if len(climb["outcomes"]) == climb["rungs"] else "holds where measured"
    return f"`{climb['rung']}` {', '.join(filter(None, [climb['failure'], ladders.amount(climb)]))}"


_OF_ALL = re.compile(r"not compared: |LPIPS: not measured|[^:]+: not measured \(disturbed")
"""Remarks that the page makes once, of all tables of the paper."""
SECTIONS: dict[str, Callable[[Page], Section | None]] = {
    "answers": answers.section, "races": races.section, "rates": rates.section, "unseen": unseen.section,
    "volumes": volumes.section, "ladders": _ladders, "economy": economy.section,
}  # fmt: skip
COLUMNS = {"answers": ("psnr", *CLOCKS), "races": ("psnr", "train_seconds")}
"""Section -> the columns behind its numbers, if not PSNR alone."""


def verdict(block: dict[str, Any]) -> str:
    """What a section of the report concludes, its table, and a line with the conditions."""
    report, name = _report(tuple(block["bundles"]), block.get("where", "index >= 0")), block["section"]
    section = SECTIONS[name](Page(report, order.family(report)))
    if section is None or not section.tables[0].rows:
        raise SystemExit(f"nothing of the kind for {block}")
    many = name == "ladders"
    answer = "\n".join(f"- {each}" for each in section.answer) if many else f"**{' '.join(section.answer)}**"
    shown = block.get("show", "")
    if shown == "conclusion":
        return f"{answer}\n"
    line = conditions(report.measured, columns=COLUMNS.get(name, ("psnr",)))
    (table,) = section.tables
    lines = block.get("lines", [head for head, *_ in table.rows])
    kept = [row for row in table.rows if row[0] in lines]
    rows = [[f"**{head}**", *cells] for head, *cells in kept] if name == "answers" else kept
    return ("" if shown == "table" else f"{answer}\n\n") + f"{markdown(table.heads, rows)}\n{line}"


@cache
def _report(bundles: tuple[str, ...], where: str) -> Report:
    parts = dict(tables(bundles))
    rows = parts["results"].query(where, engine="python")
    parts["results"] = comparability.judged(rows, Clocks(parts["results"]))
    return Report(parts)


def table(block: dict[str, Any]) -> str:
    """A table of measured values, and a line with the conditions."""
    stored = tables(tuple(block["bundles"]))["results"]
    every = by_scene_choice(stored).query(block.get("where", BY_ITSELF), engine="python")
    pairs = zip(every["method"], every["variant"], strict=True)
    every = every.assign(model=[label(*pair) for pair in pairs])
    every = comparability.judged(every, Clocks(stored), ("dataset", "preset", "split"))
    results = comparability.compared({"results": every})["results"]
    if results.empty:
        raise SystemExit(f"no rows for {block}")
    by, across = _names(block["rows"]), _names(block.get("across", ()))
    if not {"scene", "edit"} & {*by, *across} and (lacking := _lacking(results, by)):
        raise SystemExit(f"means over different scenes in {block}: {'; '.join(lacking)}")
    rows, groups = _ordered(results, by), _ordered(results, across) if across else [()]
    parts = dict(list(results.groupby(by + across)))
    counts = results.groupby(by)["seed"].nunique()
    seeds = [int(counts[row[0] if len(by) == 1 else row]) for row in rows]
    marks = {count: FEWER_SEEDS[count] for count in sorted(set(seeds)) if count < max(seeds)}
    cells = [[_label(name, value) for name, value in zip(by, row, strict=True)] for row in rows]
    for line, count in zip(cells, seeds, strict=True):
        line[-1] += marks[count][0] if count in marks else ""
    titles = [name.replace("model", "method") for name in by]
    sole = across and len(block["columns"]) == 1  # its name then stands once, in the first head
    titles[0] = f"{VALUES[block['columns'][0]].title} by {titles[0]}" if sole else titles[0]
    for group in groups:
        for name in block["columns"]:
            head = ", ".join(_label("", value) for value in group)
            titles.append(" ".join(filter(None, [head, "" if sole else VALUES[name].title])))
            each = [parts.get(row + group) for row in rows]
            numbers = [_number(one, VALUES[name], spread=block.get("spread", False)) for one in each]
            for line, (text, _) in zip(cells, numbers, strict=True):
                line.append(text)
            if block.get("change") == name:
                titles.append("change [dB]")
                for line, (_, number) in zip(cells, numbers, strict=True):
                    line.append(_change(number, numbers[0][1]))
    columns = {VALUES[name].column for name in block["columns"]}
    return (
        f"{markdown(titles, cells)}\n{conditions(every, ', '.join(map(' '.join, marks.values())), columns)}"
    )


def _names(names: str | Iterable[str]) -> list[str]:
    return [names] if isinstance(names, str) else list(names)


def _lacking(results: pd.DataFrame, by: list[str]) -> list[str]:
    """Rows that lack scenes of a dataset which others of their kind have: their means would not compare."""
    scenes = results.groupby(["dataset", "kind"])["scene"].agg(set)
    lacking = []
    for (dataset, kind, *_), part in results.groupby(list(dict.fromkeys(["dataset", "kind", *by]))):
        if missing := scenes[dataset, kind] - set(part["scene"]):
            row = ", ".join(str(part[name].iloc[0]) for name in by)
            lacking.append(f"{row} has no {', '.join(sorted(missing))} of {dataset}")
    return lacking


def _ordered(results: pd.DataFrame, names: list[str]) -> list[tuple[Any, ...]]:
    """The values that columns take together: methods as in METHODS, defaults first, numbers by size."""
    places = {method: place for place, method in enumerate(METHODS)}
    places |= {label(method, variant): place for method, place in places.items() for variant in (PAPER, "")}

    def natural(value: Any) -> list[Any]:
        parts = re.split(r"(\d+(?:\.\d+)?)", str(value))
        return [(0, float(part), "") if i % 2 else (1, 0.0, part) for i, part in enumerate(parts)]

    def key(values: tuple[Any, ...]) -> list[Any]:
        return [(places.get(str(value), len(METHODS)), natural(value)) for value in values]

    return sorted(set(results[names].itertuples(index=False, name=None)), key=key)


def _label(column: str, value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if column == "variant":
        return f"`{value}`" if value else "**default**"
    return TITLES.get(value) or (f"`{value}`" if column in ("", "dataset", "scene", "edit") else str(value))


def _number(results: pd.DataFrame | None, value: Value, *, spread: bool) -> tuple[str, float | None]:
    """Scenes make one number for each seed, and seeds that have it in all scenes make a mean."""
    seeds = [] if results is None else [rows[value.column] for _, rows in results.groupby("seed")]
    numbers = [float(rows.agg(value.over_scenes)) * value.factor for rows in seeds if rows.notna().all()]
    if not numbers:
        return MISSING, None
    every = pd.Series(numbers)
    mean = geometric(every) if value.over_scenes is geometric else float(every.mean())
    text = format(mean, value.form)
    if spread and value.over_scenes != "sum" and len(every) > 1:
        text += f" ± {format(float(every.std()), value.form)}"
    return text, mean


def _change(number: float | None, reference: float | None) -> str:
    if number is None or reference is None:
        return MISSING
    text = signed(number - reference)
    return "" if number is reference else "0" if text.endswith("0.00") else text


def conditions(results: pd.DataFrame, note: str = "", columns: Iterable[str] = ("psnr", *CLOCKS)) -> str:
    """A line on how rows were measured, and what is not compared in some columns."""
    sizes = sorted(set(results[["width", "height"]].dropna().itertuples(index=False, name=None)))
    parts = [
        f"preset {', '.join(sorted(set(results['preset'])))}",
        ", ".join(f"{width}²" if width == height else f"{width} by {height}" for width, height in sizes),
        comparability.fixed_rays(records(results)),
        f"training views {_series(results['train_views'])}",
        f"{'seeds' if results['seed'].nunique() > 1 else 'one seed,'} {_series(results['seed'])}",
        "; ".join(_machines(results)),
        note,
        _stale(results),
    ]
    found = comparability.concerning(comparability.remarks(results), columns=columns)
    return f"*{'; '.join(filter(None, parts))}.{' ' if found else ''}{comparability.summary(found)}*\n"


def _machines(results: pd.DataFrame) -> list[str]:
    """Processors of fits; those of some methods alone with these."""
    fitted = results.dropna(subset=["fit_processor"])
    machines = {
        str(processor): [name for (name,) in _ordered(group, ["called"])]
        for processor, group in fitted.assign(called=_called(fitted)).groupby("fit_processor")
    }
    if len(set(map(tuple, machines.values()))) == 1:
        return list(machines)
    return [f"{name} ({_brief(methods)})" for name, methods in machines.items()]


def _stale(results: pd.DataFrame) -> str:
    """Which rows are of versions or options that are no longer today's."""
    stale = results[results["stale"].fillna(False)]
    stale = stale.assign(called=_called(stale))
    parts = []
    for (name,) in _ordered(stale, ["called"]):
        changes = sorted(set(stale.loc[stale["called"] == name, "changes"]))
        each = dict.fromkeys(change for one in changes for change in one.split(", "))
        short = ", ".join(each) if len(each) < 3 else f"{len(each)} changes"
        short = re.sub(r"^version (\S+) \(today \S+\)$", r"v\1", short)
        parts.append(f"{name} {short}")
    return f"stale: {_brief(parts, '; ')}" if parts else ""


def _called(results: pd.DataFrame) -> list[str]:
    """Method of each row by the name that it is cited by: with the settings of its paper or with ours."""
    published = results["variant"].fillna("").str.split(",").map(lambda options: PAPER in options)
    return [
        label(method, PAPER if paper else "")
        for method, paper in zip(results["method"], published, strict=True)
    ]


def _brief(names: list[str], between: str = ", ") -> str:
    """A few names, or the number of methods."""
    return between.join(names) if len(names) < 5 else f"{len(names)} methods"


def _series(values: pd.Series) -> str:
    return ", ".join(f"{value:,}" for value in sorted(set(values.dropna())))


def markdown(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A pipe table."""
    heads = list(heads)
    escaped = ([cell.replace("|", "\\|") for cell in line] for line in (heads, ["---"] * len(heads), *rows))
    return "".join(f"| {' | '.join(line)} |\n" for line in escaped)


def chart(block: dict[str, Any]) -> str:
    """The link to a chart; :func:`generated` adds its file."""
    return f"![{block['alt']}]({block['image']})\n"


def drawing(block: dict[str, Any]) -> str:
    """The SVG of a chart."""
    stored = tables(tuple(block["bundles"]))
    parts = dict(stored)
    for column, values in block.get("keep", {}).items():
        parts = {name: one[one[column].isin(values)] if column in one else one for name, one in parts.items()}
    parts["results"] = comparability.judged(parts["results"], Clocks(stored["results"]))
    charts = (section.charts for section in chart_sections(Report(parts)))
    found = next(one[block["chart"]] for one in charts if block["chart"] in one)
    return svg.file(found) + "\n"


def paper(block: dict[str, Any]) -> str:
    """A table of the paper, without its title and without what its page says of all: :data:`_OF_ALL`."""
    text = to_markdown(_papers(tuple(block["bundles"]))[block["table"]]).partition("\n\n")[2]
    parts = dict.fromkeys(part for part in text.split("\n\n") if not _OF_ALL.match(part))
    return "\n\n".join(parts)


@cache
def _papers(bundles: tuple[str, ...]) -> dict[str, PaperTable]:
    parts = tables(bundles)
    return {one.name: one for one in paper_tables(parts, Views(parts.get("views")))}


def claims(block: dict[str, Any]) -> str:
    """The number of claims with each verdict; :func:`generated` adds the file of all checks."""
    counts = tally(_claims(block))
    return markdown(["verdict", "claims"], [[name, str(counts[name])] for name in VERDICTS if counts[name]])


def _claims(block: dict[str, Any]) -> list[Verdict]:
    """The verdicts of a block. Bundles of other machines would make its quiet times disturbed ones."""
    quiet = {(one.claim, one.where): one for one in _checked(tuple(block.get("quiet", ())))}
    return [
        quiet.get((one.claim, one.where), one) if one.verdict == UNKNOWN else one
        for one in _checked(tuple(block["bundles"]))
    ]


@cache
def _checked(bundles: tuple[str, ...]) -> list[Verdict]:
    return checked(_papers(bundles).values(), Report(dict(tables(bundles))))


def from_csv(block: dict[str, Any]) -> str:
    """A file of a program as a table, and its caption."""
    lines = (MEASURED / block["file"]).read_text(encoding="utf-8").splitlines()
    caption = " ".join(line.lstrip("# ") for line in lines if line.startswith("#"))
    heads, *rows = csv.reader(line for line in lines if not line.startswith("#"))
    rows = [[re.sub(r"^-(?=\d)", "\N{MINUS SIGN}", cell) for cell in row] for row in rows]
    return markdown(heads, rows) + (f"\n*{caption}*\n" if caption else "")


def bundle_list(_: dict[str, Any]) -> str:
    """Every bundle with its page and content."""
    rows = []
    for path in sorted(MEASURED.rglob("*" + BUNDLE)):
        results = by_scene_choice(tables((path.name.removesuffix(BUNDLE),))["results"])
        seen = {name: set(results[name].dropna()) for name in ("dataset", "method", "preset", "seed")}
        parts = (
            [f"`{name}`" for name in sorted(seen["dataset"])],
            [name for (name,) in _ordered(results.assign(called=_called(results)), ["called"])],
            sorted(seen["preset"]),
            map(str, sorted(seen["seed"])),
        )
        folder = path.parent.name
        page = f"[{folder}](../../docs/results/{folder}.md)"
        size = f"{path.stat().st_size / 1e6:.1f}"
        rows.append([page, f"`{path.name}`", size, str(len(results)), *map(", ".join, parts)])
    return markdown(["page", "bundle", "MB", "rows", "datasets", "methods", "presets", "seeds"], rows)


KINDS: dict[str, Callable[[dict[str, Any]], str]] = {
    "verdict": verdict, "table": table, "chart": chart, "paper": paper, "claims": claims, "csv": from_csv,
    "bundles": bundle_list,
}  # fmt: skip


@cache  # some blocks are on several pages
def _block(kind: str, description: str) -> str:
    return KINDS[kind](tomllib.loads(description))


def _narrow(text: str) -> str:
    """A text whose tables have no blanks around their bars."""
    return re.sub(r"^\|.*\|$", lambda row: re.sub(r" *(?<!\\)\| *", "|", row[0]), text, flags=re.MULTILINE)


def generated(page: Path) -> dict[Path, str]:
    """A page with its blocks written anew, and its charts and lists: file -> content."""
    text = page.read_text(encoding="utf-8")
    form = _narrow if page.is_relative_to(ROOT / "docs") else str
    files = {page: BLOCK.sub(lambda match: match[1] + form(_block(match[2], match[3])) + match[4], text)}
    for match in BLOCK.finditer(text):
        block = tomllib.loads(match[3])
        if match[2] == "chart":
            files[(page.parent / block["image"]).resolve()] = drawing(block)
        elif match[2] == "claims":
            files[MEASURED / block["file"]] = to_csv(_claims(block))
    return files


def pages() -> list[Path]:
    """The pages that may have blocks."""
    return sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), MEASURED / "README.md"])


def outdated(page: Path) -> dict[Path, str]:
    """A page and its charts where they differ from what the bundles give now -> their new content."""
    return {
        path: text
        for path, text in generated(page).items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    }


if __name__ == "__main__":
    for page in [Path(name).resolve() for name in sys.argv[1:]] or pages():
        for path, text in outdated(page).items():
            path.write_text(text, encoding="utf-8")
            print(path.relative_to(ROOT))
