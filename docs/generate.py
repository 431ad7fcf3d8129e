"""Write the generated blocks of the documentation anew: tables of results, the command line, the bundles.

    python docs/generate.py

A block begins with ``<!-- KIND`` and a description in TOML, and ends with ``<!-- end -->``. The kinds:

``table``    rows of the table ``results`` of one or more bundles. Keys:

    bundles     names in reports/measured, without ".zip"
    where       a pandas query; default: scenes as trained, at the default rate, by themselves
    rows        columns that a row of the block stands for, as "method"; "model": its name with its options
    across      columns whose values set the block's columns apart, as "scene"
    columns     names of VALUES
    spread      true: quality with the standard deviation over seeds
    change      a name of VALUES: a further column, the difference to the first row
    titles      a value of `across` -> its title

``chart``    a chart of `bench report`. Keys:

    bundles     as above
    chart       its file name in a report
    keep        column -> values; rows of all tables that have the column and another value are left out
    image       file of the SVG, relative to the page
    alt         text that stands for the picture

``ladders``  how far methods climb the ladders of a bundle. Keys:

    bundles     as above
    show        "breaks": the first break of each method on each ladder; "verdicts": where each method breaks
                first, in a sentence; "contrasts": which ladder breaks whom, in sentences; "flicker": that of
                each method on each scene

``departures``  every option by which the configuration "paper" of a method differs, and what taking it back
changes. Keys:

    method, preset  whose options
    suite       the suite whose variants take them back, one or a few together
    bundles     as above; none: nothing is measured yet
    where       as above

``economy``  what models spend on scenes, a row per scene and a column per method. Keys:

    bundles     as above
    show        "bytes", "primitives": for ``level`` dB; "gains": dB per added KiB along the curve;
                "prunable": percent of Gaussians that can go at ``level`` dB of loss
    level       of the levels of :mod:`.reports.sections.economy.conclusion`, or a value of
                :data:`.reports.schema.PRUNED`

``verdict``  what a section of the report concludes, its table, and a line with the conditions. Keys:

    bundles     as above
    section     "answers", "places" (the report's first screen: sentences, ranks), "races", "rates", "unseen"
                or "volumes"
    where       as above; which rows the section sees
    table       false: the sentence alone

``paper``    a table of the paper as measured, over the published values. Keys:

    bundles     as above
    table       its name in reports/paper/published

``tuned``    the studies in reports/measured/studies: settings of each method, published to best. Keys:

    scenes      number of scenes of the studies to show

``method``   what a method's author asks: what it wins, its places, its settings and their search. Keys:

    method      its name; without: what each method wins
    bundles     as above; none: no place
    data        titles of what the bundles hold, one each

``power``    the smallest losses that a baseline of the gate shows, as ``bench gate --power --without-times``
prints them. Keys:

    baseline    its path, from the root of the checkout

``index``    what each bundle holds; ``commands``: every command of ``bench`` with its options.
"""

from __future__ import annotations

import argparse
import math
import re
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from econgs_bench.bench.__main__ import parser
from econgs_bench.bench.gate.baseline import read as read_baseline
from econgs_bench.bench.gate.power import markdown as power
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.suite import load_suite
from econgs_bench.bench.tune.study import LOSS, SCENE_LOSS, Study, Trial, means, read_study, smaller
from econgs_bench.methods.interface import MethodSpec, OptionValue
from econgs_bench.methods.options import CONFIGURATION, ITERATIONS, declared, resolve, written
from econgs_bench.methods.registry import Registry
from econgs_bench.reports import comparability
from econgs_bench.reports.charts import svg
from econgs_bench.reports.clocks import CLOCKS, Clocks
from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import PRUNED, records
from econgs_bench.reports.sections import order
from econgs_bench.reports.sections.answers import contest
from econgs_bench.reports.sections.answers.conclusion import Answer, scope, standing
from econgs_bench.reports.sections.economy import conclusion as economy
from econgs_bench.reports.sections.ladders.conclusion import amount, by_method, contrasts, verdict
from econgs_bench.reports.sections.ladders.table import climbed, held, ladders
from econgs_bench.reports.sections.order import chart_sections
from econgs_bench.reports.sections.paper import datasets
from econgs_bench.reports.sections.paper.documents import to_markdown
from econgs_bench.reports.sections.paper.tables import paper_tables
from econgs_bench.reports.sections.paper.values import PaperTable
from econgs_bench.reports.sections.races import conclusion as races
from econgs_bench.reports.sections.rates import conclusion as rates
from econgs_bench.reports.sections.unseen import conclusion as unseen
from econgs_bench.reports.sections.volumes import conclusion as volumes
from econgs_bench.reports.statistics import Views
from econgs_bench.reports.style import MISSING, PAPER, TITLES, counted, label
from econgs_bench.reports.tables.documents import to_markdown as costs_as_markdown
from econgs_bench.reports.tables.protocols import by_scene_choice

ROOT = Path(__file__).resolve().parents[1]
MEASURED = ROOT / "reports" / "measured"
STUDIES = MEASURED / "studies"
BLOCK = re.compile(
    r"(<!-- (table|chart|ladders|departures|economy|verdict|paper|tuned|method|power|index|commands)\b"
    r"(.*?)-->\n).*?(<!-- end -->)",
    re.S,
)
METHODS = (
    "3dgs", "3dgs-mcmc", "vq-3dgs", "3dgs-coded", "scaffold-gs", "hac", "hac-plus", "ivr-gs", "veg",
    "plenoxels", "ccnerf", "econgs", "mesh", "sz3", "zfp",
)  # fmt: skip
FEWER_SEEDS = {1: ("¹", "one seed"), 2: ("²", "two seeds"), 3: ("³", "three seeds"), 4: ("⁴", "four seeds")}
"""Number of seeds -> mark behind a row where other rows of the table have more, and its meaning."""
BY_ITSELF = "kind == 'basic' and rate.isna()"


class Value(NamedTuple):
    """A column of a block: the column of ``results`` behind it, and how scenes make one number."""

    title: str
    column: str
    factor: float
    over_scenes: str | Callable[[pd.Series], float]
    form: str


def geometric(values: pd.Series) -> float:
    """Geometric mean, as the answers of a report have it."""
    return math.exp(float(values.astype(float).map(math.log).mean()))


VALUES = {
    "fps_each": Value("FPS", "fps", 1, geometric, ",.0f"),
    "seconds_each": Value("training [s]", "train_seconds", 1, geometric, ",.1f"),
    "mib_each": Value("size [MiB]", "size_bytes", 2**-20, geometric, ",.3f"),
    "psnr": Value("PSNR [dB]", "psnr", 1, "mean", ".2f"),
    "psnr_fg": Value("foreground PSNR [dB]", "psnr_fg", 1, "mean", ".2f"),
    "ssim": Value("SSIM", "ssim", 1, "mean", ".4f"),
    "missing": Value("missing alpha [%]", "missing", 100, "mean", ".1f"),
    "excess": Value("excess alpha [%]", "excess", 100, "mean", ".1f"),
    "fps": Value("FPS", "fps", 1, "mean", ",.0f"),
    "seconds": Value("training [s]", "train_seconds", 1, "sum", ",.0f"),
    "cpu": Value("processor time of training [s]", "cpu_seconds", 1, "sum", ",.0f"),
    "minutes": Value("training [min]", "train_seconds", 1 / 60, "sum", ",.1f"),
    "mib": Value("size [MiB]", "size_bytes", 2**-20, "sum", ",.2f"),
    "mib_scene": Value("size per scene [MiB]", "size_bytes", 2**-20, "mean", ",.3f"),
    "primitives": Value("primitives", "primitives", 1, "sum", ",.0f"),
    "gaussians": Value("Gaussians", "gaussians", 1, "sum", ",.0f"),
    "prunable": Value("can go at 0.1 dB [%]", "prunable_010", 100, "mean", ".1f"),
    "groups": Value("groups", "group", 1, "nunique", ".0f"),
    "scenes": Value("scenes", "scene", 1, "nunique", ".0f"),
}
DASH = "\N{EN DASH}"
WORTH = (("PSNR [dB]", "psnr"), ("size", "mib"), ("processor time", "cpu"))
"""Columns of a block of departures: title, and name in VALUES: a difference of PSNR, and factors."""


@cache
def tables(bundles: tuple[str, ...]) -> dict[str, pd.DataFrame]:
    """The tables of a store that holds the records of these bundles."""
    with tempfile.TemporaryDirectory() as folder:
        for bundle in bundles:
            with zipfile.ZipFile(MEASURED / f"{bundle}.zip") as archive:
                names = [name for name in archive.namelist() if not name.startswith("tables/")]
                archive.extractall(folder, names)
        return build_tables(Store(Path(folder)), Registry().specs, write=False)


def table(description: str) -> str:
    """A table of measured values as Markdown, and a line with the conditions."""
    block = tomllib.loads(description)
    every, results = _rows(block)
    if results.empty:
        raise SystemExit(f"no rows for {block}")
    by = [name for name in _names(block["rows"]) if name != "variant" or (results["variant"] != "").any()]
    across = _names(block.get("across", ()))
    rows = _ordered(results, by)
    if not {"scene", "recipe", "edit"} & set(by) and (incomplete := _incomplete(results, by)):
        raise SystemExit(f"means over different scenes in {block}: {'; '.join(incomplete)}")
    groups = _ordered(results, across) if across else [()]
    parts = dict(list(results.groupby(by + across)))
    cells = [[_label(name, value) for name, value in zip(by, row, strict=True)] for row in rows]
    counts = results.groupby(by)["seed"].nunique()
    seeds = [int(counts[row[0] if len(by) == 1 else row]) for row in rows]
    marks = {count: FEWER_SEEDS[count] for count in sorted(set(seeds)) if count < max(seeds)}
    for line, count in zip(cells, seeds, strict=True):
        line[-1] += marks[count][0] if count in marks else ""
    sole = across and len(block["columns"]) == 1  # its name then stands once, at the head of the first column
    titles = [f"{VALUES[block['columns'][0]].title} by {by[0]}", *by[1:]] if sole else list(by)
    titles[0] = titles[0].replace("model", "method")
    for group in groups:
        for name in block["columns"]:
            title = ", ".join(_plain(value, block.get("titles", {})) for value in group)
            titles.append(" ".join(filter(None, [title, "" if sole else VALUES[name].title])))
            spread = block.get("spread", False)
            numbers = [_number(parts.get(row + group), VALUES[name], spread) for row in rows]
            for line, (text, _) in zip(cells, numbers, strict=True):
                line.append(text)
            if block.get("change") == name:
                titles.append("change [dB]")
                for line, (_, number) in zip(cells, numbers, strict=True):
                    line.append(_change(number, numbers[0][1]))
    shown = {VALUES[name].column for name in block["columns"]}
    note = ", ".join(map(" ".join, marks.values()))
    return _markdown(titles, cells) + "\n" + _conditions(every, note, shown)


def _rows(block: dict[str, Any]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The rows of a block, and the same with what is compared among them."""
    stored = tables(tuple(block["bundles"]))["results"]
    results = by_scene_choice(stored).query(block.get("where", BY_ITSELF), engine="python")
    pairs = zip(results["method"], results["variant"], strict=True)
    results = results.assign(model=[label(*pair) for pair in pairs])
    results = comparability.judged(results, Clocks(stored), ("dataset", "preset", "split"))
    return results, comparability.compared({"results": results})["results"]


def _incomplete(results: pd.DataFrame, by: list[str]) -> list[str]:
    """Rows that lack scenes of a dataset which others of their kind have: their means would not compare."""
    scenes = results.groupby(["dataset", "kind"])["scene"].agg(set)
    incomplete = []
    for (dataset, kind, *_), part in results.groupby(list(dict.fromkeys(["dataset", "kind", *by]))):
        if missing := scenes[dataset, kind] - set(part["scene"]):
            row = ", ".join(str(part[name].iloc[0]) for name in by)
            incomplete.append(f"{row} has no {', '.join(sorted(missing))} of {dataset}")
    return incomplete


def _names(names: str | Iterable[str]) -> list[str]:
    return [names] if isinstance(names, str) else list(names)


def _ordered(results: pd.DataFrame, names: list[str]) -> list[tuple[Any, ...]]:
    """The values that columns take together: methods as in METHODS, defaults first, numbers by size."""
    places = {method: place for place, method in enumerate(METHODS)}
    places |= {label(method): place for method, place in places.items()}
    places |= {label(method, PAPER): place for method, place in places.items() if method in METHODS}

    def key(values: tuple[Any, ...]) -> list[Any]:
        return [(places.get(str(value), len(METHODS)), _natural(value)) for value in values]

    return sorted(set(results[names].itertuples(index=False, name=None)), key=key)


def _natural(value: Any) -> list[Any]:
    parts = re.split(r"(\d+(?:\.\d+)?)", str(value))
    return [(0, float(part), "") if i % 2 else (1, 0.0, part) for i, part in enumerate(parts)]


def _label(column: str, value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if column == "variant":
        return f"`{value}`" if value else "**default**"
    return f"`{value}`" if column in ("dataset", "scene", "edit") else TITLES.get(value, str(value))


def _plain(value: Any, titles: dict[str, str]) -> str:
    return titles.get(str(value), TITLES.get(value, f"`{value}`" if isinstance(value, str) else str(value)))


def _number(results: pd.DataFrame | None, value: Value, spread: bool) -> tuple[str, float | None]:
    """Scenes make one number for each seed, and seeds that have it in all scenes make a mean."""
    if results is None:
        return DASH, None
    whole = [rows for _, rows in results.groupby("seed") if rows[value.column].notna().all()]
    if not whole:
        return DASH, None
    numbers = [rows[value.column].agg(value.over_scenes) for rows in whole]
    seeds = pd.Series(numbers, dtype=float) * value.factor
    mean = geometric(seeds) if value.over_scenes is geometric else float(seeds.mean())
    text = format(mean, value.form)
    if spread and value.over_scenes in ("mean", geometric) and len(seeds) > 1:
        text += f" ± {format(float(seeds.std()), value.form)}"
    return text, mean


def _change(number: float | None, reference: float | None) -> str:
    if number is None or reference is None:
        return "\N{EN DASH}"
    text = f"{number - reference:+.2f}".replace("-", "\N{MINUS SIGN}")
    return "" if number is reference else "0" if text.endswith("0.00") else text


def _conditions(results: pd.DataFrame, note: str = "", columns: Iterable[str] = ("psnr", *CLOCKS)) -> str:
    """A line on how rows were measured, and what is not compared in some columns."""
    sizes = sorted(set(results[["width", "height"]].dropna().itertuples(index=False, name=None)))
    parts = [
        "preset " + ", ".join(sorted(set(results["preset"]))),
        ", ".join(f"{width}²" if width == height else f"{width} by {height}" for width, height in sizes),
        *filter(None, [comparability.fixed_rays(records(results))]),
        "training views " + _series(results["train_views"]),
        f"{'seeds' if results['seed'].nunique() > 1 else 'one seed,'} {_series(results['seed'])}",
    ]
    fitted = results.dropna(subset=["fit_processor"])
    machines = {
        str(processor): [TITLES.get(name, name) for (name,) in _ordered(group, ["method"])]
        for processor, group in fitted.groupby("fit_processor")
    }
    if len(machines) == 1 or len({tuple(names) for names in machines.values()}) == 1:
        parts.append("; ".join(machines))
    else:
        parts.append("; ".join(f"{name} ({', '.join(methods)})" for name, methods in machines.items()))
    parts += filter(None, [note, _earlier(results)])
    found = comparability.concerning(comparability.remarks(results), columns=columns)
    return f"*{'; '.join(parts)}.{' ' if found else ''}{comparability.summary(found)}*\n"


def _earlier(results: pd.DataFrame) -> str:
    """Which rows are of versions or options that are no longer today's."""
    stale = results[results["stale"].fillna(False)]
    parts = []
    for (method,) in _ordered(stale, ["method"]):
        changes = sorted(set(stale.loc[stale["method"] == method, "changes"]))
        each = dict.fromkeys(change for one in changes for change in one.split(", "))
        short = ", ".join(each) if len(each) < 3 else f"{len(each)} changes"
        parts.append(f"{TITLES.get(method, method)} {short}")
    return f"stale: {'; '.join(parts)}" if parts else ""


def _series(values: pd.Series) -> str:
    return ", ".join(f"{value:,}" for value in sorted(set(values.dropna())))


def _markdown(titles: list[str], cells: list[list[str]]) -> str:
    lines = [titles, ["---"] * len(titles), *cells]
    escaped = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "".join(f"| {' | '.join(line)} |\n" for line in escaped)


def chart(description: str) -> str:
    """The link to a chart as Markdown."""
    block = tomllib.loads(description)
    return f"![{block['alt']}]({block['image']})\n"


@cache
def image(description: str) -> tuple[str, str]:
    """The file of a chart, relative to its page, and its SVG."""
    block = tomllib.loads(description)
    parts = dict(tables(tuple(block["bundles"])))
    for column, values in block.get("keep", {}).items():
        for name, part in parts.items():
            if column in part:
                parts[name] = part[part[column].isin(values)]
    stored = tables(tuple(block["bundles"]))["results"]
    parts["results"] = comparability.judged(parts["results"], Clocks(stored))
    sections = chart_sections(Report(parts))
    (drawing,) = (section.charts[block["chart"]] for section in sections if block["chart"] in section.charts)
    return block["image"], svg.file(drawing) + "\n"


def ladders_of(description: str) -> str:
    """How far methods climb ladders, as Markdown, and a line with the conditions."""
    block = tomllib.loads(description)
    parts = tables(tuple(block["bundles"]))
    rungs = ladders(parts["rungs"])
    rungs = rungs[rungs["variant"] == ""]
    if rungs.empty:
        raise SystemExit(f"no ladders for {block}")
    shows = {
        "breaks": _breaks, "verdicts": _verdicts, "contrasts": _contrasts, "flicker": _flicker,
        "method": _of_method,
    }  # fmt: skip
    if "method" in block:
        rungs = rungs[rungs["method"] == block["method"]]
    usual = parts["results"].query(BY_ITSELF, engine="python")
    return f"{shows[block['show']](rungs)}\n{_conditions(usual[usual['variant'] == ''], columns=('psnr',))}"


def _breaks(rungs: pd.DataFrame) -> str:
    climbs = climbed(rungs)
    methods = [method for (method,) in _ordered(rungs, ["method"])]
    rows = []
    for ladder in dict.fromkeys(climb["ladder"] for climb in climbs):
        own = {climb["method"]: climb for climb in climbs if climb["ladder"] == ladder}
        name = f"**{ladder}**: {next(iter(own.values()))['purpose']}"
        rows.append([name, *(_first_break(own.get(method)) for method in methods)])
    return _markdown(["ladder", *(TITLES.get(name, name) for name in methods)], rows)


def _first_break(climb: dict[str, Any] | None) -> str:
    if climb is None:
        return "\N{EN DASH}"
    if climb["failure"] is None:
        return "holds" if len(climb["outcomes"]) == climb["rungs"] else "holds where measured"
    return f"`{climb['rung']}` {', '.join(filter(None, [climb['failure'], amount(climb)]))}"


def _verdicts(rungs: pd.DataFrame) -> str:
    own = by_method(climbed(rungs))
    names = [name for (name,) in _ordered(rungs, ["method"])]
    ordered = sorted(own.items(), key=lambda item: names.index(item[0][0]))
    return "".join(f"- {verdict(climbs)}\n" for _, climbs in ordered)


def _contrasts(rungs: pd.DataFrame) -> str:
    climbs = sorted(climbed(rungs), key=lambda climb: METHODS.index(climb["method"]))
    return "".join(f"- {sentence}\n" for sentence in contrasts(climbs))


def _of_method(rungs: pd.DataFrame) -> str:
    """All ladders of one method, the earliest break first."""
    (climbs,) = by_method(climbed(rungs)).values()
    lines = []
    for climb in climbs:
        place = "" if climb["failure"] is None else f"`{climb['rung']}`"
        if climb["subject"]:
            place += f" on `{climb['subject']}`"
        level = ""
        # One job may be a rung of several ladders.
        shown = rungs[(rungs["job"] == climb["job"]) & (rungs["ladder"] == climb["ladder"])]
        if climb["failure"] is not None and len(shown):
            row = shown.iloc[0]
            level = "" if pd.isna(row["psnr"]) else f"{row['psnr']:.2f}"
            level += "" if pd.isna(row["psnr_std"]) else f" ± {row['psnr_std']:.2f}"
        kind = ", ".join(filter(None, [climb["failure"], amount(climb)])) if place else "\N{EN DASH}"
        name = f"**{climb['ladder']}**: {climb['purpose']}"
        lines.append(
            [
                name,
                f"{held(climb)} of {climb['rungs'] - 1}",
                place or "\N{EN DASH}",
                kind,
                level or "\N{EN DASH}",
            ]
        )
    return _markdown(["ladder", "rungs that hold", "first break", "kind", "PSNR there [dB]"], lines)


def _flicker(rungs: pd.DataFrame) -> str:
    rows = rungs[rungs["flicker"].notna()]
    scenes = list(dict.fromkeys(rows["subject"]))
    lines = []
    for (method,) in _ordered(rows, ["method"]):
        own = rows[rows["method"] == method].set_index("subject")["flicker"]
        cells = [f"{own[scene]:.2f}" if scene in own.index else "\N{EN DASH}" for scene in scenes]
        lines.append([TITLES.get(method, method), *cells])
    return _markdown(["flicker [1/255]", *(f"`{scene}`" for scene in scenes)], lines)


def departures(description: str) -> str:
    """The options of the configuration "paper", and what each is worth, as Markdown."""
    block = tomllib.loads(description)
    method, preset = block["method"], block["preset"]
    spec = Registry().spec(method)
    here, paper = (_resolved(spec, preset, name) for name in ("fair", "paper"))
    meaning = {ITERATIONS: "budget of a group of one scene"}
    meaning |= {name: option.doc for name, option in declared(spec.options).items()}
    variants = [one[method] for one in load_suite(block["suite"]).variants if one]
    labels = [resolve(spec, preset, variant).variant for variant in variants]
    results = _measured(block, ["", *labels])
    worth = {label: _worth(results, label) for label in labels}
    leaders: dict[str, str] = {}  # the option that stands for its variant
    cells = [["**default**", "", "", "", *_absolute(results)]]
    for name in (name for name in here if here[name] != paper[name]):
        label = next((one for one, given in zip(labels, variants, strict=True) if name in given), "")
        numbers = worth.get(label, [DASH] * len(WORTH))
        if (leader := leaders.setdefault(label, name)) != name and label:
            numbers = [f"with `{leader}`", *[""] * (len(WORTH) - 1)]
        values = [written(side[name]) for side in (here, paper)]
        cells.append([f"`{name}`", *values, meaning[name], *numbers])
    whole = resolve(spec, preset, {CONFIGURATION: "paper"}).variant
    cells.append([f"`{whole}`", "", "", "all of them", *worth.get(whole, [DASH] * len(WORTH))])
    titles = ["option", "here", "paper", "meaning", *(title for title, _ in WORTH)]
    conditions = "*Not measured yet.*\n" if results.empty else _conditions(results)
    return _markdown(titles, cells) + "\n" + conditions


def _resolved(spec: MethodSpec, preset: str, configuration: str) -> dict[str, OptionValue]:
    """Iterations and options of a method."""
    settings = resolve(spec, preset, {CONFIGURATION: configuration})
    return {ITERATIONS: settings.iterations, **settings.values}


def _measured(block: dict[str, Any], variants: list[str]) -> pd.DataFrame:
    """Rows of these variants; none without bundles."""
    if not block["bundles"]:
        return pd.DataFrame(columns=["variant"])
    _, results = _rows(block)
    return results[(results["method"] == block["method"]) & results["variant"].isin(variants)]


def _means(results: pd.DataFrame, variant: str) -> list[float | None]:
    rows = results[results["variant"] == variant]
    return [_number(rows if len(rows) else None, VALUES[name], False)[1] for _, name in WORTH]


def _absolute(results: pd.DataFrame) -> list[str]:
    """PSNR, size and training time of the defaults."""
    units = ("{:.2f}", "{:,.2f} MiB", "{:,.0f} s")
    numbers = zip(units, _means(results, ""), strict=True)
    return [DASH if number is None else unit.format(number) for unit, number in numbers]


def _worth(results: pd.DataFrame, variant: str) -> list[str]:
    """What a variant changes: PSNR by a difference, size and training time by factors."""
    psnr, *others = zip(_means(results, variant), _means(results, ""), strict=True)
    factors = [
        DASH if None in (one, base) else f"\N{MULTIPLICATION SIGN}{one / base:.2f}" for one, base in others
    ]
    return [_change(*psnr), *factors]


def economy_of(description: str) -> str:
    """What models spend on scenes, as Markdown, and a line with the conditions."""
    block = tomllib.loads(description)
    report = Report(tables(tuple(block["bundles"]))).of_defaults
    rows = economy.of_report(report)
    if not economy.has_facts(rows):
        raise SystemExit(f"nothing of the kind for {block}")
    show, level = block["show"], float(block.get("level", 0.0))
    texts: dict[str, Callable[[economy.Economy], str]] = {
        "bytes": lambda one: one.bytes_text(level),
        "primitives": lambda one: one.primitives_text(level),
        "gains": economy.Economy.gains_text,
        "prunable": lambda one: one.prunable_text({drop: name for name, drop in PRUNED.items()}[level]),
    }
    names = {
        "bytes": f"KiB for {level:g} dB",
        "primitives": f"primitives for {level:g} dB",
        "gains": "dB per KiB",
        "prunable": f"can go at {level:g} dB [%]",
    }
    titles = [TITLES[method] for method in METHODS]
    titles = [title for title in titles if any(one.model.title == title for one in rows)]
    lines = []
    for scene in dict.fromkeys(one.scene for one in rows):
        own = {one.model.title: one for one in rows if one.scene == scene}
        volume = next(iter(own.values())).volume
        cells = [texts[show](own[title]) if title in own else MISSING for title in titles]
        lines.append([f"`{scene}`", MISSING if volume is None else f"{volume / economy.KIB:,.1f}", *cells])
    usual = report.results.query(BY_ITSELF, engine="python")
    heads = [names[show], "volume [KiB]", *titles]
    sentence = f"**{economy.conclusion(rows)}**\n\n" if block.get("conclusion") else ""
    conditions = _conditions(usual[usual["variant"] == ""], columns=("psnr",))
    return f"{sentence}{_markdown(heads, lines)}\n{conditions}"


def verdict_of(description: str) -> str:
    """What a section of the report concludes, as Markdown, its table, and a line with the conditions."""
    block = tomllib.loads(description)
    parts = dict(tables(tuple(block["bundles"])))
    rows = parts["results"].query(block.get("where", "index >= 0"), engine="python")
    parts["results"] = comparability.judged(rows, Clocks(parts["results"]))
    report = Report(parts)
    found, leads = order.answers(report), order.family(report)
    if block["section"] == "unseen":
        targets = unseen.targets(report.results)
        sentence, heads, lines = unseen.conclusion(targets), unseen.HEADS, unseen.rows(targets)
    elif block["section"] == "races":
        held = races.of_report(report)
        sentence, heads = " ".join(races.conclusion(held, leads)), races.HEADS
        lines = [races.row(race, lead, leads) for race in held for lead in race.leads]
    elif block["section"] == "rates":
        pairs = rates.of_report(report)
        sentence, heads = rates.conclusion(pairs, leads), rates.HEADS
        lines = [rates.row(one) for one in pairs]
    elif block["section"] == "answers":
        sentence, heads = scope(contest.of_report(report)[0]), ("", "")
        lines = [[f"**{one.title}**", one.sentence] for one in found]
    elif block["section"] == "places":
        heads, lines = _places(report)
        sentence = "Means per scene, and in parentheses the rank and on how many scenes a method is first."
    else:
        payoffs = volumes.payoffs(report.curves)
        sentence, heads = volumes.conclusion(payoffs), volumes.HEADS
        lines = [volumes.row(one) for one in payoffs]
    if not lines:
        raise SystemExit(f"nothing of the kind for {block}")
    if not block.get("table", True):
        return f"**{sentence}**\n"
    clocks = {"races": ("train_seconds",), "answers": tuple(CLOCKS), "places": tuple(CLOCKS)}
    columns = ("psnr", *clocks.get(block["section"], ()))
    return f"**{sentence}**\n\n{_markdown(list(heads), lines)}\n{_conditions(report.measured, '', columns)}"


def _places(report: Report) -> tuple[list[str], list[list[str]]]:
    """Methods by criteria: heads and rows."""
    lines = []
    for method in contest.of_report(report)[0].methods:
        cells = []
        for answer in order.answers(report):
            own, rank = answer.place(method) or (None, 0)
            remarks = [str(rank + 1), answer.firsts(own)] if own else []
            cells.append(f"{own.text} ({'; '.join(filter(None, remarks))})" if own else MISSING)
        lines.append([TITLES.get(method, method), *cells])
    return ["method", *(answer.title for answer in order.answers(report))], lines


def method_of(description: str) -> str:
    """What a method wins, its places, its settings beside the published ones, and their search."""
    block = tomllib.loads(description)
    answers = {title: _answers(bundle) for title, bundle in zip(block["data"], block["bundles"], strict=True)}
    if "method" not in block:
        names = {place.method for given in answers.values() for one in given for place in one.places}
        ordered = sorted(names, key=METHODS.index)
        return _markdown(["method", ""], [[TITLES[name], standing(answers, name)] for name in ordered])
    method, text = block["method"], ""
    if answers:
        (titles,) = {tuple(answer.title for answer in given) for given in answers.values()}
        places = [
            [one, *(_place(given[i], method) for given in answers.values())] for i, one in enumerate(titles)
        ]
        text = f"**{standing(answers, method)}**\n\n"
        text += _markdown(["", *(f"{title}: value, rank; the first" for title in answers)], places) + "\n"
    return text + _settings(method)


@cache
def _answers(bundle: str) -> list[Answer]:
    return order.answers(Report(tables((bundle,))))


def _place(answer: Answer, method: str) -> str:
    """A method's value, its rank, and who is first."""
    own, rank = answer.place(method) or (None, 0)
    if own is None:
        return MISSING
    first = answer.places[0]
    ahead = "" if rank == 0 else f"; {TITLES.get(first.method, first.method)} {first.text}"
    firsts = f", {answer.firsts(own)}" if own.firsts else ""
    return f"{own.text}, {rank + 1} of {len(answer.places)}{firsts}{ahead}"


def _settings(method: str) -> str:
    """Options that are not published ones or were searched, in short and full schedules; the search."""
    spec = Registry().spec(method)
    every = _studies()
    study = next((one for one in every if one.method == method), None)
    space = study.space if study else {}
    cases = (("quick", "fair"), ("paper", "fair"), ("paper", "paper"))
    each = [_resolved(spec, *case) for case in cases]
    lines = []
    for name in each[0]:
        values = [written(settings[name]) for settings in each]
        if name == ITERATIONS or name in space or len(set(values)) > 1:
            lines.append([f"`{name}`", *values, space[name].text if name in space else ""])
    text = _markdown(["option", "`quick`", "full schedules", "published", "searched in `quick`"], lines)
    if study is None:
        return f"{text}\n*Not searched.*\n"
    under = study.conditions
    scenes = ", ".join(f"`{dataset}` {scene}" for dataset, scene, _ in under.scenes)
    least = min(len(one.trials) for one in every if one.conditions == under)
    text += f"\n*Search: {counted(least, 'trial')}, preset {under.preset}, of version "
    text += f"{_version(study)}, the first with published settings, the next with the defaults of then; "
    return text + f"{scenes}; validation views, seed {', '.join(map(str, under.seeds))}.*\n"


def _version(study: Study) -> str:
    """The version that was searched, and today's where that is another."""
    today = Registry().spec(study.method).version
    return study.version if study.version == today else f"{study.version} (today {today})"


def paper_of(description: str) -> str:
    """A table of the paper as Markdown, without its title."""
    block = tomllib.loads(description)
    parts = tables(tuple(block["bundles"]))
    if block["table"] == "datasets":
        return costs_as_markdown(datasets.costs(parts["dvr"]))
    found = _papers(tuple(block["bundles"]))
    if block["table"] not in found:
        raise SystemExit(f"nothing of the kind for {block}")
    return to_markdown(found[block["table"]]).partition("\n\n")[2]


@cache
def _papers(bundles: tuple[str, ...]) -> dict[str, PaperTable]:
    parts = tables(bundles)
    return {one.name: one for one in paper_tables(parts, Views(parts.get("views")))}


def _studies() -> list[Study]:
    return [read_study(path) for path in sorted(STUDIES.glob("*.json"))]


def tuned_of(description: str) -> str:
    """What `bench tune` found, a row per method, after what the studies had in common."""
    block = tomllib.loads(description)
    found = [one for one in _studies() if len(one.conditions.scenes) == block["scenes"] and one.chosen]
    if not found:
        raise SystemExit(f"no studies for {block}")
    least = min(len(one.trials) for one in found)
    heads = [
        "method",
        "published",
        "default",
        "best score",
        f"at most {LOSS:g} dB below the default, {SCENE_LOSS:g} on a scene",
        "its options",
    ]
    lines, won, better = [], [], []
    ordered = sorted(found, key=lambda one: METHODS.index(one.method))
    for study in ordered:
        trials = study.trials[:least]
        default = study.default
        best = max(trials, key=lambda one: (one.score or 0.0, -one.number))
        improved = smaller(trials, default)
        name = TITLES[study.method]
        won += [name] if best is not default else []
        better += [name] if improved else []
        shown = [trials[0] if study.starts > 1 else None, default, best, improved]
        options = improved.overrides.items() if improved else ()
        cells = [
            "as default" if one is default and place > 1 else _mean_model(one)
            for place, one in enumerate(shown)
        ]
        lines.append([name, *cells, " ".join(f"`{name}={written(value)}`" for name, value in options)])
    under = found[0].conditions
    scenes = ", ".join(f"`{dataset}` {scene}" for dataset, scene, _ in under.scenes)
    conclusion = f"**Of {counted(len(found), 'method')}, after {least} trials each, {len(won)} score better "
    conclusion += f"than with their defaults ({', '.join(won)}); {len(better)} found a smaller model at most "
    conclusion += f"{LOSS:g} dB below it, {SCENE_LOSS:g} on a scene"
    conclusion += f" ({', '.join(better)}).**" if better else ".**"
    words = f"*PSNR [dB] / size [MiB] / score. {scenes}; preset {under.preset}, validation views, "
    words += f"seed {', '.join(map(str, under.seeds))}; score: {found[0].objective.title}, mean over scenes. "
    words += f"Versions: {', '.join(f'{TITLES[one.method]} {_version(one)}' for one in ordered)}.*"
    return f"{conclusion}\n\n{_markdown(heads, lines)}\n{words}\n"


def _mean_model(trial: Trial | None) -> str:
    """PSNR, size and score, means over scenes."""
    if trial is None or trial.score is None:
        return MISSING
    ((_, size, psnr),) = means(trial)
    return f"{psnr:.2f} / {size:.3g} / {trial.score:.1f}"


def index(_: str) -> str:
    """What each bundle holds, as Markdown."""
    titles = ["bundle", "MB", "rows", "datasets", "methods", "presets", "seeds"]
    cells = []
    for path in sorted(MEASURED.glob("*.zip")):
        results = by_scene_choice(tables((path.stem,))["results"])
        seen = {name: set(results[name].dropna()) for name in ("dataset", "method", "preset", "seed")}
        parts = (
            [f"`{name}`" for name in sorted(seen["dataset"], key=_natural)],
            [TITLES[name] for name in METHODS if name in seen["method"]],
            sorted(seen["preset"]),
            map(str, sorted(seen["seed"])),
        )
        size = f"{path.stat().st_size / 1e6:.1f}"
        cells.append([f"`{path.name}`", size, str(len(results)), *map(", ".join, parts)])
    return _markdown(titles, cells)


def commands(_: str) -> str:
    """Every command of ``bench`` with its arguments and options, as Markdown."""
    program = parser()
    (subcommands,) = (action for action in program._actions if isinstance(action, argparse._SubParsersAction))
    text = f"{program.epilog}\n"
    for name, command in subcommands.choices.items():
        purpose = _help(command.description)
        text += f"\n## bench {name}\n\n{purpose[:1].upper()}{purpose[1:]}.\n\n"
        actions = [action for action in command._actions if action.dest not in ("help", "debug")]
        text += _markdown(["argument", "meaning"], [[_argument(a), _help(a.help)] for a in actions])
    return text


def power_of(description: str) -> str:
    """The smallest losses that a baseline shows, without times, as Markdown."""
    block = tomllib.loads(description)
    return power(read_baseline(ROOT / block["baseline"]), times=False) + "\n"


def _argument(action: argparse.Action) -> str:
    what = action.metavar or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    if not action.option_strings:
        return f"`{what}…`" if action.nargs in ("*", "+") else f"`{what}`"
    takes = "" if action.nargs == 0 else f" {what}"
    return f"`{action.option_strings[-1]}{takes}`"


def _help(text: str | None) -> str:
    return (text or "").replace("%%", "%")


KINDS: dict[str, Callable[[str], str]] = {
    "table": table,
    "chart": chart,
    "ladders": ladders_of,
    "departures": departures,
    "economy": economy_of,
    "verdict": verdict_of,
    "tuned": tuned_of,
    "method": method_of,
    "paper": paper_of,
    "power": power_of,
    "index": index,
    "commands": commands,
}


@cache  # some blocks stand on several pages
def _block(kind: str, description: str) -> str:
    return KINDS[kind](description)


def generated(page: Path) -> dict[Path, str]:
    """A page with its blocks written anew, and its charts: file -> content."""
    text = page.read_text(encoding="utf-8")
    files = {page: BLOCK.sub(lambda match: match[1] + _block(match[2], match[3]) + match[4], text)}
    for match in BLOCK.finditer(text):
        if match[2] == "chart":
            path, drawing = image(match[3])
            files[(page.parent / path).resolve()] = drawing
    return files


def _pages() -> list[Path]:
    return sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), MEASURED / "README.md"])


def outdated() -> dict[Path, str]:
    """Files that differ from what the bundles and the parser give now -> their new content."""
    files = {path: text for page in _pages() for path, text in generated(page).items()}
    return {
        path: text
        for path, text in files.items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    }


def main() -> None:
    """Write all blocks; what somebody changed in a page meanwhile stays."""
    for path in outdated():
        text = next((text for page in _pages() for name, text in generated(page).items() if name == path), "")
        path.write_text(text, encoding="utf-8")
        print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
