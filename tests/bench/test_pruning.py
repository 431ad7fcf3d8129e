"""What models could do without: of a synthetic one the half that nobody sees."""

import numpy as np
import pytest
import torch

from econgs_bench.bench.jobs.measure import mean_drawn
from econgs_bench.bench.jobs.monitor import as_numpy
from econgs_bench.bench.jobs.pruning import by_weight, pruning, removable
from econgs_bench.datasets.views import ViewSet
from econgs_bench.econgs.splat import rasterise
from econgs_bench.econgs.splat.splats import Splats
from econgs_bench.methods.contract.scene import away, look_at
from econgs_bench.methods.interface import HasGaussians
from econgs_bench.reports.schema import PRUNED

HALF = 16
SEEN = look_at((0.0, -3.0, 0.0)), look_at((3.0, 0.0, 0.0))
BLACK = (0.0, 0.0, 0.0)


class Balls:
    """Balls of which the last half are under the threshold of visibility; their order differs by view.

    Args:
        hidden: numbers that no training view gives.
    """

    def __init__(self, hidden: tuple[int, ...] = ()) -> None:
        places = torch.linspace(-0.5, 0.5, 4)
        front = torch.cartesian_prod(places, torch.zeros(1), places)
        self.means = torch.cat([front, front])
        self.opacities = torch.cat([torch.full((HALF,), 0.9), torch.full((HALF,), 0.003)])
        self.hidden = hidden

    def splats(self, scene, camera):
        turn = int(10 * camera.position[0]) % 7
        numbers = torch.arange(2 * HALF).roll(turn)
        if camera in SEEN:
            numbers = numbers[~torch.isin(numbers, torch.tensor(self.hidden))]
        size = torch.full((len(numbers), 3), 0.04)
        quats = torch.eye(4)[:1].repeat(len(numbers), 1)
        colors = torch.ones(len(numbers), 3)
        return Splats(self.means[numbers], quats, size, self.opacities[numbers], colors, camera), numbers


def truth_of(model, cameras):
    """Views that the model renders without an error."""
    images = []
    for camera in cameras:
        splats, _ = model.splats("s", camera)
        drawn = rasterise(*splats[:5], camera, low_pass=splats.low_pass)
        images.append(as_numpy(torch.cat([drawn.features, drawn.alpha[..., None]], 2)))
    return ViewSet(tuple(cameras), np.stack(images), BLACK, "key")


def test_half_of_a_model_that_nobody_sees_can_go_without_a_loss():
    model = Balls()
    assert isinstance(model, HasGaussians)
    test = [look_at((2.0, -2.0, 0.5)), look_at((-2.0, -2.0, 0.5))]
    found = pruning(model, "s", SEEN, test, truth_of(model, test))
    assert found.gaussians == 2 * HALF
    assert found.shares == dict.fromkeys(PRUNED, 0.5)  # a visible one costs tens of dB


def test_gaussians_are_ordered_by_what_they_weigh_in_training_views():
    model = Balls(hidden=(0, 20))
    order = by_weight(model, "s", SEEN).tolist()
    assert set(order) == set(range(2 * HALF)) - {0, 20}
    assert all(number >= HALF for number in order[: HALF - 1])
    # From the side, balls of a row hide each other; the nearest weighs as much as in front, and the most.
    nearest = {12, 13, 14, 15}
    assert set(by_weight(model, "s", SEEN[1:]).tolist()[-4:]) == nearest


def test_what_training_views_do_not_give_stays():
    model = Balls(hidden=(0,))
    test = [look_at((2.0, -2.0, 0.5))]
    truth = truth_of(model, test)
    assert truth.images[0, ..., 3].max() > 0.5
    found = pruning(model, "s", SEEN, test, truth)
    assert found.gaussians == 2 * HALF - 1
    assert found.shares == dict.fromkeys(PRUNED, pytest.approx(HALF / (2 * HALF - 1)))


def test_a_model_without_gaussians_in_view_has_no_share():
    blind = Balls(hidden=tuple(range(2 * HALF)))
    assert pruning(blind, "s", SEEN, [away(SEEN[0])], truth_of(Balls(), [away(SEEN[0])])) is None


@pytest.mark.parametrize(
    ("count", "drops", "counts"),
    [
        (10, (0.05, 0.1, 0.5), [0, 1, 5]),  # 0.099 dB for each
        (10, (2.0,), [10]),  # all
        (0, (0.1,), [0]),
    ],
)
def test_bisection_finds_the_last_that_can_go(count, drops, counts):
    assert removable(count, lambda gone: 30.0 - 0.099 * gone, drops) == counts


def test_bisection_of_many_is_as_fine_as_a_thousandth():
    asked = []

    def quality(gone):
        asked.append(gone)
        return 30.0 - gone / 1_000_000

    (found,) = removable(1_000_000, quality, (0.3,))
    assert found == pytest.approx(300_000, abs=1_000_000 / 1000)
    assert found <= 300_000
    assert len(asked) <= 12


def test_the_drawn_gaussians_are_counted_in_a_few_views_and_summed_over_scenes():
    model = Balls(hidden=(0, 20))
    away = look_at((2.0, -2.0, 0.5))
    assert mean_drawn(model, ["s"], [SEEN[0]]) == 2 * HALF - 2
    assert mean_drawn(model, ["s"], [SEEN[0], away]) == 2 * HALF - 1
    assert mean_drawn(model, ["s", "t"], [away]) == 4 * HALF
    assert mean_drawn(model, ["s"], [SEEN[0]] + [away] * 7) == 2 * HALF - 2 / 8
    # Of nine views one is left out.
    assert mean_drawn(model, ["s"], [away] * 8 + [SEEN[0]]) == 2 * HALF
    assert mean_drawn(object(), ["s"], [away]) is None
