"""Charts as files for papers: SVG and PDF."""

from __future__ import annotations

import re
from pathlib import Path

from reports.charts import svg
from reports.charts.chart import Chart


def write(charts: dict[str, Chart], folder: Path) -> list[Path]:
    """Write charts as NAME.svg and NAME.pdf, fonts embedded; returns the paths of the PDF files.

    Args:
        charts: name -> chart.
        folder: where to; made if it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, chart in charts.items():
        document = svg.file(chart)
        (folder / f"{name}.svg").write_text(document, encoding="utf-8")
        paths.append(folder / f"{name}.pdf")
        paths[-1].write_bytes(_pdf(document))
    return paths


def _pdf(document: str) -> bytes:
    """An SVG document as PDF, the same bytes every time.

    The converter lists the resources of a page in no fixed order; sorting keeps all lengths and offsets.
    """
    import vl_convert

    content = vl_convert.svg_to_pdf(document)
    lists = rb"( +/\w+ \d+ 0 R\n)+"
    return re.sub(lists, lambda lines: b"".join(sorted(lines[0].splitlines(keepends=True))), content)
