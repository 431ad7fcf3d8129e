from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.bench_ground_truth_modes import peak_bytes, write_shells


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_512_cubed_renders_within_3_gb(tmp_path, dtype):
    path = tmp_path / "volume.npy"
    write_shells(path, 512, dtype)
    held = 512**3 * (4 + np.dtype(dtype).itemsize)  # what is mapped and at least one copy of it
    assert held < peak_bytes(path) < 3e9
