from __future__ import annotations

import numpy as np
import pytest

from econgs_bench.datasets.edits import Edit, edited, mean_color
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import BasicScene, Isosurface, Light
from econgs_bench.datasets.transfer import Bump, TransferFunction


def scene(*bumps, **more):
    transfer = TransferFunction("t", tuple(Bump("b", *b) for b in bumps)) if bumps else None
    return BasicScene("s", "v", transfer, **more)


ONE = scene((0.2, 0.3, 0.4, 0.5, (0.2, 0.4, 0.6), 0.5))
TWO = scene((0.1, 0.1, 0.3, 0.3, (0.2, 0.4, 0.6), 0.5), (0.6, 0.6, 0.7, 0.7, (0.8, 0.4, 0.3), 0.75))


def test_mean_color_is_weighted_by_extinction():
    # Boxes: widths 0.2 and 0.1, extinctions -ln 0.5 and -ln 0.25, which is twice as much.
    np.testing.assert_allclose(mean_color(TWO), (0.5, 0.4, 0.45), atol=1e-9)
    np.testing.assert_allclose(mean_color(ONE), (0.2, 0.4, 0.6), atol=1e-12)
    thin = scene((0.5, 0.500001, 0.500002, 0.500003, (0.1, 0.2, 0.3), 0.9))
    np.testing.assert_allclose(mean_color(thin), (0.1, 0.2, 0.3), atol=1e-12)
    surfaces = (Isosurface("a", 0.3, (1.0, 0.0, 0.0), 0.25), Isosurface("b", 0.6, (0.0, 0.0, 1.0), 0.75))
    np.testing.assert_allclose(mean_color(scene(isosurfaces=surfaces)), (0.25, 0.0, 0.75))


def test_a_palette_moves_every_color_by_the_same_amount():
    (bump,) = edited(ONE, Edit(palette=(0.9, 0.1, 0.5))).transfer.bumps
    np.testing.assert_allclose(bump.color, (0.9, 0.1, 0.5))
    palette = np.array([0.55, 0.3, 0.5])
    new = edited(TWO, Edit(palette=tuple(palette)))
    np.testing.assert_allclose(mean_color(new), palette)
    for old, now in zip(TWO.transfer.bumps, new.transfer.bumps, strict=True):
        np.testing.assert_allclose(np.array(now.color) - old.color, palette - (0.5, 0.4, 0.45), atol=1e-9)
    for bump in edited(TWO, Edit(palette=(1.0, 0.0, 0.0))).transfer.bumps:
        assert all(0.0 <= c <= 1.0 for c in bump.color)  # clipped
    surfaces = (Isosurface("a", 0.3, (0.5, 0.5, 0.5), 0.5),)
    (surface,) = edited(scene(isosurfaces=surfaces), Edit(palette=(0.1, 0.2, 0.3))).isosurfaces
    np.testing.assert_allclose(surface.color, (0.1, 0.2, 0.3))


def test_opacity_is_a_factor_limited_below_one():
    assert [b.opacity for b in edited(TWO, Edit(opacity=0.5)).transfer.bumps] == [0.25, 0.375]
    assert [b.opacity for b in edited(TWO, Edit(opacity=0.0)).transfer.bumps] == [0.0, 0.0]
    assert max(b.opacity for b in edited(TWO, Edit(opacity=9.0)).transfer.bumps) < 1.0
    surfaces = (Isosurface("a", 0.3, (0.5, 0.5, 0.5), 0.5),)
    assert edited(scene(isosurfaces=surfaces), Edit(opacity=3.0)).isosurfaces[0].opacity == 1.0


def test_light_and_its_coefficients():
    light = Light((0.0, 0.0, 1.0), 0.4, 0.5, 0.2, 10.0, "phong")
    lit = scene((0.2, 0.3, 0.4, 0.5, (0.2, 0.4, 0.6), 0.5), light=light)
    assert edited(lit, Edit(light="headlight")).light.direction is None
    new = edited(
        lit, Edit(light=(1.0, 0.0, 0.0), ambient=2.0, diffuse=0.5, specular=0.0, shininess=3.0)
    ).light
    assert new == Light((1.0, 0.0, 0.0), 0.8, 0.25, 0.0, 30.0, "phong")


def test_a_transfer_function_is_replaced_before_other_changes():
    other = TransferFunction("o", TWO.transfer.bumps, 0.02)
    assert edited(ONE, Edit(transfer=other)).transfer == other
    both = edited(ONE, Edit(transfer=other, opacity=0.5)).transfer
    assert [b.opacity for b in both.bumps] == [0.25, 0.375]
    assert both.reference_length == 0.02


def test_bumps_move_by_their_own_widths_and_keep_their_middle():
    (bump,) = edited(ONE, Edit(shift=-0.5)).transfer.bumps
    assert (bump.start, bump.rise, bump.fall, bump.end) == pytest.approx((0.05, 0.15, 0.25, 0.35))
    (bump,) = edited(ONE, Edit(width=0.5)).transfer.bumps
    assert (bump.start, bump.rise, bump.fall, bump.end) == pytest.approx((0.275, 0.325, 0.375, 0.425))
    both = edited(ONE, Edit(shift=1.0, width=2.0)).transfer.bumps[0]  # widened, then moved by the new width
    assert (both.start, both.end) == pytest.approx((0.65, 1.0))  # clipped
    assert edited(ONE, Edit(shift=9.0)).transfer.bumps[0].start == 1.0


def test_an_edit_of_nothing_is_the_scene_itself():
    assert edited(TWO, Edit()) == TWO


@pytest.mark.parametrize(
    ("of", "edit", "reason"),
    [
        (ONE, Edit(opacity=-1.0), "factor on opacity"),
        (ONE, Edit(diffuse=float("nan")), "factor on diffuse"),
        (ONE, Edit(shininess=0.0), "no highlight"),
        (ONE, Edit(palette=(1.2, 0.0, 0.0)), "palette"),
        (ONE, Edit(light=(1.0, 1.0, 0.0)), "no unit vector"),
        (scene((0.2, 0.3, 0.4, 0.5, (0.2, 0.4, 0.6), 0.5), light=None), Edit(ambient=2.0), "unshaded"),
        (
            scene(isosurfaces=(Isosurface("a", 0.3, (0.5, 0.5, 0.5)),)),
            Edit(transfer=ONE.transfer),
            "no transfer function",
        ),
        (ONE, Edit(shift=float("inf")), "the shift is inf"),
        (ONE, Edit(width=0.0), "factor on the width is 0"),
        (scene(views_folder="somewhere"), Edit(opacity=0.5), "rendered elsewhere"),
        (scene(), Edit(palette=(0.5, 0.5, 0.5)), "no transfer function"),
    ],
)
def test_edits_without_a_truth_are_refused(of, edit, reason):
    with pytest.raises(DataError, match=reason):
        edited(of, edit)


def test_the_contract_of_methods_is_the_same_class():
    from econgs_bench.methods import interface

    assert interface.Edit is Edit
