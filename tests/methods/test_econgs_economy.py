"""No more than a scene needs: pruning by contribution, rate control, precision of decoders."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from econgs_bench.datasets.cloud import PointCloud
from econgs_bench.econgs.codec.arrays import round_arrays, write_arrays
from econgs_bench.methods.econgs.control import RateControl
from econgs_bench.methods.econgs.model import EcongsModel
from econgs_bench.methods.econgs.schedule import Schedule
from econgs_bench.methods.econgs.spec import SPEC
from econgs_bench.methods.econgs.start import starting_points
from econgs_bench.methods.econgs.training import Trainer, growth_threshold
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.options import resolve
from econgs_bench.methods.shared.pruning import some_views, survivors
from econgs_bench.methods.shared.start import first_of_cells
from tests.methods.conftest import Fits

options = Fits("econgs", features=16, hidden=24, embedding=8, offsets=4, voxel=0.01).options


def trained(scene, iterations, **changed):
    trainer = Trainer([scene], options(**changed), iterations, 0, "cpu")
    for _ in range(iterations):
        trainer.step()
    return trainer


@pytest.mark.parametrize(
    ("allowance", "gone"),
    [
        (0.0, {0, 1}),  # these add nothing at all
        (10 * math.log10(1.5), {0, 1, 2}),
        (10 * math.log10(3.0), {0, 1, 2, 3}),
    ],
)
def test_the_lightest_go_as_far_as_the_allowance_reaches(allowance, gone):
    weights = torch.tensor([0.0, 0.1, 0.2, 0.3, 5.0])
    costs = torch.tensor([0.0, 0.0, 0.5, 1.4, 100.0])

    def measure(kept):
        return 1.0 + costs[~kept].sum()[None]

    kept = survivors(weights, allowance, measure)
    assert set((~kept).nonzero()[:, 0].tolist()) == gone


def test_one_anchor_always_stays():
    kept = survivors(torch.zeros(7), 10.0, lambda kept: torch.ones(1))
    assert kept.sum() == 1
    assert survivors(torch.zeros(1), 10.0, lambda kept: torch.ones(1)).all()


def test_every_error_has_its_own_allowance():
    weights = torch.tensor([0.1, 0.2, 0.3, 5.0])
    color, alpha = torch.tensor([0.0, 0.0, 0.0, 9.0]), torch.tensor([0.0, 0.4, 9.0, 9.0])

    def measure(kept):
        return torch.stack([7.0 + color[~kept].sum(), 1.0 + alpha[~kept].sum()])

    assert survivors(weights, 10 * math.log10(1.5), measure).tolist() == [False, False, True, True]


def test_views_are_spread():
    assert some_views(5, 24) == [0, 1, 2, 3, 4]
    assert some_views(101, 5) == [0, 25, 50, 75, 100]
    assert some_views(1, 5) == [0]


def test_pruning_by_contribution_comes_twice_after_growth():
    for share, context in ((0.5, True), (0.75, True), (0.5, False)):
        schedule = Schedule(2_000, context, share)
        when = [i for i in range(1, 2_001) if schedule.prunes_by_contribution(i)]
        assert len(when) == 2
        assert not any(schedule.grows(i) for i in range(when[0], 2_001))


def test_after_growth_a_fit_without_context_model_refines():
    stages = [Schedule(2_000, coding=False).stage(iteration) for iteration in (1, 100, 1_500)]
    assert stages == ["warm-up", "growth", "refinement"]


def test_anchors_that_add_nothing_go_and_the_picture_stays(tiny, scene):
    """Points far from the object are never seen to add anything."""
    far = np.concatenate([scene.cloud.points, np.float32([[0.0, 0.0, z] for z in np.linspace(3.0, 4.0, 40)])])
    wide = tiny.with_cloud(scene, far)
    pruned, without = trained(wide, 160, prune_loss_db=0.01), trained(wide, 160, prune_loss_db=0.0)
    assert pruned.count < without.count
    psnr = [one._psnr(one.model()) for one in (pruned, without)]
    assert psnr[0] > psnr[1] - 0.5


def test_an_empty_scene_takes_next_to_no_bytes(scene, tmp_path):
    trainer = trained(scene, 40)
    for anchors in trainer.sets:
        anchors.keep(trainer.optimiser, torch.zeros(len(anchors), dtype=torch.bool))
    trainer.place()
    model = trainer.model()
    ledger = model.save(tmp_path)
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 1024
    assert sum(sum(parts.values()) for parts in ledger.values()) < 1024
    back = EcongsModel.load(tmp_path, "cpu")
    assert back.primitives() == 0
    rgb, alpha = back.render(scene.train.cameras[0])
    assert not alpha.any()
    assert torch.equal(rgb, torch.tensor(scene.train.background).expand_as(rgb))


def test_growth_follows_the_pixel_and_the_budget(scene):
    one = options(growth_gradient=1.0)

    def wide(width):
        cameras = [camera.resized(width, width) for camera in scene.train.cameras]
        return replace(scene, train=replace(scene.train, cameras=cameras))

    small, large = wide(200), wide(400)
    assert growth_threshold([small], one, 3_000) == 1.0
    assert growth_threshold([large], one, 3_000) == 0.5
    assert growth_threshold([small, large], one, 6_000) == pytest.approx(2 / 3)
    assert growth_threshold([small], one, 12_000) == 0.5
    assert growth_threshold([large], options(growth_gradient=1.0, growth_adapts=False), 500) == 1.0


def test_full_schedules_grow_by_the_threshold_of_3000_iterations(scene):
    paper, standard = (resolve(SPEC, preset, {}) for preset in ("paper", "standard"))
    cameras = [camera.resized(200, 200) for camera in scene.train.cameras]
    wide = replace(scene, train=replace(scene.train, cameras=cameras))
    threshold = growth_threshold([wide], paper.options, paper.iterations)
    assert threshold == pytest.approx(growth_threshold([wide], standard.options, 3_000), rel=0.01)


def test_gaussians_begin_smaller_than_what_lies_between_anchors(scene):
    def scales(factor):
        trainer = Trainer([scene], options(start_scale=factor), 10, 0, "cpu")
        return trainer.optimiser[trainer.sets[0].name("log_scalings")].detach()

    small, plain = scales(0.25), scales(1.0)
    torch.testing.assert_close(small[:, 3:], plain[:, 3:] - math.log(4.0))
    assert torch.equal(small[:, :3], plain[:, :3])


def test_rate_control_moves_towards_its_target():
    """A model whose size falls with lambda_e: sizes end at the target, quality likewise."""
    control = RateControl(target_bytes=10_000)
    for _ in range(20):
        control.correct(int(20_000 * control.factor**-0.4), 30.0)
    assert 20_000 * control.factor**-0.4 == pytest.approx(10_000, rel=0.03)
    control = RateControl(target_psnr=35.0)
    for _ in range(20):
        control.correct(0, 38.0 - math.log10(control.factor))
    assert 38.0 - math.log10(control.factor) == pytest.approx(35.0, abs=0.1)
    assert not RateControl().active
    control = RateControl(target_bytes=1.0)
    for _ in range(50):
        control.correct(10_000, 0.0)
    assert control.factor <= 1e3


def test_a_smaller_target_gives_a_smaller_stream(scene):
    # Spreads have room, and time, to follow the rate in so short a fit; there are bits to save.
    wide = {"context_hidden": 50, "context_start": 0.5, "rate_weight": 1e-4}
    free = trained(scene, 600, **wide).model().bytes_estimate()
    steered = trained(scene, 600, target_bytes=int(0.6 * free), **wide).model().bytes_estimate()
    assert steered < 0.95 * free


def test_rate_control_resumes(scene):
    whole = trained(scene, 300, target_psnr=20.0)
    first = Trainer([scene], options(target_psnr=20.0), 300, 0, "cpu")
    for _ in range(220):
        first.step()
    second = Trainer([scene], options(target_psnr=20.0), 300, 0, "cpu")
    second.resume(first.checkpoint())
    assert second.control.factor == first.control.factor != 1.0
    for _ in range(80):
        second.step()
    assert second.model().bytes_estimate() == whole.model().bytes_estimate()


@pytest.mark.parametrize("precision", ["float32", "float16", "int8"])
def test_rounded_weights_are_written_as_the_same_bytes_again(precision):
    random = np.random.default_rng(0)
    arrays = {
        "matrix": (random.normal(size=(50, 103)) * np.exp2(random.integers(-9, 9, (50, 1)))).astype(
            np.float32
        ),
        "vector": random.normal(size=50).astype(np.float32),
        "zero": np.zeros((3, 4), np.float32),
    }
    once = round_arrays(arrays, precision)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(round_arrays(once, precision).values(), once.values(), strict=True)
    )
    assert write_arrays(once, precision) == write_arrays(arrays, precision)
    error = np.abs(once["matrix"] - arrays["matrix"]).max(1) / np.abs(arrays["matrix"]).max(1)
    assert error.max() <= {"float32": 0.0, "float16": 2**-11, "int8": 0.5 / 126}[precision]


@given(
    arrays(np.float32, st.tuples(st.integers(1, 60), st.just(3)), elements=st.floats(-2, 2, width=32)),
    st.floats(0.01, 1.0),
)
def test_a_cell_keeps_its_first_point(points, side):
    kept = points[first_of_cells(points, side)]
    cells = np.floor(points.astype(np.float64) / side).astype(int).tolist()
    first = [point for i, point in enumerate(points) if cells[i] not in cells[:i]]
    np.testing.assert_array_equal(kept, first)


def test_the_cloud_is_thinned_in_pixels_of_the_views(scene):
    cloud = np.asarray(scene.cloud.points)
    everything, color = starting_points(scene, options(start_spacing=0), 0)
    np.testing.assert_array_equal(everything, cloud)
    np.testing.assert_allclose(color, np.asarray(scene.cloud.colors).mean(0))
    eyes = np.array([camera.position for camera in scene.train.cameras]) - cloud.mean(0)
    pixel = np.median(np.linalg.norm(eyes, axis=1) / [camera.fx for camera in scene.train.cameras])
    thinned, same = starting_points(scene, options(start_spacing=4, start_points=0), 0)
    assert 1 <= len(thinned) < len(cloud)
    assert len(thinned) == len(np.unique(np.floor(cloud.astype(np.float64) / (4 * pixel)), axis=0))
    np.testing.assert_array_equal(same, color)
    few, _ = starting_points(scene, options(start_spacing=0, cloud_points=5), 0)
    assert len(few) == 5
    random, _ = starting_points(scene, options(start="random", random_points=50), 0)
    assert len(random) == 50
    with pytest.raises(Refused, match="start=random"):
        starting_points(replace(scene, cloud=PointCloud(cloud[:0], cloud[:0])), options(), 0)
