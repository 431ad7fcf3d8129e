"""ECoNGS: what the configuration ``paper`` takes literally, option by option."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from econgs_bench.methods.econgs.schedule import Schedule
from econgs_bench.methods.econgs.training import Trainer, make_schedule
from tests.methods.conftest import Fits

fit = Fits("econgs", features=16, hidden=24, embedding=8, offsets=4, voxel=0.01)
options = fit.options


def test_attributes_carry_noise_to_the_end():
    ours, literal = (make_schedule(20_000, options(rounding=share)) for share in (0.05, 0.0))
    assert [schedule.exact(19_001) for schedule in (ours, literal)] == [True, False]
    assert [schedule.exact(19_000) for schedule in (ours, literal)] == [False, False]
    assert (ours.stage(20_000), literal.stage(20_000)) == ("rounding", "context model")
    assert not any(literal.noisy(i) for i in range(1, 3_001))
    assert all(literal.noisy(i) for i in range(3_001, 20_001))


def test_growth_goes_on_while_the_noise_is_new():
    pausing, going_on = (make_schedule(20_000, options(growth_pauses=one)) for one in (True, False))
    new = [i for i in range(1, 20_001) if going_on.grows(i) and not pausing.grows(i)]
    assert new == list(range(3_000, 4_000, 100))
    assert not any(pausing.grows(i) and not going_on.grows(i) for i in range(1, 20_001))


def test_decoders_of_opacity_and_covariance_learn_at_the_stated_rates(scene):
    def rates(which, iterations):
        trainer = Trainer([scene], options(decoder_rates=which, decay="exponential"), iterations, 0, "cpu")
        trainer.step()
        return trainer.optimiser.learning_rates

    ours, stated = (rates(which, 10_000) for which in ("lineage", "stated"))
    assert {name for name in ours if ours[name] != stated[name]} == {"opacity", "covariance"}
    assert stated["opacity"] == stated["covariance"] == pytest.approx(0.01, rel=1e-3)
    last = rates("stated", 1)  # the only step is the last
    assert last["opacity"] == last["covariance"] == pytest.approx(1e-4)


def test_the_covariance_decoder_ends_at_the_share_that_is_asked_for(scene):
    def last(**changed):
        trainer = Trainer([scene], options(**changed), 1, 0, "cpu")
        trainer.step()
        return trainer.optimiser.learning_rates["covariance"]

    assert last(last_lr_share=1.0) == pytest.approx(4e-3)
    assert last() == pytest.approx(4e-5)
    assert last(last_lr_share=1.0, decoder_rates="stated") == pytest.approx(1e-4)


def test_clouds_are_compared_in_as_many_points_as_chosen(tiny, scene):
    """Two clouds with the same middle and other ends."""
    line = np.zeros((301, 3), np.float32)
    line[:, 0] = np.linspace(-1.0, 1.0, 301)
    turned = line[:, [1, 0, 2]]
    scenes = [
        tiny.renamed(tiny.with_cloud(scene, points), name) for name, points in (("a", line), ("b", turned))
    ]
    groups = {many: len(fit.method.partition(scenes, options(chamfer_points=many))) for many in (1, 10_000)}
    assert groups == {1: 1, 10_000: 2}


def test_scalings_after_a_sigmoid_are_learned(tiny, scene, tmp_path):
    recorder = tiny.Recorder(checkpoint_at=[60])
    model = fit(scene, recorder, 120, scaling_activation="sigmoid")
    assert tiny.psnr(model, scene.validation) > 17.0
    resumed = fit(scene, tiny.Recorder(), 120, resume=recorder.checkpoints[60], scaling_activation="sigmoid")
    camera = scene.validation.cameras[0]
    model.save(tmp_path)
    pictures = [one.render(camera)[0] for one in (model, resumed, fit.method.load(tmp_path, "cpu"))]
    assert torch.equal(pictures[0], pictures[1])
    assert torch.equal(pictures[0], pictures[2])


def test_positions_may_be_stored_as_floats(scene, tmp_path):
    trainer = Trainer([scene], options(), 40, 0, "cpu")
    for _ in range(40):
        trainer.step()
    coded = trainer.model()
    trainer.options = replace(trainer.options, positions="float32")
    plain = trainer.model()
    ledger = plain.save(tmp_path)
    assert ledger["tiny"]["positions"] == 12 * plain.primitives("tiny")
    camera = scene.validation.cameras[0]
    picture = coded.render(camera)[0]
    assert torch.equal(picture, plain.render(camera)[0])
    assert torch.equal(picture, fit.method.load(tmp_path, "cpu").render(camera)[0])


def test_defaults_of_the_schedule_are_those_of_the_options():
    assert make_schedule(2_000, options()) == Schedule(
        2_000, context_share=options().context_start, decay=options().decay
    )
