"""What hac-plus adds to the contract (test_contract.py) and to hac: mixtures, and masks that learn."""

import numpy as np
import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.hac_plus.training import Trainer
from econgs_bench.methods.interface import Refused
from tests.methods.conftest import Fits

SMALL = {"features": 16, "offsets": 4, "voxel": 0.01, "grid": "small", "context_hidden": 24}
fit = Fits("hac-plus", **SMALL)


@pytest.fixture(scope="module")
def fitted(tiny, scene):
    recorder = tiny.Recorder(checkpoint_at=[1])
    return fit(scene, recorder, 400), recorder


def test_a_fit_approaches_views_that_it_never_saw(tiny, scene, fitted, tmp_path):
    model, recorder = fitted
    before, after = (tiny.psnr(one, scene.validation) for one in (recorder.models[0], model))
    assert after > max(23.0, before + 6)
    assert recorder.stages[-3:] == ["growth with context model", "context model", "rounding"]
    ledger = model.save(tmp_path)
    assert [file.name for file in tmp_path.iterdir() if file.suffix != ".toml"] == ["tiny.hacplus"]
    assert 0 <= sum(ledger["tiny"].values()) - model.bytes_estimate() < 4096
    camera = scene.validation.cameras[0]
    assert torch.equal(fit.method.load(tmp_path, "cpu").render(camera)[0], model.render(camera)[0])


def coded_trainer(scene, **changed):
    """At the first iteration whose rate counts."""
    trainer = Trainer(scene, fit.options(rate_weight=1.0, **changed), 100, 0, "cpu")
    trainer.iteration = trainer.schedule.context_start + 1
    trainer.begin_coding()
    return trainer


def masks_of(trainer):
    return trainer.optimiser[trainer.anchors.name("masks")]


def rate(trainer, rows, seed=0):
    trainer.generator.manual_seed(seed)
    values = trainer.attributes(trainer.anchors).of(rows)
    return trainer.prepare(values, rows)


def test_the_rate_is_that_of_all_anchors_seen_or_not(scene):
    """The bits of the sample do not depend on which anchors a view shows."""
    trainer = coded_trainer(scene)
    every, some, none = torch.arange(len(trainer.anchors)), torch.arange(7), torch.arange(0)
    rates = [float(rate(trainer, rows).losses["rate"].detach()) for rows in (every, some, none)]
    assert rates[0] > 0
    # Only the noise differs, which is drawn for the visible too.
    assert rates[1:] == pytest.approx([rates[0]] * 2, rel=0.05)
    assert len(rate(trainer, some).values.features) == 7


def test_anchors_and_offsets_that_are_not_there_cost_nothing(scene):
    trainer = coded_trainer(scene)
    rows = torch.arange(len(trainer.anchors))
    whole = float(rate(trainer, rows).losses["rate"].detach())
    model = trainer.coding.model
    _, bits = model.grid(trainer.coding.lookup(trainer.anchors), rows)
    grid = float(bits.detach()) / (len(rows) * model.config.total)
    with torch.no_grad():
        masks_of(trainer).fill_(-20.0)
    gone = float(rate(trainer, rows).losses["rate"].detach())
    assert gone == pytest.approx(grid, rel=1e-6)
    with torch.no_grad():
        masks_of(trainer)[:, 0] = 1.0
    one = float(rate(trainer, rows).losses["rate"].detach())
    assert gone < one < whole


def test_masks_learn_from_what_they_would_save(scene):
    """The gradient of the rate pushes every mask of the sample down, without a loss of its own."""
    trainer = coded_trainer(scene)
    prepared = rate(trainer, torch.arange(len(trainer.anchors)))
    assert "masks" not in prepared.losses
    prepared.losses["rate"].backward()
    gradient = masks_of(trainer).grad
    touched = gradient.abs().sum(1) > 0
    assert 0 < int(touched.sum()) < len(touched)
    assert (gradient[touched] > 0).all()


def test_a_larger_lambda_makes_smaller_streams_and_fewer_offsets(tiny, scene):
    masks, sizes = [], []
    for weight in (0.0, 0.05):
        trainer = Trainer(scene, fit.options(rate_weight=weight), 300, 0, "cpu")
        trainer.run(tiny.Recorder())
        masks.append(float(masks_of(trainer).detach().mean()))
        sizes.append(trainer.model().bytes_estimate() / len(trainer.anchors))
    assert sizes[1] < 0.9 * sizes[0]
    assert masks[1] < masks[0] - 0.05


def test_anchors_without_offsets_are_not_stored(scene):
    trainer = Trainer(scene, fit.options(), 30, 0, "cpu")
    for _ in range(30):
        trainer.step()
    total = len(trainer.anchors)
    with torch.no_grad():
        masks_of(trainer)[: total // 2] = -20.0
    model = trainer.model()
    assert model.primitives() == total - total // 2
    assert np.asarray(model.groups[0].scenes[0].masks).any(1).all()


def test_networks_and_context_model_are_as_wide_as_they_are_asked_for(tiny, scene, tmp_path):
    recorder = tiny.Recorder(checkpoint_at=[14])
    small = fit(scene, recorder, 20, hidden=7, context_hidden=0, context_start=0.7)
    assert recorder.models[0].groups[0].context is None
    small.save(tmp_path)
    loaded, camera = fit.method.load(tmp_path, "cpu"), scene.validation.cameras[0]
    assert torch.equal(loaded.render(camera)[0], small.render(camera)[0])
    assert loaded.groups[0].context.config.hidden == 4
    assert loaded.scene("tiny").decoders.hidden == 7


def test_hac_and_hac_plus_do_not_mix(tiny, scene, tmp_path):
    plain = Fits("hac", **SMALL)(scene, tiny.Recorder(), 5)
    plus = fit(scene, tiny.Recorder(), 5)
    with pytest.raises(Refused, match="of its own only"):
        fit.method.compose([plus, plain])
    plain.save(tmp_path)
    with pytest.raises(DataError, match="no saved hac-plus model"):
        fit.method.load(tmp_path, "cpu")
    (tmp_path / "tiny.hac").rename(tmp_path / "tiny.hacplus")
    with pytest.raises(DataError, match="not the model of a hac-plus scene"):
        fit.method.load(tmp_path, "cpu")
