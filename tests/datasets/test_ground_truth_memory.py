"""Peak memory of ground truth: a fresh process that opens a large volume and renders views of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

# Opens a volume file and renders views of its first scene.
PROCESS = """
import sys, tempfile
from pathlib import Path
from econgs_bench.datasets.catalogue.opening import open_dataset
from econgs_bench.datasets.memory import peak_host_bytes
from econgs_bench.datasets.render_views import views_of
from econgs_bench.datasets.view_cache import ViewCache
from econgs_bench.datasets.views import ViewRequest
dataset = open_dataset(Path(sys.argv[1]))
with tempfile.TemporaryDirectory() as folder:
    views = views_of(
        dataset, dataset.scenes[0].name, ViewRequest("test", 12, 3, 400, 400), cache=ViewCache(Path(folder))
    )
assert views.images[..., 3].max() > 0.1
print(peak_host_bytes())
"""


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


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_512_cubed_renders_within_3_gb(tmp_path, dtype):
    path = tmp_path / "volume.npy"
    write_shells(path, 512, dtype)
    peak = int(subprocess.check_output([sys.executable, "-c", PROCESS, str(path)]))
    print(f"512^3 of {dtype}, views of 400^2: {peak / 1e9:.2f} GB")
    held = 512**3 * (4 + np.dtype(dtype).itemsize)  # what is mapped and at least one copy of it
    assert held < peak < 3e9
