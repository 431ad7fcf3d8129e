"""What ccnerf adds to the contract (test_contract.py): ranks to leave out, boxes, compositions, files."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.rays import camera_rays
from econgs_bench.econgs.splat.sh import spherical_harmonics
from econgs_bench.methods.ccnerf.field import SCALE, SHIFT, Factors, trace
from econgs_bench.methods.ccnerf.model import CpModel
from econgs_bench.methods.ccnerf.rays import Region
from econgs_bench.methods.ccnerf.schedule import Schedule
from econgs_bench.methods.ccnerf.training import Trainer
from econgs_bench.methods.contract.scene import look_at
from econgs_bench.methods.interface import Edit, Refused
from tests.methods.conftest import Fits

fit = Fits("ccnerf", density_ranks=8, ranks=8, groups=3, first_side=16, side=28, rays=384)
CAMERA = look_at((1.9, -2.0, 1.1), 8)
RANKS, GROUP = 6, 2


@pytest.fixture(scope="module")
def fitted(tiny, scene):
    recorder = tiny.Recorder()
    return fit(scene, recorder, 240), recorder


def a_scene(seed=0, name="a", at=0.0, cells=None):
    """A scene of random factors that can be seen, in a box whose middle is moved along x."""
    generator = torch.Generator().manual_seed(seed)

    def lines(ranks, mean):
        return tuple(mean + torch.randn((size, ranks), generator=generator) for size in (6, 5, 7))

    cells = torch.ones((6, 4, 5), dtype=torch.uint8) if cells is None else cells
    return Factors(
        name=name,
        background=(1.0, 1.0, 1.0),
        region=Region((at - 0.5, -0.4, -0.5), (at + 0.5, 0.5, 0.6), cells),
        density=lines(4, 1.0),
        color=lines(RANKS, 0.0),
        harmonics=torch.randn((16, 3, RANKS), generator=generator),
        group=GROUP,
        spacing=0.5,
        threshold=0.0,
    )


def harmonics(direction):
    """(16,) spherical harmonics of a direction, from colors 1/2 + Y / 10 of Gaussians with one band each."""
    toward = torch.from_numpy(direction).expand(16, 3)
    bands = 0.1 * torch.eye(16, dtype=torch.float64)[:, :, None].expand(16, 16, 3)
    colors = spherical_harmonics(3, toward, torch.zeros(3, dtype=torch.float64), bands)
    return 10.0 * (colors[:, 0].numpy() - 0.5)


def by_the_book(scenes, camera, factors=None):
    """Colors and alpha in float64, sample by sample: dense grids, trilinear weights, sums along rays."""
    step = min(scene.step for scene in scenes)
    origin, directions = camera.rays()
    picture = np.zeros((camera.height, camera.width, 4))
    grids = []
    for scene in scenes:
        x, y, z = (line.double().numpy() for line in scene.density)
        u, v, w = (line.double().numpy() for line in scene.color)
        densities = np.einsum("ir,jr,kr->ijk", x, y, z)
        coefficients = scene.harmonics.double().numpy()
        grids.append((densities, np.einsum("ir,jr,kr,bcr->ijkbc", u, v, w, coefficients)))
    for row in range(camera.height):
        for column in range(camera.width):
            direction = directions[row, column]
            basis = harmonics(direction)
            through = 1.0
            for k in range(int(6.0 / step)):
                point = origin + (k + 0.5) * step * direction
                there = []
                for scene, (densities, features), factor in zip(
                    scenes, grids, factors or [1.0] * len(scenes), strict=True
                ):
                    low, high = np.array(scene.region.low), np.array(scene.region.high)
                    place = (point - low) / (high - low)
                    if not ((place >= 0) & (place <= 1)).all():
                        continue
                    shape = np.array(densities.shape)
                    at = place * (shape - 1)
                    cell = np.minimum(at.astype(int), shape - 2)
                    value, feature = 0.0, np.zeros((16, 3))
                    for corner in np.ndindex(2, 2, 2):
                        weight = np.prod(np.where(corner, at - cell, 1.0 - (at - cell)))
                        value += weight * densities[tuple(cell + corner)]
                        feature += weight * features[tuple(cell + corner)]
                    there.append((factor * np.logaddexp(0.0, value + SHIFT), basis @ feature))
                if not there:
                    continue
                sigma = np.array([one for one, _ in there])
                shares = np.exp(sigma - sigma.max()) / np.exp(sigma - sigma.max()).sum()
                color = 1.0 / (1.0 + np.exp(-sum(s * f for s, (_, f) in zip(shares, there, strict=True))))
                alpha = 1.0 - np.exp(-sigma.sum() * SCALE * step)
                picture[row, column] += through * alpha * np.append(color, 1.0)
                through *= 1.0 - alpha
    return picture


def test_pictures_are_those_of_an_explicit_evaluation():
    scene, other = a_scene(), a_scene(5, "b", at=0.45)
    model = CpModel([scene, other])
    for names, edit in ((["a"], {}), (["a", "b"], {}), (["a", "b"], {"b": Edit(opacity=0.3)})):
        rgb, alpha = model.render(CAMERA, scenes=names, edit=edit, background=(0.0, 0.0, 0.0))
        expected = by_the_book([model.scene(one) for one in names], CAMERA, [1.0, 0.3] if edit else None)
        np.testing.assert_allclose(alpha.numpy(), expected[..., 3], atol=1e-4)
        np.testing.assert_allclose(rgb.numpy(), expected[..., :3], atol=1e-4)
    assert expected[..., 3].max() > 0.5


def test_empty_cells_hide_what_is_in_them():
    cells = torch.ones((6, 4, 5), dtype=torch.uint8)
    cells[:3] = 0
    scene = a_scene()
    low, high = scene.region.low, scene.region.high
    half = CpModel([replace(scene, region=Region(low, high, cells))])
    empty = CpModel([replace(scene, region=Region(low, high, torch.zeros_like(cells)))])
    alpha = CpModel([scene]).render(CAMERA)[1]
    assert 0.0 < float(half.render(CAMERA)[1].sum()) < float(alpha.sum())
    assert not empty.render(CAMERA)[1].any()


def test_truncated_ranks_are_a_model_that_never_had_the_others(tmp_path):
    scene = a_scene()
    CpModel([scene]).save(tmp_path, 2.0)
    loaded = CpModel.load(tmp_path, "cpu")
    x, y, z = (line[:, : 2 * GROUP].contiguous() for line in scene.color)
    never = replace(scene, color=(x, y, z), harmonics=scene.harmonics[..., : 2 * GROUP].contiguous())
    assert len(loaded.scene("a")) == len(scene) - GROUP
    for one, other in zip(loaded.render(CAMERA), CpModel([never]).render(CAMERA), strict=True):
        assert torch.equal(one, other)
    # And the pictures that the loss sees on the way are those of truncated models.
    rays = camera_rays(CAMERA)
    shift = torch.full((len(rays.origins),), 0.5, dtype=torch.float64)
    seen = trace(scene, rays, shift, RANKS // GROUP)
    for groups in (1, 2, 3):
        colors, _ = CpModel([scene.truncated(groups * GROUP)]).render(CAMERA, background=(0.0, 0.0, 0.0))
        torch.testing.assert_close(seen.colors[:, groups - 1].reshape_as(colors), colors, atol=1e-6, rtol=0)


def test_any_number_of_ranks_can_be_kept(tmp_path):
    model = CpModel([a_scene()])
    sizes = []
    for ranks in range(1, RANKS + 1):
        folder = tmp_path / str(ranks)
        folder.mkdir()
        sizes.append(sum(model.save(folder, ranks / GROUP)["a"].values()))
        assert CpModel.load(folder, "cpu").scene("a").color[0].shape[1] == ranks
    per_rank = 4 * (6 + 5 + 7 + 48)
    assert all(abs(b - a - per_rank) < 16 for a, b in pairwise(sizes))
    for rate in (0.0, 3.5, float("nan")):
        with pytest.raises(Refused, match="3 groups of 2 color ranks"):
            model.save(tmp_path, rate)


def test_a_composition_of_one_is_that_one(fitted):
    model, _ = fitted
    composed = fit.method.compose([model])
    camera = look_at((2.0, 1.0, 2.0), 24)
    for one, other in zip(composed.render(camera), model.render(camera), strict=True):
        assert torch.equal(one, other)


def test_a_scene_of_opacity_zero_does_not_color_the_others():
    model = CpModel([a_scene(), a_scene(5, "b")])
    together = model.render(CAMERA, edit={"b": Edit(opacity=0.0)})
    alone = CpModel([a_scene()]).render(CAMERA)
    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=0)


def test_gradients_of_a_trace_are_differences():
    scene = a_scene()
    rays = camera_rays(replace(CAMERA, width=5, height=4))
    shift = torch.full((20,), 0.25, dtype=torch.float64)
    density = [one.clone().requires_grad_(True) for one in scene.density]
    color = [one.clone().requires_grad_(True) for one in scene.color]
    harmonics = scene.harmonics.clone().requires_grad_(True)
    leaves = [*density, *color, harmonics]

    def loss(values):
        held = replace(scene, density=tuple(values[:3]), color=tuple(values[3:6]), harmonics=values[6])
        seen = trace(held, rays, shift, 3)
        weights = torch.linspace(-1.0, 1.0, seen.colors.numel()).reshape_as(seen.colors)
        return (seen.colors * weights).sum() + seen.alpha.sum()

    loss(leaves).backward()
    generator = torch.Generator().manual_seed(9)
    for place, leaf in enumerate(leaves):
        along = torch.randn(leaf.shape, generator=generator)
        along /= along.norm()
        with torch.no_grad():
            ahead, behind = (
                loss([one + (h * along if at == place else 0.0) for at, one in enumerate(leaves)])
                for h in (5e-3, -5e-3)
            )
        slope = float((ahead - behind) / 1e-2)
        assert float((leaf.grad * along).sum()) == pytest.approx(slope, rel=2e-2, abs=2e-3)


def test_a_fit_approaches_views_that_it_never_saw(tiny, scene, fitted):
    model, recorder = fitted
    assert tiny.psnr(model, scene.validation) > 20.0
    assert recorder.stages[0] == "16 rows, whole box"
    assert recorder.stages[-1] == "28 rows"
    assert set(recorder.counts) == {8 + 3 * 8}


def test_each_group_of_ranks_refines_those_before(tiny, scene, fitted):
    model, _ = fitted
    whole = model.scene("tiny")
    qualities = [tiny.psnr(CpModel([whole.truncated(8 * groups)]), scene.train) for groups in (1, 2, 3)]
    assert qualities[2] >= qualities[1] - 0.05 >= qualities[0] - 0.1


def test_the_box_shrinks_to_what_is_there(scene):
    far = np.concatenate([scene.cloud.points, [[1.5, 1.5, 1.5], [-1.5, -1.5, -1.5]]]).astype(np.float32)
    wide = replace(scene, cloud=replace(scene.cloud, points=far, colors=np.full_like(far, 0.5)))
    trainer = Trainer(wide, fit.options(visible=0.03), 900, 0, "cpu")
    before, rays = trainer.region, len(trainer.rays)
    while trainer.masked < 3:
        trainer.step()
    after = trainer.region
    assert np.prod(np.ptp(after.corners, axis=0)) < 0.7 * np.prod(np.ptp(before.corners, axis=0))
    assert len(trainer.rays) < rays
    rows = np.array([len(line) for line in trainer.optimiser.parameters["density"]])
    sides = np.ptp(after.corners, axis=0) / (rows - 1)
    assert sides.max() < 1.2 * sides.min()


def test_the_published_schedule():
    schedule = Schedule(30_000, 128, 300, through=False, always=False)
    rows = [schedule.rows(one) for one in (0, 2_000, 3_000, 4_000, 5_500, 7_000, 30_000)]
    assert rows == [128, 152, 180, 213, 253, 300, 300]
    assert [schedule.masks(one) for one in (1_999, 2_000, 3_999, 4_000)] == [0, 1, 1, 2]
    assert schedule.learning_rate_share(2_001) == pytest.approx(1.0, abs=1e-3)
    assert schedule.learning_rate_share(30_000) == pytest.approx(0.1 ** (23 / 30))
    assert Schedule(300, 8, 16, through=True, always=True).learning_rate_share(300) == pytest.approx(0.1)


@pytest.mark.parametrize(
    "change",
    [
        {"low": [0, 0]},
        {"high": [-9, 0, 0]},
        {"cells": [6, 4, 6]},
        {"cells": [0, 4, 5]},
        {"spacing": 0},
        {"format": "other"},
        {"threshold": None},
    ],
)
def test_metadata_that_do_not_fit_are_named(tmp_path, change):
    CpModel([a_scene()]).save(tmp_path)
    file = tmp_path / "a.safetensors"
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()["model"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    save_file(tensors, file, metadata={"model": json.dumps(about | change)})
    with pytest.raises(DataError, match=r"a\.safetensors"):
        CpModel.load(tmp_path, "cpu")


@pytest.mark.parametrize("name", ["density.x", "color.z", "harmonics", "mask"])
def test_tensors_that_do_not_fit_are_named(tmp_path, name):
    CpModel([a_scene()]).save(tmp_path)
    file = tmp_path / "a.safetensors"
    with safe_open(file, framework="pt") as opened:
        about = opened.metadata()
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    for broken in (None, tensors[name][:-1].contiguous(), tensors[name].double() * float("nan")):
        changed = {key: value for key, value in tensors.items() if key != name}
        save_file(changed if broken is None else changed | {name: broken}, file, metadata=about)
        with pytest.raises(DataError, match=r"a\.safetensors"):
            CpModel.load(tmp_path, "cpu")
