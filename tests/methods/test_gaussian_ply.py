import contextlib
import struct

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.gaussian_splatting.ply import PARTS, properties, read_ply, write_ply


def gaussians(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shapes = {
        "means": (3,),
        "log_scales": (3,),
        "quats": (4,),
        "logits": (),
        "sh_dc": (1, 3),
        "sh_rest": (15, 3),
    }
    values = {name: torch.randn((count, *shape), generator=generator) for name, shape in shapes.items()}
    return SceneGaussians("a scene", (1.0, 1.0, 1.0), 3, **values)


def parse(path):
    """A PLY reader of its own: property name -> values, as any splat viewer would find them."""
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    assert lines[2].startswith("comment ")
    assert len(lines) == 4 + len(names)
    values = [struct.unpack_from(f"<{len(names)}f", body, i * 4 * len(names)) for i in range(count)]
    assert len(body) == count * 4 * len(names)
    return dict(zip(names, np.array(values, dtype=np.float32).reshape(count, len(names)).T, strict=True))


def test_layout_is_what_splat_viewers_expect(tmp_path):
    scene = gaussians(5)
    write_ply(tmp_path / "s.ply", scene.rows())
    found = parse(tmp_path / "s.ply")
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(45)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(found) == expected
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(found[name], scene.means[:, axis])
        np.testing.assert_array_equal(found[f"n{name}"], 0.0)
        np.testing.assert_array_equal(found[f"scale_{axis}"], scene.log_scales[:, axis])
        np.testing.assert_array_equal(found[f"f_dc_{axis}"], scene.sh_dc[:, 0, axis])
        for k in range(15):  # all of one channel, then the next
            np.testing.assert_array_equal(found[f"f_rest_{15 * axis + k}"], scene.sh_rest[:, k, axis])
    for i in range(4):
        np.testing.assert_array_equal(found[f"rot_{i}"], scene.quats[:, i])
    np.testing.assert_array_equal(found["opacity"], scene.logits)


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_a_gaussian_takes_248_bytes(tmp_path, count):
    ledger = write_ply(tmp_path / "s.ply", gaussians(count).rows())
    size = (tmp_path / "s.ply").stat().st_size
    assert sum(ledger.values()) == size
    assert size - ledger["header"] == 248 * count


def test_vtk_opens_it(tmp_path):
    geometry = pytest.importorskip("vtkmodules.vtkIOPLY")
    numpy_support = pytest.importorskip("vtkmodules.util.numpy_support")
    scene = gaussians(50)
    write_ply(tmp_path / "s.ply", scene.rows())
    reader = geometry.vtkPLYReader()
    assert reader.CanReadFile(str(tmp_path / "s.ply"))
    reader.SetFileName(str(tmp_path / "s.ply"))
    reader.Update()
    points = numpy_support.vtk_to_numpy(reader.GetOutput().GetPoints().GetData())
    np.testing.assert_array_equal(points, scene.means)


@given(count=st.integers(0, 20), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_reading_gives_back_every_bit(tmp_path_factory, count, seed):
    path = tmp_path_factory.mktemp("ply") / "s.ply"
    scene = gaussians(count, seed)
    write_ply(path, scene.rows())
    again = SceneGaussians.from_rows("a scene", (1.0, 1.0, 1.0), 3, read_ply(path), "cpu")
    for name, value in vars(scene).items():
        same = getattr(again, name)
        assert torch.equal(value, same) if isinstance(value, torch.Tensor) else value == same


def test_properties_in_another_order_and_extra_ones_are_read_by_name(tmp_path):
    rows = gaussians(4).rows()
    names = [*properties(PARTS), "extra"]
    order = np.random.default_rng(0).permutation(len(names))
    wide = np.concatenate([rows, np.ones((4, 1), np.float32)], axis=1)[:, order]
    header = ["ply", "format binary_little_endian 1.0", "comment of another tool", "element vertex 4"]
    header += [f"property float {names[i]}" for i in order] + ["end_header\n"]
    (tmp_path / "s.ply").write_bytes("\n".join(header).encode() + wide.tobytes())
    np.testing.assert_array_equal(read_ply(tmp_path / "s.ply"), rows)


def unsealed(data):
    """As another program would write it."""
    return b"".join(line for line in data.splitlines(keepends=True) if not line.startswith(b"comment crc32"))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda data: data[:-1], "instead of"),
        (lambda data: data + b"\0", "instead of"),
        (lambda data: data[:100], "not a PLY"),
        (lambda data: b"", "not a PLY"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "unexpected header line"),
        (lambda data: data.replace(b"float f_rest_44", b"uchar f_rest_44"), "unexpected header line"),
        (lambda data: data.replace(b"property float rot_3\n", b""), "rot_3"),
        (lambda data: data.replace(b"vertex 3", b"vertex 9999999999999"), "instead of"),
        (lambda data: data.replace(b"vertex 3", b"vertex -3"), "unexpected header line"),
        (lambda data: data.replace(b"vertex 3", b"vertex " + b"9" * 5000), "unexpected header line"),
        (lambda data: unsealed(data[:-16] + bytes(16)), "a rotation that is zero"),
        (lambda data: unsealed(data[:-16] + 4 * b"\1\0\0\0"), "a rotation that is zero"),  # 1e-45
        (lambda data: unsealed(data[:-16] + 4 * b"\0\0\0\x7f"), "or too long"),  # 1.7e38
        (
            lambda data: unsealed(data[:-20] + np.float32(89.0).tobytes() + data[-16:]),
            "exponential is infinite",
        ),
        (lambda data: data.replace(b"element vertex 3\n", b""), "unexpected header line"),
        (lambda data: unsealed(data[:-4] + np.float32(np.nan).tobytes()), "NaN"),
        (lambda data: data[:-5] + bytes([data[-5] ^ 1]) + data[-4:], "checksum"),
    ],
)
def test_damaged_files_are_named(tmp_path, damage, reason):
    path = tmp_path / "s.ply"
    write_ply(path, gaussians(3).rows())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DataError, match=reason) as caught:
        read_ply(path)
    assert str(path) in str(caught.value)


@given(at=st.integers(0, 1500), byte=st.integers(0, 255), cut=st.integers(0, 400))
@settings(max_examples=150, deadline=None)
def test_any_damage_gives_values_or_a_named_error(tmp_path_factory, at, byte, cut):
    path = tmp_path_factory.mktemp("ply") / "s.ply"
    write_ply(path, gaussians(2).rows())
    data = bytearray(path.read_bytes())
    data[at % len(data)] = byte
    path.write_bytes(bytes(data[: len(data) - cut]))
    with contextlib.suppress(DataError):
        assert read_ply(path).shape == (2, 62)


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    for path in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(DataError, match="cannot be read"):
            read_ply(path)
