"""Frame times against a clock that is set by hand."""

from __future__ import annotations

import numpy as np
import pytest

from econgs_bench.bench.machine.timing import time_frames
from econgs_bench.datasets.camera import Camera


def test_fps_is_that_of_the_median_frame(monkeypatch) -> None:
    """Frames take 1 to 19 ms, each as often as any other."""
    clock, frames = [0.0], [0]
    monkeypatch.setattr("econgs_bench.bench.machine.timing.time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("econgs_bench.bench.machine.timing.lap_seconds", lambda: None)
    milliseconds = np.random.default_rng(0).permutation(np.arange(1, 20))

    def render(camera: Camera) -> None:
        clock[0] += milliseconds[frames[0] % 19] / 1000.0
        frames[0] += 1

    path = [Camera.with_fov(np.eye(4), 0.6, 4, 4)] * 19
    times = time_frames(render, path, "cpu")
    assert times.frames >= 5 * 19
    assert times.frame_seconds == pytest.approx(0.010, abs=1e-9)
    assert times.frame_seconds_p05 == pytest.approx(0.001, abs=1.1e-3)
    assert times.frame_seconds_p95 == pytest.approx(0.019, abs=1.1e-3)
