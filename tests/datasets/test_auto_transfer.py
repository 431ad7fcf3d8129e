"""Automatic transfer functions: apart from each other, over what occurs, without the background."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from datasets import procedural
from datasets.auto_transfer import automatic_scenes, statistics
from datasets.errors import DataError
from datasets.volume import Volume


def _volume(values: np.ndarray) -> Volume:
    return Volume("value", values, (1.0, 1.0, 1.0), (float(values.min()), float(values.max())), "test")


def _check(volume: Volume, count: int) -> None:
    scenes = automatic_scenes(volume, count)
    assert 1 <= len(scenes) <= count
    assert len({scene.name for scene in scenes}) == len(scenes)
    end = 0.0
    for scene in scenes:
        assert 1 <= len(scene.transfer.bumps) <= 2
        for bump in scene.transfer.bumps:
            assert end <= bump.start <= bump.rise <= bump.fall <= bump.end <= 1.0
            assert bump.start < bump.end
            assert 0.0 < bump.opacity < 1.0
            end = bump.end


def _radius(n: int, centre: float = 0.0) -> np.ndarray:
    """(n, n, n) distances from a point of the x axis in a box from -1 to 1."""
    at = np.linspace(-1, 1, n)
    return np.sqrt(at[:, None, None] ** 2 + at[:, None] ** 2 + (at - centre) ** 2)


def _balls(noise: float = 0.0) -> np.ndarray:
    """A ball of 200 in one of 100 in surroundings of 20 (u8), blurred by one voxel."""
    r = _radius(48)
    soft = 1 / (1 + np.exp((r - 0.7) / 0.03)), 1 / (1 + np.exp((r - 0.35) / 0.03))
    field = 20 + 80 * soft[0] + 100 * soft[1]
    field += noise * np.random.default_rng(0).standard_normal(field.shape)
    return np.clip(np.rint(field), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_each_boundary_has_a_bump_and_the_background_none(noise: float) -> None:
    volume = _volume(_balls(noise))
    scenes = automatic_scenes(volume, 2)
    assert len(scenes) == 2
    normalised = volume.normalised()
    low, high = volume.value_range
    opacity = [s.transfer.classify(normalised)[..., 3] for s in scenes]
    corner = tuple(slice(0, 6) for _ in range(3))
    assert all((o[corner] > 0).mean() < 0.05 for o in opacity)
    outer, inner = ((x - low) / (high - low) for x in (60, 150))
    assert scenes[0].transfer.classify(np.array([outer]))[0, 3] > 0
    assert scenes[1].transfer.classify(np.array([inner]))[0, 3] > 0


@pytest.mark.parametrize("name", procedural.FIELDS)
def test_every_scene_shows_something_and_none_a_solid_box(name: str) -> None:
    volume = procedural.make_volume(name, 48)
    for scene in automatic_scenes(volume, 3):
        share = (scene.transfer.classify(volume.normalised())[..., 3] > 0).mean()
        assert 1e-3 < share < 0.5


def test_a_mask_shows_its_inside() -> None:
    mask = np.zeros((20, 20, 20), np.uint8)
    mask[5:15, 5:15, 5:15] = 1
    (scene,) = automatic_scenes(_volume(mask), 3)
    opaque = scene.transfer.classify(_volume(mask).normalised())[..., 3] > 0
    np.testing.assert_array_equal(opaque, mask > 0)


def test_inverted_values_have_their_background_on_top() -> None:
    volume = _volume(255 - _balls())
    corner = volume.normalised()[:6, :6, :6]
    for scene in automatic_scenes(volume, 2):
        assert not (scene.transfer.classify(corner)[..., 3] > 0).any()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_signed_values_show_both_signs_and_not_zero(count: int) -> None:
    """Two balls of opposite sign in a still surrounding, as of a velocity."""
    field = sum(
        sign / (1 + np.exp((_radius(40, centre) - 0.3) / 0.05))
        for centre, sign in ((-0.45, -1.0), (0.45, 1.0))
    )
    volume = _volume(field.astype(np.float32))
    normalised = volume.normalised()
    opacity = sum(s.transfer.classify(normalised)[..., 3] for s in automatic_scenes(volume, count))
    assert not opacity[:4].any()
    assert not opacity[:, :4].any()
    middle = opacity[20]
    assert (middle[:, :20] > 0).any()
    assert (middle[:, 20:] > 0).any()
    _check(volume, count)


def test_masked_voxels_enter_no_histogram() -> None:
    values = _balls().astype(np.float32)
    inside = values > 60
    hidden = np.where(inside, values, 5000.0).astype(np.float32)
    same = np.where(inside, values, 60.0).astype(np.float32)
    low, high = float(values[inside].min()), float(values.max())
    volume = Volume("value", hidden, (1.0, 1.0, 1.0), (low, high), "test", mask=inside)
    stats = statistics(volume)
    assert stats.count.sum() == inside.sum()
    expected = np.histogram((values[inside] - low) / (high - low), 256, (0.0, 1.0))[0]
    np.testing.assert_array_equal(stats.count, expected)
    assert stats.count[-1] < 0.5 * inside.sum()
    assert len(automatic_scenes(replace(volume, values=same), 3)) > 1


def test_parts_too_small_to_be_seen_join_a_neighbour() -> None:
    """A field with a long tail: hardly any voxel has most of the range."""
    volume = _volume(np.exp(-9.0 * _radius(64)).astype(np.float32))
    normalised = volume.normalised()
    for scene in automatic_scenes(volume, 6):
        assert (scene.transfer.classify(normalised)[..., 3] > 0).mean() > 5e-4


def test_no_scenes_wanted() -> None:
    with pytest.raises(DataError):
        automatic_scenes(_volume(_balls()), 0)


@settings(max_examples=60, deadline=None)
@given(
    values=hnp.arrays(
        st.sampled_from(["u1", "i2", "f4"]),
        hnp.array_shapes(min_dims=3, max_dims=3, min_side=2, max_side=9),
        elements=st.integers(0, 100),
    ).filter(lambda a: a.min() < a.max()),
    count=st.integers(1, 6),
)
def test_any_values(values: np.ndarray, count: int) -> None:
    _check(_volume(values), count)
