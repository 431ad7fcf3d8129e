"""The timing protocol: one timed job per machine, warm-up, synchronisation, a reference kernel.

No camera comes twice, so pictures that a model keeps are of no use to it: each frame has a camera of the
path, turned a little about the origin of the scene.
"""

from __future__ import annotations

import gc
import itertools
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from econgs_bench.bench.store.records import FrameTimes
from econgs_bench.datasets.camera import Camera, rotation

WARMUP_SECONDS = 3.0
MEASURE_SECONDS = 1.0
MEASURE_FRAMES = 500
PARTS_SECONDS = 0.1
STABLE = 0.05
RULERS = {"frame": 2, "parts": 3}
"""Versions of how a frame and the parts of a frame are timed; times of different versions are not compared.

frame: 1: warm-up and timed passes on the same cameras, the kernel before and after; 2: no camera comes twice,
the kernel runs amid the frames too. parts: 1 (until 2026-11-28, 09:25:51 UTC): one pass over nine cameras;
2: whole passes for a tenth of a second, without garbage collection; 3: no camera comes twice.
"""
BY_PROGRAM = 0
"""Ruler of frames that another program drew and timed."""
AMID_SECONDS = 0.25
"""Seconds of timed frames after which the reference kernel runs."""
_AMID_FRAMES = 5
"""Least number of frames between two runs of the reference kernel: they cost slow models little."""
_TURN = math.radians(2.0)
"""Largest angle by which a camera of a path is turned, radians."""
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_WINDOW = 5
_PARTS_CAMERAS = 9
_LAPS = 3
_AMID_LAPS = 2
_N = TypeVar("_N", int, float)


def synchronise(device: str) -> None:
    """Wait until the device has finished all its work."""
    if device.startswith("cuda"):
        sys.modules["torch"].cuda.synchronize(device)


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def reference_seconds(laps: int = _LAPS) -> float | None:
    """Best of some laps of the reference kernel; None without the native core.

    An interruption lengthens a lap and never shortens one.
    """
    times = [lap_seconds() for _ in range(laps)]
    return min((lap for lap in times if lap is not None), default=None)


def amid_seconds() -> float | None:
    """Best of two laps of the reference kernel, amid what is timed; None without the native core."""
    return reference_seconds(_AMID_LAPS)


def lap_seconds() -> float | None:
    """Seconds of the fixed reference kernel on this machine; None without the native core.

    The function calls the kernel directly: the layer above it would import torch into every process.
    """
    try:
        import econgs_bench.econgs._native as native
    except ImportError:
        return None
    native.set_threads(int(os.environ.get("ECONGS_THREADS") or available_cores()))
    return float(native.reference_kernel())


def mean_of(before: float | None, after: float | None) -> float | None:
    """Mean of two reference times; None if one is missing."""
    return None if before is None or after is None else 0.5 * (before + after)


def worst_of(values: Iterable[_N | None]) -> _N | None:
    """The largest of the known values; None if none is known."""
    return max((value for value in values if value is not None), default=None)


def fresh_cameras(path: Sequence[Camera]) -> Iterator[Camera]:
    """Cameras along a path, again and again, without end; no two are equal.

    Each is turned about the origin of scene space, with its own vertical as the axis, by an angle of at most
    2 degrees that is another one for every camera: the multiples of the golden ratio, modulo 1, cover the
    range evenly. Its distance from the origin stays as it is, and so does what it sees of a scene there.
    Names are the numbers of the frames.
    """
    for number, camera in enumerate(itertools.cycle(path), 1):
        angle = _TURN * (2.0 * (number * _GOLDEN % 1.0) - 1.0)
        yield replace(turned(camera, angle), name=f"frame {number}")


def turned(camera: Camera, angle: float) -> Camera:
    """A camera, turned by an angle in radians about its own vertical through the origin of scene space."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(camera.camera_to_world[:3, 1], angle)
    return replace(camera, camera_to_world=matrix @ camera.camera_to_world)


@contextmanager
def _no_collection() -> Iterator[None]:
    """Collect garbage once, and not again before the end: a collection would lengthen some frame."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def time_frames(
    render: Callable[[Camera], Any],
    cameras: Sequence[Camera],
    device: str,
    seconds: float = MEASURE_SECONDS,
) -> FrameTimes:
    """Time ``render`` end to end over a whole path of cameras.

    Warm-up follows the path until the medians of two successive windows of five frames differ by less than
    5 %, for at most three seconds (but at least two windows). Then whole passes over the path are timed,
    frame by frame, for some ``seconds`` or 500 frames. No camera comes twice (:func:`fresh_cameras`). The
    garbage collector is off meanwhile.

    The reference kernel runs before, after, and amid the timed frames: after each quarter of a second of
    them, and an untimed frame follows, which finds the memory as other frames do.
    """
    path = fresh_cameras(cameras)

    def frame() -> float:
        camera = next(path)
        synchronise(device)
        start = time.perf_counter()
        render(camera)
        synchronise(device)
        return time.perf_counter() - start

    before = reference_seconds()
    with _no_collection():
        warm: list[float] = []
        begin = time.perf_counter()
        stable = False
        while not stable and (time.perf_counter() - begin < WARMUP_SECONDS or len(warm) < 2 * _WINDOW):
            warm.append(frame())
            if len(warm) >= 2 * _WINDOW and len(warm) % _WINDOW == 0:
                earlier, last = np.median(warm[-2 * _WINDOW : -_WINDOW]), np.median(warm[-_WINDOW:])
                stable = bool(abs(last - earlier) < STABLE * earlier)
        times: list[float] = []
        amid: list[float | None] = []
        stretch: list[float] = []
        while not times or (sum(times) < seconds and len(times) < MEASURE_FRAMES):
            for _ in cameras:
                if sum(stretch) >= AMID_SECONDS and len(stretch) >= _AMID_FRAMES:
                    amid.append(amid_seconds())
                    stretch.clear()
                    frame()
                stretch.append(frame())
                times.append(stretch[-1])
    after = reference_seconds()
    return FrameTimes(
        **_spread(times),
        warmup_frames=len(warm),
        warmup_stable=stable,
        reference_seconds=mean_of(before, after),
        reference_worst=worst_of([before, *amid, after]),
        ruler=RULERS["frame"],
    )


def _spread(times: Sequence[float]) -> dict[str, Any]:
    """Median and percentiles of the seconds of frames, and their number; None where there are none."""
    p05, median, p95 = np.percentile(times, [5, 50, 95]).tolist() if times else (None, None, None)
    return {
        "frame_seconds": median, "frame_seconds_p05": p05, "frame_seconds_p95": p95, "frames": len(times),
    }  # fmt: skip


def told_frames(times: Sequence[float]) -> FrameTimes:
    """Seconds of frames by the program that drew them; those not finite and positive are left out."""
    known = [one for one in times if math.isfinite(one) and one > 0.0]
    return FrameTimes(
        **_spread(known),
        warmup_stable=False,
        reference_seconds=reference_seconds(),
        ruler=BY_PROGRAM,
    )


def median_timings(timings: Callable[[Camera], Any], cameras: Sequence[Camera]) -> dict[str, float]:
    """Median seconds of each part of a frame over cameras spread along the path.

    After one frame of warm-up, whole passes over these cameras are timed for a tenth of a second, so that an
    interruption of some milliseconds is no part of the median. No camera comes twice (:func:`fresh_cameras`).
    The garbage collector is off meanwhile.

    Args:
        timings: seconds by part of one frame of a camera.
        cameras: the path; about nine of them are timed.
    """
    chosen = cameras[:: max(1, len(cameras) // _PARTS_CAMERAS)]
    path = fresh_cameras(chosen)
    with _no_collection():
        timings(next(path))
        samples: list[dict[str, float]] = []
        begin = time.perf_counter()
        while not samples or time.perf_counter() - begin < PARTS_SECONDS:
            samples += [dict(timings(next(path))) for _ in chosen]
    return {part: float(np.median([s[part] for s in samples])) for part in samples[0]}


def peak_device_bytes(device: str) -> int | None:
    """Peak of torch's memory on a CUDA device in bytes; None on the CPU."""
    torch = sys.modules.get("torch")
    if torch is None or not device.startswith("cuda") or not torch.cuda.is_available():
        return None
    return int(torch.cuda.max_memory_allocated(device))
