"""Training under quantisation: what the grid of positions and the masks do to it."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from econgs_bench.econgs.anchors.coding import Coding
from econgs_bench.econgs.codec.model import Attributes
from tests.econgs.streams import CONFIG

ALWAYS = SimpleNamespace(noisy=lambda i: True, coded=lambda i: True, exact=lambda i: i > 1)


def anchors(positions, voxel=0.01):
    positions = torch.tensor(positions, dtype=torch.float32)
    return SimpleNamespace(key="a", voxel=voxel, positions=positions, __len__=lambda: len(positions))


def coding(**more):
    return Coding(CONFIG, ALWAYS, torch.Generator().manual_seed(1), "cpu", **more)


CORNERS = [[0.0, 0.0, 0.0], [1.0, 0.5, 0.2]]


def test_with_a_margin_the_grid_stays_while_anchors_grow_within_it():
    one = coding(margin=0.1)
    with pytest.raises(RuntimeError, match="not placed"):
        _ = one.grid
    one.place([anchors(CORNERS)])
    first = one.grid
    np.testing.assert_allclose(first.origin, [-0.1, -0.05, -0.02], atol=1e-6)
    assert first.extent == (120, 60, 24)
    one.place([anchors([*CORNERS, [1.08, 0.0, 0.2]])])
    assert one.grid is first
    one.place([anchors([*CORNERS, [1.2, 0.0, 0.2]])])
    assert one.grid.extent[0] > 120
    again = coding(margin=0.1)
    again.load_state(one.state())
    assert again.grid == one.grid


def test_without_a_margin_it_is_that_of_the_anchors():
    one = coding()
    one.place([anchors(CORNERS)])
    assert one.grid.extent == (100, 50, 20)
    one.place([anchors(CORNERS[:1])])
    assert one.grid.extent == (1, 1, 1)


def test_the_bits_of_every_visible_anchor_may_count():
    values = Attributes(torch.zeros(9, CONFIG.features), torch.ones(9, 6), torch.zeros(9, CONFIG.offsets, 3))
    values.features[3] = 50.0
    places = [[0.1 * i, 0.0, 0.0] for i in range(9)]

    def bits(rows):
        one = coding(sample=1.0)
        one.place([anchors(places)])
        one.begin([values])
        return one.apply(anchors(places), values.of(rows), rows, 9, 2)[1].attributes

    rows = torch.arange(9)
    each = torch.stack([bits(row[None]) for row in rows])
    assert each.max() > 1.5 * each.min()
    torch.testing.assert_close(bits(rows), each.mean())


@pytest.mark.parametrize("iteration", [1, 2])
def test_masked_offsets_cost_nothing(iteration):
    generator = torch.Generator().manual_seed(2)
    places = torch.rand((40, 3), generator=generator).mul(100).round().div(100).tolist()
    values = Attributes(
        torch.randn((40, CONFIG.features), generator=generator),
        torch.rand((40, 6), generator=generator),
        torch.randn((40, CONFIG.offsets, 3), generator=generator),
    )

    def bits(masks):
        of = None if masks is None else partial(masks.index_select, 0)
        one = coding()
        one.place([anchors(places)])
        one.begin([values])
        return one.apply(anchors(places), values, torch.arange(40), 40, iteration, of)[1]

    plain, whole = bits(None), bits(torch.ones(40, CONFIG.offsets))
    soft = torch.full((40, CONFIG.offsets), 0.5, requires_grad=True)
    none = bits(0.0 * soft)
    assert torch.equal(plain.attributes, whole.attributes)
    assert float(none.groups[3]) == 0.0 < float(whole.groups[3])
    assert torch.equal(none.groups[:3], whole.groups[:3])
    bits(soft).attributes.backward()
    assert (soft.grad >= 0.0).all()
    assert soft.grad.any()
