"""Frames: views show what is visible, as large as it fits; those of the catalogue show the whole box."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from econgs_bench.datasets.camera_paths import test_cameras as path_cameras
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.content import fingerprint
from econgs_bench.datasets.render_views import cameras_of, views_of
from econgs_bench.datasets.view_cache import ViewCache
from econgs_bench.datasets.views import ViewRequest

REQUEST = ViewRequest("test", 12, 5, 64, 48, samples=1)

ENTRY = """
[[files]]
path = "ball.npy"
[[scenes]]
name = "ball"
[[scenes.bumps]]
name = "ball"
range = [0.4, 0.5, 1.0, 1.0]
color = [0.9, 0.6, 0.2]
opacity = 0.5
"""


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    """A ball of radius 0.15 around (0.2, -0.1, -0.25), in scene space."""
    x, y, z = np.meshgrid(*[np.linspace(-0.5, 0.5, 48)] * 3, indexing="ij")
    far = np.sqrt((z - 0.2) ** 2 + (y + 0.1) ** 2 + (x + 0.25) ** 2)
    np.save(tmp_path / "ball.npy", (1 / (1 + np.exp((far - 0.15) / 0.01))).astype(np.float32))
    (tmp_path / "mine.toml").write_text(ENTRY)
    return tmp_path


def _filling(alpha: np.ndarray) -> float:
    """Longer side of the visible part over the shorter side of the picture."""
    rows, columns = (np.flatnonzero((alpha > 0.1).any(axis=axis)) for axis in (1, 0))
    return float(max(np.ptp(rows), np.ptp(columns)) + 1) / min(alpha.shape)


@pytest.mark.parametrize("name", ["ball.npy", "mine.toml"])
def test_a_small_thing_in_a_large_box_fills_the_picture(ball: Path, cache: ViewCache, name: str) -> None:
    dataset = open_dataset(str(ball / name))
    frame = dataset.frame
    assert frame is not None
    np.testing.assert_allclose(frame.centre, (0.2, -0.1, -0.25), atol=0.03)
    assert 0.13 < frame.radius < 0.25
    scene = dataset.scenes[0].name
    views = views_of(dataset, scene, REQUEST, renderer="reference", cache=cache)
    for alpha in views.images[..., 3]:
        assert 0.6 <= _filling(alpha) <= 1.0
        assert max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) < 0.1


@pytest.mark.data
@pytest.mark.parametrize("name", ["fuel", "vis_male", "isabel_wind"])
def test_real_volumes_fill_the_picture(data_folder: Path, cache: ViewCache, name: str) -> None:
    file = sorted(file for file in (data_folder / name).iterdir())[0]
    dataset = open_dataset(str(file))
    whole = "all" if dataset.compositions else dataset.scenes[0].name
    views = views_of(dataset, whole, REQUEST, cache=cache)
    assert np.mean([_filling(alpha) for alpha in views.images[..., 3]]) >= 0.6


def test_a_written_frame_is_kept(ball: Path) -> None:
    before = open_dataset(str(ball / "mine.toml"))
    text = "frame = { centre = [0.1, 0.0, -0.2], radius = 0.4 }\n" + ENTRY
    (ball / "mine.toml").write_text(text)
    dataset = open_dataset(str(ball / "mine.toml"))
    for camera in cameras_of(dataset, "ball", REQUEST):
        ahead = camera.camera_to_world[:3, 2]
        way = np.array([0.1, 0.0, -0.2]) - camera.position
        assert way @ ahead == pytest.approx(np.linalg.norm(way))
        assert np.linalg.norm(way) == pytest.approx(0.4 * 1.02 / np.sin(np.radians(15.0)))
    assert fingerprint(dataset, "ball") != fingerprint(before, "ball"), "the views differ"


def test_isosurfaces_have_a_frame_too(ball: Path) -> None:
    head, _, _ = ENTRY.partition("[[scenes.bumps]]")
    level = '[[scenes.isosurfaces]]\nname = "s"\nvalue = 0.5\ncolor = [1.0, 1.0, 1.0]\n'
    (ball / "mine.toml").write_text(head + level)
    frame = open_dataset(str(ball / "mine.toml")).frame
    assert frame is not None
    np.testing.assert_allclose(frame.centre, (0.2, -0.1, -0.25), atol=0.03)


def test_the_catalogue_shows_whole_boxes() -> None:
    dataset = open_dataset("vortices@16")
    assert dataset.frame is None
    radius = 0.5 * float(np.linalg.norm(dataset.volume(dataset.scenes[0].variable).extent))
    expected = path_cameras(5, radius, 64, 48)
    for one, other in zip(cameras_of(dataset, dataset.scenes[0].name, REQUEST), expected, strict=True):
        assert one.camera_to_world.tobytes() == other.camera_to_world.tobytes()
