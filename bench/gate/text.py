"""The verdict as text, Markdown and JUnit's XML."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from econgs_bench.bench.gate.baseline import Baseline
from econgs_bench.bench.gate.verdict import LEVEL, Finding, Verdict
from econgs_bench.bench.store.store import write_text
from econgs_bench.reports.text import markdown_cell, one_line, xml_text


def lines(verdict: Verdict) -> Iterator[str]:
    """A line per finding, then the summary."""
    for finding in verdict.findings:
        yield one_line(f"{finding.kind:<12}  {finding.cell}: {finding.text}")
    yield f"{verdict.word}: {summary(verdict)}"


def summary(verdict: Verdict) -> str:
    """Counts, and what the gate is able to see."""
    counts = [
        f"{len(verdict.of(kind))} {kind}" for kind in ("worse", "better", "not measured") if verdict.of(kind)
    ]
    parts = [f"{len(verdict.cells)} results", ", ".join(counts) or "nothing differs"]
    if verdict.same or verdict.differ:
        whole = not verdict.differ and not verdict.unknown
        text = f"{'all ' if whole else ''}{verdict.same} models equal the baseline's byte for byte"
        if verdict.differ:
            text += f", {verdict.differ} differ" + (f" ({verdict.elsewhere})" if verdict.elsewhere else "")
        if verdict.unknown:
            text += f", {verdict.unknown} have no files to compare"
        parts.append(text)
    if verdict.unidentified:
        parts.append(f"{verdict.unidentified} without the identity of their truth")
    if verdict.tests:
        parts.append(f"{verdict.tests} comparisons, {100 * LEVEL:g} % chance of any false alarm")
    return "; ".join(parts)


def markdown(verdict: Verdict, baseline: Baseline) -> str:
    """A summary for a comment on a change."""
    sign = {"pass": "✅", "worse": "❌", "not measured": "⚠️"}[verdict.word]
    last = baseline.changes[-1]
    parts = [
        f"### {sign} Quality gate: {verdict.word}",
        f"{markdown_cell(summary(verdict))}.",
        markdown_cell(f"Baseline: {last.reason} ({last.date[:10]}, {last.commit or last.version})."),
    ]
    for kind in ("worse", "not measured", "better", "note"):
        rows = verdict.of(kind)  # type: ignore[arg-type]
        if rows:
            table = "\n".join(f"| {markdown_cell(row.cell)} | {markdown_cell(row.text)} |" for row in rows)
            title = f"{kind.capitalize()} ({len(rows)})"
            table = f"| result | difference |\n|---|---|\n{table}"
            parts.append(
                f"**{title}**\n\n{table}"
                if kind == "worse"
                else f"<details><summary>{title}</summary>\n\n{table}\n\n</details>"
            )
    return "\n\n".join(parts) + "\n"


def write_junit(path: Path, verdict: Verdict) -> None:
    """A test case per result; a loss is a failure, what was not measured is skipped."""
    by_cell = findings_by_cell(verdict)
    suite = ElementTree.Element(
        "testsuite", name="bench gate", tests=str(len(by_cell)),
        failures=str(sum(any(f.kind == "worse" for f in found) for found in by_cell.values())),
    )  # fmt: skip
    for cell, findings in by_cell.items():
        case = ElementTree.SubElement(suite, "testcase", classname="econgs_bench.bench.gate", name=cell)
        worse = [f.text for f in findings if f.kind == "worse"]
        absent = [f.text for f in findings if f.kind == "not measured"]
        if worse:
            ElementTree.SubElement(case, "failure", message=worse[0]).text = "\n".join(worse)
        elif absent:
            ElementTree.SubElement(case, "skipped", message=absent[0])
        others = [f.text for f in findings if f.kind in ("better", "note")]
        if others:
            ElementTree.SubElement(case, "system-out").text = "\n".join(others)
    document = ElementTree.tostring(suite, encoding="unicode", xml_declaration=True)
    write_text(path, xml_text(document) + "\n")


def findings_by_cell(verdict: Verdict) -> dict[str, list[Finding]]:
    """Title of each result, and of each mean over scenes with a finding -> its findings."""
    cells: dict[str, list[Finding]] = {title: [] for title in verdict.cells}
    for finding in verdict.findings:
        cells.setdefault(finding.cell, []).append(finding)
    return cells
