"""The timing protocol: alone on the machine, warmed up, synchronised, with a reference kernel."""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from datasets.camera import Camera

WARMUP_SECONDS = 3.0
MEASURE_SECONDS = 1.0
MEASURE_FRAMES = 500
STABLE = 0.05
_WINDOW = 5


def machine_lock() -> FileLock:
    """One lock per machine: timed jobs of all runs and users take turns.

    The environment variable BENCH_LOCKS moves it (to a folder that only those runs share that
    should not overlap).
    """
    folder = Path(os.environ.get("BENCH_LOCKS") or tempfile.gettempdir())
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / "econgs-bench-timing.lock", mode=0o666)


def synchronise(device: str) -> None:
    """Wait until the device has finished its work."""
    if device.startswith("cuda"):
        sys.modules["torch"].cuda.synchronize(device)


def reference_seconds() -> float | None:
    """Time of the fixed reference kernel on this machine now; None without the native core.

    Taken from the kernels themselves: their calling layer would bring torch into every process.
    """
    try:
        import econgs._native as native
    except ImportError:
        return None
    native.set_threads(int(os.environ.get("ECONGS_THREADS") or os.cpu_count() or 1))
    return float(native.reference_kernel())


def mean_of(before: float | None, after: float | None) -> float | None:
    """Mean of two reference times, None where one is missing."""
    return None if before is None or after is None else 0.5 * (before + after)


@dataclass(frozen=True)
class FrameTimes:
    """Frame times over a path of cameras, in seconds.

    Attributes:
        median, p05, p95: over the frames (at least one per camera).
        frames, warmup: numbers of frames after and during warm-up.
        stable: whether warm-up ended because times had settled, not because of its limit.
    """

    median: float
    p05: float
    p95: float
    frames: int
    warmup: int
    stable: bool


def time_frames(render: Callable[[Camera], Any], cameras: Sequence[Camera], device: str) -> FrameTimes:
    """Time ``render`` end to end over a whole path of cameras.

    Warm-up follows the path until the medians of two successive windows of five frames differ by
    less than 5 %, for at most three seconds (but at least two windows). Then whole passes over the
    path are timed, frame by frame, until a second has gone by or 500 frames are timed. The garbage collector
    rests meanwhile.
    """

    def seconds_of(camera: Camera) -> float:
        synchronise(device)
        start = time.perf_counter()
        render(camera)
        synchronise(device)
        return time.perf_counter() - start

    gc.collect()
    gc.disable()
    try:
        warm: list[float] = []
        begin = time.perf_counter()
        stable = False
        while not stable and (time.perf_counter() - begin < WARMUP_SECONDS or len(warm) < 2 * _WINDOW):
            warm.append(seconds_of(cameras[len(warm) % len(cameras)]))
            if len(warm) >= 2 * _WINDOW and len(warm) % _WINDOW == 0:
                before, now = np.median(warm[-2 * _WINDOW : -_WINDOW]), np.median(warm[-_WINDOW:])
                stable = bool(abs(now - before) < STABLE * before)
        times: list[float] = []
        begin = time.perf_counter()
        while not times or (time.perf_counter() - begin < MEASURE_SECONDS and len(times) < MEASURE_FRAMES):
            times += [seconds_of(camera) for camera in cameras]
    finally:
        gc.enable()
    p05, median, p95 = np.percentile(times, [5, 50, 95])
    return FrameTimes(float(median), float(p05), float(p95), len(times), len(warm), stable)


def median_timings(
    timings: Callable[[Camera], Any], cameras: Sequence[Camera], frames: int = 9
) -> dict[str, float]:
    """Median seconds of each part of a frame, over cameras spread along the path, after one warm-up."""
    step = max(1, len(cameras) // frames)
    samples = [dict(timings(camera)) for camera in [cameras[0], *cameras[::step]]][1:]
    return {part: float(np.median([s[part] for s in samples])) for part in samples[0]}


def peak_device_bytes(device: str) -> int | None:
    """Most memory that torch held on a CUDA device; None on the CPU."""
    torch = sys.modules.get("torch")
    if torch is None or not device.startswith("cuda") or not torch.cuda.is_available():
        return None
    return int(torch.cuda.max_memory_allocated(device))
