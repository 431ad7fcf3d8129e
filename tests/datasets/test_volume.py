"""Volumes: what readers hand over, in the units of transfer functions."""

import numpy as np
import pytest

from econgs_bench.datasets.volume import Volume


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.float32, np.float64])
def test_the_value_range_becomes_zero_to_one(dtype):
    values = np.array([20, 40, 60, 70, 100, 120], dtype).reshape(1, 2, 3).repeat(2, 0)
    volume = Volume("v", values, (1.0, 1.0, 1.0), (20.0, 100.0), "test")
    expected = np.array([0.0, 0.25, 0.5, 0.625, 1.0, 1.0]).reshape(1, 2, 3).repeat(2, 0)
    np.testing.assert_allclose(volume.normalised(), expected, rtol=1e-6)
    assert volume.normalised().dtype == np.float32
