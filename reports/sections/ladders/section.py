"""The page's section on ladders: where each method fails first, every rung with its pictures, and flicker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

from econgs_bench.reports import markup
from econgs_bench.reports.pictures.files import thumbnail
from econgs_bench.reports.schema import COLUMNS, COVERAGE, records
from econgs_bench.reports.sections.ladders import breaks as ladder_files
from econgs_bench.reports.sections.ladders import strips
from econgs_bench.reports.sections.ladders.chart import KINDS, anchor, kind_of, ladder_chart
from econgs_bench.reports.sections.ladders.conclusion import by_method, contrasts, flickering, title, verdict
from econgs_bench.reports.sections.ladders.table import EXPLOSION, LOSS, Row, climbed, held, of_report
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import MISSING, absent, label, signed
from econgs_bench.reports.tables.table import html_table

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


PICTURE_BYTES = 1_500_000
"""Most bytes of pictures on the page."""
_WORDS = (
    "A ladder leads from the usual run to one that no method may survive. A field is a rung above the "
    "usual run: green where it holds, else in the color of its break; of several scenes the gravest "
    f"counts. A rung breaks where a step fails or where, against the usual run, PSNR falls by {LOSS:g} dB "
    "(quality), a fifth of the truth's alpha more is missing (vanishing parts; more than half of it: "
    f"collapse) or in excess (floaters), or there are more than {EXPLOSION:g} times the primitives "
    "(explosion). Where a rung has other test pictures, its fall is that of the distance to the best method. "
    "Names lead to the details."
)
_LADDER = ("ladder", "preset", "split", "requested_views")


def section(page: Page) -> Section | None:
    """The heat map of all ladders and methods; None without ladders."""
    climbs = climbed(of_report(page.report))
    if not climbs:
        return None
    chart = ladder_chart(climbs)
    files = {"ladders.csv": "all rungs"}
    answer = contrasts(climbs)
    return Section("ladders", "Where methods break", answer, _WORDS, {"ladders": chart}, files=files)


def breaks(page: Page) -> Section | None:
    """Breaks by method, rungs by ladder, and flicker; None without ladders."""
    report, folder = page.report.whole, page.folder
    climbs = climbed(of_report(report))
    if folder is None or not climbs:
        return None
    views = strips.views_of_jobs(report.table("rung_views"))
    rows = records(of_report(report))
    methods = by_method(climbs)
    found = {name: ladder_files.breaks_of(own, rows, views, page.root) for name, own in methods.items()}
    parts = ["<h3>Methods</h3>"]
    if any(found.values()):
        parts.append(f'<p class="note">Pictures of breaks: {ladder_files.RULE}</p>')
    parts += [_method(own, climbs, found[name], folder) for name, own in methods.items()]
    parts += ["<h3>Ladders</h3>", *_ladders(rows, climbs, views, page.root)]
    parts += _flicker(rows, views, page.root, folder)
    return Section("breaks", "Where each method fails first", html="\n".join(parts))


def _method(
    own: Sequence[Row], climbs: Sequence[Row], breaks: Sequence[ladder_files.Break], charts: Path
) -> str:
    """A method's ladders, the one on which it breaks first ahead, and files with pictures of its breaks."""
    heads = ["Ladder", "What gets harder", "Rungs that hold", "Breaks at", "Scene", "Break"]
    heads += [COLUMNS["change"].header, "Missing [%]", "Excess [%]"]
    rows = [
        [
            f'<a href="#{anchor("ladder", row["ladder"])}">{escape(title(row, climbs))}</a>',
            f'<span class="wrap">{escape(row["purpose"])}</span>',
            f"{held(row)} of {row['rungs'] - 1}",
            *(escape(row[name] or "") or MISSING for name in ("rung", "subject")),
            _kind(row["failure"], row["reason"]) or MISSING,
            MISSING if absent(row["change"]) else signed(row["change"]),
            *(MISSING if absent(row[name]) else f"{100.0 * row[name]:.0f}" for name in COVERAGE),
        ]
        for row in own
    ]
    name = label(own[0]["method"], own[0]["variant"])
    table = html_table(f"Where {name} breaks first", heads, rows)
    if breaks:
        file = anchor("breaks", name)
        ladder_files.write_breaks(breaks, charts, file)
        table += f'<p class="note"><a href="{charts.name}/{file}.png">Pictures of its breaks</a></p>'
    return (
        f'<details id="{anchor("method", name)}"><summary>{escape(verdict(own))}</summary>{table}</details>'
    )


def _kind(failure: Any, reason: Any = None) -> str:
    """A kind of break after a mark of its color; "" without one."""
    if absent(failure):
        return ""
    mark = f'<span class="dot" style="background:{KINDS[kind_of(failure)]}"></span>'
    return mark + (escape(failure) if absent(reason) else markup.hint(failure, reason))


def _ladders(
    rows_of_report: Sequence[Row], climbs: Sequence[Row], views: strips.ViewsOfJobs, root: Path
) -> list[str]:
    """Every rung of every ladder, with the pictures of one scene."""
    ladders: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows_of_report:
        ladders.setdefault(tuple(row[name] for name in _LADDER), []).append(row)
    blocks, seen, room, omitted = [], set(), PICTURE_BYTES, 0
    for rows in ladders.values():
        subjects: dict[str, list[Row]] = {}
        for row in rows:
            subjects.setdefault(row["subject"], []).append(row)
        worst = strips.worst_subject(rows)
        tables = []
        for subject in sorted(subjects, key=lambda name: name != worst):
            pictures = strips.strip(subjects[subject], views, root) if subject == worst else {}
            html = _rungs(subjects[subject], pictures)
            if len(html) > room:
                omitted += 1
                html = _rungs(subjects[subject], {})
            room -= len(html) if pictures else 0
            tables.append(html)
        place = anchor("ladder", rows[0]["ladder"])
        mark = "" if place in seen else f' id="{place}"'
        seen.add(place)
        name = f"<b>{escape(title(rows[0], climbs))}</b>: {escape(rows[0]['purpose'])}"
        blocks.append(f"<details{mark}><summary>{name}</summary>{''.join(tables)}</details>")
    note = (
        "PSNR is the mean over test views and seeds, with its standard deviation where there are several "
        "seeds, and its change against the usual run in parentheses."
    )
    if room < PICTURE_BYTES:
        note += f" {strips.RULE}"
    if omitted:
        note += " This page omits pictures of "
        note += f"{omitted} {'ladder' if omitted == 1 else 'ladders'} to stay small."
    return [f'<p class="note">{note}</p>', *blocks]


def _rungs(rows: Sequence[Row], pictures: Mapping[int, strips.Rung]) -> str:
    """A row per rung and a column per method."""
    methods = list(dict.fromkeys((row["method"], row["variant"]) for row in rows))
    cells = {(row["place"], row["method"], row["variant"]): row for row in rows}
    lines = []
    for place in sorted({row["place"] for row in rows}):
        name = next(row["rung"] for row in rows if row["place"] == place)
        rung = pictures.get(place)
        head = escape(name)
        if rung is not None and rung.truth is not None:
            head += _picture(rung.truth, f"{name}, view {rung.view}: ground truth") + "<small>truth</small>"
        own = []
        for method in methods:
            row = cells.get((place, *method))
            picture = rung.pictures.get(method) if rung is not None else None
            words = f"{name}, view {rung.view}: {label(*method)}" if rung is not None else ""
            own.append(_cell(row, "" if picture is None else _picture(picture, words)))
        lines.append([head, *own])
    subject = rows[0]["subject"]
    several = sorted({rung.view for rung in pictures.values()})
    caption = " \N{MIDDLE DOT} ".join(
        filter(None, [rows[0]["ladder"], subject, f"view {several[0]}" if len(several) == 1 else ""])
    )
    table = html_table(caption, ["Rung", *(label(*method) for method in methods)], lines)
    return table.replace("<table>", '<table class="rungs">', 1)


def _cell(row: Row | None, picture: str) -> str:
    """PSNR, change and break of a rung below its picture."""
    if row is None:
        return MISSING
    broken = not absent(row["failure"])
    style = f' style="--kind:{KINDS[kind_of(row["failure"])]}"' if broken and picture else ""
    spread = "" if absent(row["psnr_std"]) else f" ± {COLUMNS['psnr_std'].text(row['psnr_std'])}"
    text = MISSING if absent(row["psnr"]) else f"{COLUMNS['psnr'].text(row['psnr'])}{spread} dB"
    if row["place"] and not absent(row["change"]):
        text += f" ({signed(row['change'])})"
    kind = _kind(row["failure"], row["reason"])
    return f"<div{style}>{picture}{text}</div>" + (f"<div>{kind}</div>" if kind else "")


def _picture(pixels: NDArray[np.uint8], alt: str) -> str:
    height, width = pixels.shape[:2]
    return (
        f'<img src="{thumbnail(pixels)}" alt="{escape(alt)}" width="{width}" height="{height}" '
        'decoding="async" loading="lazy">'
    )


def _flicker(every: Sequence[Row], views: strips.ViewsOfJobs, root: Path, charts: Path) -> list[str]:
    """Flicker by method and scene, and one pair of frames."""
    rows = [row for row in every if not absent(row["flicker"])]
    amounts: dict[tuple[str, str], dict[str, float]] = {}
    for row in rows:
        scene = f"{row['subject'] or row['dataset'] + '/' + row['scene']} ({row['rung']})"
        amounts.setdefault((row["method"], row["variant"]), {})[scene] = float(row["flicker"])
    if not amounts:
        return []
    scenes = list(dict.fromkeys(scene for own in amounts.values() for scene in own))
    columns = [{name: own[scene] for name, own in amounts.items() if scene in own} for scene in scenes]
    if len(scenes) > 1:
        whole = {name: fmean(own.values()) for name, own in amounts.items() if len(own) == len(scenes)}
        scenes, columns = [*scenes, "mean"], [*columns, whole]
    lines = []
    for name in amounts:
        cells = [
            MISSING if name not in column else _marked(column[name], min(column.values()))
            for column in columns
        ]
        lines.append([escape(label(*name)), *cells])
    text = (
        "Flicker is what the eye sees when the camera moves: how much the error of a picture changes from "
        "one frame to the next, root mean square over pixels and channels, in steps of 1/255; an error that "
        f"stays in place counts nothing. {flickering(amounts)}"
    )
    parts = ['<h3 id="flicker">Flicker</h3>', f"<p>{escape(text)}</p>"]
    parts.append(html_table("Flicker in steps of 1/255, the least in bold", ["Method", *scenes], lines))
    pair = strips.flicker(rows, views, root)
    if pair is not None:
        ladder_files.write_flicker(pair, charts)
        heads = ["Truth", *(label(*name) for name in pair.changes)]
        where = f"{pair.subject}, views {pair.views[0]} and {pair.views[1]}"
        cells = [
            f"{_picture(change, f'{where}: change of error of {label(*name)}')}{pair.amounts[name]:.2f}"
            for name, change in pair.changes.items()
        ]
        caption = (
            f"Change of the error from view {pair.views[0]} to {pair.views[1]} of {pair.subject}, absolute, "
            f"{strips.FACTOR} times: the pair with the largest mean over methods"
        )
        table = html_table(caption, heads, [[_picture(pair.truth, f"{where}: ground truth"), *cells]])
        parts.append(table.replace("<table>", '<table class="rungs">', 1))
    return parts


def _marked(value: float, least: float) -> str:
    text = COLUMNS["flicker"].text(value)
    return f"<b>{text}</b>" if value == least else text
