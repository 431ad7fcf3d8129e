"""What ground truth costs, as Markdown: against VTK, by size, and without Mitsuba.

    python -m tools.benchmarks.bench_ground_truth [--size 256] [--pixels 400] [--turns 5] [--quick]
                                                  [--only PART]

What is compared runs in turns on the same views; cells give the median and, in brackets, the shortest time,
in ms per view. ``--quick`` takes small sizes and two turns: it shows that everything runs, not how fast.
Accuracy, and what compositions, isosurfaces and depth enhancement cost: see ``bench_ground_truth_modes.py``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from econgs_bench.bench.machine.provenance import cpu
from econgs_bench.bench.machine.timing import available_cores
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.ground_truth import probe
from econgs_bench.datasets.ground_truth.model import Draw, Layer, MarchSettings
from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher
from econgs_bench.datasets.scene import Light
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.volume import Volume
from tests.datasets import marching, vtk_oracle
from tools.benchmarks.turns import Time, heading, interleaved, row

LIGHT = Light(model="phong")  # VTK's
PICK = (3, 4, 5, 6)
"""Cameras, of 42."""
VIEWS = len(PICK)


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


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def ours(
    volume: Volume, tf: TransferFunction, light: Light | None, step: float = 1.0, samples: int = 1
) -> Draw:
    marcher = marching.mitsuba(volume, MarchSettings(step_voxels=step))
    return marcher.prepare((Layer(volume, tf, light),), samples)


def against_vtk(size: int, pixels: int, turns: int) -> None:
    """VTK's CPU ray caster: as many threads, same sample distance, floats or 16 bits, what is faster."""
    threads = available_cores()
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
        cameras = marching.around(volume, pixels, 42, PICK)
        our_setup = seconds(lambda v=volume, t=tf, i=light: ours(v, t, i))
        draw = ours(volume, tf, light)
        caster, their_setup = fastest_caster(volume, tf, light, threads, cameras)
        ways = {
            "ours": lambda d=draw, c=cameras: d(c),
            "VTK": lambda r=caster, c=cameras: [r.draw(one) for one in c],
        }
        fast, slow = interleaved(ways, turns, VIEWS).values()
        alike = "shaded otherwise"
        if light is None:
            alike = (
                f"{marching.decibels(draw(cameras), np.stack([caster.render(c) for c in cameras])):.0f} dB"
            )
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


def against_vtk_sampled(size: int, pixels: int, turns: int) -> None:
    """k x k rays a pixel against VTK's way to have as many: a picture k times as large, averaged.

    Averaging is left out of VTK's times: what counts is the casting.
    """
    threads, volume = available_cores(), shells(size)
    heading(
        f"Rays a pixel against VTK {version('vtk')} at k times the size: {size}³, {pixels}², step of one "
        f"voxel, {threads} threads, ms per view, {VIEWS} views",
        "TF", "light", "rays a pixel", "ours", "VTK, CPU mapper", "ratio", "of CPU time",
        "ours, as needed", "ratio", "same picture",
    )  # fmt: skip
    for tf, light in ((NARROW, LIGHT), (WIDE, LIGHT), (NARROW, None)):
        cameras = marching.around(volume, pixels, 42, PICK)
        needed = ours(volume, tf, light, samples=0)
        for k in (2, 4):
            large = tuple(camera.resized(k * pixels, k * pixels) for camera in cameras)
            draw = ours(volume, tf, light, samples=k * k)
            caster, _ = fastest_caster(volume, tf, light, threads, large)
            ways = {
                "ours": lambda d=draw, c=cameras: d(c),
                "needed": lambda c=cameras, d=needed: d(c),
                "VTK": lambda r=caster, c=large: [r.draw(one) for one in c],
            }
            fast, adaptive, slow = interleaved(ways, turns, VIEWS).values()
            alike = "shaded otherwise"
            if light is None:
                theirs = np.stack([caster.render(camera) for camera in large])
                means = theirs.reshape(-1, pixels, k, pixels, k, 4).mean(axis=(2, 4))
                alike = f"{marching.decibels(draw(cameras), means):.0f} dB"
            row(
                f"{tf.name}, {volume.name}",
                "Phong" if light else "none",
                k * k,
                fast,
                slow,
                f"{slow.median / fast.median:.2f} x",
                f"{slow.cpu / fast.cpu:.2f} x",
                adaptive,
                f"{slow.median / adaptive.median:.2f} x",
                alike,
            )


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


def by_size(sizes: Sequence[int], images: Sequence[int], size: int, pixels: int, turns: int) -> None:
    heading(
        f"By volume size: shells, {pixels}², step of one voxel, shaded, ms per view",
        "volume", "narrow", "wide", "set-up in s",
    )  # fmt: skip
    for n in sizes:
        volume = shells(n)
        setup = seconds(lambda v=volume: ours(v, NARROW, Light()))
        row(f"{n}³", *narrow_and_wide(volume, pixels, turns), f"{setup:.2f}")
    heading(
        f"By image size: shells {size}³, step of one voxel, shaded, ms per view",
        "image", "narrow", "wide",
    )  # fmt: skip
    volume = shells(size)
    for p in images:
        row(f"{p}²", *narrow_and_wide(volume, p, turns))


def narrow_and_wide(volume: Volume, pixels: int, turns: int) -> Iterable[Time]:
    draws = {tf.name: ours(volume, tf, Light()) for tf in (NARROW, WIDE)}
    cameras = marching.around(volume, pixels, 42, PICK)
    ways = {name: lambda d=draw: d(cameras) for name, draw in draws.items()}
    return interleaved(ways, max(2, turns // 2), VIEWS).values()


def reference(turns: int) -> None:
    """The renderer without Mitsuba."""
    volume = shells(64)
    cameras = marching.around(volume, 128, 42, PICK[:3])
    marcher = ReferenceMarcher(volume, MarchSettings(), dtype=torch.float32)
    draw = ours(volume, NARROW, Light(), 0.5)
    ways = {"reference": lambda: marcher.render(cameras, NARROW, Light()), "Mitsuba": lambda: draw(cameras)}
    slow, quick = interleaved(ways, turns, len(cameras)).values()
    ratio = slow.median / quick.median
    print(f"\n64³, 128², step 0.5: reference (float32) {slow} ms, Mitsuba {quick} ms: {ratio:.0f} x.")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--pixels", type=int, default=400)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="small sizes, two turns")
    parser.add_argument("--only", choices=("vtk", "samples", "sizes", "reference"))
    options = parser.parse_args()
    sizes, images = (64, 128, 256, 512), (128, 200, 400, 800)
    if options.quick:
        options.size, options.pixels, options.turns = 64, 96, 2
        sizes, images = (32, 64), (64, 128)
    backend = probe.find_backend()
    if backend.name == "none":
        sys.exit(f"Mitsuba has no backend: {backend.reason}. {probe.REMEDY}")
    probe.activate(backend)
    library = Path(backend.library).name or backend.name
    print(
        f"{available_cores()} cores, {cpu()}; Mitsuba {version('mitsuba')}, Dr.Jit {version('drjit')}, "
        f"{library}, VTK {version('vtk')}, {time.strftime('%Y-%m-%d')}; medians (shortest) of "
        f"{options.turns} turns, or half as many"
    )
    size, pixels, turns = options.size, options.pixels, options.turns
    parts: dict[str, Callable[[], None]] = {
        "vtk": lambda: against_vtk(size, pixels, turns),
        "samples": lambda: against_vtk_sampled(size, pixels // 2, turns),
        "sizes": lambda: by_size(sizes, images, size, pixels, turns),
        "reference": lambda: reference(turns),
    }
    for name, part in parts.items():
        if options.only in (None, name):
            part()


if __name__ == "__main__":
    main()
