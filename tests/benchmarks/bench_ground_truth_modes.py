"""Modes of ground truth: error against the oracle, convergence with the step, cost, memory at 512^3.

Run: ``python tests/benchmarks/bench_ground_truth_modes.py [accuracy] [convergence] [cost] [memory]``
(default: all). Figures are printed as Markdown.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from datasets.camera_paths import training_cameras
from datasets.ground_truth import probe
from datasets.ground_truth.model import Layer, MarchSettings
from datasets.scene import Isosurface, Light
from datasets.transfer import Bump, TransferFunction
from datasets.volume import Volume

PHONG = Light(model="phong")
FIXED = Light(direction=(0.6, 0.0, 0.8))
_PROCESS = """
import sys, tempfile
from pathlib import Path
from datasets.catalogue.opening import open_dataset
from datasets.memory import peak_host_bytes
from datasets.render_views import views_of
from datasets.view_cache import ViewCache
from datasets.views import ViewRequest
dataset = open_dataset(Path(sys.argv[1]))
with tempfile.TemporaryDirectory() as folder:
    views = views_of(
        dataset, dataset.scenes[0].name, ViewRequest("test", 12, 3, 400, 400), cache=ViewCache(Path(folder))
    )
assert views.images[..., 3].max() > 0.1
print(peak_host_bytes())
"""


def shells(n: int, seed: int = 0) -> Volume:
    """Wobbling nested shells."""
    x = np.linspace(-1.0, 1.0, n, dtype=np.float32)
    z, y, x = np.meshgrid(x, x, x, indexing="ij", sparse=True)
    radius = np.sqrt(x * x + y * y + z * z)
    noise = np.random.default_rng(seed).standard_normal((n, n, n)).astype(np.float32)
    wobble = gaussian_filter(noise, n / 16, mode="wrap")
    values = 1.1 - radius + 0.25 * wobble / np.abs(wobble).max()
    return Volume("shells", np.clip(values, 0.0, 1.0), (1.0, 1.0, 1.0), (0.0, 1.0), "made here")


def modes(n: int) -> dict[str, list[Layer]]:
    """The layers of a scene of each mode."""
    first, second = shells(n), shells(n, seed=1)
    low, high = (
        TransferFunction("t", (Bump("b", a, a + 0.03, a + 0.07, a + 0.1, color, opacity),))
        for a, color, opacity in ((0.4, (0.9, 0.5, 0.2), 0.3), (0.65, (0.2, 0.5, 0.9), 0.7))
    )
    both = replace(low, bumps=low.bumps + high.bumps)
    z, y, x = np.indices((n, n, n), sparse=True)
    masked = replace(first, mask=(x + 2 * y - z) < 1.1 * n)
    levels = (
        Isosurface("outer", 0.45, (0.9, 0.5, 0.2), 0.4),
        Isosurface("inner", 0.7, (0.2, 0.5, 0.9), 1.0),
    )
    return {
        "unshaded": [Layer(first, both, None)],
        "Blinn-Phong": [Layer(first, both, Light())],
        "Phong": [Layer(first, both, PHONG)],
        "composition, one volume": [Layer(first, low, Light()), Layer(first, high, FIXED)],
        "composition, two volumes": [Layer(first, low, Light()), Layer(second, high, FIXED)],
        "mask": [Layer(masked, both, Light())],
        "depth-enhanced": [Layer(first, both, Light(), (), 1.0)],
        "isosurfaces": [Layer(first, None, Light(), levels)],
        "isosurface in a volume": [Layer(first, None, Light(), levels[1:]), Layer(second, low, Light())],
    }


def marcher(layers: list[Layer], step: float = MarchSettings.step_voxels, leap: bool = True):
    from datasets.ground_truth.mitsuba_marcher import MitsubaMarcher

    return MitsubaMarcher([layer.volume for layer in layers], MarchSettings(step_voxels=step), leap)


def cameras(layers: list[Layer], pixels: int, pick: tuple[int, ...]):
    radius = 0.5 * float(np.linalg.norm(layers[0].volume.extent))
    made = training_cameras(42, radius, pixels, pixels)
    return tuple(made[i] for i in pick)


def accuracy() -> None:
    from datasets.ground_truth.reference import ReferenceMarcher

    print("\nMitsuba against the float64 oracle, shells of 64^3, two views of 96^2\n")
    print("| mode | RMS | max | pixels over 2e-4 | bricks off |\n|---|---|---|---|---|")
    for name, layers in modes(64).items():
        views = cameras(layers, 96, (3, 17))
        image = marcher(layers).compose(views, layers)
        oracle = ReferenceMarcher([layer.volume for layer in layers])
        exact = np.stack([oracle.compose_exact(camera, layers).numpy() for camera in views])
        error = np.abs(image - exact)
        over = int((error.max(axis=-1) > 2e-4).sum())
        same = np.array_equal(image, marcher(layers, leap=False).compose(views, layers))
        rms = np.sqrt((error**2).mean())
        print(f"| {name} | {rms:.1e} | {error.max():.1e} | {over} | {'identical' if same else 'DIFFERS'} |")


def convergence() -> None:
    steps = (2.0, 1.0, 0.5, 0.25, 0.125)
    print("\nPSNR (dB, white background) to a step of 1/32 voxel, shells of 128^3, two views of 200^2\n")
    print(f"| mode | {' | '.join(f'{s:g}' for s in steps)} |\n|---|{'---|' * len(steps)}")
    for name, layers in modes(128).items():
        views = cameras(layers, 200, (3, 17))
        seen = {}
        for step in (*steps, 1 / 32):
            image = marcher(layers, step).compose(views, layers)
            seen[step] = image[..., :3] + 1.0 - image[..., 3:]
        errors = [np.mean((seen[step] - seen[1 / 32]) ** 2, dtype=np.float64) for step in steps]
        print(f"| {name} | {' | '.join(f'{-10 * np.log10(e):.1f}' for e in errors)} |")


def cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def cost() -> None:
    print("\nms per view, shells of 256^3, 400^2, four views in a launch, least of four turns\n")
    works = {}
    for name, layers in modes(256).items():
        start = time.perf_counter()
        held = marcher(layers)
        ready = time.perf_counter()
        draw = held.prepare(layers)
        works[name] = (draw, cameras(layers, 400, (3, 4, 5, 6)), ready - start, time.perf_counter() - ready)
    wall = dict.fromkeys(works, float("inf"))
    cpu = dict.fromkeys(works, float("inf"))
    for turn in range(5):
        for name, (draw, views, _, _) in works.items():
            start, before = time.perf_counter(), cpu_seconds()
            draw(views)
            if turn:  # the first compiles
                wall[name] = min(wall[name], 1e3 * (time.perf_counter() - start) / len(views))
                cpu[name] = min(cpu[name], 1e3 * (cpu_seconds() - before) / len(views))
    print("| mode | ms | ms of CPU | to Blinn-Phong (CPU) | volume set up, s | scene set up, s |")
    print("|---|---|---|---|---|---|")
    for name, (_, _, volume, scene) in works.items():
        ratio = cpu[name] / cpu["Blinn-Phong"]
        row = f"{wall[name]:.0f} | {cpu[name]:.0f} | {ratio:.2f} x | {volume:.1f} | {scene:.2f}"
        print(f"| {name} | {row} |")


def write_shells(path: Path, n: int, dtype: str) -> None:
    """A volume of any size on disk, made slice by slice."""
    x = np.linspace(-1.0, 1.0, n, dtype=np.float32)
    out = np.lib.format.open_memmap(path, "w+", dtype, (n, n, n))
    most = 1.0 if dtype == "float32" else np.iinfo(dtype).max
    for i, z in enumerate(x):
        radius = np.sqrt(z * z + (x * x)[:, None] + x * x)
        values = np.clip(1.1 - radius + 0.1 * np.sin(9 * x + 3 * z) * np.cos(7 * x[:, None]), 0.0, 1.0)
        out[i] = values if dtype == "float32" else np.rint(values * most)
    out.flush()


def peak_bytes(path: Path) -> int:
    """High-water mark of a fresh process that opens a volume file and renders views of its first scene."""
    done = subprocess.run(
        [sys.executable, "-c", _PROCESS, str(path)], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


def memory() -> None:
    print("\nPeak memory of a process that opens 512^3 and renders views of 400^2\n")
    print("| type | peak, GB |\n|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for dtype in ("uint8", "uint16", "float32"):
            path = Path(folder) / f"{dtype}.npy"
            write_shells(path, 512, dtype)
            print(f"| {dtype} | {peak_bytes(path) / 1e9:.2f} |")
            path.unlink()


if __name__ == "__main__":
    parts = {"accuracy": accuracy, "convergence": convergence, "cost": cost, "memory": memory}
    probe.activate(probe.find_backend())
    for part in sys.argv[1:] or parts:
        parts[part]()
