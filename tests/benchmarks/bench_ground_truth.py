"""What ground truth costs, as Markdown: against VTK, by size, in memory, and how it converges.

    python tests/benchmarks/bench_ground_truth.py [--size 256] [--pixels 400] [--turns 5] [--quick]

What is compared runs in turns (A B A B …) on the same views; cells give the median and, in brackets, the
shortest time, in ms per view. ``--quick`` takes small sizes and two turns: it shows that everything runs, not
how fast. What compositions, isosurfaces and depth enhancement cost: see ``bench_ground_truth_modes.py``.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from datasets.camera import Camera
from datasets.camera_paths import training_cameras
from datasets.ground_truth import probe
from datasets.ground_truth.model import Draw, Layer, MarchSettings
from datasets.ground_truth.reference import ReferenceMarcher
from datasets.memory import peak_host_bytes
from datasets.scene import Light
from datasets.transfer import Bump, TransferFunction
from datasets.volume import Volume

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "datasets"))
import vtk_oracle

LIGHT = Light(model="phong")  # VTK's
VIEWS = 4


def shells(n: int) -> Volume:
    """Wobbling nested shells: much empty space, thin features; made slice by slice."""
    axis = np.linspace(-1.0, 1.0, n, dtype=np.float32)
    y, x = axis[:, None], axis[None, :]
    values = np.empty((n, n, n), dtype=np.float32)
    for z, out in zip(axis, values, strict=True):
        wobble = np.sin(5 * x + 1) * np.cos(4 * y) * np.sin(6 * z + 2) + np.sin(7 * z - 1) * np.cos(
            8 * x - 3 * y
        )
        out[:] = np.clip(1.1 - np.sqrt(x * x + y * y + z * z) + 0.075 * wobble, 0.0, 1.0)
    return Volume("shells", values, (1.0, 1.0, 1.0), (0.0, 1.0), "made here")


def noise(n: int) -> Volume:
    """Noise a few voxels wide."""
    values = gaussian_filter(np.random.default_rng(0).standard_normal((n, n, n), dtype=np.float32), 2.0)
    values -= values.min()
    return Volume("noise", values / values.max(), (1.0, 1.0, 1.0), (0.0, 1.0), "made here")


def transfer(name: str, opacity: float, *ranges: tuple[float, float]) -> TransferFunction:
    bumps = (
        Bump(str(i), low, low + 0.2 * (high - low), high - 0.2 * (high - low), high, (0.9, 0.5, 0.3), opacity)
        for i, (low, high) in enumerate(ranges)
    )
    return TransferFunction(name, tuple(bumps))


NARROW = transfer("narrow", 0.5, (0.55, 0.65))
THIN = transfer("thin", 0.3, (0.3, 0.32), (0.5, 0.52), (0.7, 0.72), (0.9, 0.92))
WIDE = transfer("wide", 0.05, (0.3, 0.9))
DENSE = transfer("wide, dense", 0.2, (0.3, 0.9))
ALL = transfer("all > 0", 0.02, (-0.5, 2.0))


@dataclass(frozen=True)
class Time:
    """Median and shortest of some turns and the least processor time of all threads, in ms."""

    median: float
    shortest: float
    cpu: float

    def __str__(self) -> str:
        digits = 1 if self.median < 20 else 0
        return f"{self.median:.{digits}f} ({self.shortest:.{digits}f})"


def interleaved(works: Sequence[Callable[[], object]], turns: int, views: int = 1) -> list[Time]:
    """Time of each per view, in turns, so that other load falls on all alike; the first turn warms up."""
    taken: list[list[tuple[float, float]]] = [[] for _ in works]
    for turn in range(turns + 1):
        for times, work in zip(taken, works, strict=True):
            start, cpu = time.perf_counter(), time.process_time()
            work()
            if turn:
                spent = time.perf_counter() - start, time.process_time() - cpu
                times.append((1e3 * spent[0] / views, 1e3 * spent[1] / views))
    result = []
    for times in taken:
        wall, cpus = zip(*times, strict=True)
        result.append(Time(statistics.median(wall), min(wall), min(cpus)))
    return result


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def decibels(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """PSNR over premultiplied red, green, blue and alpha."""
    return float(-10.0 * np.log10(np.mean((a.astype(np.float64) - b) ** 2)))


def around(volume: Volume, pixels: int, views: int = VIEWS) -> tuple[Camera, ...]:
    cameras = training_cameras(42, 0.5 * float(np.linalg.norm(volume.extent)), pixels, pixels)
    return tuple(cameras[i % 42] for i in range(3, 3 + views))


def ours(
    volume: Volume, tf: TransferFunction, light: Light | None, step: float = 1.0, leap: bool = True
) -> Draw:
    from datasets.ground_truth.mitsuba_marcher import MitsubaMarcher

    marcher = MitsubaMarcher(volume, MarchSettings(step_voxels=step), leap)
    return marcher.prepare((Layer(volume, tf, light),))


def heading(title: str, *columns: str) -> None:
    print(f"\n**{title}**\n\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")


def row(*cells: object) -> None:
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def against_vtk(size: int, pixels: int, turns: int) -> None:
    """VTK's CPU ray caster: as many threads, same sample distance, floats or 16 bits, what is faster."""
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    shell, rough = shells(size), noise(size)
    cases = [
        (shell, NARROW, LIGHT, "≥ 2"),
        (shell, THIN, LIGHT, ""),
        (shell, WIDE, LIGHT, "≥ 1.5"),
        (shell, DENSE, LIGHT, ""),
        (rough, ALL, LIGHT, ""),
        (shell, NARROW, None, ""),
        (shell, WIDE, None, ""),
    ]
    heading(
        f"Against VTK {version('vtk')}: {size}³, {pixels}², step of one voxel, {threads} threads, "
        f"ms per view, {VIEWS} views",
        "TF", "light", "ours", "VTK, CPU mapper", "ratio", "of shortest", "of CPU time", "target",
        "set-up ours, VTK in s", "same picture",
    )  # fmt: skip
    for volume, tf, light, target in cases:
        cameras = around(volume, pixels)
        our_setup = seconds(lambda v=volume, t=tf, i=light: ours(v, t, i))
        draw = ours(volume, tf, light)
        caster, their_setup = fastest_caster(volume, tf, light, threads, cameras)
        fast, slow = interleaved(
            [lambda d=draw, c=cameras: d(c), lambda r=caster, c=cameras: [r.draw(one) for one in c]],
            turns,
            VIEWS,
        )
        alike = "shaded otherwise"
        if light is None:
            alike = f"{decibels(draw(cameras), np.stack([caster.render(c) for c in cameras])):.0f} dB"
        row(
            f"{tf.name}, {volume.name}",
            "Phong" if light else "none",
            fast,
            slow,
            f"{slow.median / fast.median:.2f} x",
            f"{slow.shortest / fast.shortest:.2f} x",
            f"{slow.cpu / fast.cpu:.2f} x",
            target,
            f"{our_setup:.2f}, {their_setup:.2f}",
            alike,
        )
    print("\nVTK stops rays at a transmittance of 0.8 %, we at 1e-6: of the dense one it takes about half.")


def fastest_caster(
    volume: Volume, tf: TransferFunction, light: Light | None, threads: int, cameras: Sequence[Camera]
) -> tuple[vtk_oracle.VtkRenderer, float]:
    """VTK's ray caster on floats or 16-bit values, and the seconds its first picture takes beyond others."""
    best = None
    for integers in (False, True):
        caster = vtk_oracle.VtkRenderer(volume, tf, light, mapper="cpu", threads=threads, integers=integers)
        first = seconds(lambda r=caster: r.draw(cameras[0]))
        later = min(seconds(lambda r=caster, c=c: r.draw(c)) for c in cameras[:2])
        if best is None or later < best[0]:
            best = later, caster, max(first - later, 0.0)
    assert best is not None
    return best[1], best[2]


def against_vtk_gpu(size: int, pixels: int, turns: int) -> None:
    volume = shells(size)
    heading(
        f"VTK's GPU mapper as it runs here: {size}³, {pixels}², step of one voxel, Phong, ms per view",
        "TF", "ours", "VTK, GPU mapper", "ratio", "OpenGL",
    )  # fmt: skip
    cameras = around(volume, pixels, 1)
    for tf in (NARROW, WIDE):
        caster = vtk_oracle.VtkRenderer(volume, tf, LIGHT)
        draw = ours(volume, tf, LIGHT)
        fast, slow = interleaved(
            [lambda d=draw: d(cameras), lambda r=caster: r.finish(cameras[0])], max(2, turns // 2)
        )
        row(tf.name, fast, slow, f"{slow.median / fast.median:.1f} x", caster.driver())


def modes(size: int, pixels: int, turns: int) -> None:
    volume = shells(size)
    cameras = around(volume, pixels)
    heading(
        f"Shading, step and bricks: shells {size}³, {pixels}², ms per view",
        "TF", "step", "unshaded", "shaded", "shaded without bricks", "bricks save",
    )  # fmt: skip
    for step in (1.0, 0.5):
        for tf in (NARROW, DENSE, ALL):
            draws = [
                ours(volume, tf, None, step),
                ours(volume, tf, Light(), step),
                ours(volume, tf, Light(), step, leap=False),
            ]
            plain, shaded, without = interleaved(
                [lambda d=d: d(cameras) for d in draws], max(2, turns // 2), VIEWS
            )
            row(tf.name, step, plain, shaded, without, f"{without.median / shaded.median:.1f} x")


def by_size(sizes: Sequence[int], images: Sequence[int], size: int, pixels: int, turns: int) -> None:
    heading(
        f"By volume size: shells, {pixels}², step of one voxel, shaded, ms per view",
        "volume", "narrow", "wide", "set-up in s",
    )  # fmt: skip
    for n in sizes:
        volume = shells(n)
        cameras = around(volume, pixels)
        setup = seconds(lambda v=volume: ours(v, NARROW, Light()))
        draws = [ours(volume, tf, Light()) for tf in (NARROW, WIDE)]
        narrow, wide = interleaved([lambda d=d, c=cameras: d(c) for d in draws], max(2, turns // 2), VIEWS)
        row(f"{n}³", narrow, wide, f"{setup:.2f}")
    heading(
        f"By image size: shells {size}³, step of one voxel, shaded, ms per view",
        "image", "narrow", "wide",
    )  # fmt: skip
    volume = shells(size)
    draws = [ours(volume, tf, Light()) for tf in (NARROW, WIDE)]
    for p in images:
        cameras = around(volume, p)
        narrow, wide = interleaved([lambda d=d, c=cameras: d(c) for d in draws], max(2, turns // 2), VIEWS)
        row(f"{p}²", narrow, wide)


def convergence(size: int, pixels: int) -> None:
    """The picture at larger steps against that at 1/16; each step halves the error or better."""
    volume = shells(size)
    cameras = around(volume, pixels, 2)
    steps = (1.0, 0.5, 0.25, 0.125)
    heading(
        f"Convergence: PSNR (largest error) against a step of 1/16; shells {size}³, {pixels}², two views",
        "TF", "light", *(f"step {s:g}" for s in steps),
    )  # fmt: skip
    for tf in (NARROW, THIN, WIDE):
        for light in (None, Light()):
            exact = ours(volume, tf, light, 0.0625)(cameras)
            cells = []
            for step in steps:
                image = ours(volume, tf, light, step)(cameras)
                cells.append(f"{decibels(image, exact):.1f} dB ({np.abs(image - exact).max():.1g})")
            row(tf.name, "Blinn-Phong" if light else "none", *cells)


def memory(sizes: Sequence[int], pixels: int) -> None:
    heading(
        f"Memory: most a fresh process held, MiB (VmHWM), {pixels}², shaded, wide TF",
        "volume (float32)", "its data", "before the marcher", "after two views",
    )  # fmt: skip
    for n in sizes:
        done = subprocess.run(
            [sys.executable, str(Path(__file__).resolve()), "--memory", str(n), "--pixels", str(pixels)],
            check=True,
            capture_output=True,
            text=True,
        )
        before, after = done.stdout.split()[-2:]
        row(f"{n}³", 4 * n**3 // 2**20, before, after)


def memory_of_one(n: int, pixels: int) -> None:
    """The process that :func:`memory` starts."""
    volume = shells(n)
    before = peak_host_bytes() or 0
    draw = ours(volume, WIDE, Light())
    draw(around(volume, pixels, 2))
    print(before // 2**20, (peak_host_bytes() or 0) // 2**20)


def around_it(turns: int) -> None:
    """What stands around the marching: imports, and the renderer without Mitsuba."""
    imports = "from datasets.ground_truth import probe; probe.activate(probe.find_backend())"
    process, bare = interleaved(
        [
            lambda: subprocess.run([sys.executable, "-c", imports], check=True),
            lambda: subprocess.run([sys.executable, "-c", "import numpy"], check=True),
        ],
        turns,
    )
    print(f"\nImporting Mitsuba with its variant costs a process {process.shortest - bare.shortest:.0f} ms.")
    volume = shells(64)
    cameras = around(volume, 128, 3)
    reference = ReferenceMarcher(volume, MarchSettings(), dtype=torch.float32)
    draw = ours(volume, NARROW, Light(), 0.5)
    slow, quick = interleaved(
        [lambda: reference.render(cameras, NARROW, Light()), lambda: draw(cameras)], turns, len(cameras)
    )
    ratio = slow.median / quick.median
    print(f"64³, 128², step 0.5: reference (float32) {slow} ms, Mitsuba {quick} ms: {ratio:.0f} x.")


def machine() -> str:
    model, flags = platform.processor() or platform.machine(), ""
    for line in _lines("/proc/cpuinfo"):
        if line.startswith("model name"):
            model = line.split(":")[1].strip()
        if line.startswith("flags"):
            have = line.split()
            flags = " with " + next((f.upper() for f in ("avx512f", "avx2", "avx") if f in have), "SSE")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{cores} cores, {model}{flags}{load}"


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--pixels", type=int, default=400)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="small sizes, two turns")
    parser.add_argument("--only", help="name of one part: " + ", ".join(parts(None)))
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.quick:
        options.size, options.pixels, options.turns = 64, 96, 2
    backend = probe.find_backend()
    if backend.name == "none":
        sys.exit(f"Mitsuba has no backend: {backend.reason}. {probe.REMEDY}")
    probe.activate(backend)
    if options.memory:
        return memory_of_one(options.memory, options.pixels)
    began = time.perf_counter()
    library = Path(backend.library).name or backend.name
    print(
        f"{machine()}; Mitsuba {version('mitsuba')}, Dr.Jit {version('drjit')}, {library}, "
        f"VTK {version('vtk')}, {time.strftime('%Y-%m-%d')}; medians (shortest) of {options.turns} turns, "
        "or half as many"
    )
    for name, part in parts(options).items():
        if options.only in (None, name):
            part()
    print(f"\nAll of this took {time.perf_counter() - began:.0f} s.")
    return None


def parts(o: Any) -> dict[str, Callable[[], None]]:
    """The sections by name, for some options."""
    quick = bool(o and o.quick)
    sizes = (32, 64) if quick else (64, 128, 256, 512)
    images = (64, 128) if quick else (128, 200, 400, 800)
    return {
        "vtk": lambda: against_vtk(o.size, o.pixels, o.turns),
        "vtk-gpu": lambda: against_vtk_gpu(o.size, o.pixels, o.turns),
        "modes": lambda: modes(o.size, o.pixels, o.turns),
        "sizes": lambda: by_size(sizes, images, o.size, o.pixels, o.turns),
        "convergence": lambda: convergence(min(o.size, 128), min(o.pixels, 200)),
        "memory": lambda: memory(sizes[-2:], o.pixels),
        "around": lambda: around_it(o.turns),
    }


if __name__ == "__main__":
    main()
