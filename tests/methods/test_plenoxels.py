"""Plenoxels: quality, the hull, the schedule, sums of grids, files as published."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.contract.scene import tiny_scene
from econgs_bench.methods.interface import Edit, Refused
from econgs_bench.methods.plenoxels.grid import occupied
from econgs_bench.methods.plenoxels.model import PER_VOXEL, VoxelModel
from econgs_bench.methods.plenoxels.region import Hull, first_grid
from econgs_bench.methods.plenoxels.schedule import Schedule
from tests.methods.conftest import Fits, Recorder, psnr

fit = Fits("plenoxels", resolution=28, rays=800)


@pytest.fixture(scope="module")
def fitted():
    recorder = Recorder([100, 200])
    return fit(tiny_scene("tiny"), recorder, 200), recorder


def vertices(grid):
    """(N, 3) places of the voxels."""
    nx, ny, _ = grid.size
    place = occupied(grid.links)
    cells = torch.stack([place % nx, place // nx % ny, place // (nx * ny)], dim=1)
    return cells * grid.spacing + torch.tensor(grid.origin)


def test_it_learns_the_scene_coarse_to_fine(fitted):
    model, recorder = fitted
    validation = tiny_scene("tiny").validation
    coarse = recorder.models[0]
    assert recorder.stages == ["coarse", "fine"]
    assert max(model.scene("tiny").grid.size) == 28
    assert recorder.counts[0] != recorder.counts[-1]
    assert psnr(model, validation) > 22.0
    assert psnr(model, validation) > psnr(coarse, validation)


def of_a_ball(middle, radius):
    """The tiny scene with views of an opaque ball instead: its rays decide, not a renderer."""
    scene = tiny_scene("tiny")
    cameras = tuple(replace(one, near=0.1).resized(64, 64) for one in scene.train.cameras)
    images = np.zeros((len(cameras), 64, 64, 4), np.float32)
    for camera, image in zip(cameras, images, strict=True):
        origin, directions = camera.rays()
        past = np.linalg.norm(np.cross(directions, middle - origin), axis=-1)
        image[..., 3] = past < radius
    return replace(scene, train=replace(scene.train, cameras=cameras, images=images))


def test_the_hull_holds_the_scene_and_little_else():
    middle, radius = np.array([0.15, -0.1, 0.2]), 0.15
    scene = of_a_ball(middle, radius)
    hull = Hull(scene)
    grid = first_grid(scene, hull, 32, "hull", 0.1)
    full = first_grid(scene, hull, 32, "box", 0.1)
    assert grid.size == full.size
    assert 0 < len(grid) < 0.75 * len(full)
    away = (vertices(grid) - torch.from_numpy(middle)).norm(dim=1)
    every = (vertices(full) - torch.from_numpy(middle)).norm(dim=1)
    assert int((every < radius + grid.spacing).sum()) == int((away < radius + grid.spacing).sum()) > 1000
    assert float(away.max()) < 2.5 * radius
    assert torch.equal(grid.voxels.densities, torch.full((len(grid),), 0.1))


def test_views_without_transparency_are_learned_from_the_whole_box():
    scene = tiny_scene("tiny")
    opaque = scene.train.images.copy()
    opaque[..., :3] += 1.0 - opaque[..., 3:]
    opaque[..., 3] = 1.0
    white = replace(scene, train=replace(scene.train, images=opaque))
    recorder = Recorder()
    model = fit(white, recorder, 60)
    assert max(recorder.losses[-5:]) < recorder.losses[0]
    rgb, _ = model.render(scene.validation.cameras[0])
    assert bool(torch.isfinite(rgb).all())


def test_the_schedule_is_the_published_one_in_proportion():
    for iterations in (1_280, 128_000):
        schedule = Schedule(iterations)
        part = iterations / 128_000
        assert schedule.finer == round(38_400 * part)
        assert schedule.sh_learning_rate(round(128_000 * part), 0.01) == pytest.approx(0.01 * 5e-4**0.512)
        late = 30.0 * (0.05 / 30.0) ** 0.512
        assert schedule.density_learning_rate(round(128_000 * part), 30.0) == pytest.approx(late)
        delayed = schedule.density_learning_rate(round(1_500 * part), 30.0)
        assert 0.3 < delayed < 0.2 * 30.0


def test_densities_of_overlapping_scenes_add(fitted):
    model, _ = fitted
    method, camera = fit.method, tiny_scene("tiny").validation.cameras[0]
    one = model.scene("tiny")
    twin = VoxelModel([replace(one, name="twin")])
    both = method.compose([model, twin])
    together = both.render(camera)
    twice = model.render(camera, edit={"tiny": Edit(opacity=2.0)})
    halves = both.render(camera, edit={name: Edit(opacity=0.5) for name in ("tiny", "twin")})
    for pair in ((together, twice), (halves, model.render(camera))):
        for a, b in zip(*pair, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=2e-5)


def test_its_size_is_that_of_the_published_file(fitted, tmp_path):
    model, _ = fitted
    grid = model.scene("tiny").grid
    for folder in ("stored", "small"):
        (tmp_path / folder).mkdir()
    ledger = model.save(tmp_path / "stored")["tiny"]
    dense = 4 * grid.links.numel() + PER_VOXEL * len(grid)
    assert PER_VOXEL == 58
    assert dense <= sum(ledger.values()) < dense + 2000
    assert model.bytes_estimate() == dense
    small = model.save(tmp_path / "small", 9.0)["tiny"]
    assert sum(small.values()) < 0.95 * sum(ledger.values())
    with np.load(tmp_path / "stored/tiny.npz") as archive:  # NumPy reads it as it is
        assert archive["sh_data"].dtype == np.float16
        assert archive["sh_data"].shape == (len(grid), 27)
        assert np.array_equal(archive["links"], grid.links.numpy())
    camera = tiny_scene("tiny").validation.cameras[0]
    for folder in ("stored", "small"):
        again = VoxelModel.load(tmp_path / folder, "cpu")
        assert torch.equal(again.render(camera)[0], model.render(camera)[0])
    with pytest.raises(Refused, match="from 0 to 9"):
        model.save(tmp_path / "small", 0.5)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("links", lambda a: np.where(a == 0, 1, a), "name every voxel once"),
        ("density_data", lambda a: a[:-1], "sh_data has"),
        ("density_data", lambda a: np.full_like(a, np.nan), "NaN"),
        ("sh_data", lambda a: a.astype(np.float32), "sh_data is"),
        ("sh_data", lambda a: np.zeros((2**12, 2**12), np.float16), "sh_data has"),
        ("about", lambda a: np.zeros(2**24, np.uint8), "about has"),
        ("about", lambda a: about(a, spacing=-1.0), "out of range"),
        ("about", lambda a: about(a, format="other"), "other"),
        ("about", lambda a: about(a, origin=[0.0]), "not a scene"),
    ],
)
def test_files_that_hold_something_else_are_named(fitted, tmp_path, name, change, words):
    model, _ = fitted
    model.save(tmp_path)
    file = tmp_path / "tiny.npz"
    with np.load(file) as archive:
        arrays = dict(archive)
    arrays[name] = change(arrays[name])
    np.savez(file, **arrays)
    with pytest.raises(DataError, match=words) as caught:
        VoxelModel.load(tmp_path, "cpu")
    assert "tiny.npz" in str(caught.value)


def about(array, **changes):
    facts = json.loads(array.tobytes()) | changes
    return np.frombuffer(json.dumps(facts).encode(), np.uint8)


def test_a_damaged_byte_is_noticed(fitted, tmp_path):
    model, _ = fitted
    model.save(tmp_path)
    file = tmp_path / "tiny.npz"
    data = bytearray(file.read_bytes())
    with zipfile.ZipFile(io.BytesIO(bytes(data))) as archive:
        start = archive.getinfo("sh_data.npy").header_offset
    data[start + 500] ^= 1
    file.write_bytes(data)
    with pytest.raises(DataError, match=r"tiny\.npz"):
        VoxelModel.load(tmp_path, "cpu")


def test_torch_alone_fits_nearly_the_same(monkeypatch):
    scene = tiny_scene("tiny")
    losses = []
    for backend in ("native", "torch"):
        monkeypatch.setenv("ECONGS_BACKEND", backend)
        recorder = Recorder()
        fit(scene, recorder, 12, resolution=16, rays=200)
        losses.append(recorder.losses)
    np.testing.assert_allclose(*losses, rtol=1e-3)
