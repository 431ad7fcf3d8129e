"""Pruning by contribution: common equipment of every method that splats."""

import numpy as np
import pytest

from econgs_bench.methods.contract.scene import tiny_scene
from tests.methods.conftest import Fits, Recorder
from tests.methods.test_start import METHODS

ITERATIONS = 120
CHECKPOINT = 100
"""After the first time that primitives go, in every method's schedule."""


@pytest.fixture(scope="module")
def crowded(tiny):
    """The tiny scene, with points that no view ever sees."""
    scene = tiny_scene("tiny", volume="transfer")
    hidden = np.random.default_rng(0).normal(4.0, 0.3, (60, 3))
    return tiny.with_cloud(scene, np.concatenate([scene.cloud.points, hidden]))


@pytest.mark.parametrize("name", METHODS)
def test_what_no_view_shows_goes_and_pictures_stay(tiny, crowded, name):
    fit, recorders, models = Fits(name), {}, {}
    for loss in (0.0, 0.01):
        recorders[loss] = Recorder([CHECKPOINT])
        models[loss] = fit(crowded, recorders[loss], ITERATIONS, prune_loss_db=loss)
    assert recorders[0.01].counts[-1] <= recorders[0.0].counts[-1] - 40
    quality = {loss: tiny.psnr(model, crowded.train) for loss, model in models.items()}
    assert quality[0.01] > quality[0.0] - 1.0
    checkpoint = recorders[0.01].checkpoints[CHECKPOINT]
    resumed = fit(crowded, Recorder(), ITERATIONS, resume=checkpoint, prune_loss_db=0.01)
    assert tiny.psnr(resumed, crowded.train) == quality[0.01]
