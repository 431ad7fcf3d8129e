import numpy as np
import pytest
import torch

from econgs_bench.econgs.points import neighbour_distances
from econgs_bench.methods.gaussian_splatting.training import Trainer
from econgs_bench.methods.interface import Diverged, Refused
from tests.methods.conftest import Fits

fit = Fits("3dgs")


def test_training_recovers_views_it_never_saw(tiny, scene):
    recorder = tiny.Recorder(checkpoint_at=[1])
    model = fit(scene, recorder, iterations=300, start_spacing=0.0)
    before, after = tiny.psnr(recorder.models[0], scene.validation), tiny.psnr(model, scene.validation)
    assert after > before + 6.0
    assert after > 27.0
    assert len(recorder.losses) == 300
    assert recorder.counts[-1] == model.primitives() != recorder.counts[0] == 96
    assert recorder.stages == ["growth", "refinement"]


def test_views_come_without_replacement(scene):
    trainer = Trainer(scene, fit.options(), 100, 0, "cpu")
    count = len(scene.train)
    rounds = [[trainer.next_view() for _ in range(count)] for _ in range(3)]
    assert all(sorted(one) == list(range(count)) for one in rounds)
    assert rounds[0] != rounds[1]


def test_initial_scales_are_neighbour_distances():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 0, 0]])
    found = neighbour_distances(points, 1.0)
    assert found[0] == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
    assert neighbour_distances(points[:2], 1.0).tolist() == [1.0, 1.0]
    assert neighbour_distances(points[:1], 0.044).tolist() == [pytest.approx(0.044)]
    assert neighbour_distances(torch.zeros(6, 3), 1.0)[0] == pytest.approx(np.sqrt(1e-7))


def test_start_from_the_cloud_takes_its_points_and_colors(tiny, scene):
    colors = np.array([[1.0, 0.0, 0.25], [0.5, 0.5, 0.5]])
    given = tiny.with_cloud(scene, [[0, 0, 0.1], [0.1, 0, 0]], colors)
    gaussians = Trainer(given, fit.options(), 10, 0, "cpu").model().scene("tiny")
    np.testing.assert_allclose(gaussians.means, [[0, 0, 0.1], [0.1, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(gaussians.sh_dc[:, 0] * 0.28209479177387814 + 0.5, colors, atol=1e-6)
    np.testing.assert_allclose(gaussians.logits.sigmoid(), 0.1, atol=1e-6)
    np.testing.assert_allclose(gaussians.log_scales.exp(), 0.6 * np.sqrt(0.02), rtol=1e-6)


@pytest.mark.parametrize("name", ["3dgs", "3dgs-mcmc", "vq-3dgs", "ivr-gs"])
def test_the_first_opacity_is_an_option(scene, name):
    fits = Fits(name)
    trainer = fits.method.trainer(scene, fits.options(start_opacity=0.25), 10, 0, "cpu")
    np.testing.assert_allclose(trainer.optimiser["logits"].detach().sigmoid(), 0.25, atol=1e-6)
    assert fits.options().start_opacity == (0.5 if name == "3dgs-mcmc" else 0.1)


@pytest.mark.parametrize(("name", "growing"), [("3dgs", 20), ("3dgs-mcmc", 33)])
def test_rates_of_all_but_positions_fall_once_nothing_grows(scene, name, growing):
    fits = Fits(name)
    trainer = fits.method.trainer(scene, fits.options(last_lr_share=0.2, prune_loss_db=0.0), 40, 0, "cpu")
    first = dict(trainer.optimiser.learning_rates)
    for iteration in range(1, 41):
        trainer.step()
        factors = {n: trainer.optimiser.learning_rates[n] / first[n] for n in first if n != "means"}
        share = max(0, iteration - growing) / (40 - growing)
        assert factors == pytest.approx(dict.fromkeys(factors, 1.0 - 0.8 * share))


def test_random_start_fills_its_cube(scene):
    options = fit.options(start="random", random_half_extent=0.7, random_points=5000)
    means = Trainer(scene, options, 10, 0, "cpu").model().scene("tiny").means
    assert means.shape == (5000, 3)
    assert means.abs().max() <= 0.7
    assert means.abs().amax(0).min() > 0.69
    assert abs(float(means.mean())) < 0.02


def test_no_visible_gaussian_leaves_the_background_and_learns_nothing(tiny, scene):
    """graphdeco-inria/gaussian-splatting#482 ended in an autograd error here."""
    points = [[0.0, 0.0, 100.0], [0.1, 0.0, 100.0], [0.0, 0.1, 100.0]]
    far = tiny.with_cloud(scene, points)
    model = fit(far, tiny.Recorder(), 20, opacity_reset=False, prune_loss_db=0.0, start_spacing=0.0)
    assert model.primitives() == 3
    rgb, alpha = model.render(scene.train.cameras[0])
    assert not alpha.any()
    assert torch.equal(rgb, torch.ones(32, 32, 3))
    assert torch.equal(model.scene("tiny").means, torch.tensor(points))


def test_all_pruned_away_ends_in_an_empty_model(tiny, scene, tmp_path):
    recorder = tiny.Recorder(checkpoint_at=[40])
    model = fit(scene, recorder, 60, prune_opacity=1.0)
    assert model.primitives() == 0
    assert "no Gaussians left" in recorder.stages
    assert len(recorder.losses) == 60
    model.save(tmp_path)
    loaded = fit.method.load(tmp_path, "cpu")
    assert torch.equal(loaded.render(scene.train.cameras[0])[0], torch.ones(32, 32, 3))
    again = fit(scene, tiny.Recorder(), 60, prune_opacity=1.0, resume=recorder.checkpoints[40])
    assert again.primitives() == 0


def test_parameters_that_blow_up_are_called_diverged(scene):
    trainer = Trainer(scene, fit.options(), 20, 0, "cpu")
    with torch.no_grad():
        trainer.optimiser["log_scales"][3] = float("nan")
    with pytest.raises(Diverged, match="log_scales hold NaN"):
        trainer.step()
    trainer = Trainer(scene, fit.options(), 20, 0, "cpu")
    with torch.no_grad():
        trainer.optimiser["log_scales"][3] = 200.0  # finite, but its exponential is not
    with pytest.raises(Diverged, match="log_scales"):
        trainer.step()


def test_losses_that_are_looked_at_rarely_are_means_of_the_same_fit(scene):
    """On a GPU each look waits for it."""
    often, rarely = (Trainer(scene, fit.options(), 50, 0, "cpu") for _ in range(2))
    rarely.look_every = 20
    all_reports = [often.step() for _ in range(50)]
    reports = [rarely.step() for _ in range(50)]
    assert [i + 1 for i, report in enumerate(reports) if report] == [20, 40, 50]
    for first, last in ((0, 20), (20, 40), (40, 50)):
        for name, value in reports[last - 1].items():
            assert value == pytest.approx(np.mean([one[name] for one in all_reports[first:last]]), rel=1e-6)
    for name in often.names:
        assert torch.equal(often.optimiser[name], rarely.optimiser[name])


def test_the_limit_is_kept_and_shown(tiny, scene):
    recorder = tiny.Recorder()
    model = fit(scene, recorder, 200, max_gaussians=110, growth_gradient=0.0)
    assert max(recorder.counts) <= 110
    assert model.primitives() <= 110
    assert any("110" in stage for stage in recorder.stages)


def test_what_cannot_be_fitted_is_refused(tiny, scene):
    with pytest.raises(Refused, match="more than max_gaussians = 50"):
        fit(scene, tiny.Recorder(), 10, max_gaussians=50)
    with pytest.raises(Refused, match="empty"):
        fit(tiny.with_cloud(scene, []), tiny.Recorder(), 10)
