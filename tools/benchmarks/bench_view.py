"""Frames a second of `bench view` while the mouse drags, and the time to full quality after it.

python -m tools.benchmarks.bench_view --runs DIR JOB... [--size N] [--seconds N]

In headless Chromium without a graphics card.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import threading
import time
from pathlib import Path

from econgs_bench.bench.view.server import Server, Viewer
from econgs_bench.bench.view.sources import found
from tests.reports.page.browser import Browser

_SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_REST = "document.body.dataset.settled !== undefined"
_TURNS = 5


def main() -> None:
    """Print a line for each model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="store that holds the models")
    parser.add_argument("jobs", nargs="+", metavar="JOB", help="encode jobs")
    parser.add_argument("--size", default="400", help="of the picture: 200, 400, 800 or window")
    parser.add_argument("--seconds", type=float, default=2.0, help="that the mouse drags")
    options = parser.parse_args()
    shown = found(options.jobs, options.runs, (), "cpu")
    with Server(Viewer(shown)) as server, tempfile.TemporaryDirectory() as profile:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with Browser(Path(profile), *_SOFTWARE) as page:
                page.emulate(1200, 900)
                page.open(server.address)
                page.until(_REST)
                _choose(page, "size", options.size)
                print(f"{'FPS':>5} {'share of the size':>18} {'full quality [s]':>17}")
                for place, source in enumerate(shown):
                    _choose(page, "left", place)
                    page.until(f"bench.source(0) === {place} && {_REST}")
                    _measure(page, 0.5)
                    rows = [_measure(page, options.seconds) for _ in range(_TURNS)]
                    fps, share, rest = (statistics.median(values) for values in zip(*rows, strict=True))
                    print(f"{fps:5.1f} {share:18.2f} {rest:17.2f}  {source.label}", flush=True)
        finally:
            server.shutdown()


def _choose(page: Browser, control: str, value: object) -> None:
    page.run(
        f"document.getElementById('{control}').value = '{value}';"
        f"document.getElementById('{control}').dispatchEvent(new Event('change'))"
    )


def _measure(page: Browser, seconds: float) -> tuple[float, float, float]:
    """Frames a second of a drag, their last share of the size, and seconds from its end to full quality."""
    x, y = page.run(
        "(() => { const r = document.getElementById('canvas').getBoundingClientRect();"
        "return [r.x + r.width / 2, r.y + r.height / 2]; })()"
    )
    held = {"button": "left", "buttons": 1, "clickCount": 1}
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **held)
    before, start = page.run("bench.frames()"), time.perf_counter()
    step = 0
    while time.perf_counter() - start < seconds:
        step += 1
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + step % 60, y=y + step % 40, **held)
        time.sleep(0.02)
    frames, end = page.run("bench.frames()") - before, time.perf_counter()
    share = page.run("bench.share()")
    page.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, **held)
    page.run(
        f"new Promise((done) => {{ const look = () => {_REST} && done(); look();"
        "new MutationObserver(look).observe(document.body, {attributes: true}); })"
    )
    return frames / (end - start), share, time.perf_counter() - end


if __name__ == "__main__":
    main()
