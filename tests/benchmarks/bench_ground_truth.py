"""What ground truth costs; ratios are taken within one run.

Run: ``python tests/benchmarks/bench_ground_truth.py [--size 256] [--pixels 400]``
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from datasets.camera_paths import training_cameras
from datasets.ground_truth import probe
from datasets.ground_truth.model import MarchSettings
from datasets.ground_truth.reference import ReferenceMarcher
from datasets.scene import Light
from datasets.transfer import Bump, TransferFunction
from datasets.volume import Volume


def shells(n: int) -> Volume:
    """Wobbling nested shells: much empty space, thin features."""
    x = np.linspace(-1.0, 1.0, n, dtype=np.float32)
    z, y, x = np.meshgrid(x, x, x, indexing="ij", sparse=True)
    radius = np.sqrt(x * x + y * y + z * z)
    wobble = gaussian_filter(np.random.default_rng(0).standard_normal((n, n, n)).astype(np.float32), n / 16)
    values = 1.1 - radius + 0.15 * wobble / np.abs(wobble).max()
    return Volume("shells", np.clip(values, 0.0, 1.0), (1.0, 1.0, 1.0), (0.0, 1.0), "made here")


def transfer(low: float, high: float, opacity: float) -> TransferFunction:
    rim = 0.2 * (high - low)
    return TransferFunction("t", (Bump("b", low, low + rim, high - rim, high, (0.9, 0.5, 0.3), opacity),))


def milliseconds(*works: Callable[[], object], repeats: int = 4) -> list[float]:
    """Shortest time of each, taken in turns so that other load on the machine falls on all alike."""
    best = [float("inf")] * len(works)
    for repeat in range(repeats + 1):
        for i, work in enumerate(works):
            start = time.perf_counter()
            work()
            if repeat:  # the first compiles
                best[i] = min(best[i], 1e3 * (time.perf_counter() - start))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--pixels", type=int, default=400)
    options = parser.parse_args()
    backend = probe.find_backend()
    probe.activate(backend)
    from datasets.ground_truth.mitsuba_marcher import MitsubaMarcher

    imports = "from datasets.ground_truth import probe; probe.activate(probe.find_backend())"
    process, bare = milliseconds(
        lambda: subprocess.run([sys.executable, "-c", imports], check=True),
        lambda: subprocess.run([sys.executable, "-c", "import numpy"], check=True),
    )
    print(
        f"backend {backend.name}; importing Mitsuba with its variant costs a process {process - bare:.0f} ms"
    )

    volume = shells(options.size)
    radius = 0.5 * float(np.linalg.norm(volume.extent))
    transfers = {
        "narrow": transfer(0.55, 0.65, 0.5),
        "wide": transfer(0.3, 0.9, 0.2),
        "all > 0": transfer(-0.5, 2.0, 0.02),
    }
    print(f"\n{options.size}^3, {options.pixels}^2, ms per view, four views in a launch")
    print(
        "| TF | step | unshaded | shaded | shaded without bricks | bricks save |\n|---|---|---|---|---|---|"
    )
    cameras = training_cameras(42, radius, options.pixels, options.pixels)[3:7]
    for step in (1.0, 0.5):
        fast, plain = (
            MitsubaMarcher(volume, MarchSettings(step_voxels=step), leap=leap) for leap in (True, False)
        )
        for name, tf in transfers.items():
            works = [
                lambda m=m, tf=tf, light=light: m.render(cameras, tf, light)
                for m, light in ((fast, None), (fast, Light()), (plain, Light()))
            ]
            unshaded, shaded, without = (ms / len(cameras) for ms in milliseconds(*works))
            ratio = without / shaded
            print(f"| {name} | {step} | {unshaded:.0f} | {shaded:.0f} | {without:.0f} | {ratio:.1f} x |")

    fast = MitsubaMarcher(volume)
    print("\nnarrow TF, shaded, step 0.5, ms per view by image size (42 views, launches as in use)")
    for pixels in (128, 200, 400, 800):
        cameras = training_cameras(42, radius, pixels, pixels)[: 42 if pixels <= 200 else 6]
        tf = transfers["narrow"]
        (ms,) = milliseconds(lambda c=cameras, tf=tf: fast.render(c, tf, Light()))
        print(f"{pixels}^2: {ms / len(cameras):.1f}")

    small = shells(64)
    cameras = training_cameras(12, radius, 128, 128)[:3]
    tf = transfers["narrow"]
    reference, marcher = ReferenceMarcher(small, dtype=torch.float32), MitsubaMarcher(small)
    slow, quick = (
        ms / len(cameras)
        for ms in milliseconds(
            lambda: reference.render(cameras, tf, Light()), lambda: marcher.render(cameras, tf, Light())
        )
    )
    print(f"\n64^3, 128^2: reference (float32) {slow:.0f} ms, Mitsuba {quick:.1f} ms: {slow / quick:.0f} x")


if __name__ == "__main__":
    main()
