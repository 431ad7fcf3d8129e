"""Large arrays lie in files: the same values, readers' and marchers' alike, with little anonymous memory."""

from __future__ import annotations

import errno
import gzip
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import zarr

from econgs_bench.datasets import scratch
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import read_volume
from econgs_bench.datasets.scratch import is_mapped, new_array, picked
from tests.datasets.marching import mitsuba, volume

# Renders a volume in memory and in a file; prints what each adds to the anonymous memory, and whether the
# pictures agree.
PROCESS = """
import json, sys, threading, time
import numpy as np
from econgs_bench.datasets import scratch
from econgs_bench.datasets.camera_paths import training_cameras
from econgs_bench.datasets.ground_truth import probe
from econgs_bench.datasets.ground_truth.model import Layer
from econgs_bench.datasets.readers import read_volume
from econgs_bench.datasets.render_views import marcher_of
from econgs_bench.datasets.scene import BasicScene
from econgs_bench.datasets.transfer import Bump, TransferFunction

def anonymous():
    lines = open("/proc/self/status").read().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("RssAnon:"))

peak = 0
def watch():
    global peak
    while True:
        peak = max(peak, anonymous())
        time.sleep(0.002)

bump = Bump("b", 0.5, 0.55, 0.6, 0.65, (0.9, 0.5, 0.3), 0.5)
scene = BasicScene("s", "value", TransferFunction("s", (bump,)), depth_enhancement=0.5)
backend = probe.find_backend() if sys.argv[2] == "mitsuba" else probe.Backend("none")
def render(path):
    global peak
    peak = before = anonymous()
    volume = read_volume(path)
    marcher = marcher_of([volume], backend)
    cameras = training_cameras(6, 0.5 * float(np.linalg.norm(volume.extent)), 24, 24)
    picture = marcher.compose(cameras[:2], [Layer.of(scene, volume)])
    return picture, max(peak, anonymous()) - before

render(sys.argv[3])  # imports and compiles
threading.Thread(target=watch, daemon=True).start()
scratch.LIMIT = 2**20
in_file, little = render(sys.argv[1])
scratch.LIMIT = 2**40
in_memory, much = render(sys.argv[1])
assert in_memory[..., 3].max() > 0.5
print(json.dumps([little, much, bool(np.array_equal(in_file, in_memory))]))
"""


@pytest.fixture
def small_limit(monkeypatch, tmp_path):
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(scratch, "LIMIT", 2**16)
    return tmp_path / "cache" / "scratch"


def test_an_array_beyond_the_limit_lies_in_a_file_without_a_name(small_limit):
    small, large = new_array((2**14,), np.float32), new_array((2**13 + 1, 2), np.float32)
    companion = new_array((4, 5), np.uint16, together=2**16 + 1)
    assert [is_mapped(array) for array in (small, large, companion)] == [False, True, True]
    assert list(small_limit.iterdir()) == []
    assert all(array.ctypes.data % 64 == 0 and array.flags.writeable for array in (small, large, companion))
    large[:] = np.arange(large.size).reshape(large.shape)
    some = picked(large, [7, 3])
    assert not is_mapped(some)
    np.testing.assert_array_equal(some, large[[7, 3]])
    assert is_mapped(picked(large, range(len(large))))


@pytest.mark.parametrize("where", ["full", "file"])
def test_scratch_data_without_a_place_is_an_error_with_a_remedy(small_limit, monkeypatch, tmp_path, where):
    if where == "full":

        def full(*given):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(os, "posix_fallocate", full)
    else:
        (tmp_path / "cache").write_text("no folder")
    with pytest.raises(DataError, match="no place for 1 MiB") as caught:
        new_array((2**20,), np.uint8)
    assert str(small_limit) in str(caught.value)
    assert "BENCH_CACHE" in caught.value.remedy


@pytest.mark.parametrize("form", ["zarr", "holes", "gzip", "big endian"])
def test_readers_give_the_same_values_in_a_file(small_limit, monkeypatch, tmp_path, form):
    values = np.random.default_rng(0).random((30, 28, 26), dtype=np.float32)
    if form in ("zarr", "holes"):
        if form == "holes":
            values[12:20, 5, 6] = np.nan
        path = tmp_path / "volume.zarr"
        store = zarr.create_array(path, shape=values.shape, chunks=(8, 8, 8), dtype="float32")
        store[:] = values
    elif form == "gzip":
        path = tmp_path / "volume_26x28x30_float32.raw.gz"
        path.write_bytes(gzip.compress(values.tobytes()))
    else:
        path = tmp_path / "volume_26x28x30_float32_be.raw"
        path.write_bytes(values.astype(">f4").tobytes())
    in_file = read_volume(path)
    monkeypatch.setattr(scratch, "LIMIT", 2**40)
    in_memory = read_volume(path)
    assert is_mapped(in_file.values)
    assert not is_mapped(in_memory.values)
    np.testing.assert_array_equal(in_file.values, in_memory.values)
    assert in_file.value_range == in_memory.value_range
    assert (in_file.mask is not None) == (form == "holes")
    if in_file.mask is None:
        np.testing.assert_array_equal(in_file.values, values)
    else:
        np.testing.assert_array_equal(in_file.mask, in_memory.mask)
        np.testing.assert_array_equal(in_file.mask, ~np.isnan(values))


@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone tells anonymous memory")
@pytest.mark.parametrize("renderer", ["mitsuba", "reference"])
def test_a_mapped_volume_renders_the_same_with_little_anonymous_memory(tmp_path, renderer):
    n = 192
    x = np.linspace(-1.0, 1.0, n, dtype=np.float32)
    path = tmp_path / f"shells_{n}x{n}x{n}_float32.raw"
    values = np.memmap(path, np.float32, "w+", shape=(n, n, n))
    for z, out in zip(x, values, strict=True):
        out[:] = 1.1 - np.sqrt(x * x + (x * x)[:, None] + z * z) + 0.05 * np.sin(9 * x + 7 * z)
    values.flush()
    small = tmp_path / "small_16x16x16_float32.raw"
    small.write_bytes(np.ascontiguousarray(values[::12, ::12, ::12]).tobytes())
    command = [sys.executable, "-c", PROCESS, str(path), renderer, str(small)]
    little, much, same = json.loads(subprocess.check_output(command))
    grid = n**3 * (8 if renderer == "mitsuba" else 4)
    assert same
    assert much > grid
    assert little < 0.7 * n**3 * 4


def test_a_grid_beyond_the_marcher_s_indices_is_an_error_before_it_takes_memory():
    mitsuba(volume(np.zeros((4, 4, 4))))  # sets its variant
    from econgs_bench.datasets.ground_truth.field import Field

    with pytest.raises(DataError, match=r"1024 x 1024 x 2048.*2147483648 values"):
        Field(iter(()), (2048, 1024, 1024))
