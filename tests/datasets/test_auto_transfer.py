"""Automatic transfer functions: apart from each other in values and in what they show."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.ndimage import map_coordinates

from econgs_bench.datasets import procedural
from econgs_bench.datasets.auto_transfer import automatic_scenes, statistics
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.visibility import LEAST_WEIGHT, Samples, overlaps
from econgs_bench.datasets.volume import Volume


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
    volume, *_ = procedural.make_volumes(name, 48).values()
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


REAL = (
    "vis_male", "stroke_mri", "boston_teapot", "csafe_heptane", "fuel",
    "stent_ct", "isabel_wind",  # kept back until the rule was fixed
)  # fmt: skip


@pytest.mark.data
@pytest.mark.parametrize("name", REAL)
def test_scenes_of_real_volumes_show_different_places(data_folder: Path, name: str) -> None:
    """At another resolution than that of the choice."""
    dataset = open_dataset(name, [data_folder])
    for variable in dataset.volumes:
        volume = dataset.volume(variable)
        samples = Samples.of(volume, 128)
        scenes = automatic_scenes(volume)
        assert len(scenes) >= 2, variable
        visible = [samples.look(scene.transfer).visible for scene in scenes]
        shares = [float(one.sum() / samples.valid.sum()) for one in visible]
        assert min(shares) >= 0.005, (variable, shares)
        assert max(shares) <= 0.3, (variable, shares)
        assert (overlaps(visible) - np.eye(len(visible))).max() <= 0.5, (variable, overlaps(visible))


def test_visible_voxels_are_those_that_rays_with_many_samples_see() -> None:
    """A ray of 40 samples per voxel, of interpolated values, along each row in both directions."""
    volume = _volume(_balls(3.0)[4:24, 8:40, 10:36])
    transfer = TransferFunction("t", (Bump("b", 0.3, 0.35, 0.5, 0.6, (1.0, 1.0, 1.0), 0.3),), 0.01)
    samples = Samples.of(volume)
    seen = samples.look(transfer).visible
    fine, weights = 40, np.zeros(seen.shape)
    for axis in range(3):
        n = seen.shape[axis]
        along = (np.arange((n - 1) * fine) + 0.5) / fine
        index = np.meshgrid(
            *[along if a == axis else np.arange(m) for a, m in enumerate(seen.shape)], indexing="ij"
        )
        values = map_coordinates(samples.values, index, order=1)
        depth = transfer.classify(values)[..., 3] * samples.distances[axis] / fine
        depth = np.moveaxis(depth, axis, 0).reshape(n - 1, fine, -1)
        for turned in (False, True):
            ordered = depth[::-1, ::-1] if turned else depth
            flat = ordered.reshape((n - 1) * fine, -1)
            weight = -np.expm1(-flat) * np.exp(flat - np.cumsum(flat, axis=0))
            segment = weight.reshape(n - 1, fine, -1).sum(axis=1)
            segment = segment[::-1] if turned else segment
            shape = np.moveaxis(seen, axis, 0).shape
            best = np.moveaxis(weights, axis, 0)
            segment = segment.reshape(n - 1, *shape[1:])
            np.maximum(best[:-1], segment, out=best[:-1])
            np.maximum(best[1:], segment, out=best[1:])
    clear = np.abs(weights - LEAST_WEIGHT) > 0.002
    assert 0.1 < seen.mean() < 0.5
    assert ((weights > LEAST_WEIGHT) & ~seen)[clear].sum() == 0
    assert (seen & (weights < LEAST_WEIGHT))[clear].sum() == 0
    hidden = (transfer.classify(samples.values)[..., 3] > 0) & ~seen
    assert hidden.any(), "what is inside does not count"


def _places() -> tuple[np.ndarray, ...]:
    return tuple(np.meshgrid(*[np.linspace(0.0, 1.0, 40)] * 3, indexing="ij"))


def _storm() -> np.ndarray:
    """Pressure that falls with height, with a low at one place."""
    z, y, x = _places()
    low = np.exp(-((x - 0.5) ** 2 + (y - 0.4) ** 2) / 0.02 - z / 0.3)
    return (1000.0 * np.exp(-z / 0.6) - 200.0 * low).astype(np.float32)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (_places()[2] + 0.5 * _places()[1], "a linear ramp and nothing else"),
        (np.exp(-_places()[0]), "the position along z and nothing else"),
        (np.random.default_rng(0).random((40, 40, 40)), "noise"),
        (_storm(), "mostly follow the position along z"),
    ],
)
def test_where_nothing_separates_a_message_tells_and_a_scene_is_there(values, words, caplog) -> None:
    volume = _volume(values.astype(np.float32))
    with caplog.at_level(logging.WARNING):
        scenes = automatic_scenes(volume)
    assert words in caplog.text
    look = Samples.of(volume).look(scenes[0].transfer)
    assert 0.01 < look.visible.mean() < 0.8
    assert look.alpha > 0.15


def test_the_low_of_a_storm_bends_the_sheet_that_shows_it() -> None:
    volume = _volume(_storm())
    visible = Samples.of(volume).look(automatic_scenes(volume)[-1].transfer).visible
    height = np.where(visible.any(axis=0), visible.argmax(axis=0), -1)
    assert height[16, 20] <= height[2, 2] - 2


def test_each_large_label_has_a_scene() -> None:
    """Labels 1 to 4 are balls apart from each other; interpolation alone passes the labels between."""
    z, y, x = _places()
    labels = np.zeros(x.shape, np.uint8)
    for label, (at, radius) in enumerate([(0.2, 0.15), (0.5, 0.15), (0.8, 0.15), (0.5, 0.1)], 1):
        labels[(x - at) ** 2 + (y - (0.8 if label == 4 else 0.4)) ** 2 + (z - 0.5) ** 2 < radius**2] = label
    scenes = automatic_scenes(_volume(labels))
    assert len(scenes) == 3
    for scene in scenes:
        opaque = scene.transfer.classify(_volume(labels).normalised())[..., 3] > 0
        assert len(np.unique(labels[opaque])) == 1
        assert labels[opaque].min() > 0


def test_the_choice_does_not_depend_on_threads_or_chance() -> None:
    volume = procedural.make_volumes("vortices", 32)["vortices"]
    assert automatic_scenes(volume) == automatic_scenes(volume)
