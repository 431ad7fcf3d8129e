import math
from dataclasses import replace

import numpy as np
import pytest

from econgs_bench.bench.metrics.flicker import Flicker, is_dense
from econgs_bench.datasets.camera_paths import test_cameras as cameras_of_the_path


def flicker(truth, rendered):
    frames = Flicker()
    for pair in zip(truth, rendered, strict=True):
        frames.add(*pair)
    return frames.mean


def test_flicker_is_the_change_of_the_error_from_frame_to_frame():
    rng = np.random.default_rng(0)
    truth = rng.integers(40, 200, (6, 64, 64, 3), dtype=np.uint8)
    assert flicker(truth[:1], truth[:1]) is None
    assert flicker(truth, truth) == 0.0
    assert flicker(truth, truth + 17) == 0.0  # an error that stays in place
    pops = truth.copy()
    pops[3] += 12  # one frame of six: two of five pairs
    assert flicker(truth, pops) == pytest.approx(2 * 12 / 5)
    noise = np.rint(rng.normal(0.0, 10.0, truth.shape)).astype(int)
    assert flicker(truth, (truth + noise).astype(np.uint8)) == pytest.approx(math.sqrt(200.0), rel=0.02)


def test_only_neighbouring_frames_flicker():
    frames = cameras_of_the_path(16, 1.0, 32, 32, step=1.0)
    assert is_dense(frames)
    assert not is_dense(frames[:1])
    assert not is_dense(frames[:5] + frames[9:])
    assert not is_dense(cameras_of_the_path(181, 1.0, 32, 32))
    assert is_dense([replace(frame, width=7) for frame in frames])
