"""Streams of other people's libraries: their headers are compared with the file before they are read."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
import zlib

import imagecodecs
import numpy as np
import pytest

from econgs_bench.datasets.bounded import DEPTH, array_of, inflated, json_of, room
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.shared import decoders
from econgs_bench.methods.shared.decoders import decoded, own_streams
from econgs_bench.methods.volume.codecs import Sz3, Zfp
from econgs_bench.methods.volume.stored import _HEAD, _MAGIC, Samples, read

SHAPE = (9, 10, 11)


@pytest.fixture(scope="module")
def grid():
    return np.random.default_rng(0).random(SHAPE).astype(np.float32)


def zfp(grid, **how):
    return bytes(imagecodecs.zfp_encode(grid, **how))


@pytest.mark.parametrize(
    "how", [{"mode": "a", "level": 1e-3}, {"mode": "r", "level": 8}, {"mode": "r", "level": 40}]
)
def test_zfp_is_read_as_its_library_reads_it(grid, how) -> None:
    stream = zfp(grid, **how)
    (values,) = decoded("zfp", stream, shape=list(SHAPE)).values()
    np.testing.assert_array_equal(values, imagecodecs.zfp_decode(stream))
    with own_streams():
        np.testing.assert_array_equal(decoded("zfp", stream, shape=list(SHAPE))["values"], values)


def with_bits(stream, first, number, value):
    """A stream with other bits, counted from the lowest of the first byte."""
    bits = int.from_bytes(stream[:20], "little")
    mask = ((1 << number) - 1) << first
    return ((bits & ~mask) | value << first).to_bytes(20, "little") + stream[20:]


@pytest.mark.parametrize(
    ("first", "number", "value"),
    [
        (32, 2, 3), (32, 2, 0), (34, 2, 0), (34, 2, 1), (34, 2, 3),  # type and axes
        (36, 16, 4095), (52, 16, 65535), (68, 16, 0),  # nx, ny, nz
        (84, 12, 2176), (84, 12, 2100), (84, 12, 2047), (84, 12, 4095),  # mode
        (0, 8, 0),
    ],
)  # fmt: skip
def test_zfp_with_another_header_is_not_given_to_its_library(grid, monkeypatch, first, number, value) -> None:
    monkeypatch.setattr(imagecodecs, "zfp_decode", lambda *_: pytest.fail("was decoded"))
    stream = with_bits(zfp(grid, mode="a", level=1e-3), first, number, value)
    with own_streams(), pytest.raises(ValueError, match=r"zfp|grid"):
        decoded("zfp", stream, shape=list(SHAPE))


def test_a_grid_larger_than_memory_is_refused_by_its_shape() -> None:
    with own_streams(), pytest.raises(ValueError, match="bytes of memory"):
        decoded("sz3", struct.pack("<IIQQ", 0xF342F310, 0, 4, 16) + bytes(9), shape=[60_000] * 3)


FAULTS = {
    "SIGSEGV": "os.kill(os.getpid(), signal.SIGSEGV)",
    "memory": "return {'values': np.ones(8 << 30, np.uint8)}",
    "stood still": "time.sleep(1000)",
    "ended with code 7": "os._exit(7)",
}


@pytest.mark.parametrize("words", FAULTS)
def test_what_a_library_does_not_survive_is_an_error_here(grid, monkeypatch, tmp_path, words) -> None:
    code = f"import os, signal, time\nimport numpy as np\ndef decode_zfp(data, shape):\n    {FAULTS[words]}\n"
    (tmp_path / "faulty_decoders.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(decoders, "__name__", "faulty_decoders")
    patience = 0.5 if words == "stood still" else 5.0
    monkeypatch.setattr("econgs_bench.datasets.readers.sandbox.PATIENCE", patience)
    with pytest.raises(ValueError, match=words):
        decoded("zfp", zfp(grid, mode="a", level=1e-3), shape=list(SHAPE))


# --------------------------------------------------------------------------- files of volumes


@pytest.fixture(scope="module")
def samples(grid):
    mask = grid > 0.2
    return Samples(
        "v", np.rint(255 * grid).astype(np.float32) / 255, mask, (1.0, 1.0, 1.0), (0.0, 255.0), "uint8"
    )


def forged(data: bytes, header=None, stream=None, mask=None) -> bytes:
    """A file with other parts, whose lengths and checksum fit."""
    _, length = _HEAD.unpack_from(data)
    about = json.loads(data[_HEAD.size : _HEAD.size + length])
    start = _HEAD.size + length
    parts = [data[start : start + about["stream"]], data[start + about["stream"] : -4]]
    if stream is not None:
        parts[0] = stream(parts[0])
    if mask is not None:
        parts[1] = mask
    text = json.dumps({**about, "stream": len(parts[0]), "mask": len(parts[1]), **(header or {})}).encode()
    body = _HEAD.pack(_MAGIC, len(text)) + text + b"".join(parts)
    return body + struct.pack("<I", zlib.crc32(body))


HEADERS = [
    {"dtype": "O"}, {"dtype": "f4,f4"}, {"dtype": "float32"}, {"dtype": ["u1"]}, {"dtype": "uint64"},
    {"range": [float("-inf"), 1.0]}, {"range": [0.0, 1e999]}, {"range": [0.0, 1e9]},
    {"range": [-1e308, 1e308]}, {"spacing": [1.0, 1.0, 1e999]}, {"bound": float("nan")},
    {"shape": [9, 10, 12]}, {"shape": [10**6] * 3}, {"shape": [9, 10, 10**400]}, {"shape": "123456"},
    {"variable": [[[]]] * 3}, {"variable": None},
]  # fmt: skip


@pytest.mark.parametrize("header", HEADERS, ids=str)
@pytest.mark.parametrize("codec", [Zfp(), Sz3()], ids=["zfp", "sz3"])
def test_headers_of_volumes_that_lie_are_refused(samples, codec, header) -> None:
    with own_streams(), pytest.raises(DataError, match="not a volume"):
        read(forged(samples.stored(codec, 1e-3).data, header), codec, "v")


@pytest.mark.parametrize("nested", ["[" * 900 + "]" * 900, "[" * 100_000])
def test_deep_headers_are_refused(samples, nested) -> None:
    data = samples.stored(Zfp(), 1e-3).data
    text = b'{"codec":' + nested.encode()
    body = _HEAD.pack(_MAGIC, len(text)) + text
    with pytest.raises(DataError, match="not a volume"):
        read(body + struct.pack("<I", zlib.crc32(body)), Zfp(), "v")
    assert read(data, Zfp(), "v").volume.values.dtype == np.uint8


@pytest.mark.parametrize("size", [0, 1, 123, 125, 64 << 20])
def test_a_mask_has_a_bit_of_each_voxel(samples, size) -> None:
    assert -(-int(np.prod(SHAPE)) // 8) == 124
    with own_streams(), pytest.raises(DataError, match="not a volume"):
        read(forged(samples.stored(Zfp(), 1e-3).data, mask=zlib.compress(bytes(size), 9)), Zfp(), "v")


@pytest.mark.parametrize("share", [0.0, 0.02, 0.125, 0.5, 0.95])
@pytest.mark.parametrize("how", [Zfp(), Zfp(fixed_rate=True), Sz3()], ids=["zfp", "zfp at a rate", "sz3"])
def test_a_stream_that_was_cut_gives_finite_values_or_none(samples, how, share) -> None:
    data = samples.stored(how, 1e-3).data
    with own_streams():
        try:
            values = read(forged(data, stream=lambda s: s[: int(share * len(s))]), how, "v").volume.values
        except DataError:
            return
    assert how.name == "zfp"
    assert how.bounded
    assert np.isfinite(values).all()
    assert values.shape == SHAPE


def test_mutated_streams_crash_nothing_and_give_finite_values(samples) -> None:
    data, rng = samples.stored(Zfp(), 1e-3).data, np.random.default_rng(0)
    read_whole = 0

    def mutated(stream):
        bytes_ = bytearray(stream)
        for _ in range(2):
            bytes_[rng.integers(4, 20)] = rng.integers(256)
        return bytes(bytes_)

    with own_streams():
        for _ in range(400):
            try:
                values = read(forged(data, stream=mutated), Zfp(), "v").volume.values
            except DataError:
                continue
            read_whole += 1
            assert values.shape == SHAPE
    assert 0 < read_whole < 400


# --------------------------------------------------------------------------- meshes and Gaussians


def test_a_point_cloud_is_no_mesh() -> None:
    draco = pytest.importorskip("DracoPy")
    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    with pytest.raises(ValueError, match="point cloud"):
        decoded("draco", draco.encode(points, quantization_bits=10))
    mesh = decoded("draco", draco.encode(points, np.array([[0, 1, 2]], np.uint32), quantization_bits=10))
    assert mesh["faces"].shape == (1, 3)


def spz(count, points, version=3, degree=0):
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, 0)
    return gzip.compress(head + bytes(20 * points), mtime=0)


@pytest.mark.parametrize(
    "made",
    [(10, 9), (10, 11), (2**32 - 1, 10), (10, 10 << 20), (10, 10, 9), (10, 10, 3, 9), (1 << 25, 1 << 25),
     gzip.compress(b"", mtime=0), b"NGSP", spz(10, 10)[:-12]],
)  # fmt: skip
def test_spz_of_another_size_than_its_header_says_is_refused(made, monkeypatch) -> None:
    data = made if isinstance(made, bytes) else spz(*made)
    gsply = pytest.importorskip("gsply")
    monkeypatch.setattr(gsply, "read_spz", lambda *_: pytest.fail("was decoded"))
    with own_streams(), pytest.raises(ValueError, match=r"SPZ|Gaussians|gzip"):
        decoded("spz", data)


def test_zstandard_grows_no_further_than_its_size_allows() -> None:
    data = bytes(imagecodecs.zstd_encode(bytes(300 << 20), level=3))
    assert len(data) < 1 << 16
    with own_streams(), pytest.raises(ValueError, match="hold more than"):
        decoded("zstd", data)
    plain = np.random.default_rng(0).bytes(5000)
    assert decoded("zstd", bytes(imagecodecs.zstd_encode(plain)))["bytes"].tobytes() == plain


@pytest.mark.parametrize("lossless", [True, False])
@pytest.mark.parametrize("channels", [3, 4])
def test_pictures_are_measured_before_they_are_decoded(lossless, channels) -> None:
    images = [np.random.default_rng(i).integers(0, 256, (8 + i, 12, channels), np.uint8) for i in range(2)]
    files = [bytes(imagecodecs.webp_encode(image, lossless=lossless)) for image in images]
    lengths = [len(file) for file in files]
    found = decoded("webp", b"".join(files), lengths=lengths, most=[8 * 12, 9 * 12])
    for image, file, picture in zip(images, files, found.values(), strict=True):
        np.testing.assert_array_equal(picture, imagecodecs.webp_decode(file))
        assert picture.shape[:2] == image.shape[:2]
    with own_streams(), pytest.raises(ValueError, match="12 x 9 pixels"):
        decoded("webp", b"".join(files), lengths=lengths, most=[8 * 12, 9 * 12 - 1])


# --------------------------------------------------------------------------- texts and archives


@pytest.mark.parametrize(
    "text",
    ["[" * (DEPTH + 1) + "]" * (DEPTH + 1), '{"a":' * 5000 + "0" + "}" * 5000, "[" * 10**6, "NaN",
     "[Infinity]",
     "-1e999", '["]]]]",' + "[" * DEPTH + "]" * DEPTH + "]", "[0" + ",0" * 1_000_000 + "]", "\xff", ""],
    ids=lambda text: text[:12],
)  # fmt: skip
def test_json_beyond_bounds_is_refused(text) -> None:
    with pytest.raises(ValueError, match=r"values|within each|not finite|Expecting|codec"):
        json_of(text.encode("latin-1"))


def test_json_within_bounds_is_read_as_it_is() -> None:
    deep = "[" * DEPTH + "]" * DEPTH
    assert json_of(deep) == json.loads(deep)
    text = '{"text": "' + "[{" * 500 + '\\"", "numbers": [1, -2.5e-3, 1e308, true, null]}'
    assert json_of(text) == json.loads(text)
    assert np.isnan(json_of("NaN", finite=False))


def test_streams_inflate_to_the_size_that_is_known() -> None:
    assert inflated(zlib.compress(b"abc"), 3) == b"abc"
    for size in (0, 2, 4):
        with pytest.raises(ValueError, match="deflated"):
            inflated(zlib.compress(b"abc"), size)
    with pytest.raises(ValueError, match="deflated"):
        inflated(zlib.compress(bytes(1000))[:-6], 1000)
    assert room(10) == 64 << 20
    assert room(10 << 20) == 1000 << 20


@pytest.mark.parametrize(
    "header",
    [b"{'descr': '<f4', 'fortran_order': False, 'shape': (4096, 4096, 4096), }", b"{" + b"[" * 2000,
     b"{'descr': '|O', 'fortran_order': False, 'shape': (2,), }",
     b"{'descr': '<f4,<f4', 'fortran_order': False, 'shape': (2,), }",
     b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }", b"\xff\xfe", b"",
     b"{'descr': '<f4', 'fortran_order': False, 'shape': (10000000000000000000000,), }"],
)  # fmt: skip
def test_headers_of_numpy_that_lie_are_refused(header) -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(8))
    with zipfile.ZipFile(out) as archive, pytest.raises(ValueError, match=r"^(a is|a has|the header)"):
        array_of(archive, "a", np.float32, 1, 1 << 20)
