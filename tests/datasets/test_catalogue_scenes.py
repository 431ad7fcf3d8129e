"""Every scene of the catalogue shows something, none fills its box, and no two show the same."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from skimage.morphology import convex_hull_image

from econgs_bench.datasets.auto_transfer import automatic_scenes
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.catalogue import entries, open_dataset
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.datasets.render_views import views_of
from econgs_bench.datasets.scene import Dataset
from econgs_bench.datasets.view_cache import ViewCache
from econgs_bench.datasets.views import ViewRequest, ViewSet

REQUEST = ViewRequest("test", 12, 2, 48, 48, samples=1)
NAMES = (
    "boston_teapot", "carotid_flow", "csafe_heptane", "cth_impact", "engine_ct", "fuel", "hydrogen_atom",
    "isabel_wind", "mesh_disk_out_ref", "mesh_fire_ug", "nucleon", "stent_ct", "stroke_mri", "vis_male",
    "viscous_fingers",
)  # fmt: skip


PROCEDURAL = [
    name for name in entries.names() if entries.entry(name)["kind"] == "procedural" and name != "extremes"
]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> ViewCache:
    return ViewCache(tmp_path_factory.mktemp("views"))


def _silhouette(camera: Camera, box: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(height, width) bool: the pixels that the volume's box covers."""
    corners = np.array([[box[(i >> axis) & 1][axis] for axis in range(3)] for i in range(8)])
    local = (corners - camera.position) @ camera.camera_to_world[:3, :3]
    x = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    y = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    picture = np.zeros((camera.height, camera.width), dtype=bool)
    at = (np.clip(v.astype(int), 0, n - 1) for v, n in ((y, camera.height), (x, camera.width)))
    picture[tuple(at)] = True
    return np.asarray(convex_hull_image(picture))


def _check(dataset: Dataset, name: str, views: ViewSet, least: float) -> None:
    alpha = views.images[..., 3]
    assert least < alpha.mean() < 0.7, f"{name}: mean alpha {alpha.mean():.4f}"
    for camera, picture in zip(views.cameras, alpha, strict=True):
        box = _silhouette(camera, dataset.volume(dataset.scene(name).variable).box)
        assert picture[~box].max(initial=0.0) < 0.5  # the silhouette is that of the box
        assert picture[box].mean() < 0.8, f"{name}: fills {picture[box].mean():.2f} of its box"


def _unlike(a: ViewSet, b: ViewSet) -> float:
    """1 - intersection over union of two coverages."""
    x, y = a.images[..., 3], b.images[..., 3]
    return float(1.0 - np.minimum(x, y).sum() / np.maximum(x, y).sum())


def _check_all(dataset: Dataset, cache: ViewCache, least: float = 0.005) -> None:
    views = {s.name: views_of(dataset, s.name, REQUEST, cache=cache) for s in dataset.scenes}
    for scene, view_set in views.items():
        _check(dataset, scene, view_set, least)
    alike = {(a, b): round(_unlike(views[a], views[b]), 3) for a, b in combinations(views, 2)}
    assert min(alike.values(), default=1.0) > 0.05, min(alike, key=lambda pair: alike[pair])


@pytest.mark.data
@pytest.mark.parametrize("name", NAMES)
def test_tuned_scenes(data_folder: Path, cache: ViewCache, name: str) -> None:
    dataset = open_dataset(name, [data_folder])
    assert {dataset.volume(v).dims for v in dataset.volumes} == {tuple(entries.entry(name)["dims"])}
    assert len(dataset.scenes) >= 2
    _check_all(dataset, cache)


@pytest.mark.parametrize("name", PROCEDURAL)
def test_procedural_scenes(cache: ViewCache, name: str) -> None:
    _check_all(open_dataset(name, []), cache)


def test_extreme_scenes(cache: ViewCache) -> None:
    dataset = open_dataset("extremes", [])
    request = replace(REQUEST, samples=0)  # a point may lie between single rays
    alphas = {s.name: views_of(dataset, s.name, request, cache=cache).images[..., 3] for s in dataset.scenes}
    assert not alphas["nothing"].any()
    assert 1e-4 < alphas["point"].mean() < 0.005
    assert 0.005 < alphas["hairs"].mean() < 0.2
    assert alphas["full"].mean() > 0.25
    assert (alphas["full"] > 0.95).mean() > 0.8 * (alphas["full"] > 0.05).mean()


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_automatic_scenes(data_folder: Path, cache: ViewCache, name: str) -> None:
    dataset = open_dataset(name, [data_folder])
    for variable in dataset.volumes:
        volume = dataset.volume(variable)
        for count in (1, 3):
            one = replace(dataset, scenes=automatic_scenes(volume, count), compositions={})
            _check_all(one, cache, 0.002)


def test_joined_sets_keep_their_boxes_and_names():
    joined = open_dataset("beetle_like@16+vortices@16")
    first, second = open_dataset("beetle_like@16"), open_dataset("vortices@16")
    assert [scene.name for scene in joined.scenes] == [
        f"{one.name}.{scene.name}" for one in (first, second) for scene in one.scenes
    ]
    for scene in joined.scenes:
        member, _, name = scene.name.rpartition(".")
        alone = open_dataset(member)
        own = alone.scene(name)
        assert (scene.transfer, scene.light, scene.isosurfaces) == (own.transfer, own.light, own.isosurfaces)
        ours, theirs = joined.volume(scene.variable), alone.volume(own.variable)
        assert ours.extent == pytest.approx(theirs.extent)
        np.testing.assert_array_equal(ours.values, theirs.values)
    assert all(name.startswith("vortices@16.") for name in joined.compositions)


def test_joined_sets_must_be_different_volumes_of_the_catalogue():
    with pytest.raises(DataError, match="names a dataset twice"):
        open_dataset("vortices@16+vortices@16")
    with pytest.raises(UnknownName):
        open_dataset("vortices+nothing_like_it")
