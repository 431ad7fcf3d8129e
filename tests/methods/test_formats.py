"""File formats of splats: bounds by their own steps, the axes of each, and programs of others as judges."""

from __future__ import annotations

import gzip
import json
import math
import shutil
import struct
import subprocess
import sys
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pyarrow
import pytest
import torch
from scipy.spatial import cKDTree

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.splat.sh import spherical_harmonics
from econgs_bench.econgs.splat.torch_backend import rotations
from econgs_bench.methods import formats
from econgs_bench.methods.formats import glb, integer, ply, sog, spz, zstd
from econgs_bench.methods.formats.gaussians import (
    COEFFICIENTS,
    LEFT_UP_FRONT,
    RIGHT_UP_BACK,
    degree_of,
    drawable,
    scene_of,
    tables,
)
from econgs_bench.methods.gaussian_splatting.ply import PARTS, properties, write_ply
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.decoders import own_streams

READ_AND_WRITTEN = {"ply": ply, "zstd": zstd, "spz": spz, "sog": sog, "integer": integer}
COUNT = 300


def asymmetric(count=COUNT, seed=5, degree=3):
    """Gaussians without any symmetry: no axis can be taken for another, nor for its opposite."""
    rng = np.random.default_rng(seed)
    values = {
        "means": rng.uniform([-1.0, 0.1, 2.0], [0.2, 0.5, 4.0], (count, 3)),
        "log_scales": rng.uniform([-6.0, -4.0, -3.0], [-5.0, -3.5, -2.0], (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "logits": rng.normal(size=count),
        "sh_dc": rng.uniform(-1.0, 1.5, (count, 1, 3)),
        "sh_rest": rng.uniform(-0.4, 0.6, (count, 15, 3)),
    }
    return scene_of(
        {name: one.astype(np.float32) for name, one in values.items()}, "a", (0.0, 0.5, 1.0), degree
    )


def paired(values, others):
    """Rows of the others that lie nearest to those of the first."""
    rows = cKDTree(others["means"]).query(values["means"])[1]
    assert len(set(rows.tolist())) == len(rows)
    return {name: one[rows] for name, one in others.items()}


def covariances(quats, log_scales):
    turns = rotations(torch.from_numpy(np.asarray(quats, np.float64)))
    spread = turns * torch.from_numpy(np.exp(log_scales.astype(np.float64)))[:, None]
    return (spread @ spread.transpose(1, 2)).numpy()


def angles(one, other):
    """Degrees between rotations."""
    unit = [values / np.linalg.norm(values, axis=1, keepdims=True) for values in (one, other)]
    return np.degrees(2.0 * np.arccos(np.clip(np.abs((unit[0] * unit[1]).sum(1)), 0.0, 1.0)))


def opacities(values):
    return 1.0 / (1.0 + np.exp(-values["logits"].astype(np.float64)))


def of_gsply(found):
    count = len(found.means)
    return {
        "means": found.means, "log_scales": found.scales, "quats": found.quats,
        "logits": found.opacities.reshape(count), "sh_dc": found.sh0.reshape(count, 1, 3),
        "sh_rest": found.shN.reshape(count, 15, 3),
    }  # fmt: skip


def differences(values, others):
    return {name: float(np.abs(values[name] - others[name]).max()) for name in values}


def within_spz(values, others):
    """Steps of SPZ 3: 2^-12 in place, 1/16 in scale, 9 bits and a sign of √½, 8 bits, 5 and 4 bits of ±1."""
    off = differences(values, others)
    assert off["means"] <= 0.5 / 4096 + 1e-6
    assert off["log_scales"] <= 0.5 / 16 + 1e-5
    assert off["sh_dc"] <= 0.5 / (0.15 * 255) + 1e-5
    assert np.abs(opacities(values) - opacities(others)).max() <= 0.5 / 255 + 1e-5
    assert np.abs(values["sh_rest"] - others["sh_rest"])[:, :3].max() <= 0.5 / 16 + 1 / 128
    assert off["sh_rest"] <= 0.5 / 8 + 1 / 128
    assert angles(values["quats"], others["quats"]).max() < 0.3


def within_sog(values, others):
    """Steps of SOG 2: 16 bits of the logarithm's range, 8 bits of ±√½, 8 bits; 256 words for the others."""
    off = differences(values, others)
    assert off["means"] <= 1e-4
    assert np.abs(opacities(values) - opacities(others)).max() <= 0.5 / 255 + 1e-5
    assert off["log_scales"] < 0.05
    assert off["sh_dc"] < 0.05
    assert angles(values["quats"], others["quats"]).max() < 1.1


def test_plain_numbers_are_kept(tmp_path):
    scene = asymmetric()
    for name in ("ply", "zstd"):
        file = tmp_path / f"a{READ_AND_WRITTEN[name].SUFFIX}"
        parts = READ_AND_WRITTEN[name].write(file, scene)
        assert sum(parts.values()) == file.stat().st_size
        off = differences(tables(scene), READ_AND_WRITTEN[name].read(file).tables)
        assert off.pop("quats") < 3e-7  # brought to length 1 once more
        assert not any(off.values())
    assert max(differences(tables(scene), of_gsply(gsply.plyread(tmp_path / "a.ply"))).values()) == 0.0


def test_spz_keeps_its_steps(tmp_path):
    file, values = tmp_path / "a.spz", tables(asymmetric())
    assert spz.write(file, asymmetric()) == {"file": file.stat().st_size}
    within_spz(values, spz.read(file).tables)
    spz.write(file, asymmetric(), spz.FINEST)
    assert differences(values, spz.read(file).tables)["sh_rest"] <= 0.5 / 128 + 1e-6


@pytest.mark.parametrize("name", ["ply", "zstd", "spz", "sog"])
def test_a_file_says_for_which_viewers_it_is(tmp_path, name):
    form = READ_AND_WRITTEN[name]
    versions = [{"version": 3}, {"version": 4}] if name == "spz" else [{}]
    for more in versions:
        file = tmp_path / f"a{form.SUFFIX}"
        for marked, viewer in ((True, "antialiased"), (False, "plain")):
            parts = form.write(file, asymmetric(40), antialiased=marked, **more)
            assert sum(parts.values()) == file.stat().st_size
            assert form.read(file).viewer == viewer


def test_formats_without_a_mark_are_written_the_same(tmp_path):
    for form in (glb, integer):
        found = set()
        for marked in (True, False):
            form.write(tmp_path / "x", asymmetric(40), antialiased=marked)
            found.add((tmp_path / "x").read_bytes())
        assert len(found) == 1


def with_contents(file, change):
    """Change the table of contents of a SOG."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    about = json.loads(members["meta.json"])
    members["meta.json"] = json.dumps(change(about)).encode()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return about


def test_marks_of_other_programs_are_read(tmp_path):
    file = tmp_path / "a.sog"
    sog.write(file, asymmetric(40))
    assert not with_contents(file, lambda about: about | {"antialias": True}).keys() & {"antialias", "model"}
    assert sog.read(file).antialiased
    for entries, antialiased in (
        ({"model": "antialiased"}, True),
        ({"model": "2dgs", "antialias": True}, False),
        ({"antialias": False}, False),
        ({"antialias": "no"}, False),
    ):
        with_contents(file, lambda about, own=entries: {
            name: one for name, one in about.items() if name not in ("antialias", "model")
        } | own)  # fmt: skip
        assert sog.read(file).antialiased == antialiased
    sog.write(file, asymmetric(40), antialiased=True)
    about = with_contents(file, dict)
    assert (about["antialias"], about["model"]) == (True, "antialiased")

    file = tmp_path / "a.ply"
    ply.write(file, asymmetric(40), antialiased=True)
    own = b"comment SplatRenderMode: mip\n"
    assert own in file.read_bytes()
    for lines, antialiased in (
        (b"comment splatrendermode:  MIP\n", True),
        (b"comment SplatRenderMode: default\n", False),
        (b"comment antialiased 1\n", True),
        (b"comment postshot.anti_aliasing=1\n", True),
        (b"comment postshot.anti_aliasing=0\n", False),
        (b"comment antialiased 1\ncomment SplatRenderMode: default\n", False),
        (b"comment is antialiased 1\n", False),
    ):
        ply.write(file, asymmetric(40), antialiased=True)
        file.write_bytes(file.read_bytes().replace(own, lines))
        assert ply.read(file).antialiased == antialiased, lines


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_ply_of_another_trainer_is_read(tmp_path, degree):
    """Without normals, and with no more coefficients than its degree has."""
    scene, many = asymmetric(40, degree=degree), COEFFICIENTS[degree]
    kept = [f"f_rest_{15 * channel + place}" for channel in range(3) for place in range(many)]
    parts = {part: names for part, names in PARTS.items() if part not in ("normals", "sh_rest")}
    places = [properties(PARTS).index(name) for name in (*properties(parts), *kept)]
    names = parts | ({"sh_rest": PARTS["sh_rest"][: 3 * many]} if many else {})
    write_ply(tmp_path / "a.ply", scene.rows()[:, places], names)
    off = differences(tables(scene), ply.read(tmp_path / "a.ply").tables)
    assert off.pop("quats") < 3e-7
    assert not any(off.values())


@pytest.mark.parametrize("suffix", [".splat", ".ksplat", ".GLB"])
def test_splats_that_cannot_be_read_are_refused_with_those_that_can(tmp_path, suffix):
    with pytest.raises(DataError, match=r"Convert it to one of \.ply, \.spz, \.sog"):
        formats.refuse_unread(tmp_path / f"a{suffix}")
    for name in ("a.ply", "a.vti", "a"):
        formats.refuse_unread(tmp_path / name)
    assert set(formats.READ) <= {form.SUFFIX for form in READ_AND_WRITTEN.values()}


def test_spz_is_the_same_at_any_time(tmp_path, monkeypatch):
    found = []
    for now in (1.0e9, 2.0e9):
        monkeypatch.setattr(time, "time", lambda now=now: now)
        spz.write(tmp_path / "a.spz", asymmetric())
        found.append((tmp_path / "a.spz").read_bytes())
    assert found[0] == found[1]


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_both_versions_of_spz_hold_the_same(tmp_path, degree):
    scene = asymmetric(degree=degree)
    third, fourth = tmp_path / "3.spz", tmp_path / "4.spz"
    spz.write(third, scene, antialiased=True)
    spz.write(fourth, scene, antialiased=True, version=4)
    data = fourth.read_bytes()
    streams = 6 if degree else 5
    head = (b"NGSP", 4, COUNT, degree, 12, 1, streams, 32)
    assert struct.unpack_from("<4sIIBBBBI12x", data) == head
    sizes = struct.unpack_from(f"<{2 * streams}Q", data, 32)
    plain, start = [], 32 + 16 * streams
    for stored, size in zip(sizes[::2], sizes[1::2], strict=True):
        plain.append(pyarrow.decompress(data[start : start + stored], size, codec="zstd", asbytes=True))
        start += stored
    assert start == len(data)
    assert b"".join(plain) == gzip.decompress(third.read_bytes())[16:]
    with own_streams():
        assert not max(differences(spz.read(third).tables, spz.read(fourth).tables).values())
        for broken in (
            data[:40],
            data[:-9],
            data[:200] + bytes(60) + data[260:],
            data[:8] + b"\xff" * 4 + data[12:],
        ):
            fourth.write_bytes(broken)
            with pytest.raises(DataError, match=r"4\.spz"):
                spz.read(fourth)


def test_spz_points_right_up_and_back(tmp_path):
    """Against the bytes that the format's description gives, read here."""
    file, values = tmp_path / "a.spz", tables(asymmetric())
    spz.write(file, asymmetric())
    data = gzip.decompress(file.read_bytes())
    magic, version, count, degree, fraction = struct.unpack_from("<IIIBB", data)
    assert (magic, version, count, degree, fraction) == (0x5053474E, 3, COUNT, 3, 12)
    triples = np.frombuffer(data, np.uint8, 9 * count, 16).reshape(count, 3, 3).astype(np.int64)
    whole = triples @ np.array([1, 256, 65536])
    whole = np.where(whole >= 1 << 23, whole - (1 << 24), whole)
    turned = values["means"] * np.array(RIGHT_UP_BACK)
    assert np.abs(whole / 4096 - turned).max() <= 0.5 / 4096 + 1e-6
    # The harmonic of z is odd in z, which the frame turns round.
    start = 16 + count * (9 + 1 + 3 + 3 + 4)
    rest = np.frombuffer(data, np.uint8, count * 45, start).reshape(count, 15, 3)
    assert np.abs((rest[:, 1] - 128.0) / 128.0 + values["sh_rest"][:, 1]).max() <= 0.5 / 16 + 1e-5


@pytest.mark.parametrize("frame", [RIGHT_UP_BACK, LEFT_UP_FRONT])
def test_a_turned_scene_looks_the_same_from_a_turned_place(frame):
    scene = asymmetric()
    turned = scene_of(tables(scene, frame), "a", (0.0, 0.0, 0.0), 3)
    signs = torch.tensor(frame, dtype=torch.float32)
    eye = torch.tensor([0.7, -1.3, 0.4])
    colors = [
        spherical_harmonics(3, one.means, place, one.sh_dc, one.sh_rest)
        for one, place in ((scene, eye), (turned, eye * signs))
    ]
    torch.testing.assert_close(colors[0], colors[1], atol=1e-5, rtol=1e-5)
    flip = np.diag(np.array(frame, np.float64))
    expected = flip @ covariances(scene.quats.numpy(), scene.log_scales.numpy()) @ flip
    found = covariances(turned.quats.numpy(), turned.log_scales.numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9)


def test_positions_in_spz_fit_scenes_of_any_size(tmp_path):
    for size, bits in ((1.0, 12), (100.0, 12), (5000.0, 9), (0.01, 18)):
        means = size * np.array([[1.0, -0.5, 0.25]], np.float32)
        assert spz.fraction_bits(means) == bits
        scene = replace(asymmetric(1), means=torch.from_numpy(means))
        spz.write(tmp_path / "a.spz", scene)
        off = np.abs(spz.read(tmp_path / "a.spz").tables["means"] - means).max()
        assert off <= 0.5 / 2.0**bits + 1e-7 * size


def test_sog_is_read_by_another_program(tmp_path):
    file, values = tmp_path / "a.sog", tables(asymmetric())
    parts = sog.write(file, asymmetric())
    assert sum(parts.values()) == file.stat().st_size
    own = sog.read(file).tables
    within_sog(values, paired(values, own))
    found = of_gsply(gsply.sogread(str(file)))
    assert max(differences(own, found).values()) < 1e-5


def test_integers_keep_their_steps(tmp_path):
    scene, file = asymmetric(), tmp_path / f"a{integer.SUFFIX}"
    values, sizes = tables(scene), []
    for factor in (0.25, 1.0, 4.0):
        parts = integer.write(file, scene, factor)
        assert sum(parts.values()) == file.stat().st_size
        sizes.append(file.stat().st_size)
        read = paired(values, integer.read(file).tables)
        cell = factor * integer.CELL * math.exp(np.median(values["log_scales"].mean(1)))
        assert differences(values, read)["means"] <= 0.51 * cell
        assert differences(values, read)["logits"] <= 0.51 * factor * integer.STEPS["logits"]
        largest = factor * 2.0 ** integer.COARSER[1]
        assert differences(values, read)["sh_rest"] <= 0.51 * largest * integer.STEPS["sh_rest"]
        scales = [np.sort(one["log_scales"], axis=1) for one in (values, read)]
        assert np.abs(scales[0] - scales[1]).max() <= 0.51 * factor * integer.STEPS["log_scales"]
    assert sizes[0] > sizes[1] > sizes[2]
    again = file.read_bytes()
    integer.write(file, scene, 4.0)
    assert file.read_bytes() == again


def test_fine_integers_are_the_same_ellipsoids(tmp_path):
    scene, file = asymmetric(), tmp_path / f"a{integer.SUFFIX}"
    integer.write(file, scene, 1e-3)
    values = tables(scene)
    read = paired(values, integer.read(file).tables)
    expected = covariances(values["quats"], values["log_scales"])
    found = covariances(read["quats"], read["log_scales"])
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def test_the_least_turn_names_the_same_ellipsoid():
    values = tables(asymmetric(2000))
    scales, vectors = integer.least_turn(values["log_scales"], values["quats"])
    w = np.sqrt(1.0 - np.square(vectors).sum(1, keepdims=True))
    assert w.min() > math.cos(math.radians(62.8 / 2)) - 1e-4  # the largest turn from a cube to itself
    found = covariances(np.concatenate([w, vectors], 1), scales)
    np.testing.assert_allclose(
        found, covariances(values["quats"], values["log_scales"]), rtol=1e-3, atol=1e-8
    )


def parsed_glb(file):
    """Contents and attributes of a binary glTF, by its specification."""
    data = file.read_bytes()
    magic, version, length = struct.unpack_from("<III", data)
    assert (magic, version, length) == (0x46546C67, 2, len(data))
    size, kind = struct.unpack_from("<II", data, 12)
    assert kind == 0x4E4F534A
    contents = json.loads(data[20 : 20 + size])
    assert struct.unpack_from("<I", data, 24 + size)[0] == 0x004E4942
    binary = data[28 + size :]
    found = {}
    for name, number in contents["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = contents["accessors"][number]
        view = contents["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        found[name] = np.frombuffer(part, kind).reshape(accessor["count"], -1)
    return contents, found


def test_glb_points_left_up_and_to_the_front(tmp_path):
    scene, file = asymmetric(), tmp_path / "a.glb"
    assert sum(glb.write(file, scene).values()) == file.stat().st_size
    contents, found = parsed_glb(file)
    values, prefix = tables(scene), glb.EXTENSION
    assert contents["extensionsUsed"] == [prefix]
    np.testing.assert_array_equal(found["POSITION"], values["means"] * np.array([-1, -1, 1]))
    np.testing.assert_allclose(found[f"{prefix}:OPACITY"][:, 0], opacities(values), atol=1e-6)
    np.testing.assert_allclose(found[f"{prefix}:SCALE"], np.exp(values["log_scales"]), rtol=1e-5)
    # Odd in x and y alone: x y is even in this frame, y z odd.
    np.testing.assert_array_equal(found[f"{prefix}:SH_DEGREE_2_COEF_0"], values["sh_rest"][:, 3])
    np.testing.assert_array_equal(found[f"{prefix}:SH_DEGREE_2_COEF_1"], -values["sh_rest"][:, 4])
    accessor = contents["accessors"][0]
    assert accessor["min"] == found["POSITION"].min(0).tolist()
    glb.write(file, replace(scene, sh_degree=1))
    assert not any("DEGREE_2" in name for name in parsed_glb(file)[1])


FLOAT = (5126, False)
SPLATTING = {
    "ROTATION": ("VEC4", {FLOAT, (5120, True), (5122, True)}),
    "SCALE": ("VEC3", {FLOAT, (5120, False), (5120, True), (5122, False), (5122, True)}),
    "OPACITY": ("SCALAR", {FLOAT, (5121, True), (5123, True)}),
}
"""Attributes that the ratified KHR_gaussian_splatting requires: type, and kinds of numbers (normalized)."""


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_glb_keeps_the_rules_of_the_ratified_extension(tmp_path, degree):
    """Its tables of properties and attributes, and its rules for the kernel "ellipse"."""
    glb.write(tmp_path / "a.glb", asymmetric(degree=degree))
    contents, found = parsed_glb(tmp_path / "a.glb")
    (primitive,) = contents["meshes"][0]["primitives"]
    about = primitive["extensions"][glb.EXTENSION]
    assert glb.EXTENSION in contents["extensionsUsed"]
    assert primitive["mode"] == 0  # points
    assert about.pop("kernel") == "ellipse"
    assert about.pop("colorSpace") in ("srgb_rec709_display", "lin_rec709_display")
    assert about.pop("projection", "perspective") == "perspective"
    assert about.pop("sortingMethod", "cameraDistance") == "cameraDistance"
    assert not about
    coefficients = {f"SH_DEGREE_{one}_COEF_{n}" for one in range(degree + 1) for n in range(2 * one + 1)}
    needed = SPLATTING | dict.fromkeys(coefficients, ("VEC3", {FLOAT}))
    names = {f"{glb.EXTENSION}:{name}" for name in needed}
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0"} | names
    for name, (kind, numbers) in needed.items():
        accessor = contents["accessors"][primitive["attributes"][f"{glb.EXTENSION}:{name}"]]
        assert accessor["type"] == kind
        assert (accessor["componentType"], accessor.get("normalized", False)) in numbers
        assert accessor["count"] == COUNT
    values = {name: found[f"{glb.EXTENSION}:{name}"] for name in SPLATTING}
    assert values["SCALE"].min() >= 0.0
    assert values["OPACITY"].min() >= 0.0
    assert values["OPACITY"].max() <= 1.0
    np.testing.assert_allclose(np.linalg.norm(values["ROTATION"], axis=1), 1.0, atol=1e-5)


# --------------------------------------------------------------------------- the viewers' own tool


@pytest.fixture(scope="module")
def convert():
    """Runs splat-transform of PlayCanvas, where it is (npm install -g @playcanvas/splat-transform)."""
    tool = shutil.which("splat-transform")
    if tool is None:
        pytest.skip("no splat-transform here")

    def run(source, target, *options):
        command = [tool, "-w", "-q", "-g", "cpu", str(source), *options, str(target)]
        subprocess.run(command, check=True, capture_output=True, timeout=300)

    return run


@pytest.mark.parametrize(
    ("name", "version", "within"), [("spz", 3, within_spz), ("spz", 4, within_spz), ("sog", 2, within_sog)]
)
def test_the_viewers_tool_reads_and_writes_the_same(convert, tmp_path, name, version, within):
    scene, form = asymmetric(), READ_AND_WRITTEN[name]
    values = tables(scene)
    form.write(tmp_path / f"ours{form.SUFFIX}", scene, **({"version": version} if name == "spz" else {}))
    convert(tmp_path / f"ours{form.SUFFIX}", tmp_path / "ours.ply")
    within(values, paired(values, of_gsply(gsply.plyread(tmp_path / "ours.ply"))))
    ply.write(tmp_path / "a.ply", scene)
    convert(
        tmp_path / "a.ply",
        tmp_path / f"theirs{form.SUFFIX}",
        *(["--spz-version", str(version)] if name == "spz" else []),
    )
    theirs = paired(values, form.read(tmp_path / f"theirs{form.SUFFIX}").tables)
    if name == "spz":
        within(values, theirs)
    else:  # its codebooks come from fewer rounds
        assert differences(values, theirs)["means"] <= 1e-4
        assert angles(values["quats"], theirs["quats"]).max() < 1.5


def test_the_viewers_tool_writes_the_same_gltf(convert, tmp_path):
    scene = asymmetric()
    ply.write(tmp_path / "a.ply", scene)
    glb.write(tmp_path / "ours.glb", scene)
    convert(tmp_path / "a.ply", tmp_path / "theirs.glb")
    (one, ours), (other, theirs) = (parsed_glb(tmp_path / f"{who}.glb") for who in ("ours", "theirs"))
    assert list(ours) == list(theirs)
    first, second = (contents["meshes"][0]["primitives"][0]["extensions"] for contents in (one, other))
    assert first == second
    rotation, scale = (f"{glb.EXTENSION}:{name}" for name in ("ROTATION", "SCALE"))
    for name in set(ours) - {rotation}:
        np.testing.assert_allclose(ours[name], theirs[name], atol=2e-6)
    # Theirs is the same ellipsoid with two axes reversed.
    found = [covariances(np.roll(part[rotation], 1, 1), np.log(part[scale])) for part in (ours, theirs)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3, atol=1e-8)


# --------------------------------------------------------------------------- what goes wrong


@pytest.mark.parametrize("name", READ_AND_WRITTEN)
def test_damaged_files_are_named(tmp_path, name):
    form = READ_AND_WRITTEN[name]
    file = tmp_path / f"scene{form.SUFFIX}"
    form.write(file, asymmetric(40))
    whole = file.read_bytes()
    for broken in (b"", whole[:7], whole[: len(whole) // 2], whole[:-5], b"nothing of the kind" * 40):
        file.write_bytes(broken)
        with pytest.raises(DataError, match=r"scene\."):
            form.read(file)
    file.unlink()
    with pytest.raises(DataError, match=r"scene\."):
        form.read(file)


@pytest.mark.parametrize("name", READ_AND_WRITTEN)
@pytest.mark.parametrize("count", [0, 1])
def test_nothing_and_a_single_gaussian(tmp_path, name, count):
    form = READ_AND_WRITTEN[name]
    file = tmp_path / f"scene{form.SUFFIX}"
    form.write(file, asymmetric(count))
    read = form.read(file).tables
    assert len(read["means"]) == count
    assert np.abs(read["means"] - asymmetric(count).means.numpy()).max(initial=0.0) < 1e-2


def test_lower_degrees_take_fewer_bytes(tmp_path):
    full, flat = asymmetric(), replace(asymmetric(), sh_degree=0)
    assert degree_of(full) == 3
    assert degree_of(flat) == 0
    for form in (spz, sog, integer, glb):
        sizes = []
        for scene in (full, flat):
            form.write(tmp_path / "x", scene)
            sizes.append((tmp_path / "x").stat().st_size)
        assert sizes[1] < 0.6 * sizes[0]
    spz.write(tmp_path / "x", flat)
    assert not spz.read(tmp_path / "x").tables["sh_rest"].any()


def test_what_cannot_be_seen_is_left_out():
    scene = asymmetric(6)
    scene.logits[0], scene.means[1, 2], scene.quats[2] = -6.0, math.nan, 0.0
    assert len(drawable(scene)) == 3


def test_spz_without_its_library_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(Refused, match=r"econgs-bench\[rivals\]"):
        spz.write(Path(tmp_path, "a.spz"), asymmetric(3))
