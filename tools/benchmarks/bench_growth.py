"""How time and memory grow: ladders of volume size, Gaussians, pixels, views, scenes and iterations.

    python -m tools.benchmarks.bench_growth [--only LADDER ...] [--quick] [--folder FOLDER]

Each rung runs in a process of its own and counts processor seconds (user + system, all threads), which other
work on the machine hardly changes, and the peak of anonymous memory (RssAnon of the process and its children,
looked at every 5 ms). Pages of mapped files do not count: the system drops them when it needs room. An
exponent is the slope of a least-squares line through the logarithms of the rungs that the head of its table
names. ``--folder`` (default: the folder of temporary files) takes volumes of up to 4 GiB, BENCH_CACHE scratch
data of up to 8 GiB. ``--quick`` takes the small rungs: it shows that everything runs, not how it grows.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import mmap
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.bench.machine.provenance import cpu
from tools.benchmarks.turns import heading, row

Part = dict[str, float]
Parts = dict[str, Part]

LADDERS: dict[str, list[dict[str, Any]]] = {
    "volume": [{"n": n} for n in (64, 128, 256, 512, 1024)],
    "gaussians": [{"count": 4**k * 1000, "size": 200} for k in range(5)],
    "pixels": [{"count": 50_000, "size": size} for size in (64, 128, 256, 512, 1024)],
    "views": [
        *({"way": way, "views": 42, "size": 400} for way in ("memory", "file", "disk")),
        {"way": "memory", "views": 12, "size": 800},
    ],
    "scenes": [{"scenes": scenes} for scenes in (1, 4, 9, 24, 41)],
    "iterations": [
        {"method": method, "iterations": iterations}
        for method in ("3dgs", "econgs")
        for iterations in (250, 500, 1000)
    ],
}
STEPS = 60
"""Iterations of the ladder of views."""
GROUP_STEPS = 200
"""Iterations of the ladder of scenes."""


# --------------------------------------------------------------------------- within a rung


class Memory:
    """Peak of the anonymous memory of this process and its children, in bytes."""

    def __init__(self) -> None:
        self.peak = anonymous_bytes()
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        while True:
            self.peak = max(self.peak, anonymous_bytes())
            time.sleep(0.005)

    def part(self, work: Callable[[], Any]) -> tuple[Any, Part]:
        """What some work returns, with its user and system seconds and the peak while it ran."""
        self.peak, before = anonymous_bytes(), resource.getrusage(resource.RUSAGE_SELF)
        result = work()
        after = resource.getrusage(resource.RUSAGE_SELF)
        return result, {
            "user": after.ru_utime - before.ru_utime,
            "system": after.ru_stime - before.ru_stime,
            "peak": max(self.peak, anonymous_bytes()),
        }


def anonymous_bytes() -> int:
    """RssAnon of this process and its children."""
    total, queue = 0, [os.getpid()]
    while queue:
        folder = Path(f"/proc/{queue.pop()}")
        with suppress(OSError):
            for line in (folder / "status").read_text(encoding="ascii", errors="replace").splitlines():
                if line.startswith("RssAnon:"):
                    total += int(line.split()[1]) * 1024
            for task in (folder / "task").iterdir():
                queue += map(int, (task / "children").read_text(encoding="ascii").split())
    return total


def volume(folder: Path, n: int) -> Parts:
    """A volume file: reading, hash, cloud, set-up of the marcher, views of 400²."""
    from econgs_bench.datasets.camera_paths import training_cameras
    from econgs_bench.datasets.cloud import cloud_source
    from econgs_bench.datasets.ground_truth import probe
    from econgs_bench.datasets.ground_truth.model import Layer
    from econgs_bench.datasets.readers import read_volume
    from econgs_bench.datasets.render_views import marcher_of, volume_digest
    from econgs_bench.datasets.scene import BasicScene, Dataset
    from econgs_bench.datasets.transfer import Bump, TransferFunction

    shell = Bump("shell", 0.55, 0.57, 0.63, 0.65, (0.9, 0.5, 0.3), 0.5)
    scene = BasicScene("shells", "value", TransferFunction("shells", (shell,)))
    backend = probe.find_backend()
    small = read_volume(write_shells(folder, 16))  # imports and compiles
    cameras = training_cameras(42, 0.5 * float(np.linalg.norm(small.extent)), 400, 400)
    marcher_of([small], backend).compose(cameras[:1], [Layer.of(scene, small)])
    path = write_shells(folder, n)
    memory, parts = Memory(), {}
    field, parts["read"] = memory.part(lambda: read_volume(path))
    dataset = Dataset("shells", "shells", "volume", (scene,), {}, {"value": lambda: field})
    _, parts["hash"] = memory.part(lambda: volume_digest(field))
    _, parts["cloud"] = memory.part(lambda: cloud_source(dataset, scene).draw(scene, 10_000, 0))
    marcher, parts["set-up"] = memory.part(lambda: marcher_of([field], backend))
    draw, parts["classification"] = memory.part(lambda: marcher.prepare((Layer.of(scene, field),)))
    views, parts["view"] = memory.part(lambda: [draw((camera,)) for camera in cameras[3:7]])
    assert min(view[..., 3].max() for view in views) > 0.5
    parts["view"]["user"] /= len(views)
    parts["view"]["system"] /= len(views)
    return parts


def write_shells(folder: Path, n: int, brick: int = 128) -> Path:
    """The wobbling shells of ``bench_ground_truth.py`` as a raw float32 file, made brick by brick."""
    path = folder / f"shells_{n}x{n}x{n}_float32.raw"
    axis = np.linspace(-1.0, 1.0, n, dtype=np.float32)
    values = np.memmap(path, np.float32, "w+", shape=(n, n, n))
    starts = range(0, n, brick)
    for k, j, i in ((k, j, i) for k in starts for j in starts for i in starts):
        z, y, x = axis[k : k + brick, None, None], axis[j : j + brick, None], axis[i : i + brick]
        wobble = np.sin(5 * x + 1) * np.cos(4 * y) * np.sin(6 * z + 2)
        wobble = wobble + np.sin(7 * z - 1) * np.cos(8 * x - 3 * y)
        distance = np.sqrt(x * x + y * y + z * z)
        values[k : k + brick, j : j + brick, i : i + brick] = np.clip(1.1 - distance + 0.075 * wobble, 0, 1)
    values.flush()
    return path


def frames(count: int, size: int) -> Parts:
    """A frame of Gaussians in a ball, with gradients; the more of them, the smaller each."""
    import torch

    from econgs_bench.datasets.camera import Camera
    from econgs_bench.econgs.splat import rasterise

    torch.set_num_threads(1)
    random = np.random.default_rng(7)
    pose = np.eye(4)
    pose[2, 3] = -3.0
    camera = Camera.with_fov(pose, 0.6, size, size)
    directions = random.normal(size=(count, 3))
    radius = 0.8 * random.uniform(size=(count, 1)) ** (1 / 3)
    arrays = {
        "means": radius * directions / np.linalg.norm(directions, axis=1, keepdims=True),
        "quats": random.normal(size=(count, 4)),
        "scales": 0.5 * count ** (-1 / 3) * np.exp(0.3 * random.normal(size=(count, 3))),
        "opacities": random.uniform(0.1, 0.95, count),
        "features": random.uniform(size=(count, 3)),
    }
    leaves = {name: torch.from_numpy(one.astype(np.float32)) for name, one in arrays.items()}
    leaves = {name: one.requires_grad_() for name, one in leaves.items()}
    color, alpha = torch.rand(size, size, 3), torch.rand(size, size)

    def frame() -> None:
        drawn = rasterise(camera=camera, backend="native", **leaves)
        torch.autograd.grad([drawn.features, drawn.alpha], list(leaves.values()), [color, alpha])

    frame()
    memory, start, repeats = Memory(), time.process_time(), 1
    frame()
    repeats = max(3, int(1.0 / (time.process_time() - start)))
    _, part = memory.part(lambda: [frame() for _ in range(repeats)])
    return {"frame": {**part, "user": part["user"] / repeats, "system": part["system"] / repeats}}


def group(
    folder: Path, dataset_name: str, count: int, views: int, size: int, streamed: bool | None
) -> tuple[list[Any], list[int]]:
    """Scenes as a fit gets them, from files; and bytes of their pictures.

    Args:
        folder: where files of pictures lie.
        dataset_name: of the catalogue.
        count: number of scenes.
        views: training views of each, the tenth of which are left out.
        size: of a picture.
        streamed: whether pictures lie in memory or in a file; None: as the rule has it.
    """
    from econgs_bench.bench.jobs.scenes import camera_extent
    from econgs_bench.datasets import scratch
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.datasets.cloud import initial_cloud
    from econgs_bench.datasets.render_views import views_of
    from econgs_bench.datasets.view_files import images_bytes, read_views, write_views
    from econgs_bench.datasets.views import ViewRequest, ViewSet
    from econgs_bench.methods.interface import SceneInput

    dataset = open_dataset(dataset_name)
    stored = []
    for scene in dataset.scenes[:count]:
        rendered = views_of(dataset, scene.name, ViewRequest("trainval", views, 4, size, size))
        file = folder / f"{scene.name}.zst"
        index = write_views(file, rendered.images)
        stored.append((scene, replace(rendered, images=np.empty((0, size, size, 4))), file, index))
    sizes = [images_bytes(index) for *_, index in stored]
    together = sum(sizes) if streamed is None else streamed * (scratch.LIMIT + 1)
    scenes = []
    for scene, rendered, file, index in stored:
        images = read_views(file, index, None, together)
        train = ViewSet(rendered.cameras, images, rendered.background, rendered.key)
        scenes.append(
            SceneInput(
                scene=scene,
                train=train,
                validation=ViewSet((), images[:0], rendered.background, rendered.key),
                cloud=initial_cloud(dataset, scene, 10_000, 0),
                extent=camera_extent(train.cameras),
            )
        )
    return scenes, sizes


class Silence:
    """A monitor that asks for nothing; it keeps the number of primitives, a hash of all losses, and times.

    Args:
        after: called after each iteration.
    """

    def __init__(self, after: Callable[[], None] = lambda: None) -> None:
        self.primitives = 0
        self.losses = hashlib.sha256()
        self.times: list[float] = []
        self._after = after

    def progress(self, iteration: int, losses: dict[str, float], primitives: int) -> None:
        self.primitives = primitives
        self.losses.update(float(losses["loss"]).hex().encode())
        self._after()
        self.times.append(time.process_time())

    def due(self, iteration: int) -> bool:
        return False

    def pause(self, *given: Any) -> None:
        raise AssertionError("nothing was due")

    def stage(self, name: str) -> None:
        pass


def fit(
    method: str, scenes: list[Any], iterations: int, memory: Memory, after: Callable[[], None] = lambda: None
) -> Part:
    """What a fit with the options of preset quick costs, and what it comes to."""
    import torch

    from econgs_bench.methods.interface import Budget
    from econgs_bench.methods.options import resolve
    from econgs_bench.methods.registry import Registry, load_method

    torch.set_num_threads(1)
    spec = Registry().spec(method)
    options = resolve(spec, "quick", {}).options
    monitor = Silence(after)
    trainer = load_method(spec)
    _, part = memory.part(lambda: trainer.fit(scenes, options, Budget(iterations), 0, "cpu", monitor, None))
    return {
        **part,
        "iteration": statistics.median(np.diff(monitor.times)),
        "primitives": monitor.primitives,
        "losses": monitor.losses.hexdigest(),
    }


def views(folder: Path, way: str, views: int, size: int) -> Parts:
    """ECoNGS on four scenes: views in memory, in a file, or in a file that is read from disk."""
    memory = Memory()
    scenes, sizes = group(folder, "jet_flame", 4, views, size, streamed=way != "memory")
    maps = [mapped(scene.train.images) for scene in scenes] if way == "disk" else []
    for one in maps:
        one.flush()

    def after() -> None:
        for one in maps:
            one.madvise(_PAGE_OUT)

    after()
    before = read_bytes()
    part = fit("econgs", scenes, STEPS, memory, after)
    return {"fit": {**part, "pictures": sum(sizes), "read": read_bytes() - before}}


_PAGE_OUT = 21
"""Linux's MADV_PAGEOUT: pages of a mapped file leave the memory."""


def mapped(images: Any) -> mmap.mmap:
    """The mapped file that images lie in."""
    owner = images
    while not isinstance(owner, mmap.mmap):
        owner = owner.obj if isinstance(owner, memoryview) else owner.base
    return owner


def read_bytes() -> int:
    """Bytes that this process had read from disk so far."""
    lines = Path("/proc/self/io").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("read_bytes"))


def scenes(folder: Path, scenes: int) -> Parts:
    """ECoNGS on scenes of the jet flame together: 48², 42 views of each, `GROUP_STEPS` iterations."""
    memory = Memory()
    given, sizes = group(folder, "jet_flame", scenes, 42, 48, None)
    part = fit("econgs", given, GROUP_STEPS, memory)
    return {"fit": {**part, "pictures": sum(sizes)}}


def iterations(folder: Path, method: str, iterations: int) -> Parts:
    """A scene of the vortices, 128², 42 views: a fit of so many iterations."""
    memory = Memory()
    given, _ = group(folder, "vortices", 1, 42, 128, None)
    return {"fit": fit(method, given, iterations, memory)}


RUNGS: dict[str, Callable[..., Parts]] = {
    "volume": volume,
    "gaussians": lambda folder, **which: frames(**which),
    "pixels": lambda folder, **which: frames(**which),
    "views": views,
    "scenes": scenes,
    "iterations": iterations,
}


# --------------------------------------------------------------------------- all rungs


def climb(ladder: str, rungs: Sequence[dict[str, Any]], parent: str | None) -> list[Parts]:
    """What each rung measured."""
    results = []
    for rung in rungs:
        with tempfile.TemporaryDirectory(dir=parent) as folder:
            command = [
                sys.executable,
                "-m",
                "tools.benchmarks.bench_growth",
                "--rung",
                ladder,
                "--which",
                json.dumps(rung),
            ]
            run = subprocess.run([*command, "--folder", folder], capture_output=True, text=True)
        if run.returncode:
            sys.exit(run.stderr)
        results.append(json.loads(run.stdout.splitlines()[-1]))
        print(f"{ladder} {rung}", results[-1], file=sys.stderr, flush=True)
    return results


def exponent(x: Sequence[float], y: Sequence[float]) -> float:
    """Slope of the least-squares line through the logarithms."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def seconds(part: Part) -> float:
    return part["user"] + part["system"]


def mib(size: float) -> str:
    return f"{size / 2**20:.0f}"


def time_of(value: float) -> str:
    """Seconds, in milliseconds where they are few."""
    return f"{value:.2f} s" if value >= 1 else f"{1e3 * value:.1f} ms"


def print_volume(rungs: Sequence[dict[str, Any]], results: Sequence[Parts]) -> None:
    names = list(results[0])
    sides = [rung["n"] for rung in rungs]
    heading("Volume of N³, float32: processor time, and peak of anonymous memory in MiB", "N", *names, "peak")
    for n, parts in zip(sides, results, strict=True):
        peak = max(part["peak"] for part in parts.values())
        row(n, *(time_of(seconds(parts[name])) for name in names), mib(peak))
    last = [(n, parts) for n, parts in zip(sides, results, strict=True) if n >= 128]
    fits = [exponent([n for n, _ in last], [seconds(p[name]) for _, p in last]) for name in names]
    row("exponent in N, from 128", *(f"{one:.2f}" for one in fits), "")


def print_frames(name: str, unit: str, rungs: Sequence[dict[str, Any]], results: Sequence[Parts]) -> None:
    x = [rung[name] for rung in rungs]
    heading(f"Frame with gradients by {unit}", unit, "ms", "peak MiB")
    for value, parts in zip(x, results, strict=True):
        row(value, f"{1e3 * seconds(parts['frame']):.1f}", mib(parts["frame"]["peak"]))
    x = [value**2 for value in x] if name == "size" else x
    spent = [seconds(parts["frame"]) for parts in results]
    row("exponent, all rungs", f"{exponent(x, spent):.2f}", "")
    row("exponent, last three", f"{exponent(x[-3:], spent[-3:]):.2f}", "")


def print_views(rungs: Sequence[dict[str, Any]], results: Sequence[Parts]) -> None:
    heading(
        f"Views of four scenes: an iteration of ECoNGS, median of {STEPS}",
        "size",
        "views a scene", "pictures MiB", "where", "ms", "peak MiB", "MiB from disk", "losses",
    )  # fmt: skip
    first: dict[tuple[int, int], str] = {}
    for rung, parts in zip(rungs, results, strict=True):
        part = parts["fit"]
        same = first.setdefault((rung["views"], rung["size"]), str(part["losses"])) == part["losses"]
        row(
            f"{rung['size']}²",
            rung["views"],
            mib(part["pictures"]),
            rung["way"],
            f"{1e3 * part['iteration']:.1f}",
            mib(part["peak"]),
            mib(part["read"]),
            "same bits" if same else "DIFFER",
        )


def print_scenes(rungs: Sequence[dict[str, Any]], results: Sequence[Parts]) -> None:
    heading(
        f"Scenes in one group: jet_flame, 48², 42 views a scene, {GROUP_STEPS} iterations of ECoNGS",
        "scenes", "ms an iteration, median", "fit in s", "peak MiB", "anchors", "pictures MiB",
    )  # fmt: skip
    x = [rung["scenes"] for rung in rungs]
    parts = [one["fit"] for one in results]
    for n, part in zip(x, parts, strict=True):
        spent = f"{1e3 * part['iteration']:.1f}", f"{seconds(part):.1f}"
        row(n, *spent, mib(part["peak"]), int(part["primitives"]), mib(part["pictures"]))
    once, whole = exponent(x, [p["iteration"] for p in parts]), exponent(x, [seconds(p) for p in parts])
    row("exponent, all rungs", f"{once:.2f}", f"{whole:.2f}", "", "", "")
    slope, spent = (np.polyfit(x, y, 1) for y in ([p["peak"] for p in parts], [seconds(p) for p in parts]))
    print(
        f"\nLines through all rungs: {mib(slope[1])} MiB and {slope[0] / 2**20:.1f} MiB a scene, "
        f"{spent[1]:.2f} s and {spent[0]:.3f} s a scene."
    )


def print_iterations(rungs: Sequence[dict[str, Any]], results: Sequence[Parts]) -> None:
    heading(
        "Iterations: a scene of the vortices, 128², 42 views, preset quick",
        "method", "iterations", "s", "peak MiB", "primitives",
    )  # fmt: skip
    for rung, parts in zip(rungs, results, strict=True):
        part = parts["fit"]
        spent = f"{seconds(part):.1f}"
        row(rung["method"], rung["iterations"], spent, mib(part["peak"]), int(part["primitives"]))
    for method in dict.fromkeys(rung["method"] for rung in rungs):
        pairs = zip(rungs, results, strict=True)
        own = [(rung["iterations"], parts["fit"]) for rung, parts in pairs if rung["method"] == method]
        fitted = exponent([n for n, _ in own], [seconds(part) for _, part in own])
        row(method, "exponent, all rungs", f"{fitted:.2f}", "", "")


PRINT: dict[str, Callable[..., None]] = {
    "volume": print_volume,
    "gaussians": partial(print_frames, "count", "Gaussians"),
    "pixels": partial(print_frames, "size", "side in pixels"),
    "views": print_views,
    "scenes": print_scenes,
    "iterations": print_iterations,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=tuple(LADDERS), default=list(LADDERS))
    parser.add_argument("--quick", action="store_true", help="small rungs only")
    parser.add_argument("--folder", help="where volumes lie for a while")
    parser.add_argument("--rung", help=argparse.SUPPRESS)
    parser.add_argument("--which", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.rung:
        print(json.dumps(RUNGS[options.rung](Path(options.folder), **options.which)))
        return
    print(f"{cpu()}, {time.strftime('%Y-%m-%d')}; processor time of all threads")
    for ladder in options.only:
        rungs = LADDERS[ladder]
        rungs = rungs[:3] if options.quick else rungs
        PRINT[ladder](rungs, climb(ladder, rungs, options.folder))


if __name__ == "__main__":
    main()
