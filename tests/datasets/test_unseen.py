"""Transfer functions that nobody trained on: their distance, and the trained scenes that come near."""

from __future__ import annotations

import numpy as np
import pytest

from econgs_bench.datasets.edits import Edit, edited
from econgs_bench.datasets.scene import BasicScene, Isosurface
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.unseen import recipe, transfer_distance

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


def box(name, start, end, color=RED, opacity=0.3):
    """A scene whose bump is a box, so that areas are known."""
    return BasicScene(
        name, "v", TransferFunction(name, (Bump(name, start, start, end, end, color, opacity),))
    )


LOW, HIGH = box("low", 0.2, 0.3), box("high", 0.6, 0.7, BLUE)


@pytest.mark.parametrize(
    ("after", "distance"),
    [
        ([LOW], 0.0),
        ([box("half", 0.25, 0.35)], 2 / 3),  # half of each is shared: 0.5 of 1.5
        ([HIGH], 1.0),
        ([box("faint", 0.2, 0.3, opacity=0.1)], 0.0),
        ([LOW, HIGH], 2 / 3),  # half of the extinction is shared: 0.5 of 1.5
    ],
)
def test_distance_is_what_is_not_shared(after, distance):
    assert transfer_distance([LOW], after) == pytest.approx(distance, abs=5e-3)


def test_distance_of_what_has_no_transfer_function_is_unknown():
    surfaces = BasicScene("s", "v", isosurfaces=(Isosurface("a", 0.3, RED),))
    assert transfer_distance([surfaces], [surfaces]) is None
    assert (
        transfer_distance([box("none", 0.1, 0.2, opacity=0.0)], [box("none", 0.3, 0.4, opacity=0.0)]) is None
    )


def test_a_trained_transfer_function_is_its_own_recipe():
    for palette in (False, True):
        found = recipe(LOW, Edit(width=1.0), [LOW, HIGH], palette=palette)
        assert found.keys() == {"low"}
        assert found["low"].opacity == pytest.approx(1.0, abs=1e-3)
    assert found["low"].palette == pytest.approx(RED)


def test_a_bump_between_two_is_a_mixture_of_both_and_has_its_own_color():
    found = recipe(LOW, Edit(shift=2.0), [LOW, HIGH], palette=True)
    assert found.keys() == {"low", "high"}
    weights = np.array([found["low"].opacity, found["high"].opacity])
    np.testing.assert_allclose(weights, 0.5, atol=0.03)  # its middle, 0.45, is halfway
    assert all(edit.palette == pytest.approx(RED) for edit in found.values())


def test_colors_decide_where_palettes_cannot_be_edited():
    red_high = box("red", 0.6, 0.7)
    found = recipe(LOW, Edit(shift=4.0), [LOW, HIGH, red_high], palette=False)
    assert found["red"].opacity == pytest.approx(1.0, abs=0.02)
    assert "high" not in found


def test_light_stays_an_edit_of_every_scene():
    found = recipe(LOW, Edit(shift=2.0, light=(1.0, 0.0, 0.0), opacity=2.0), [LOW, HIGH], palette=False)
    assert all(edit.light == (1.0, 0.0, 0.0) for edit in found.values())
    assert all(edit.shift is None for edit in found.values())


def test_the_scene_itself_stands_where_nothing_comes_near():
    found = recipe(LOW, Edit(shift=1.0), [box("faint", 0.3, 0.4, opacity=0.0), LOW], palette=False)
    assert found.keys() == {"low"}
    gone = recipe(LOW, Edit(shift=99.0), [LOW], palette=False)
    assert gone == {"low": Edit(opacity=1.0)}
    assert edited(LOW, Edit(shift=99.0)).transfer.bumps[0].start == 1.0
