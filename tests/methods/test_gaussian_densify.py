import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from econgs_bench.econgs.optim import Adam
from econgs_bench.methods.gaussian_splatting.densify import (
    GrowthRules,
    GrowthStatistics,
    capped_logits,
    grow,
    rotate,
)
from econgs_bench.methods.gaussian_splatting.training import PARAMETERS

SHAPES = {"means": (3,), "log_scales": (3,), "quats": (4,), "logits": (), "sh_dc": (1, 3), "sh_rest": (15, 3)}
RULES = GrowthRules(gradient=2e-4, dense_scale=0.04, prune_opacity=0.005, extent=4.0, limit=0)


def gaussians(scales, opacities=0.5):
    """One Gaussian per scale; every other attribute is random, so that rows can be told apart."""
    count = len(scales)
    generator = torch.Generator().manual_seed(3)
    values = {name: torch.randn((count, *shape), generator=generator) for name, shape in SHAPES.items()}
    values["log_scales"] = torch.tensor(scales).log()[:, None] * torch.ones(1, 3)
    values["logits"] = torch.logit(torch.as_tensor(opacities, dtype=torch.float32).expand(count).clone())
    return values


def statistics(gradients, radii=None):
    count = len(gradients)
    radii = [5.0] * count if radii is None else radii
    return GrowthStatistics(torch.tensor(gradients), torch.ones(count), torch.tensor(radii))


def run(parameters, seen, rules=RULES, prune_large=False, seed=0):
    return grow(parameters, seen, rules, prune_large, torch.Generator().manual_seed(seed))


def test_cold_stay_small_hot_are_cloned_large_hot_are_split():
    parameters = gaussians([0.01, 0.01, 0.1])
    growth = run(parameters, statistics([1e-4, 3e-4, 3e-4]))
    assert growth.keep.tolist() == [0, 1]
    assert len(growth.added["means"]) == 3
    for name in PARAMETERS:
        torch.testing.assert_close(growth.added[name][0], parameters[name][1], rtol=0, atol=0)
    parts = {name: values[1:] for name, values in growth.added.items()}
    torch.testing.assert_close(parts["log_scales"].exp(), torch.full((2, 3), 0.1 / 1.6))
    for name in ("quats", "logits", "sh_dc", "sh_rest"):
        torch.testing.assert_close(parts[name], parameters[name][2].expand_as(parts[name]), rtol=0, atol=0)
    assert not torch.equal(parts["means"][0], parts["means"][1])


def test_the_gradient_is_a_mean_over_the_views_that_saw_it():
    seen = GrowthStatistics.zeros(3, "cpu")
    # 200 x 100 pixels: a pixel gradient of (1, 1)e-6 is (1, 0.5)e-4 in normalised device coordinates
    seen.record(torch.tensor([[1e-6, 1e-6], [2e-6, 0.0], [0.0, 0.0]]), torch.tensor([4, 7, 0]), 200, 100)
    seen.record(torch.tensor([[0.0, 0.0], [4e-6, 0.0], [0.0, 0.0]]), torch.tensor([0, 3, 0]), 200, 100)
    expected = torch.tensor([math.hypot(1e-4, 0.5e-4), 3e-4, 0.0])
    torch.testing.assert_close(seen.mean_gradients(), expected)
    assert seen.visits.tolist() == [1, 2, 0]
    assert seen.radii.tolist() == [4, 7, 0]


def test_parts_of_a_split_are_distributed_like_their_parent():
    parameters = gaussians([0.2] * 4000)
    scales = torch.tensor([0.3, 0.1, 0.05])
    quat = torch.tensor([0.3, -0.7, 0.2, 0.9])
    parameters["log_scales"] = scales.log().expand(4000, 3).clone()
    parameters["quats"] = quat.expand(4000, 4).clone()
    parameters["means"] = torch.zeros(4000, 3)
    growth = run(parameters, statistics([1e-3] * 4000))
    assert growth.keep.numel() == 0
    rotation = Rotation.from_quat(quat[[1, 2, 3, 0]].numpy()).as_matrix()
    expected = rotation @ np.diag(scales.numpy() ** 2) @ rotation.T
    np.testing.assert_allclose(np.cov(growth.added["means"].numpy().T), expected, atol=0.004)


def test_rotation_matches_scipy():
    generator = torch.Generator().manual_seed(0)
    quats, vectors = torch.randn((20, 4), generator=generator), torch.randn((20, 3), generator=generator)
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]].numpy()).apply(vectors.numpy())
    np.testing.assert_allclose(rotate(quats, vectors).numpy(), expected, atol=1e-5)


def test_transparent_ones_are_pruned_and_large_ones_only_when_asked():
    parameters = gaussians([0.01, 0.01, 0.5, 0.01], [0.5, 0.004, 0.5, 0.5])
    seen = statistics([0.0] * 4, radii=[5.0, 5.0, 5.0, 21.0])
    assert run(parameters, seen).keep.tolist() == [0, 2, 3]
    assert run(parameters, seen, prune_large=True).keep.tolist() == [0]


def test_the_limit_lets_the_hottest_grow_and_says_so():
    rules = GrowthRules(2e-4, 0.04, 0.005, 4.0, limit=6)
    growth = run(gaussians([0.01] * 4), statistics([3e-4, 9e-4, 5e-4, 4e-4]), rules)
    assert growth.limited
    assert len(growth.keep) + len(growth.added["means"]) == 6
    first_coordinate = gaussians([0.01] * 4)["means"][[1, 2], 0]
    torch.testing.assert_close(growth.added["means"][:, 0], first_coordinate, rtol=0, atol=0)
    roomy = GrowthRules(2e-4, 0.04, 0.005, 4.0, limit=8)
    assert not run(gaussians([0.01] * 4), statistics([3e-4, 9e-4, 5e-4, 4e-4]), roomy).limited


@pytest.mark.parametrize("opacity", [0.5, 0.001])
def test_nothing_to_do_and_nothing_left(opacity):
    growth = run(gaussians([0.01, 0.1], opacity), statistics([0.0, 0.0]))
    assert len(growth.keep) == (2 if opacity == 0.5 else 0)
    assert {len(values) for values in growth.added.values()} == {0}


def test_growing_from_nothing():
    growth = run(gaussians([]), GrowthStatistics.zeros(0, "cpu"), prune_large=True)
    assert len(growth.keep) == len(growth.added["means"]) == 0


def test_optimiser_rows_stay_with_their_gaussians():
    parameters = gaussians([0.01, 0.1, 0.01, 0.01, 0.1, 0.01], [0.5, 0.5, 0.001, 0.5, 0.5, 0.5])
    optimiser = Adam(
        {name: values.clone() for name, values in parameters.items()}, dict.fromkeys(PARAMETERS, 0.0)
    )
    for row in range(6):  # moments that tell which row they belong to
        for name in PARAMETERS:
            optimiser.first[name][0][row] = row + 1
            optimiser.second[name][0][row] = 10 * (row + 1)
    growth = run(parameters, statistics([3e-4, 3e-4, 0.0, 0.0, 0.0, 3e-4]))
    optimiser.keep(growth.keep, PARAMETERS)
    optimiser.append(growth.added)
    kept = [0, 3, 4, 5]
    assert growth.keep.tolist() == kept
    for name in PARAMETERS:
        values, first, second = optimiser[name], optimiser.first[name][0], optimiser.second[name][0]
        assert len(values) == len(first) == len(second) == 4 + 2 + 2
        torch.testing.assert_close(values[:4].detach(), parameters[name][kept], rtol=0, atol=0)
        assert [float(row.flatten()[0]) for row in first[:4]] == [k + 1 for k in kept]
        assert [float(row.flatten()[0]) for row in second[:4]] == [10 * (k + 1) for k in kept]
        assert not first[4:].any()
        assert not second[4:].any()
        assert values.is_leaf
        assert values.requires_grad


def test_reset_caps_opacity_at_one_percent():
    logits = torch.logit(torch.tensor([0.9, 0.01, 0.002]))
    torch.testing.assert_close(capped_logits(logits).sigmoid(), torch.tensor([0.01, 0.01, 0.002]))
