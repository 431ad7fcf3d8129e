"""Point clouds: where opacity is, in the colors of the transfer function; PLY both ways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from econgs_bench.datasets.camera import Camera, with_near_planes
from econgs_bench.datasets.camera_paths import training_cameras
from econgs_bench.datasets.cloud import initial_cloud, random_cloud, random_start, read_ply
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import BasicScene, Dataset, Isosurface
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.volume import Volume
from tests.datasets.damage import check_damage
from tests.datasets.views_folder import write_ply

COLOR = (0.2, 0.4, 0.9)


def _dataset(shape: tuple[int, int, int], bump: tuple[float, float, float, float]) -> Dataset:
    nz, ny, nx = shape
    z, y, x = np.meshgrid(np.linspace(0, 1, nz), np.linspace(0, 1, ny), np.linspace(0, 1, nx), indexing="ij")
    values = (0.5 * x + 0.3 * y + 0.2 * z).astype(np.float32)
    volume = Volume("v", values, (1.0, 2.0, 0.5), (0.0, 1.0), "test")
    transfer = TransferFunction("t", (Bump("b", *bump, COLOR, 0.5),))
    return Dataset("d", "test", "volume", (BasicScene("t", "v", transfer),), volumes={"v": lambda: volume})


@pytest.mark.parametrize("shape", [(20, 30, 40), (8, 10, 600)])
def test_points_lie_where_opacity_is(shape: tuple[int, int, int]) -> None:
    dataset = _dataset(shape, (0.4, 0.45, 0.5, 0.55))
    cloud = initial_cloud(dataset, "t", max_points=500)
    assert 0 < len(cloud) <= 500
    volume = dataset.volume("v")
    low, high = volume.box
    axes = [np.linspace(low[a], high[a], n) for a, n in ((2, shape[0]), (1, shape[1]), (0, shape[2]))]
    at = np.clip(cloud.points[:, ::-1], [a[0] for a in axes], [a[-1] for a in axes])
    values = RegularGridInterpolator(axes, volume.values.astype(float))(at)
    assert values.min() > 0.4 - 1e-4
    assert values.max() < 0.55 + 1e-4
    np.testing.assert_allclose(cloud.colors, np.tile(COLOR, (len(cloud), 1)), atol=1e-6)
    assert len(np.unique(cloud.points, axis=0)) == len(cloud)
    assert len(np.unique(cloud.points[:, 0])) < 256


def test_same_seed_same_cloud() -> None:
    dataset = _dataset((20, 30, 40), (0.2, 0.3, 0.5, 0.6))
    first, again, other = (initial_cloud(dataset, dataset.scenes[0], 100, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.points, again.points)
    assert (first.points != other.points).any()


def test_all_visible_voxels_if_they_are_few() -> None:
    dataset = _dataset((5, 6, 7), (0.4, 0.45, 0.5, 0.55))
    values = dataset.volume("v").values.astype(np.float64)
    assert len(initial_cloud(dataset, "t")) == np.count_nonzero((values > 0.4) & (values < 0.55))


def test_isosurfaces_give_voxels_beside_them_in_their_colors() -> None:
    dataset = _dataset((20, 30, 40), (0.4, 0.45, 0.5, 0.55))
    volume = dataset.volume("v")
    levels = (Isosurface("a", 0.31, (1.0, 0.0, 0.0)), Isosurface("b", 0.62, (0.0, 0.0, 1.0), 0.5))
    scene = BasicScene("i", "v", None, isosurfaces=levels)
    cloud = initial_cloud(dataset, scene, max_points=400)
    assert len(cloud) == 400
    at = (cloud.points + 0.5 * volume.extent) / volume.extent  # the field is linear
    values = at @ (0.5, 0.3, 0.2)
    most = 0.5 / 39 + 1e-5  # the steepest step between neighbours
    for level in levels:
        own = (cloud.colors == np.float32(level.color)).all(axis=1)
        assert own.sum() > 50
        assert np.abs(values[own] - level.value).max() <= most
    assert {tuple(c) for c in cloud.colors} == {level.color for level in levels}
    missing = replace(scene, isosurfaces=(replace(levels[0], value=0.5),))
    volume.values[:] = 0.1
    with pytest.raises(DataError, match="no voxel lies at its isosurfaces"):
        initial_cloud(dataset, missing)


def test_what_is_masked_is_not_drawn() -> None:
    dataset = _dataset((20, 30, 40), (0.4, 0.45, 0.5, 0.55))
    whole = dataset.volume("v")
    masked = replace(whole, mask=np.broadcast_to(np.arange(40) < 18, (20, 30, 40)))
    dataset = replace(dataset, volumes={"v": lambda: masked}, _loaded={})
    level = BasicScene("i", "v", None, isosurfaces=(Isosurface("a", 0.5, COLOR),))
    for scene in (dataset.scenes[0], level):
        cloud = initial_cloud(dataset, scene)
        assert len(cloud) > 50
        x = (cloud.points[:, 0] / whole.extent[0] + 0.5) * 39
        assert x.max() < 17.5


def test_nothing_visible() -> None:
    dataset = _dataset((2, 2, 2), (0.51, 0.52, 0.53, 0.54))
    volume = dataset.volume("v")
    volume.values[volume.values > 0.45] = 1.0
    with pytest.raises(DataError, match="no voxel has opacity"):
        initial_cloud(dataset, "t")


def test_ply_round_trip(tmp_path: Path) -> None:
    cloud = random_cloud(1000, 1.3, seed=4)
    assert np.abs(cloud.points).max() <= 1.3
    write_ply(tmp_path / "points3d.ply", cloud)
    again = read_ply(tmp_path / "points3d.ply")
    np.testing.assert_array_equal(again.points, cloud.points)
    np.testing.assert_allclose(again.colors, cloud.colors, atol=0.5 / 255 + 1e-6)
    scene = BasicScene("s", views_folder=tmp_path)
    dataset = Dataset("d", "", "views", (scene,))
    np.testing.assert_array_equal(initial_cloud(dataset, scene).points, cloud.points)
    assert len(initial_cloud(dataset, scene, max_points=10)) == 10


HEADER = (
    "ply\nformat {} 1.0\ncomment made by hand\nelement vertex 2\nproperty double x\nproperty float y\n"
    "property float z\nproperty float nx\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_of_others(tmp_path: Path, encoding: str) -> None:
    rows = [(1.5, -2.0, 3.0, 0.0, 255, 0, 51), (0.0, 0.25, 1.0, 1.0, 0, 102, 255)]
    if encoding == "ascii":
        body = "\n".join(" ".join(map(str, row)) for row in rows).encode() + b"\n"
    else:
        order = "<" if "little" in encoding else ">"
        body = np.array(rows, dtype=[("x", order + "f8"), *[(n, order + "f4") for n in ("y", "z", "n")],
                                     *[(n, "u1") for n in "rgb"]]).tobytes()  # fmt: skip
    (tmp_path / "c.ply").write_bytes(HEADER.format(encoding).encode() + body)
    cloud = read_ply(tmp_path / "c.ply")
    np.testing.assert_allclose(cloud.points, [row[:3] for row in rows])
    np.testing.assert_allclose(cloud.colors, np.array([row[4:] for row in rows]) / 255)


def test_damaged_ply(tmp_path: Path) -> None:
    def check(path: Path) -> None:
        try:
            cloud = read_ply(path)
        except DataError as error:
            assert str(path) in str(error)  # noqa: PT017
        else:
            assert np.isfinite(cloud.points).all()

    check_damage(
        tmp_path / "c.ply", lambda path: write_ply(path, random_cloud(6, 1.0)), check, "cut", "set", many=80
    )


def test_missing_ply(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such point cloud"):
        read_ply(tmp_path / "points3d.ply")


def _inside(camera: Camera, points: np.ndarray) -> np.ndarray:
    """By hand: project each point, compare with the borders."""
    x, y, z = camera.world_to_camera[:3, :3] @ points.T + camera.world_to_camera[:3, 3:]
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return (z > camera.near) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)


def test_a_random_start_fills_what_all_cameras_see() -> None:
    """A sphere of radius 4 sin(fov / 2) around the origin is in every picture, hardly more is."""
    cameras = with_near_planes(training_cameras(42, 0.7, 40, 40))
    reach = np.linalg.norm(cameras[0].position)
    cloud = random_start(cameras)
    assert cloud.points.shape == (100_000, 3)
    assert all(_inside(camera, cloud.points).all() for camera in cameras)
    radius = reach * np.sin(0.5 * cameras[0].fov_x)  # of the sphere that touches the borders of all pictures
    distances = np.linalg.norm(cloud.points, axis=1)
    assert distances.max() < 1.6 * radius
    shells = np.histogram(distances, np.linspace(0.4 * radius, radius, 5))[0]  # uniform: counts as volumes
    volumes = np.diff(np.linspace(0.4, 1.0, 5) ** 3)
    np.testing.assert_allclose(shells / shells.sum(), volumes / volumes.sum(), rtol=0.05)
    again = random_start(cameras)
    np.testing.assert_array_equal(cloud.points, again.points)
    assert not np.array_equal(cloud.points, random_start(cameras, seed=1).points)


def test_cameras_with_nothing_in_common_start_from_what_half_of_the_best_see() -> None:
    """Looking around from one place, and outward."""
    around = []
    for i in range(8):
        angle = 2 * np.pi * i / 8
        forward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([np.cross([0, 1, 0], forward), [0, 1, 0], forward], axis=1)
        matrix[:3, 3] = 0.01 * forward
        around.append(Camera.with_fov(matrix, 1.0, 16, 16, near=0.001))
    cloud = random_start(around, 2000)
    assert len(cloud) == 2000
    assert (sum(_inside(camera, cloud.points.astype(float)).astype(int) for camera in around) >= 1).all()
    one = random_start([Camera.with_fov(np.eye(4), 1.0, 16, 16)], 100)
    assert len(one) == 100
    assert _inside(Camera.with_fov(np.eye(4), 1.0, 16, 16), one.points).all()
