"""Charts as files for papers: SVG and PDF.

Run as a program with the paths of SVG files, it writes the PDF of each beside it.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from reports.charts.chart import Chart


@contextmanager
def output(charts: Mapping[str, Chart], folder: Path) -> Iterator[None]:
    """Write charts as NAME.svg and NAME.pdf, fonts embedded; another process makes the PDF files meanwhile.

    Args:
        charts: name -> chart.
        folder: folder of the files; it is created if it does not exist.

    Raises:
        RuntimeError: a chart cannot be converted. The message holds the converter's own.
    """
    from reports.charts import svg

    if not charts:
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    # By its path: by its name, a folder `reports/` in the working directory would be run instead.
    command = [sys.executable, "-P", __file__]
    for name, chart in charts.items():
        path = folder / f"{name}.svg"
        path.write_text(svg.file(chart), encoding="utf-8")
        command.append(str(path.resolve()))
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield
        except BaseException:
            process.kill()
            raise
        _, message = process.communicate()
    if process.returncode:
        raise RuntimeError(f"the charts in {folder} cannot be converted to PDF: {message.strip()}")


def pdf(document: str) -> bytes:
    """An SVG document as PDF, the same bytes every time.

    The converter lists the resources of a page in no fixed order; sorting keeps all lengths and offsets.
    """
    import vl_convert

    content = vl_convert.svg_to_pdf(document)
    lists = rb"( +/\w+ \d+ 0 R\n)+"
    return re.sub(lists, lambda lines: b"".join(sorted(lines[0].splitlines(keepends=True))), content)


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        file = Path(argument)
        file.with_suffix(".pdf").write_bytes(pdf(file.read_text(encoding="utf-8")))
