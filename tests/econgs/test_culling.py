"""Streams without the offsets of Gaussians that decoders cull."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.codec.container import Kind, Section, read_container, write_container
from econgs_bench.econgs.codec.culling import kept_offsets
from econgs_bench.econgs.codec.group import GroupAttributes
from econgs_bench.econgs.codec.quantiser import round_group
from econgs_bench.econgs.codec.stream import decode_group, encode_group
from tests.econgs.streams import arrays_of, group, with_culling, with_masks


def opacities(one: GroupAttributes, place: int = 0) -> np.ndarray:
    """(N, K) opacities before activation, in float64."""
    scene, nets = one.scenes[place], {name: w.astype(np.float64) for name, w in one.decoders.items()}
    rows = np.broadcast_to(scene.parameters["embedding"], (len(scene), 5))
    inputs = np.concatenate([scene.features, rows], 1).astype(np.float64)
    hidden = np.maximum(inputs @ nets["opacity.first_weight"].T + nets["opacity.first_bias"], 0.0)
    return np.asarray(hidden @ nets["opacity.second_weight"].T + nets["opacity.second_bias"])


@pytest.mark.parametrize("precision", ["float32", "float16", "int8"])
def test_what_is_seen_keeps_its_offsets_and_the_rest_takes_no_bytes(precision: str) -> None:
    original = with_culling(group((300, 0, 40)))
    encoded = encode_group(original, weights=precision)  # type: ignore[arg-type]
    decoded = decode_group(encoded.data)
    whole = decode_group(encode_group(replace(original, culling=False), weights=precision).data)  # type: ignore[arg-type]
    assert encode_group(decoded, weights=precision).data == encoded.data  # type: ignore[arg-type]
    for ours, theirs in zip(arrays_of(decoded), arrays_of(round_group(decoded)), strict=True):
        np.testing.assert_array_equal(ours, theirs, strict=True)
    for place, (scene, full) in enumerate(zip(decoded.scenes, whole.scenes, strict=True)):
        np.testing.assert_array_equal(scene.features, full.features)
        shown = opacities(decoded, place)
        np.testing.assert_array_equal(scene.offsets[shown > 0.0], full.offsets[shown > 0.0])
        assert not scene.offsets[shown < -0.02].any()
    shown = opacities(decoded)
    assert 0.2 < (shown > 0.0).mean() < 0.8
    assert encoded.ledger["offsets"] < 0.8 * encode_group(replace(original, culling=False)).ledger["offsets"]


def test_a_stream_with_culling_has_a_version_of_its_own() -> None:
    assert encode_group(with_culling(group())).data[8] == 2
    assert encode_group(group()).data[8] == 1


def test_culling_goes_with_a_context_and_without_masks() -> None:
    for wrong in (replace(with_culling(group()), context=None), with_masks(with_culling(group()))):
        with pytest.raises(DataError, match="culling"):
            encode_group(wrong)


@pytest.mark.parametrize("lacks", ["opacity.first_weight", "opacity.second_bias"])
def test_without_the_network_there_is_no_culling(lacks: str) -> None:
    one = with_culling(group((20,)))
    del one.decoders[lacks]
    with pytest.raises(ValueError, match="culled"):
        encode_group(one)
    data = encode_group(replace(one, culling=False)).data
    sections = read_container(data, "test")
    head = bytearray(sections[0].payload)
    head[6] |= 4  # the kinds: culling, which its decoders cannot do
    changed = write_container([Section(Kind.GROUP, 0, bytes(head)), *sections[1:]], 2)
    with pytest.raises(DataError, match="culled"):
        decode_group(changed, "test")


def test_any_numbers_give_some_masks() -> None:
    one = with_culling(group((20,)))
    (scene,) = one.scenes
    for value in (np.nan, np.inf, -np.inf, 3e38):
        nets = {name: np.full_like(array, value) for name, array in one.decoders.items()}
        assert kept_offsets(nets, scene.features, scene.parameters).shape == (20, 3)
        features = np.full_like(scene.features, value)
        assert kept_offsets(one.decoders, features, scene.parameters).shape == (20, 3)


@pytest.mark.parametrize("name", ["first_weight", "first_bias", "second_weight", "second_bias"])
def test_networks_of_other_sizes_are_refused(name: str) -> None:
    one = with_culling(group((20,)))
    (scene,) = one.scenes
    for other in (one.decoders[f"opacity.{name}"][:-1], np.float32(1.0), np.ones((1, 1, 1), np.float32)):
        nets = one.decoders | {f"opacity.{name}": np.asarray(other)}
        with pytest.raises(ValueError, match="another size"):
            kept_offsets(nets, scene.features, scene.parameters)
