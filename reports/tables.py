"""Tables for people: the columns of `results` they read, in their units; CSV, Markdown, LaTeX, terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from reports.statistics import METRICS, Sample, Views
from reports.style import MISSING, absent, label, mib, seconds

if TYPE_CHECKING:
    import pandas as pd

_KEYS = ["dataset", "method", "variant", "rate", "preset", "split"]
_MEAN = ("psnr", "psnr_fg", "ssim", "lpips_vgg", "flip", "delta_e_uv", "fps")
_SUM = ("size_bytes", "train_seconds", "load_seconds", "primitives")
_MAX = ("peak_host_bytes", "peak_device_bytes")


class Column(NamedTuple):
    """How a column is shown.

    Attributes:
        title: header with unit.
        write: value -> text; called on values that are present.
        better: 1 if higher is better, -1 if lower is, 0 if it is not ranked.
        doc: tooltip of the header.
    """

    title: str
    write: Callable[[Any], str]
    better: int = 0
    doc: str = ""


def _fixed(digits: int) -> Callable[[Any], str]:
    return lambda value: f"{value:.{digits}f}"


def _significant(value: float) -> str:
    return f"{value:.5g}"


def _three(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def _fps(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.3f}"


COLUMNS: dict[str, Column] = {
    "dataset": Column("Dataset", str),
    "scene": Column("Scene", str),
    "method": Column("Method", str),
    "scenes": Column("Scenes", str),
    "seeds": Column("Seeds", str),
    "psnr": Column("PSNR [dB]", _fixed(2), 1, "mean over views; per image on 8-bit composited RGB"),
    "psnr_std": Column("± [dB]", _fixed(2), 0, "standard deviation of PSNR over seeds"),
    "psnr_fg": Column("PSNR fg [dB]", _fixed(2), 1, "over pixels where truth or model has alpha >= 1/255"),
    "ssim": Column("SSIM", _fixed(4), 1, "Gaussian 11x11, sigma 1.5, interior"),
    "lpips_vgg": Column("LPIPS", _fixed(4), -1, "VGG, input in [-1, 1]"),
    "lpips_vgg01": Column("LPIPS [0,1]", _fixed(4), -1, "VGG, unscaled input in [0, 1]"),
    "lpips_alex": Column("LPIPS Alex", _fixed(4), -1, "AlexNet, input in [-1, 1]"),
    "flip": Column("FLIP", _fixed(4), -1, "mean, 67 pixels per degree"),
    "delta_e_uv": Column("ΔE*uv", _fixed(2), -1, "mean CIELUV color difference, D65"),
    "size_bytes": Column("Size [MiB]", mib, -1,
                         "bytes of the files that load opens; the scene's share of its group"),
    "primitives": Column("Primitives", lambda value: f"{int(value):,}"),
    "train_seconds": Column("Training", seconds, -1, "partition + fit + encode; the scene's share"),
    "load_seconds": Column("Load", seconds, -1, "from files to a model ready to render"),
    "fps": Column("FPS", _fps, 1, "1 / median frame time, camera to image, of the loaded model"),
    "peak_host_bytes": Column("Host mem. [MiB]", mib, -1, "peak of fit and measurement"),
    "peak_device_bytes": Column("Device mem. [MiB]", mib, -1, "peak device memory"),
    "status": Column("Status", str),
    "reason": Column("Reason", str),
    # Of rendering the volumes themselves.
    "resolution": Column("Resolution", str),
    "variables": Column("Variables", _significant),
    "volume_gib": Column("Volume [GiB]", _three),
    "cpu_gib": Column("CPU mem. [GiB]", _three, 0, "peak of the process that renders"),
    "gpu_gib": Column("GPU mem. [GiB]", _three, 0, "peak device memory"),
    "ms_per_view": Column("ms per view", _three, 0, "median of one view per launch, after warm-up"),
    "ms_p05": Column("5 %", _three),
    "ms_p95": Column("95 %", _three),
    "setup_seconds": Column("Set-up", seconds, 0, "from the volume in memory to the first picture"),
    "image": Column("Image", str),
    "renderer": Column("Renderer", str),
    "file": Column("Image", str),
    # Of the comparison of two runs.
    "views": Column("Views", _significant),
    "first": Column("First", _significant),
    "second": Column("Second", _significant),
    "difference": Column("Difference", _significant, 0, "second - first, mean over the paired views"),
    "least": Column("Least", _significant, 0, "difference of any view"),
    "greatest": Column("Greatest", _significant, 0, "difference of any view"),
    "identical": Column("Identical", lambda value: "yes" if value else "no"),
}  # fmt: skip


def quality(table: pd.DataFrame) -> list[str]:
    """The quality metrics in the order they are shown: where LPIPS is missing, SSIM and FLIP lead."""
    if "lpips_vgg" in table and table["lpips_vgg"].notna().any():
        return ["psnr", "psnr_fg", "ssim", "lpips_vgg", "flip", "delta_e_uv"]
    return ["ssim", "flip", "psnr", "psnr_fg", "delta_e_uv", "lpips_vgg"]


def is_results(table: pd.DataFrame) -> bool:
    """Whether a table is `results` as documented, not one made for people."""
    return {"job", "status", "variant"} <= set(table.columns)


def shown(results: pd.DataFrame) -> pd.DataFrame:
    """What people read of `results`: method with variant and rate in one name, no columns of bookkeeping.

    Columns that say the same for all rows (one seed, what nobody has measured) are left out; reasons are
    those of rows that did not finish.
    """
    import pandas as pd

    names = ["dataset", "scene", "method", *quality(results), "size_bytes", "primitives", "train_seconds"]
    names += ["load_seconds", "fps", "peak_host_bytes", "peak_device_bytes"]
    names = [name for name in names if name in ("psnr", "size_bytes") or results[name].notna().any()]
    out = pd.DataFrame({name: results[name] for name in names}, index=results.index)
    out["method"] = [label(*row) for row in results[["method", "variant", "rate"]].itertuples(index=False)]
    for axis in ("kind", "preset", "split", "seed", "device"):
        if results[axis].nunique(dropna=False) > 1:
            out.insert(3, axis, results[axis])
    out["status"] = [_status(row) for row in results[["status", "stale"]].itertuples(index=False)]
    unfinished = results["status"] != "ok"
    if unfinished.any():
        out["reason"] = results["reason"].where(unfinished, None)
    return out


def notes(results: pd.DataFrame) -> list[str]:
    """Why finished rows lack a metric, each reason once; and the processors that timed them, if several."""
    finished = results[results["status"] == "ok"]
    reasons = [str(reason) for reason in finished["reason"] if not absent(reason)]
    return [told for told in dict.fromkeys([*reasons, processors(results)]) if told]


def processors(results: pd.DataFrame) -> str:
    """That speeds and times are of several processors; "" if they are not, or it is not known."""
    told = []
    for column, what in (("processor", "rendering was timed"), ("fit_processor", "models were trained")):
        names = distinct_processors(results, column)
        if len(names) > 1:
            told.append(f"{what} on {' and on '.join(names)}")
    return f"Several processors: {'; '.join(told)}. Compare times of one." if told else ""


def distinct_processors(results: pd.DataFrame, column: str) -> list[str]:
    """Those that a column names. What runs without native kernels does not name their instruction set."""
    every = [str(name) for name in results[column].dropna().unique()] if column in results else []
    return [name for name in every if not any(other.startswith(f"{name},") for other in every)]


def left_out(superseded: pd.DataFrame | None) -> str:
    """How many rows the tables leave out for others of the same model; "" if none."""
    count = 0 if superseded is None else len(superseded)
    if not count:
        return ""
    rows = "1 row" if count == 1 else f"{count} rows"
    verb = "is" if count == 1 else "are"
    return f"{rows} of older versions of the same models {verb} left out."


def _readable(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """A table as people read it, and remarks to stand under it."""
    if is_results(table):
        return shown(table), notes(table)
    if "reason" not in table:
        return table, []
    # Why metrics are missing is told once instead of in every row.
    told = (part for reason in table["reason"] if not absent(reason) for part in reason.split("; "))
    ranked = [name for name in table.columns if name in COLUMNS and COLUMNS[name].better]
    nowhere = [name for name in ranked if table[name].isna().all()]
    return table.drop(columns=["reason", *nowhere]), list(dict.fromkeys(part for part in told if part))


def _status(row: Any) -> str:
    status, stale = row
    return f"{status} (stale)" if not absent(stale) and stale else str(status)


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Per dataset and method: means over scenes of quality and FPS, sums of size and time, maximum of memory.

    Several seeds are averaged after that, and ``psnr_std`` is their spread. Composed rows do not take part.
    ``jobs`` names the rows' jobs. A set is complete if every scene that `results` knows of this dataset (at
    this preset and split) is "ok" for every seed of the method; all numbers of an incomplete set are missing,
    and ``note`` says why.
    """
    import pandas as pd

    basic = results[results["kind"] == "basic"]
    rows: list[dict[str, Any]] = []
    for keys, group in basic.groupby(_KEYS, dropna=False, sort=False):
        row: dict[str, Any] = dict(zip(_KEYS, keys, strict=True))
        same = (basic["dataset"] == row["dataset"]) & (basic["preset"] == row["preset"])
        wanted = set(basic.loc[same & (basic["split"] == row["split"]), "scene"])
        good = group[group["status"] == "ok"]
        seeds = sorted(set(group["seed"].dropna()))
        lacking = [
            (s, seed) for seed in seeds for s in sorted(wanted - set(good.loc[good["seed"] == seed, "scene"]))
        ]
        row["scenes"] = f"{len(wanted) - len({s for s, _ in lacking})} of {len(wanted)}"
        row["seeds"], row["complete"] = len(seeds), not lacking
        row["stale"] = bool(group["stale"].fillna(False).any())
        row["note"] = _note(group, lacking)
        row["jobs"] = tuple(str(job) for job in good["job"].dropna()) if not lacking else ()
        per_seed = [good[good["seed"] == seed] for seed in seeds] if not lacking else []
        for names, how in ((_MEAN, "mean"), (_SUM, "sum"), (_MAX, "max")):
            for name in names:
                values = [_reduce(part[name], how) for part in per_seed]
                known = values and all(value is not None for value in values)
                row[name] = (
                    sum(value for value in values if value is not None) / len(values) if known else None
                )
        psnr = [_reduce(part["psnr"], "mean") for part in per_seed]
        row["psnr_std"] = float(pd.Series(psnr).std()) if len(psnr) > 1 and None not in psnr else None
        rows.append(row)
    columns = [
        *_KEYS,
        "scenes",
        "seeds",
        "complete",
        *_MEAN,
        "psnr_std",
        *_SUM,
        *_MAX,
        "stale",
        "note",
        "jobs",
    ]
    table = pd.DataFrame(rows, columns=columns)
    numbers = [*_MEAN, "psnr_std", *_SUM, *_MAX]
    table[numbers] = table[numbers].astype("Float64")
    return table


def _reduce(values: pd.Series, how: str) -> float | None:
    """Of one set; None if any is missing."""
    if values.empty or values.isna().any():
        return None
    return float(values.astype(float).agg(how))


def _note(group: pd.DataFrame, lacking: list[tuple[Any, Any]]) -> str:
    told = []
    for scene in dict.fromkeys(scene for scene, _ in lacking):
        status = group.loc[(group["scene"] == scene) & (group["status"] != "ok"), "status"]
        told.append(f"{scene}: {status.iloc[0] if len(status) else 'not run'}")
    return "incomplete, no average: " + "; ".join(told) if told else ""


UNDECIDED = 3
"""Mark of a value that is not ranked: the interval of its paired difference contains zero."""
UNDECIDED_SIGN = "\N{ALMOST EQUAL TO}"
UNDECIDED_NOTE = (
    f"{UNDECIDED_SIGN}: not ranked against each other: the 95 % interval of their paired difference over "
    "views contains zero."
)


def ranks(results: pd.DataFrame, views: pd.DataFrame | None = None) -> dict[tuple[Any, str], int]:
    """(row label, column) -> 1 for the best and 2 for the second best, where several methods share a scene.

    Only finished rows compete; equal values as shown share a rank. A quality metric is ranked by its mean
    over views only as far as these views say so: where the interval of the paired difference to the leading
    value contains zero, both are marked :data:`UNDECIDED` and nothing after them is marked.

    Args:
        results: the documented table, or its :func:`summary`.
        views: the documented table; without it (or where it lacks a row's job) means alone decide.
    """
    places: dict[tuple[Any, str], int] = {}
    by = [c for c in ("dataset", "scene", "kind", "preset", "split", "seed") if c in results]
    if results.empty or not by or not {"status", "complete"} & set(results.columns):
        return places
    measured = Views(views) if views is not None and not views.empty else None
    for _, group in results.groupby(by, dropna=False, sort=False):
        rivals = group[group["complete"]] if "complete" in group else group[group["status"] == "ok"]
        for name, column in COLUMNS.items():
            if not column.better or name not in rivals:
                continue
            values = rivals[name].dropna()
            texts = {index: column.write(value) for index, value in values.items()}
            order = sorted(values.index, key=lambda index: -column.better * float(values[index]))
            if len(values) < 2 or len(set(texts.values())) < 2:
                continue
            samples: dict[Any, Sample | None] = dict.fromkeys(order)
            if measured is not None and name in METRICS:
                samples = {index: measured.sample(_jobs(rivals.loc[index]), name) for index in order}
            apart = partial(told_apart, samples, column.better)
            for index, place in standing(order, texts, apart).items():
                places[index, name] = place
    return places


def standing(order: list[Any], texts: dict[Any, str], apart: Callable[[Any, Any], bool]) -> dict[Any, int]:
    """Places of rows that are ordered from the best.

    Args:
        order: the rows.
        texts: their values as shown; equal ones share a place.
        apart: whether a row and one after it can be told apart.
    """
    places: dict[Any, int] = {}
    rest = order
    for place in (1, 2):
        leaders = [index for index in rest if texts[index] == texts[rest[0]]]
        rest = rest[len(leaders) :]
        near = [index for index in rest if not all(apart(leader, index) for leader in leaders)]
        places |= dict.fromkeys([*leaders, *near], UNDECIDED if near else place)
        if near or not rest:
            break
    return places


def told_apart(samples: Mapping[Any, Sample | None], better: int, first: Any, second: Any) -> bool:
    """Whether views say too that the first is better; where they are not at hand it is taken as it is.

    Args:
        samples: of all rows.
        better: 1 if more is, -1 if less is.
        first: the row whose mean is better.
        second: the other.
    """
    a, b = samples[first], samples[second]
    if a is None or b is None:
        return True
    difference = a.minus(b)
    return difference is None or difference.lies(better)


def _jobs(row: Any) -> list[str]:
    """Of a row of `results` or its summary."""
    return list(row["jobs"]) if "jobs" in row else [str(row["job"])]


def cell(name: str, value: Any) -> str:
    """One value as text in the column's unit; an en dash if it is missing."""
    if absent(value):
        return MISSING
    column = COLUMNS.get(name)
    if column is not None:
        return column.write(value)
    return _significant(value) if isinstance(value, float) else str(value)


def title(name: str) -> str:
    """A column's header."""
    return COLUMNS[name].title if name in COLUMNS else name.replace("_", " ").capitalize()


def to_csv(table: pd.DataFrame) -> str:
    """All columns with raw values; missing is empty.

    Numbers are written as Python does: NumPy's text has fewer digits once any library in the process has set
    its print options (colour-science does).
    """
    import pandas as pd

    plain = table.copy()
    for name in plain.columns:
        if plain[name].dtype.kind == "f":
            values = [None if absent(value) else float(value) for value in plain[name]]
            plain[name] = pd.Series(values, plain.index, dtype=object)
    return plain.to_csv(index=False, lineterminator="\n")


def to_markdown(table: pd.DataFrame, views: pd.DataFrame | None = None, remark: str = "") -> str:
    """A pipe table; the best value in bold, the second in italics. `results` is cut to what people read.

    Args:
        table: `results` or any other.
        views: what :func:`ranks` asks.
        remark: to stand under it, besides those that follow from its rows.
    """
    marks = ranks(table, views)
    table, remarks = _readable(table)
    remarks += [remark] if remark else []
    lines = ["| " + " | ".join(_md(title(name)) for name in table.columns) + " |"]
    lines.append("|" + "|".join("---:" if _right(name) else "---" for name in table.columns) + "|")
    for index, row in table.iterrows():
        texts = []
        for name in table.columns:
            mark = marks.get((index, name), 0)
            sign = {1: "**", 2: "*"}.get(mark, "")
            near = f" {UNDECIDED_SIGN}" if mark == UNDECIDED else ""
            texts.append(f"{sign}{_md(cell(name, row[name]))}{sign}{near}")
        lines.append("| " + " | ".join(texts) + " |")
    if UNDECIDED in marks.values():
        remarks.append(UNDECIDED_NOTE)
    lines += [f"\n{_md(remark)}" for remark in remarks]
    return "\n".join(lines) + "\n"


def to_latex(table: pd.DataFrame, views: pd.DataFrame | None = None, remark: str = "") -> str:
    """With booktabs; the best value bold, the second underlined. `results` is cut to what is read.

    `results` becomes a longtable, which breaks across pages, any other table a tabular.

    Args:
        table: `results` or any other.
        views: what :func:`ranks` asks.
        remark: to stand under it, besides those that follow from its rows.
    """
    marks = ranks(table, views)
    results = is_results(table)
    notes = [UNDECIDED_NOTE] if UNDECIDED in marks.values() else []
    notes += _unfinished(table) if results else []
    table, remarks = _readable(table)
    notes += [*remarks, *([remark] if remark else [])]
    if results:
        table = table.drop(columns="reason", errors="ignore")
    spec = "".join("r" if _right(name) else "l" for name in table.columns)
    head = [r"\toprule", " & ".join(tex(title(name)) for name in table.columns) + r" \\", r"\midrule"]
    if results:
        lines = [r"% needs \usepackage{booktabs,longtable}; wide: landscape, small type"]
        lines += [rf"\begin{{longtable}}{{{spec}}}", *head, r"\endhead", r"\bottomrule", r"\endfoot"]
    else:
        lines = [r"% needs \usepackage{booktabs}", rf"\begin{{tabular}}{{{spec}}}", *head]
    for index, row in table.iterrows():
        texts = []
        for name in table.columns:
            text = tex(cell(name, row[name]))
            mark = marks.get((index, name), 0)
            if mark == UNDECIDED:
                text += r"\rlap{$^{\approx}$}"  # takes no width, so the digits stay aligned
            macro = {1: "textbf", 2: "underline"}.get(mark)
            texts.append(f"\\{macro}{{{text}}}" if macro else text)
        lines.append(" & ".join(texts) + r" \\")
    lines += [r"\end{longtable}"] if results else [r"\bottomrule", r"\end{tabular}"]
    return "\n".join([*lines, *tex_notes(notes)]) + "\n"


def _unfinished(results: pd.DataFrame) -> list[str]:
    """Of each row that did not finish, why."""
    return [
        f"{row['dataset']}, {row['scene']}, {label(row['method'], row['variant'], row['rate'])}: "
        f"{row['status']}{'' if absent(row['reason']) else f' ({row.reason})'}"
        for _, row in results[results["status"] != "ok"].iterrows()
    ]


def tex_notes(notes: Iterable[str]) -> list[str]:
    """What stands below a LaTeX table, a paragraph each."""
    return [rf"\par\noindent{{\footnotesize {tex(note)}\par}}" for note in notes]


_FIRST_TO_GO = (
    "reason", "load_seconds", "peak_device_bytes", "peak_host_bytes", "primitives", "delta_e_uv", "psnr_fg",
)  # fmt: skip
_GAP = 2


def terminal_rows(results: pd.DataFrame, width: int) -> list[list[str]]:
    """Header and lines of the table that ends a run.

    Where the columns do not fit ``width`` characters, those that people miss least are left out (the
    reasons are told below the table anyway): a number cut short is worse than none.
    """
    table = shown(results)
    texts = {
        name: ["" if name == "reason" and absent(value) else cell(name, value) for value in table[name]]
        for name in table.columns
    }
    for name in _FIRST_TO_GO:
        if sum(least_width(title(n), cells) + _GAP for n, cells in texts.items()) - _GAP <= width:
            break
        texts.pop(name, None)
    return [[title(name) for name in texts], *map(list, zip(*texts.values(), strict=True))]


def least_width(header: str, cells: list[str]) -> int:
    """Characters that a column needs: a header can be broken between words, cells cannot."""
    return max(map(len, [*header.split(), *cells]))


def _right(name: str) -> bool:
    return name in COLUMNS and COLUMNS[name].write is not str


def _md(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("\n", " ")


_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\n": " ", "Δ": r"$\Delta$",
    "±": r"$\pm$", MISSING: "--",
    "\N{MINUS SIGN}": "$-$",
    "*": r"$^{*}$", UNDECIDED_SIGN: r"$\approx$", "\N{MULTIPLICATION SIGN}": r"$\times$",
}  # fmt: skip


def tex(text: str) -> str:
    """Text with what LaTeX would take for commands escaped."""
    return "".join(_TEX.get(sign, sign) for sign in text)
