"""All checks and figures that need a GPU, in one call.

python -m tools.gpu [--out DIR] [--minutes 9] [--device cuda] [--suite FILE]

1. oracle: the tests of the CUDA paths against float64, in a folder of their own.
2. waits: how often a training step of each method makes the host wait for the device, and where.
3. launches: the decoders as they are, and under torch.compile, side by side.
4. runs: a suite at the paper's scale, until the minutes are over. The next call resumes it.

DIR/gpu.json holds the figures as they come, DIR/runs.zip the records of the finished jobs. On a CPU
(``--device cpu``) steps 1 and 2 are left out; that form is for the tests.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
import warnings
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from econgs_bench.bench.machine.provenance import provenance
from econgs_bench.econgs.anchors.decode import decode
from econgs_bench.econgs.anchors.decoders import Decoders
from econgs_bench.econgs.splat import trusted_values
from econgs_bench.methods.contract.scene import tiny_scene
from econgs_bench.methods.interface import Budget
from econgs_bench.methods.options import resolve
from econgs_bench.methods.registry import Registry, load_method

ROOT = Path(__file__).resolve().parents[2]
SUITE = Path(__file__).with_name("suite.toml")
ORACLE = ("tests/econgs", "tests/datasets/test_marcher.py")
STEPS = (60, 80)
"""Between these iterations waits are counted: after the first growth, before the next."""
ANCHORS = 50_000
"""About what a view of ECoNGS at the paper's scale decodes."""
RESERVE = 40.0
"""Seconds kept for the last checkpoint and the bundle."""


class Waits:
    """A monitor of a fit that counts where the host waits for the device.

    Attributes:
        places: "file:line" -> number of waits between the iterations of :data:`STEPS`.
    """

    def __init__(self) -> None:
        self.places: Counter[str] = Counter()

    def progress(self, iteration: int, losses: Any, primitives: int) -> None:
        if iteration in STEPS:
            torch.cuda.set_sync_debug_mode("warn" if iteration == STEPS[0] else "default")

    def due(self, iteration: int) -> bool:
        return False

    def pause(self, *_: Any) -> None: ...

    def stage(self, name: str) -> None: ...

    def note(self, message: Any, category: Any, filename: str, line: int, *_: Any) -> None:
        """Take the place of ``warnings.showwarning``."""
        if "synchroniz" in str(message):
            self.places[f"{filename.removeprefix(f'{ROOT}/')}:{line}"] += 1


def oracle(folder: Path) -> dict[str, int]:
    """Numbers of tests that passed, failed and were skipped."""
    report = folder / "oracle.xml"
    command = [sys.executable, "-P", "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={report}"]
    subprocess.run(
        [*command, *ORACLE, "-k", "cuda or gsplat"], cwd=ROOT, env=os.environ | {"CI": ""}, check=False
    )
    (suite,) = ElementTree.parse(report).getroot().iter("testsuite")
    total, failed, skipped = (
        sum(int(suite.attrib[name]) for name in names)
        for names in (("tests",), ("failures", "errors"), ("skipped",))
    )
    return {"passed": total - failed - skipped, "failed": failed, "skipped": skipped}


def waits(device: str) -> dict[str, dict[str, float]]:
    """Method -> place -> waits of one training step there."""
    registry, found = Registry(), {}
    for name in registry.names():
        spec = registry.spec(name)
        if "cuda" not in spec.devices:
            continue
        method, monitor = load_method(spec), Waits()
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.showwarning = monitor.note
            group = [tiny_scene("a", volume="transfer")]
            options = resolve(spec, "quick", {}).options
            method.fit(group, options, Budget(STEPS[1] + 20), 0, device, monitor, None)
        torch.cuda.set_sync_debug_mode("default")
        steps = STEPS[1] - STEPS[0]
        found[name] = {place: count / steps for place, count in monitor.places.most_common()}
    return found


def launches(device: str, anchors: int, rounds: int = 5) -> dict[str, float]:
    """Milliseconds of a decoding forward and backward, plain and compiled, in turn; the best counts."""
    generator = torch.Generator().manual_seed(0)
    decoders = Decoders(generator=generator).to(device)
    shapes = ((3,), (decoders.width,), (6,), (decoders.offsets, 3))
    drawn = [torch.rand((anchors, *shape), generator=generator).to(device) for shape in shapes]
    rest = [torch.rand(n, generator=generator).to(device) for n in (decoders.embedding, 3)]

    def run(way: Callable[..., Any]) -> float:
        inputs = [one.requires_grad_() for one in (*drawn, *rest)]
        begin = time.perf_counter()
        decoded = way(*inputs[:4], decoders, *inputs[4:], (0.0, 0.0, 3.0), backend="torch")
        sum(one.sum() for one in (decoded.means, decoded.quats, decoded.scales, decoded.colors)).backward()
        if device != "cpu":
            torch.cuda.synchronize(device)
        return 1e3 * (time.perf_counter() - begin)

    with trusted_values():
        backend = "eager" if device == "cpu" else "inductor"
        ways = {"plain": decode, "compiled": torch.compile(decode, backend=backend)}
        for way in ways.values():
            run(way)
        times = [{name: run(way) for name, way in ways.items()} for _ in range(rounds)]
    return {name: min(one[name] for one in times) for name in ways}


def runs(suite: Path, store: Path, device: str, end: float) -> int:
    """Run a suite until a time of the monotonic clock; the exit code of ``bench run``."""
    command = [sys.executable, "-P", "-m", "econgs_bench.bench", "run", str(suite), "--device", device]
    process = subprocess.Popen([*command, "--out", str(store), "--no-report"])
    try:
        return process.wait(max(1.0, end - time.monotonic()))
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        return process.wait(RESERVE)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("gpu"), help="default: gpu")
    parser.add_argument("--minutes", type=float, default=9.0, help="of all steps (default: 9)")
    parser.add_argument("--device", default="cuda", help="cuda, cuda:<number> or cpu (default: cuda)")
    parser.add_argument(
        "--anchors", type=int, default=ANCHORS, help=f"of the decoders' step (default: {ANCHORS})"
    )
    parser.add_argument("--suite", type=Path, default=SUITE, help="default: that at the paper's scale")
    options = parser.parse_args()
    end = time.monotonic() + 60.0 * options.minutes
    if options.device != "cpu" and not torch.cuda.is_available():
        print(
            f"torch {torch.__version__} finds no CUDA device: see its driver with nvidia-smi", file=sys.stderr
        )
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {"machine": provenance(1, None, options.device).model_dump(mode="json")}
    steps: dict[str, Callable[[], Any]] = {
        "oracle": lambda: oracle(options.out),
        "waits": lambda: waits(options.device),
        "launches": lambda: launches(options.device, options.anchors),
        "runs": lambda: runs(options.suite, options.out / "runs", options.device, end - RESERVE),
    }
    for name, step in steps.items():
        if options.device == "cpu" and name in ("oracle", "waits"):
            continue
        begin = time.monotonic()
        try:
            figures[name] = step()
        except Exception as error:  # the others still count
            figures[name] = {"error": f"{type(error).__name__}: {error}"}
        print(f"{name}: {figures[name]}, {time.monotonic() - begin:.0f} s", flush=True)
        (options.out / "gpu.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    bundle = [sys.executable, "-P", "-m", "econgs_bench.bench", "bundle", "--runs", str(options.out / "runs")]
    subprocess.run([*bundle, "--out", str(options.out / "runs.zip")], check=False)
    broken = any(isinstance(one, dict) and "error" in one for one in figures.values())
    return int(broken or figures["runs"] not in (0, 130) or bool(figures.get("oracle", {}).get("failed")))


if __name__ == "__main__":
    sys.exit(main())
