from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import time
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.png import read_png, write_png
from econgs_bench.datasets.scratch import cache_root
from econgs_bench.datasets.view_cache import ViewCache
from econgs_bench.datasets.view_files import read_views
from tests.datasets.damage import damage

RECORD = {"renderer": "none", "ms_per_view": 1.5}


def images(seed=0, n=3, h=20, w=30):
    rgba = np.random.default_rng(seed).random((n, h, w, 4), dtype=np.float32)
    rgba[..., :3] *= rgba[..., 3:]
    return rgba


def test_views_come_back_within_a_hundred_thousandth_and_as_put_said(cache):
    truth = images()
    stored = cache.put("a", truth, RECORD)
    back = cache.get("a")
    np.testing.assert_array_equal(back.images, stored)
    assert np.abs(back.images - truth).max() <= 1e-5
    assert back.images.dtype == np.float32
    assert back.record == RECORD
    assert sorted(p.name for p in cache.folder.iterdir()) == ["a"]


def test_absent_entries_are_none(cache):
    assert cache.get("nothing") is None
    assert cache.prune(0) == 0
    assert cache.size() == 0


CUT, EMPTY = (partial(damage, kind="cut", at=at, value=0) for at in (0.99, 0.0))
FLIP = partial(damage, kind="flip", at=0.5, value=2)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [("images.zst", each) for each in (CUT, FLIP, Path.unlink, EMPTY)]
    + [("entry.json", each) for each in (CUT, FLIP, Path.unlink, EMPTY)],
)
def test_damaged_entries_are_removed_and_made_again(cache, name, spoil):
    cache.put("a", images(), RECORD)
    spoil(cache.folder / "a" / name)
    assert cache.get("a") is None
    stored = cache.put("a", images(1), RECORD)
    np.testing.assert_array_equal(cache.get("a").images, stored)


def test_least_recently_used_entries_go_first(cache):
    for i, key in enumerate("abcd"):
        cache.put(key, images(i), RECORD)
        os.utime(cache.folder / key, (1000.0 + i, 1000.0 + i))
    cache.get("a")
    one = cache.size() // 4
    freed = cache.prune(int(2.5 * one))
    assert sorted(p.name for p in cache.folder.iterdir()) == ["a", "d"]
    assert freed == pytest.approx(2 * one, rel=0.01)


def test_the_cap_holds_after_each_write_but_spares_what_was_just_written(tmp_path):
    cache = ViewCache(tmp_path, max_bytes=1)
    cache.put("a", images(), RECORD)
    cache.put("b", images(), RECORD)
    assert cache.get("a") is None
    assert cache.get("b") is not None


def test_prune_clears_what_dead_writers_left(cache):
    cache.put("a", images(), RECORD)
    left = cache.folder / ".partial-1-dead"
    left.mkdir()
    (left / "images.zst").write_bytes(b"half")
    cache.prune(10**9)
    assert left.exists()  # perhaps its writer is still at work
    os.utime(left, (1000.0, 1000.0))
    cache.prune(10**9)
    assert not left.exists()
    assert cache.get("a") is not None


WRITER = """
import sys
from pathlib import Path
import numpy as np
from econgs_bench.datasets.view_cache import ViewCache
cache = ViewCache(Path(sys.argv[1]))
first, same = int(sys.argv[2]), sys.argv[3] == "same"
print("ready", flush=True)
for i in range(first, first + 100000):
    key = i % 3 if same else i
    value = np.random.default_rng(key).random((2, 150, 150, 4), dtype=np.float32)
    cache.put(f"k{key}", value, {"i": key})
"""


def start_writer(folder, first, same):
    writer = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder), str(first), "same" if same else "new"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=Path(__file__).parents[2],
    )
    writer.stdout.readline()
    return writer


def check_all(cache):
    keys = [p.name for p in cache.folder.iterdir() if not p.name.startswith(".")]
    for key in keys:
        number = int(key[1:])
        truth = np.random.default_rng(number).random((2, 150, 150, 4), dtype=np.float32)
        found = cache.get(key)
        assert found is not None
        assert found.record == {"i": number}
        assert np.abs(found.images - truth).max() <= 1e-5
    return len(keys)


def test_a_killed_writer_leaves_no_half_written_entry(cache):
    for attempt in range(4):
        writer = start_writer(cache.folder, attempt * 1000, same=False)
        time.sleep(0.13 + 0.037 * attempt)
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
    assert check_all(cache) > 4


def test_two_processes_may_write_the_same_keys_while_a_third_reads(cache):
    writers = [start_writer(cache.folder, 0, same=True) for _ in range(2)]
    end = time.monotonic() + 1.0
    seen = 0
    while time.monotonic() < end:
        for key in range(3):
            found = cache.get(f"k{key}")
            if found is not None:
                seen += 1
                assert found.record == {"i": key}
    assert all(w.poll() is None for w in writers)
    for writer in writers:
        writer.terminate()
        writer.communicate()
    assert seen > 3
    assert check_all(cache) == 3


def test_the_environment_names_the_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path))
    assert cache_root() == tmp_path
    assert ViewCache().folder == tmp_path / "views"
    monkeypatch.delenv("BENCH_CACHE")
    assert "econgs-bench" in str(cache_root())


def test_pictures_keep_straight_alpha_on_disk_and_premultiplied_in_memory(tmp_path):
    from skimage.io import imread

    picture = images(h=40, w=50)[0]
    picture[:5] = 0.0
    write_png(tmp_path / "a.png", picture)
    pixels = imread(tmp_path / "a.png").astype(float) / 255.0
    assert pixels.shape == (40, 50, 4)
    assert np.abs(pixels[..., 3] - picture[..., 3]).max() <= 0.5001 / 255
    opaque = picture[..., 3] > 0.5
    assert np.abs(pixels[opaque][:, :3] - picture[opaque][:, :3] / picture[opaque][:, 3:]).max() <= 1.6 / 255
    assert np.abs(read_png(tmp_path / "a.png") - picture).max() <= 1.01 / 255
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    write_png(tmp_path / "b.png", picture[..., :3])
    assert read_png(tmp_path / "b.png")[..., 3].min() == 1.0


def test_what_is_no_picture_is_refused_by_name(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match=r"a\.png"):
        read_png(tmp_path / "a.png")
    with pytest.raises(DataError, match="no such"):
        read_png(tmp_path / "b.png")


def png(width, height, depth, kind, rows=b""):
    """A PNG file with these numbers in its head, and these rows."""
    head = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    packed = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_deep_pictures_are_refused_as_they_would_lose_bits(tmp_path, channels):
    rows = b"".join(b"\0" + bytes(range(2 * 5 * channels)) for _ in range(4))
    (tmp_path / "a.png").write_bytes(png(5, 4, 16, {1: 0, 3: 2, 4: 6}[channels], rows))
    with pytest.raises(DataError, match=r"a\.png: has pixels of 16 bits a channel.*8-bit"):
        read_png(tmp_path / "a.png")


def test_a_picture_that_would_fill_memory_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(png(20_000, 20_000, 8, 2))
    with pytest.raises(DataError, match=r"a\.png: cannot be read as a picture"):
        read_png(tmp_path / "a.png")


def test_linked_pictures_outlive_their_entry(cache, tmp_path):
    stored = cache.put("a", images(), RECORD)
    file = tmp_path / "pictures.zst"
    index = cache.link("a", file)
    assert cache.link("b", tmp_path / "no.zst") is None
    cache.prune(0)
    assert cache.get("a") is None
    np.testing.assert_array_equal(read_views(file, index), stored)
    np.testing.assert_array_equal(read_views(file, index, [2, 0]), stored[[2, 0]])
