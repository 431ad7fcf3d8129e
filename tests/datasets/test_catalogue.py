"""The catalogue: names, paths, what is missing, and pictures' worth of every scene."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.datasets.catalogue import entries, list_datasets, open_dataset
from econgs_bench.datasets.catalogue.files import safe_name
from econgs_bench.datasets.errors import DataError, UnknownName

ALL = {"vortices", "vortices_fuzzy", "shells", "shells_pale", "jet_flame_iso", "vis_male", "fuel", "nucleon",
       "hydrogen_atom", "boston_teapot", "csafe_heptane",
       "stent_ct", "stroke_mri", "vortex_views", "vortex_views_400"}  # fmt: skip


def test_every_set_is_listed_without_numpy() -> None:
    code = (
        "import sys; from econgs_bench.datasets.catalogue import list_datasets;"
        "print(*[d.name for d in list_datasets()]);"
        "print([m for m in ('numpy', 'torch', 'mitsuba', 'nibabel') if m in sys.modules])"
    )
    names, heavy = subprocess.check_output([sys.executable, "-c", code], encoding="utf-8").splitlines()
    assert set(names.split()) >= ALL
    assert heavy == "[]"


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    infos = {info.name: info for info in list_datasets([tmp_path])}
    assert infos["vortices"].available
    assert not infos["fuel"].available
    for part in ("BENCH_DATA", str(tmp_path), "`bench fetch fuel`", "klacansky.com"):
        assert part in infos["fuel"].where
    assert (infos["fuel"].host, infos["fuel"].size) == ("klacansky.com", 64**3)
    assert infos["argon_bubble"].size == 2560 * 1024 * 1024 * 4
    assert (infos["cth_impact"].host, infos["cth_impact"].size) == ("", None)
    assert infos["vortices"].size is None
    with pytest.raises(DataError) as caught:
        open_dataset("fuel", data_dirs=[tmp_path])
    assert "BENCH_DATA" in str(caught.value)
    assert "fuel_64x64x64_uint8.raw" in str(caught.value)


def test_unknown_names() -> None:
    with pytest.raises(UnknownName, match="vis_male"):
        open_dataset("vis_mal")
    with pytest.raises(DataError, match="no number"):
        open_dataset("vortices@big")
    with pytest.raises(DataError, match="out of range"):
        open_dataset("vortices", resolution=100_000)
    with pytest.raises(DataError, match="only procedural"):
        open_dataset("fuel@32")


def test_default_dataset_has_four_scenes_the_first_two_without_common_voxels() -> None:
    dataset = open_dataset("vortices")
    assert dataset.name == "vortices"
    assert len(dataset.scenes) == 4
    assert dataset.compositions["all"] == tuple(scene.name for scene in dataset.scenes)
    values = dataset.volume("vortices").normalised()
    assert values.shape == (64, 64, 64)
    first, second = (scene.transfer.classify(values)[..., 3] > 0 for scene in dataset.scenes[:2])
    assert not (first & second).any()


def test_resolution() -> None:
    assert open_dataset("shells@24").volume("shells").dims == (24, 24, 24)
    assert open_dataset("shells@24").name == "shells@24"
    assert open_dataset("shells", resolution=24).volume("shells").dims == (24, 24, 24)


@pytest.mark.parametrize("name", sorted(ALL))
def test_entries_are_sound(name: str) -> None:
    table = entries.entry(name)
    scenes = [scene["name"] for scene in table["scenes"]]
    assert len(set(scenes)) == len(scenes) >= 2
    for parts in entries.compositions_of(table).values():
        assert set(parts) <= set(scenes)
        assert len(parts) >= 2
    for scene in table["scenes"]:
        for bump in scene.get("bumps", []):
            assert bump["range"] == sorted(bump["range"])
            assert 0 <= bump["range"][0] < bump["range"][3] <= 1
            assert 0 < bump["opacity"] < 1
            assert all(0 <= c <= 1 for c in bump["color"])


@pytest.mark.data
@pytest.mark.parametrize(
    "name", sorted(ALL - {"vortices", "vortices_fuzzy", "shells", "shells_pale", "jet_flame_iso"})
)
def test_real_sets(data_folder: Path, name: str) -> None:
    dataset = open_dataset(name)
    info = next(i for i in list_datasets() if i.name == name)
    assert info.available
    if dataset.kind == "views":
        assert all((scene.views_folder / "points3d.ply").is_file() for scene in dataset.scenes)
        return
    masks = []
    for scene in dataset.scenes:
        volume = dataset.volume(scene.variable)
        assert volume.dims == info.dims
        visible = scene.transfer.classify(volume.normalised()[::2, ::2, ::2])[..., 3] > 0
        assert 1e-4 < visible.mean() < 0.3, scene.name
        masks.append((scene.variable, visible))
    for i, (variable, a) in enumerate(masks):
        for other, b in masks[:i]:
            assert variable != other or (a & b).sum() < 0.1 * min(a.sum(), b.sum())


@pytest.mark.data
def test_views_folder_by_path(data_folder: Path) -> None:
    dataset = open_dataset(data_folder / "vortex_views")
    assert [scene.name for scene in dataset.scenes] == ["TF01", "TF02", "TF03", "TF04"]
    assert dataset.kind == "views"
    assert not dataset.compositions
    assert [s.name for s in open_dataset(data_folder / "vortex_views" / "TF02").scenes] == ["TF02"]


def test_a_file_nobody_knows(tmp_path: Path) -> None:
    values = (np.arange(24**3) % 251).astype(np.uint8).reshape(24, 24, 24)
    path = tmp_path / "my scan (1)_24x24x24_uint8.raw"
    path.write_bytes(values.tobytes())
    dataset = open_dataset(path)
    assert dataset.name == "my_scan_1_24x24x24_uint8"
    assert dataset.kind == "volume"
    np.testing.assert_array_equal(dataset.volume(dataset.scenes[0].variable).values, values)
    with pytest.raises(DataError, match="no such file"):
        open_dataset(tmp_path / "none_2x2x2_uint8.raw")
    with pytest.raises(DataError, match=r"transforms_train\.json"):
        open_dataset(tmp_path)


def test_safe_names() -> None:
    assert safe_name("../ä b") == "b"
    assert safe_name("§") == "volume"


def test_scenes_may_be_isosurfaces_and_depth_enhanced() -> None:
    from econgs_bench.datasets.catalogue.opening import _scenes
    from econgs_bench.datasets.scene import Isosurface

    table = tomllib.loads("""
        [[scenes]]
        name = "shells"
        variable = "T"
        depth_enhancement = 0.5
        light.model = "phong"
        light.direction = [0.0, 0.6, 0.8]
        [[scenes.isosurfaces]]
        name = "outer"
        value = 0.3
        color = [0.9, 0.5, 0.1]
        opacity = 0.4
        [[scenes.isosurfaces]]
        name = "inner"
        value = 0.6
        color = [0.1, 0.5, 0.9]
        """)
    (scene,) = _scenes(table)
    assert scene.transfer is None
    assert scene.depth_enhancement == 0.5
    assert (scene.light.model, scene.light.direction) == ("phong", (0.0, 0.6, 0.8))
    assert scene.isosurfaces == (
        Isosurface("outer", 0.3, (0.9, 0.5, 0.1), 0.4),
        Isosurface("inner", 0.6, (0.1, 0.5, 0.9), 1.0),
    )
