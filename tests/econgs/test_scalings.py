"""Activations of anchors' scalings, and the anchors that begin and grow with them."""

import math

import pytest
import torch

from econgs_bench.econgs.anchors.anchor_set import AnchorSet
from econgs_bench.econgs.anchors.growing import AnchorRules
from econgs_bench.econgs.anchors.scalings import activated, logarithms, of_logarithms
from econgs_bench.econgs.optim import Adam

VOXEL = 0.01


@pytest.mark.parametrize("activation", ["exp", "sigmoid"])
def test_scalings_come_back(activation):
    lengths = torch.tensor([1e-6, 1e-3, 0.1, 0.9])
    raw = of_logarithms(lengths.log(), activation)
    torch.testing.assert_close(activated(raw, activation), lengths, rtol=1e-5, atol=0.0)
    torch.testing.assert_close(logarithms(raw, activation), lengths.log(), rtol=1e-5, atol=1e-6)


def test_a_sigmoid_ends_below_one():
    raw = of_logarithms(torch.tensor([0.0, 3.0]), "sigmoid")
    assert raw.isfinite().all()
    torch.testing.assert_close(activated(raw, "sigmoid"), torch.full((2,), math.exp(-1e-3)))


@pytest.mark.parametrize("activation", ["exp", "sigmoid"])
def test_anchors_begin_and_grow_in_the_same_lengths(activation):
    points = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    anchors = AnchorSet(
        "a", points, voxel=VOXEL, features=4, offsets=1, fallback=0.1, scale=0.5, activation=activation
    )
    groups = anchors.groups()
    optimiser = Adam(groups, dict.fromkeys(groups, 0.0))
    expected = torch.tensor([0.4] * 3 + [0.2] * 3).expand(2, 6)
    torch.testing.assert_close(anchors.scalings(optimiser), expected)
    with torch.no_grad():  # Gaussians half a scaling away grow anchors in every size of cells
        optimiser["a/offsets"][:, 0, 1] = 0.5
    anchors.statistics.draws[:] = 100.0
    anchors.statistics.gradients[:] = 100.0
    anchors.grow_and_prune(
        optimiser, AnchorRules(voxel=VOXEL, gradient=0.1), torch.Generator().manual_seed(1)
    )
    grown = anchors.scalings(optimiser)[2:]
    assert len(grown) > 0
    torch.testing.assert_close(anchors.positions[2:, 1], torch.full((len(grown),), 0.2), atol=0.08, rtol=0.0)
    cells = grown[:, :1] / VOXEL
    torch.testing.assert_close(cells, cells.round(), rtol=1e-3, atol=0.0)
    assert set(cells.round().int().flatten().tolist()) <= {16, 4, 1}
