"""What 3dgs-mcmc adds to the contract (test_contract.py): moves that change no picture, noise, and a cap."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from econgs_bench.econgs.splat import LINEAGE, LowPass, rasterise
from econgs_bench.methods.contract.scene import look_at
from econgs_bench.methods.gaussian_mcmc.chain import noise, shared_opacity
from econgs_bench.methods.gaussian_mcmc.schedule import Schedule
from econgs_bench.methods.gaussian_mcmc.training import McmcTrainer
from econgs_bench.methods.shared.units import in_units
from tests.methods.conftest import Fits

fit = Fits("3dgs-mcmc", cap=200)


@pytest.mark.parametrize(
    ("opacity", "copies", "shared", "factor"),
    [(0.1, 2, 0.0513, 0.992), (0.5, 4, 0.1591, 0.929), (0.95, 2, 0.7764, 0.843), (0.95, 10, 0.2589, 0.734)],
)
def test_copies_have_the_opacity_and_scale_of_the_paper(opacity, copies, shared, factor):
    """Values worked out by hand from equation 9."""
    got = shared_opacity(torch.tensor([opacity]), torch.tensor([copies]), 0.005)
    assert got[0].item() == pytest.approx(shared, abs=6e-5)
    assert got[1].item() == pytest.approx(factor, abs=6e-4)


@pytest.mark.parametrize("copies", [1, 2, 7, 50])
@pytest.mark.parametrize("opacity", [0.02, 0.3, 0.9, 0.9999])
@pytest.mark.parametrize("least", [1e-9, 0.05])
def test_copies_absorb_along_a_line_what_their_source_does(opacity, copies, least):
    """By quadrature of the formula's integral, also where the least opacity binds."""
    shared, factor = (
        float(one) for one in shared_opacity(torch.tensor([opacity]), torch.tensor([copies]), least)
    )
    joint = quad(lambda x: 1 - (1 - shared * np.exp(-0.5 * x * x)) ** copies, -9, 9, epsabs=1e-12)[0]
    assert factor * joint == pytest.approx(np.float32(opacity) * np.sqrt(2 * np.pi), rel=1e-6)
    if shared > least:
        assert (1 - shared) ** copies == pytest.approx(1 - opacity, rel=1e-3)


def test_more_than_fifty_copies_count_as_fifty_and_opaque_sources_stay_finite():
    fifty = shared_opacity(torch.tensor([0.9]), torch.tensor([50]), 0.005)
    many = shared_opacity(torch.tensor([0.9]), torch.tensor([400]), 0.005)
    assert fifty == many
    shared, factor = shared_opacity(torch.ones(50), torch.arange(1, 51), 0.005)
    assert torch.isfinite(shared).all()
    assert ((shared > 0.2) & (shared < 1)).all()
    assert ((factor > 0.4) & (factor <= 1 + 1e-6)).all()


def drawn(opacity, scale, copies, low_pass):
    """Alpha of coincident round Gaussians at the centre of a view."""
    camera = look_at((0.0, 0.0, -4.0), 65)
    means = torch.zeros(copies, 3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(copies, 1)
    scales, opacities = torch.full((copies, 3), scale), torch.full((copies,), opacity)
    low = rasterise(means, quats, scales, opacities, torch.ones(copies, 1), camera, low_pass=low_pass)
    return low.alpha


@pytest.mark.parametrize("copies", [2, 5])
@pytest.mark.parametrize(("scale", "tolerance"), [(0.3, 0.01), (0.03, 0.05)])
def test_copies_look_like_their_source(copies, scale, tolerance):
    """At the centre and summed over its row, for the published rasteriser and the defaults here.

    The identity holds where the filter on the image adds nothing: closely for large Gaussians (10 px), less
    for small ones (1 px).
    """
    shared, factor = (float(v) for v in shared_opacity(torch.tensor([0.8]), torch.tensor([copies]), 0.005))
    for low_pass in (LINEAGE, LowPass(0.03, True, 0.1 * 0.03**2, 1.0)):
        one, many = drawn(0.8, scale, 1, low_pass), drawn(shared, scale * factor, copies, low_pass)
        middle = one.shape[0] // 2
        assert float(one[middle].sum()) > 1
        assert float(many[middle, middle]) == pytest.approx(float(one[middle, middle]), rel=tolerance)
        assert float(many[middle].sum()) == pytest.approx(float(one[middle].sum()), rel=tolerance)


def test_noise_has_the_covariance_squared_and_spares_the_opaque():
    count = 40_000
    rotation = Rotation.from_euler("xyz", [0.4, -1.1, 2.0])
    x, y, z, w = rotation.as_quat()
    scales = np.array([0.5, 0.2, 0.05])
    covariance = rotation.as_matrix() @ np.diag(scales**2) @ rotation.as_matrix().T
    log_scales = torch.tensor(np.log(scales), dtype=torch.float32).repeat(count, 1)
    quats = 3.0 * torch.tensor([[w, x, y, z]], dtype=torch.float32).repeat(count, 1)
    generator = torch.Generator().manual_seed(0)
    steps = noise(log_scales, quats, torch.full((count,), 0.005).logit(), 0.005, generator).numpy()
    expected = 0.25 * covariance @ covariance.T
    np.testing.assert_allclose(np.cov(steps.T), expected, atol=0.03 * expected.max())
    opaque = noise(log_scales, quats, torch.full((count,), 0.3).logit(), 0.005, generator)
    assert opaque.abs().max() < 1e-9


def test_a_scene_in_other_units_takes_the_same_steps(scene):
    """Twice as large, with noise and both losses: positions and scales double at every step."""
    small, large = (
        McmcTrainer(in_units(scene, units), fit.options(start_opacity=0.02), 200, 1, "cpu")
        for units in (1.0, 2.0)
    )
    start = small.optimiser["means"].detach().clone()
    for _ in range(15):  # with relocations; rounding sets fits apart in the end
        small.step(), large.step()
    moved = (small.optimiser["means"].detach()[: len(start)] - start).abs().max()
    assert float(moved) > 0.01
    torch.testing.assert_close(large.optimiser["means"], 2 * small.optimiser["means"], rtol=0, atol=2e-4)
    torch.testing.assert_close(
        large.optimiser["log_scales"].exp(), 2 * small.optimiser["log_scales"].exp(), rtol=2e-3, atol=0
    )


def test_the_dead_move_onto_the_living_and_the_picture_stays(scene):
    options = fit.options(start_scale=5.0, low_pass=0.3, antialiased=False, smoothing=0.0, ray_power=0.0)
    trainer = McmcTrainer(scene, options, 1000, 0, "cpu")
    dead = torch.arange(0, trainer.count, 8)
    with torch.no_grad():
        trainer.optimiser["logits"][dead] = -6.0
    for name in trainer.names:
        trainer.optimiser.first[name][0].fill_(1.0)
    before = {name: trainer.optimiser[name].detach().clone() for name in trainer.names}
    picture = trainer.model().render(scene.train.cameras[0])[1]
    with torch.no_grad():
        trainer.densification.relocate()
    after = trainer.optimiser
    assert trainer.count == len(before["means"])
    alive = torch.ones(trainer.count, dtype=torch.bool).index_fill_(0, dead, False)
    for row in dead.tolist():
        twins = (before["means"][alive] == after["means"][row]).all(1)
        assert int(twins.sum()) == 1
    opacities = after["logits"].detach().sigmoid()
    assert opacities.min() > 0.005
    touched = alive & (after["logits"] != before["logits"])
    assert (opacities[touched] < 0.5).all()
    for name in trainer.names:
        moments = (
            after.first[name][0].flatten(1)
            if after.first[name][0].ndim > 1
            else after.first[name][0][:, None]
        )
        assert not moments[touched].any()
        assert (moments[~touched] == 1.0).all()
        if name not in ("logits", "log_scales"):
            assert torch.equal(after[name][alive], before[name][alive])
    drawn = trainer.model().render(scene.train.cameras[0])[1]
    assert float((drawn - picture).abs().mean()) < 0.01 < float(picture.mean())


def test_growth_reaches_the_cap_in_twentieths_and_stays(tiny, scene):
    recorder = tiny.Recorder()
    model = fit(scene, recorder, 300, cap=150, prune_loss_db=0.0)
    assert model.primitives() == 150
    counts = sorted(set(recorder.counts))
    assert counts[:3] == [96, 100, 105]
    assert counts[-1] == 150
    assert recorder.stages == ["growth", "relocation", "refinement"]


def test_a_cloud_larger_than_the_cap_is_thinned_at_random(scene):
    first, again, other = (McmcTrainer(scene, fit.options(cap=40), 10, seed, "cpu") for seed in (0, 0, 1))
    places = {tuple(point) for point in np.asarray(scene.cloud.points, np.float32).tolist()}
    means = first.optimiser["means"]
    assert len(means) == 40
    assert {tuple(point) for point in means.tolist()} <= places
    assert torch.equal(means, again.optimiser["means"])
    assert not torch.equal(means, other.optimiser["means"])


def test_a_fit_approaches_views_that_it_never_saw(tiny, scene):
    recorder = tiny.Recorder(checkpoint_at=[1])
    model = fit(scene, recorder, 300, start_scale=10.0)  # few steps: from the size of 3DGS's first Gaussians
    before, after = (tiny.psnr(one, scene.validation) for one in (recorder.models[0], model))
    assert after > max(26.0, before + 6.0)


def test_nothing_drawn_and_all_dead_change_nothing(tiny, scene):
    """A start that no view sees, all of it dead: no source to move to, and no error."""
    far = tiny.with_cloud(scene, [[0.0, 0.0, 100.0], [0.1, 0.0, 100.0]])
    model = fit(
        far,
        tiny.Recorder(),
        30,
        cap=2,
        start_opacity=0.005,
        opacity_weight=0.0,
        noise_rate=0.0,
        prune_loss_db=0.0,
    )
    assert model.primitives() == 2
    assert not model.render(scene.train.cameras[0])[1].any()


@pytest.mark.parametrize(("iterations", "interval"), [(30_000, 100), (7_000, 23), (1_200, 10), (32, 2)])
def test_short_budgets_relocate_more_often(iterations, interval):
    schedule = Schedule(iterations)
    assert schedule.growth_interval == interval
    events = [i for i in range(1, iterations + 1) if schedule.grows(i)]
    assert events[0] > iterations / 60
    assert events[-1] < iterations * 5 / 6
    assert not any(schedule.resets_opacity(i) or schedule.collects(i) for i in range(1, 100))
