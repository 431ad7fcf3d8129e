"""Alpha as a target of its own, as ECoNGS has it: what has the background's color is learned too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from econgs_bench.methods.contract.checks import Recorder, Subject
from econgs_bench.methods.registry import Registry, load_method


@pytest.fixture(params=["3dgs", "scaffold-gs"])
def subject(request: pytest.FixtureRequest, tmp_path: Path) -> Subject:
    spec = Registry().spec(request.param)
    # Resets of opacities hide what fits of the 3DGS family learn in fewer iterations.
    return Subject(spec, load_method(spec), tmp_path, 400 if "3dgs" in request.param else 150)


def test_a_white_scene_on_white_is_learned_by_its_alpha(subject: Subject) -> None:
    scene = subject.tiny("white")
    images = scene.train.images.copy()
    images[..., :3] = images[..., 3:]
    white = replace(scene, train=replace(scene.train, images=images))
    truth = torch.from_numpy(images[..., 3])

    def missing(weight: float) -> float:
        model = subject.fit([white], alpha_weight=weight)
        alphas = torch.stack([model.render(camera)[1] for camera in white.train.cameras])
        return float((truth - alphas).clamp(min=0).sum() / truth.sum())

    assert missing(0.2) < 0.5
    assert missing(0.0) > 0.9


def test_opaque_pictures_have_no_alpha_to_learn(subject: Subject) -> None:
    """Their background is part of them; asking for alpha there would fill the space with it."""
    scene = subject.tiny("opaque")
    images = scene.train.images.copy()
    images[..., :3] += 1 - images[..., 3:]
    images[..., 3] = 1
    opaque = replace(scene, train=replace(scene.train, images=images))
    first, second = Recorder(), Recorder()
    subject.fit([opaque], first, iterations=6, alpha_weight=0.0)
    subject.fit([opaque], second, iterations=6, alpha_weight=0.5)
    assert first.losses == second.losses
