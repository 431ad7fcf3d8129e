"""Growing and pruning of anchors, against cells counted by hand."""

import math

import pytest
import torch

from econgs_bench.econgs.anchors.growing import AnchorRules, AnchorStatistics, grow, lattice_anchors, prunable

RULES = AnchorRules(voxel=0.01, init_factor=16, gradient=1.0)


def setting(offsets, gradients, draws=100.0):
    """One anchor at the origin with unit scaling, K offsets, and their mean gradients."""
    many = len(offsets)
    anchors, scalings = torch.zeros(1, 3), torch.zeros(1, 6)
    features = torch.arange(4.0)[None]
    statistics = AnchorStatistics.zeros(1, many, "cpu")
    statistics.draws[:] = draws
    statistics.gradients[:] = torch.tensor([gradients]) * draws
    return anchors, scalings, features, torch.tensor([offsets]), statistics


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_cells_are_sixteen_four_and_one_voxel():
    assert [RULES.cell(level) for level in range(3)] == [0.16, 0.04, 0.01]


@pytest.mark.parametrize(("voxel", "factor"), [(0.001, 4), (0.0, 16), (-1.0, 16)])
def test_cells_without_size_are_refused(voxel, factor):
    with pytest.raises(ValueError, match="cells"):
        AnchorRules(voxel=voxel, init_factor=factor)


def test_anchors_grow_on_the_lattice_in_free_cells_only():
    # The first Gaussian lies in the anchor's own coarse cell, the others far away and in one cell together.
    offsets = [[0.01, 0.0, 0.0], [1.0, 0.0, 0.0], [1.01, 0.0, 0.0]]
    *state, statistics = setting(offsets, [1.5, 1.5, 1.5])  # level 0 only
    counts = set()
    for seed in range(20):
        copied = AnchorStatistics(*(v.clone() for v in vars(statistics).values()))
        grown = grow(*state, copied, RULES, generator(seed))
        assert len(grown.anchors) <= 1
        counts.add(len(grown.anchors))
        for place in grown.anchors:
            torch.testing.assert_close(place, torch.tensor([round(1.0 / 0.16) * 0.16, 0.0, 0.0]))
    assert counts == {0, 1}  # thinning keeps about half at level 0


def test_strong_gradients_reach_the_fine_levels():
    *state, statistics = setting([[1.0, 0.0, 0.0]], [100.0])
    grown = grow(*state, statistics, RULES, generator(3))
    cells = set(grown.log_scalings[:, 0].exp().mul(100).round().int().tolist())
    assert cells <= {16, 4, 1}
    assert 1 in cells
    assert torch.equal(grown.log_scalings, grown.log_scalings[:, :1].expand(-1, 6))


@pytest.mark.parametrize(
    ("gradient", "cells"),
    [(0.99, set()), (1.01, {16}), (1.99, {16}), (2.01, {16, 4}), (3.99, {16, 4}), (4.01, {16, 4, 1})],
)
def test_each_level_asks_for_twice_the_gradient(gradient, cells):
    *state, statistics = setting([[1.013, 0.0, 0.0]], [gradient])
    met = set()
    for seed in range(40):  # thinning leaves levels out
        copied = AnchorStatistics(*(v.clone() for v in vars(statistics).values()))
        grown = grow(*state, copied, RULES, generator(seed))
        met |= set(grown.log_scalings[:, 0].exp().mul(100).round().int().tolist())
    assert met == cells


def test_features_are_the_maximum_over_those_who_asked():
    anchors = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    features = torch.tensor([[1.0, 5.0], [3.0, 2.0]])
    offsets = torch.tensor([[[1.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0]]])  # both Gaussians lie at x = 1
    for seed in range(50):
        statistics = AnchorStatistics.zeros(2, 1, "cpu")
        statistics.draws[:] = 100.0
        statistics.gradients[:] = 150.0
        grown = grow(anchors, torch.zeros(2, 6), features, offsets, statistics, RULES, generator(seed))
        if len(grown.anchors):
            feature = grown.features[0].tolist()
            assert feature in ([3.0, 5.0], [1.0, 5.0], [3.0, 2.0])
            if feature == [3.0, 5.0]:
                return
    pytest.fail("in none of 50 draws did both ask")


def test_offsets_seen_too_seldom_wait():
    *state, statistics = setting([[1.0, 0.0, 0.0]], [100.0], draws=40.0)
    assert len(grow(*state, statistics, RULES, generator()).anchors) == 0
    assert statistics.draws.item() == 40.0  # not judged, so not reset
    *state, statistics = setting([[1.0, 0.0, 0.0]], [100.0], draws=41.0)
    grow(*state, statistics, RULES, generator())
    assert statistics.draws.item() == 0.0


def test_the_limit_holds_and_is_told():
    offsets = [[float(i), 0.0, 0.0] for i in range(1, 30)]
    *state, statistics = setting(offsets, [100.0] * 29)
    rules = AnchorRules(voxel=0.01, gradient=1.0, limit=6)
    grown = grow(*state, statistics, rules, generator())
    assert len(grown.anchors) == 5
    assert grown.limited


def test_a_start_may_exceed_the_limit():
    """It failed: 500,000 random points are more than ECoNGS's default lets a scene grow to."""
    *state, statistics = setting([[1.0, 0.0, 0.0]], [100.0])
    state = [values.repeat(3, *[1] * (values.dim() - 1)) for values in state]
    repeated = AnchorStatistics(*(torch.cat([v, v, v]) for v in vars(statistics).values()))
    grown = grow(*state, repeated, AnchorRules(voxel=0.01, gradient=1.0, limit=2), generator())
    assert len(grown.anchors) == 0
    assert grown.limited


def test_at_the_limit_the_largest_gradients_come_in():
    """Not those of the smallest x, in which order cells are found."""
    offsets = [[float(i), 0.0, 0.0] for i in range(1, 21)]
    gradients = [1.1 + 0.01 * i for i in range(20)]  # the far ones ask loudest; level 0 only
    *state, statistics = setting(offsets, gradients)
    free = [AnchorStatistics(*(v.clone() for v in vars(statistics).values())) for _ in range(2)]
    every = grow(*state, free[0], RULES, generator())
    few = grow(*state, free[1], AnchorRules(voxel=0.01, gradient=1.0, limit=4), generator())
    assert len(every.anchors) > 6
    assert few.limited
    torch.testing.assert_close(few.anchors, every.anchors[-3:])  # found in order of x


def test_faint_anchors_are_pruned_once_seen_often_enough():
    statistics = AnchorStatistics.zeros(4, 2, "cpu")
    statistics.visits[:] = torch.tensor([100.0, 100.0, 80.0, 100.0])
    statistics.opacities[:] = torch.tensor([0.1, 0.6, 0.0, 0.5])
    assert prunable(statistics, AnchorRules()).tolist() == [True, False, False, False]
    assert statistics.visits.tolist() == [100.0, 0.0, 80.0, 0.0]  # the judged that stay begin anew


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_record_counts_what_was_drawn(backend, monkeypatch):
    monkeypatch.setenv("ECONGS_BACKEND", backend)
    statistics = AnchorStatistics.zeros(3, 2, "cpu")
    for _ in range(2):
        statistics.record(
            visible=torch.tensor([0, 2]),
            opacities=torch.tensor([[0.5, -0.5], [0.25, 0.25]]),
            slots=torch.tensor([0, 2, 3]),
            pixel_gradients=torch.tensor([[3.0, 0.0], [3.0, 8.0], [1.0, 1.0]]),
            radii=torch.tensor([1, 4, 0], dtype=torch.int32),
            size=(20, 10),
        )
    assert statistics.visits.tolist() == [2.0, 0.0, 2.0]
    assert statistics.opacities.tolist() == [1.0, 0.0, 1.0]
    assert statistics.draws.tolist() == [[2.0, 0.0], [0.0, 0.0], [2.0, 0.0]]
    assert statistics.gradients.tolist() == [[60.0, 0.0], [0.0, 0.0], [100.0, 0.0]]


def test_points_of_one_cell_make_one_anchor():
    points = torch.tensor([[0.0011, 0.0, 0.0], [0.0009, 0.0, 0.0], [-0.0021, 0.0, 0.0]])
    anchors = lattice_anchors(points, 0.001)
    torch.testing.assert_close(anchors, torch.tensor([[-0.002, 0.0, 0.0], [0.001, 0.0, 0.0]]))
    assert math.isclose(float(anchors[1, 0]), 0.001, rel_tol=1e-6)
