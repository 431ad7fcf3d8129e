"""The report: one HTML file that needs no network, with the same charts and tables beside it as files."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reports import datasets
from reports.chart_sections import Section, chart_sections
from reports.files import write_files, write_text
from reports.panels import DELTA_E_MAX, Panel, panels, scale
from reports.style import MISSING, absent, color, label, mib, seconds, series
from reports.tables import (
    COLUMNS,
    cell,
    quality,
    ranks,
    summary,
    title,
)

if TYPE_CHECKING:
    import pandas as pd

PICTURE_BYTES = 4_500_000
"""Room for example pictures; with the chart library (4.8 MB) the page stays under 10 MB."""
_HERE = Path(__file__).parent


def write_report(tables: dict[str, pd.DataFrame], root: Path, out: Path) -> Path:
    """Write the report.

    Beside it go the files of :func:`reports.files.write_files`.

    Args:
        tables: results, views, curve, ledger, timing, features and dvr as documented in docs/architecture.md.
        root: run store that the picture paths in ``views`` are relative to.
        out: the HTML file.

    Returns:
        ``out``.
    """
    results = tables["results"]
    sections = chart_sections(tables)
    body = [
        _head(tables, sections),
        _results(results, tables["views"]),
        _scenes(tables, root),
        *(f'<h2 id="{part.anchor}">{escape(part.title)}</h2>\n{part.html}' for part in sections),
        datasets.section(tables["dvr"]),
        _provenance(results),
    ]
    write_files(tables, out.parent)
    write_text(out, _document(_name(tables["dvr"] if results.empty else results), "\n".join(body)))
    return out


def _document(name: str, body: str) -> str:
    from plotly.offline import get_plotlyjs

    css, js = ((_HERE / file).read_text(encoding="utf-8") for file in ("page.css", "page.js"))
    plotly = f"<script>{get_plotlyjs()}</script>\n<script>{js}</script>" if "data-figure" in body else ""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(name)}</title>\n<style>\n{css}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        f"{plotly}\n</body>\n</html>\n"
    )


def _name(results: pd.DataFrame) -> str:
    datasets = _listed(results, "dataset")
    return f"Benchmark report: {datasets}" if datasets else "Benchmark report"


def _scene_count(results: pd.DataFrame) -> str:
    kinds = results[["dataset", "scene", "kind"]].drop_duplicates()["kind"].value_counts()
    composed = f" and {kinds['composed']} composed" if "composed" in kinds else ""
    return f"{kinds.get('basic', 0)}{composed}"


def _listed(results: pd.DataFrame, column: str) -> str:
    """The different values of a column, in order."""
    return ", ".join(str(value) for value in results[column].dropna().unique() if str(value))


# --------------------------------------------------------------------------- summary


def _head(tables: dict[str, pd.DataFrame], sections: list[Section]) -> str:
    results, dvr = tables["results"], tables["dvr"]
    if results.empty:
        if not dvr.empty:
            return f"<h1>{escape(_name(dvr))}</h1>"
        return (
            "<h1>Benchmark report</h1><p>The run store holds no results yet. "
            "<code>bench run quick</code> makes some.</p>"
        )
    sizes = {
        f"{w} \N{MULTIPLICATION SIGN} {h}"
        for w, h in zip(results["width"], results["height"], strict=True)
        if not absent(w)
    }
    facts = [
        ("Methods", ", ".join(series(results))),
        ("Datasets", _listed(results, "dataset")),
        ("Scenes", _scene_count(results)),
        ("Preset, split", f"{_listed(results, 'preset')}, {_listed(results, 'split')}"),
        ("Image size", ", ".join(sorted(sizes)) or MISSING),
        ("Training views", _listed(results, "train_views") or MISSING),
        ("Seeds", _listed(results, "seed")),
        ("Machine", f"{_listed(results, 'machine')} ({_listed(results, 'device')})"),
    ]
    cards = "".join(f'<div class="fact"><span>{escape(k)}</span><b>{escape(v)}</b></div>' for k, v in facts)
    counts = results["status"].value_counts()
    tags = " ".join(
        f'<span class="tag {"ok" if status == "ok" else "bad"}">{count} {escape(str(status))}</span>'
        for status, count in counts.items()
    )
    stale = int(results["stale"].fillna(False).astype(bool).sum())
    if stale:
        tags += f' <span class="tag stale">{stale} stale</span>'
    links = "".join(
        f'<a href="#{anchor}">{escape(text)}</a>'
        for anchor, text in (
            ("results", "Results"),
            ("scenes", "Scenes"),
            *((part.anchor, part.title) for part in sections),
            *([] if dvr.empty else [("datasets", "Rendering the volumes")]),
            ("provenance", "Provenance"),
        )
    )
    return f'<h1>{escape(_name(results))}</h1><p>{tags}</p><nav>{links}</nav><div class="facts">{cards}</div>'


# --------------------------------------------------------------------------- results


def _results(results: pd.DataFrame, views: pd.DataFrame) -> str:
    if results.empty:
        return ""
    metrics = quality(results)
    columns = [
        *metrics,
        "size_bytes",
        "primitives",
        "train_seconds",
        "load_seconds",
        "fps",
        "peak_host_bytes",
    ]
    if results["peak_device_bytes"].notna().any():
        columns.append("peak_device_bytes")
    axes = [a for a in ("kind", "preset", "split", "seed", "device") if results[a].nunique(dropna=False) > 1]
    means, names = summary(results), series(results)
    marks, mean_marks = ranks(results, views), ranks(means, views)
    head = "".join(
        f'<th class="{"r" if name in columns else ""}" title="{escape(_doc(name))}">'
        f"{escape(title(name))}</th>"
        for name in ("scene", "method", *axes, "status", *columns)
    )
    lines = []
    for dataset, rows in results.groupby("dataset", sort=False):
        span = len(columns) + len(axes) + 3
        lines.append(f'<tr class="group"><td colspan="{span}">{escape(str(dataset))}</td></tr>')
        order = {scene: i for i, scene in enumerate(rows["scene"].unique())}
        # The methods of a scene stand together, to be compared.
        ordered = rows.sort_values("scene", key=lambda s: s.map(order), kind="stable")
        told: dict[str, list[str]] = {"basic": [], "composed": []}
        for index, row in ordered.iterrows():
            first = f"<td>{escape(str(row['scene']))}</td><td>{_method(row, names)}</td>"
            first += "".join(f"<td>{escape(cell(axis, row[axis]))}</td>" for axis in axes)
            first += f"<td>{_status(row)}</td>"
            cells = _cells(row, columns, marks, index, _reasons(row))
            told[row["kind"]].append(f"<tr>{first}{cells}</tr>")
        lines += told["basic"]
        for index, row in means[means["dataset"] == dataset].iterrows():
            first = f"<td>{'all' if row['complete'] else 'incomplete'} ({escape(row['scenes'])} scenes)</td>"
            first += f"<td>{_method(row, names)}</td>"
            first += "".join(f"<td>{escape(cell(axis, row.get(axis)))}</td>" for axis in axes)
            state = "mean, sum" if row["complete"] else _abbr("no average", row["note"])
            if row["stale"]:
                state += ' <span class="tag stale">stale</span>'
            missing = dict.fromkeys(columns, row["note"] or "missing in some scene")
            cells = _cells(row, columns, mean_marks, index, missing, spread=row["psnr_std"])
            lines.append(f'<tr class="mean">{first}<td>{state}</td>{cells}</tr>')
        lines += told["composed"]
    note = (
        "Quality and FPS of the rows “all” are means over scenes, size and time are sums, memory is the "
        "maximum. Sizes are MiB (2<sup>20</sup> bytes). "
    )
    if (results["kind"] == "composed").any():
        note += (
            "A composed row shows its scenes rendered together, with the sum of their sizes and times; it "
            "is in no mean or sum. "
        )
    if marks or mean_marks:
        note += "Among several methods the <b>best</b> is bold, the <u>second best</u> underlined. "
    if metrics[0] == "ssim":
        note += "LPIPS could not be computed (the reason stands in its cells), so SSIM and FLIP lead. "
    note += 'Files: <a href="results.csv">CSV</a>, <a href="results.md">Markdown</a>, '
    note += '<a href="results.tex">LaTeX</a>, <a href="charts/">charts</a>.'
    return (
        '<h2 id="results">Results</h2><div class="wide"><table class="results">'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
        f'<p class="note">{note}</p>{_failures(results)}'
    )


def _cells(
    row: Any,
    columns: list[str],
    marks: dict[tuple[Any, str], int],
    index: Any,
    reasons: dict[str, str],
    spread: Any = None,
) -> str:
    cells = []
    for name in columns:
        text = escape(cell(name, row[name]))
        if absent(row[name]):
            text = _abbr(MISSING, reasons.get(name) or reasons.get("", "not measured"))
        elif name == "psnr" and not absent(spread):
            text += f" ± {spread:.2f}"
        place = {1: " first", 2: " second"}.get(marks.get((index, name), 0), "")
        cells.append(f'<td class="r{place}">{text}</td>')
    return "".join(cells)


def _reasons(row: Any) -> dict[str, str]:
    """Column -> why it is missing; "" for all others. `reason` lists "metric: why" joined by "; "."""
    text = "" if absent(row["reason"]) else str(row["reason"])
    if row["status"] != "ok":
        return {"": f"{row['status']}: {text}" if text else str(row["status"])}
    parts = (part.partition(": ") for part in text.split("; "))
    return {name: why for name, _, why in parts if name in COLUMNS}


def _doc(name: str) -> str:
    return COLUMNS[name].doc if name in COLUMNS else ""


def _abbr(text: str, why: str) -> str:
    return f'<abbr title="{escape(str(why))}">{escape(text)}</abbr>'


def _method(row: Any, names: list[str]) -> str:
    shade = color(label(row["method"], row["variant"]), names)
    name = escape(label(row["method"], row["variant"], row["rate"])).replace(",", ",<wbr>")
    return f'<span class="dot" style="background:{shade}"></span>{name}'


def _status(row: Any) -> str:
    status = str(row["status"])
    why = "" if absent(row["reason"]) else str(row["reason"])
    tag = (
        f'<span class="tag {"ok" if status == "ok" else "bad"}" title="{escape(why)}">{escape(status)}</span>'
    )
    if not absent(row["stale"]) and row["stale"]:
        tag += ' <span class="tag stale" title="the method\'s source has changed since">stale</span>'
    return tag


def _failures(results: pd.DataFrame) -> str:
    bad = results[results["status"] != "ok"]
    if bad.empty:
        return ""
    names = series(results)
    lines = "".join(
        f"<tr><td>{escape(str(row['dataset']))}</td><td>{escape(str(row['scene']))}</td>"
        f"<td>{_method(row, names)}</td><td>{_status(row)}</td><td>{escape(cell('stage', row['stage']))}</td>"
        f'<td class="wrap">{escape(cell("reason", row["reason"]))}</td></tr>'
        for _, row in bad.iterrows()
    )
    return (
        "<h3>What did not finish</h3>"
        '<div class="wide"><table><thead><tr><th>Dataset</th><th>Scene</th><th>Method</th><th>Status</th>'
        f"<th>Stage</th><th>Reason</th></tr></thead><tbody>{lines}</tbody></table></div>"
    )


# --------------------------------------------------------------------------- scenes


def _scenes(tables: dict[str, pd.DataFrame], root: Path) -> str:
    results, views = tables["results"], tables["views"]
    if results.empty:
        return ""
    examples, left_out = panels(views, root, PICTURE_BYTES)
    names = series(results)
    parts = ['<h2 id="scenes">Scenes</h2>', _scalebar()]
    for (dataset, scene), rows in results.groupby(["dataset", "scene"], sort=False):
        composed = ' <span class="soft">composed</span>' if (rows["kind"] == "composed").any() else ""
        name = f"{escape(str(dataset))} / {escape(str(scene))}{composed}"
        parts.append(f'<section class="scene"><h3>{name}</h3>')
        for _, row in rows.iterrows():
            shown = examples.get(str(row["job"]), [])
            told = f"<p>{_method(row, names)} "
            if row["seed"] and results["seed"].nunique() > 1:
                told += f'<span class="soft">seed {row["seed"]}</span> '
            parts.append(told + ("" if row["status"] == "ok" else _status(row)) + "</p>")
            if shown:
                parts.append(f'<div class="triptychs">{"".join(_triptych(panel) for panel in shown)}</div>')
        parts.append("</section>")
    if left_out:
        parts.append(
            f'<p class="note">{left_out} further example views were left out to keep this file small.</p>'
        )
    return "\n".join(parts)


def _triptych(panel: Panel) -> str:
    values = f"PSNR <b>{cell('psnr', panel.psnr)}</b> dB · SSIM <b>{cell('ssim', panel.ssim)}</b>"
    values += f" · ΔE*uv <b>{cell('delta_e_uv', panel.delta_e)}</b>"
    which = f'<span class="soft">{panel.which}, view {escape(panel.view)}</span>'
    foot = f'<div class="values"><span>{values}</span>{which}</div>'
    if panel.problem:
        return f'<figure class="card"><p class="note">{escape(panel.problem)}</p>{foot}</figure>'
    images = (("ground truth", panel.truth), ("render", panel.render), ("ΔE*uv", panel.difference))
    cells = "".join(
        f'<img src="{source}" alt="{what}"{" class=pixels" if source.startswith("data:image/png") else ""}>'
        for what, source in images
    )
    cells += "".join(f"<span>{what}</span>" for what, _ in images)
    return f'<figure class="card"><div class="triptych">{cells}</div>{foot}</figure>'


def _scalebar() -> str:
    stops = ", ".join("rgb({},{},{})".format(*scale()[i]) for i in range(0, 256, 15))
    return (
        "<p>Worst, median and best view of each model by PSNR. Difference is CIELUV ΔE*<sub>uv</sub>; "
        "about 1 is just noticeable.</p>"
        f'<div class="scalebar"><span>ΔE*uv&nbsp; 0</span><span class="bar" '
        f'style="background:linear-gradient(to right,{stops})"></span>'
        f"<span>{DELTA_E_MAX:.0f} and more</span></div>"
    )


# --------------------------------------------------------------------------- provenance


def _provenance(results: pd.DataFrame) -> str:
    if results.empty:
        return ""
    columns = ("commit", "machine", "device", "threads", "preset", "iterations", "variant")
    keys = ["method", "dataset", *columns]
    lines = []
    names = series(results)
    for _, rows in results.groupby(keys, dropna=False, sort=False):
        row = rows.iloc[0]
        kernel = rows["reference_seconds"].dropna()
        times = f"{kernel.min() * 1e3:.1f} to {kernel.max() * 1e3:.1f} ms" if len(kernel) else MISSING
        cells = [_method(row, names), escape(str(row["dataset"])), _code(row["commit"], 12)]
        cells += [
            escape(cell(name, row[name])) for name in ("machine", "device", "threads", "preset", "iterations")
        ]
        cells += [escape(str(row["variant"])) if row["variant"] else "the preset", times]
        cells += [f"{len(rows)}", seconds(float(rows["group_seconds"].drop_duplicates().fillna(0).sum()))]
        memory = rows["group_peak_host_bytes"].dropna()
        cells.append(f"{mib(float(memory.max()))} MiB" if len(memory) else MISSING)
        lines.append("<tr>" + "".join(f"<td>{text}</td>" for text in cells) + "</tr>")
    heads = ("Method", "Dataset", "Commit", "Machine", "Device", "Threads", "Preset", "Iterations", "Options")
    more = ("Reference kernel", "Rows", "Fit time", "Fit memory")
    head = "".join(f"<th>{text}</th>" for text in (*heads, *more))
    return (
        f'<h2 id="provenance">Provenance</h2><div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
        '<p class="note">The reference kernel is a fixed piece of work timed before and after each '
        "measurement: speeds from different moments or machines can be normalised by it. "
        "All resolved options and software versions stand in the run store's records, the jobs' names in "
        "<code>results.csv</code>.</p>"
    )


def _code(value: Any, digits: int) -> str:
    return MISSING if absent(value) else f"<code>{escape(str(value)[:digits])}</code>"
