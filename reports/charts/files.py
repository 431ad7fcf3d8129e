"""Charts as files for papers: SVG and PDF.

Run as a program, it reads paths of SVG files, a JSON text on a line each, and writes the PDF of each beside
it.
"""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from econgs_bench.reports.charts.chart import Chart


@contextmanager
def output(folder: Path) -> Iterator[Callable[[Mapping[str, Chart]], None]]:
    """Yield a function that writes charts (name -> chart) as NAME.svg and NAME.pdf, fonts embedded.

    A chart that no page of paper holds becomes NAME-1.svg, NAME-2.svg and so on. Another process makes the
    PDF files meanwhile; all are there when the context ends.

    Args:
        folder: folder of the files; it is created if it does not exist and there is a chart.

    Raises:
        RuntimeError: a chart cannot be converted. The message holds the converter's own.
    """
    from econgs_bench.reports.charts import svg

    # By its path: by its name, a folder `reports/` in the working directory would be run instead.
    command = [sys.executable, "-P", __file__]
    with ExitStack() as stack:
        processes: list[subprocess.Popen[str]] = []

        def write(charts: Mapping[str, Chart]) -> None:
            for name, chart in _pages(charts, folder):
                if not processes:
                    folder.mkdir(parents=True, exist_ok=True)
                    child = subprocess.Popen(
                        command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8"
                    )
                    processes.append(stack.enter_context(child))
                path = folder / f"{name}.svg"
                path.write_text(svg.file(chart), encoding="utf-8")
                with suppress(BrokenPipeError):  # its message follows at the end
                    print(json.dumps(str(path.resolve())), file=processes[0].stdin, flush=True)

        try:
            yield write
        except BaseException:
            for process in processes:
                process.kill()
            raise
        for process in processes:
            _, message = process.communicate()
            if process.returncode:
                raise RuntimeError(f"the charts in {folder} cannot be converted to PDF: {message.strip()}")


def _pages(charts: Mapping[str, Chart], folder: Path) -> Iterator[tuple[str, Chart]]:
    """The charts in parts that a page holds (:func:`.reports.charts.svg.pages`); earlier files go."""
    from econgs_bench.reports.charts import svg

    for name, chart in charts.items():
        earlier = re.compile(rf"{re.escape(name)}(-\d+)?\.(svg|pdf)")
        for path in folder.glob(f"{name}*"):
            if earlier.fullmatch(path.name):
                path.unlink()
        pages = svg.pages(chart.panels)
        for number, panels in enumerate(pages, 1):
            part = dataclasses.replace(chart, panels=panels)
            yield (name if len(pages) == 1 else f"{name}-{number}"), part


def pdf(document: str) -> bytes:
    """An SVG document as PDF, the same bytes every time.

    The converter lists the resources of a page in no fixed order; sorting keeps all lengths and offsets.
    """
    import vl_convert

    content = vl_convert.svg_to_pdf(document)
    lists = rb"( +/\w+ \d+ 0 R\n)+"
    return re.sub(lists, lambda lines: b"".join(sorted(lines[0].splitlines(keepends=True))), content)


if __name__ == "__main__":
    for line in sys.stdin:
        file = Path(json.loads(line))
        file.with_suffix(".pdf").write_bytes(pdf(file.read_text(encoding="utf-8")))
