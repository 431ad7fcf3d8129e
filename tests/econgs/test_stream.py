"""The stream of a group: what comes back, how long it is, and that it is the same everywhere."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.codec.group import CodedContext, GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.hash_grid import GridConfig
from econgs_bench.econgs.codec.model import Attributes, ContextConfig, ContextModel
from econgs_bench.econgs.codec.positions import PositionGrid
from econgs_bench.econgs.codec.quantiser import round_group
from econgs_bench.econgs.codec.stream import Encoded, decode_group, encode_group
from tests.econgs.streams import arrays_of, attribute_tensors, group, with_culling, with_masks

GOLDEN = Path(__file__).parent / "data" / "golden_v1.econgs"
GOLDEN_SHA = "00772faa9b7de7b958d9b7003b75236f6ec82daf4bd92738df5230133f9cfebc"


def fingerprint(one: GroupAttributes) -> str:
    """Of all decoded numbers, names and metadata."""
    digest = hashlib.sha256(repr((one.grid, one.metadata, [s.name for s in one.scenes])).encode())
    for array in arrays_of(one):
        digest.update(repr(array.shape).encode() + array.astype("<f4").tobytes())
    return digest.hexdigest()


def same(ours: GroupAttributes, theirs: GroupAttributes) -> None:
    for a, b in zip(arrays_of(ours), arrays_of(theirs), strict=True):
        assert a.dtype == b.dtype == np.float32
        np.testing.assert_array_equal(a, b, strict=True)
    assert [s.name for s in ours.scenes] == [s.name for s in theirs.scenes]
    assert (ours.grid, ours.metadata) == (theirs.grid, theirs.metadata)


def test_decoding_gives_what_was_rounded() -> None:
    original = group()
    encoded = encode_group(original)
    decoded = decode_group(encoded.data)
    same(decoded, round_group(original))
    assert sum(encoded.ledger.values()) == len(encoded.data)
    assert all(size > 0 for size in encoded.ledger.values())
    # What was decoded is on its lattice already: it encodes to the very same bytes.
    assert encode_group(decoded).data == encoded.data
    assert decoded.context is not None
    assert original.context is not None
    assert (decoded.context.positive == original.context.positive).all()
    for layers in ("first", "second"):
        ours, theirs = getattr(decoded.context.head, layers), getattr(original.context.head, layers)
        assert all((vars(ours)[name] == vars(theirs)[name]).all() for name in vars(ours))


def test_masked_offsets_are_zero_and_cost_nothing() -> None:
    plain, masked = group(), with_masks(group())
    encoded = encode_group(masked)
    decoded = decode_group(encoded.data)
    same(decoded, round_group(masked))
    for ours, theirs in zip(decoded.scenes, round_group(masked).scenes, strict=True):
        assert ours.masks is not None
        assert (ours.masks == theirs.masks).all()
        assert not ours.offsets[~ours.masks].any()
        assert ours.offsets[ours.masks].any() or not len(ours)
    whole = encode_group(plain)
    assert encoded.ledger["masks"] > 0
    assert encoded.ledger["offsets"] < 0.8 * whole.ledger["offsets"]
    assert encoded.ledger["features"] == whole.ledger["features"]
    assert "masks" not in whole.ledger
    assert encode_group(decoded).data == encoded.data


@pytest.mark.parametrize("of", [group, lambda: with_masks(group()), lambda: with_culling(group())])
def test_plain_positions_are_three_floats_and_change_nothing_else(of: Callable[[], GroupAttributes]) -> None:
    coded, plain = (encode_group(replace(of(), plain_positions=plain)) for plain in (False, True))
    assert plain.data[8] == 3
    assert plain.ledger["positions"] == 12 * sum(map(len, of().scenes))
    assert {part for part in coded.ledger if coded.ledger[part] != plain.ledger[part]} == {"positions"}
    decoded = decode_group(plain.data)
    same(decoded, decode_group(coded.data))
    assert encode_group(decoded).data == plain.data


def test_masks_of_some_scenes_only_and_of_another_shape_are_refused() -> None:
    masked = with_masks(group())
    first, *others = masked.scenes
    with pytest.raises(DataError, match="only some"):
        encode_group(replace(masked, scenes=(first, replace(others[0], masks=None))))
    with pytest.raises(DataError, match="masks have shape"):
        encode_group(replace(masked, scenes=(replace(first, masks=np.ones((3, 1), np.bool_)), *others)))


def test_rounding_keeps_within_half_a_step() -> None:
    original = group((200,))
    decoded = decode_group(encode_group(original).data)
    assert original.context is not None
    codes = original.grid.codes(original.scenes[0].positions)
    context = original.context
    steps = context.steps(context.coding(codes, original.grid))
    # Back to the order of the original: positions tell which anchor is which.
    places = {tuple(one): index for index, one in enumerate(original.scenes[0].positions.tolist())}
    assert len(places) == 200
    order = [places[tuple(one)] for one in decoded.scenes[0].positions.tolist()]
    away = np.abs(decoded.scenes[0].values - original.scenes[0].values[order])
    assert (away <= 0.5001 * steps[order] + 1e-7).all()
    assert len(np.unique(steps)) > 20


def test_every_machine_decodes_the_golden_stream(ways: Any) -> None:
    """Committed once with the format; any ISA, number of threads and backend gives the same numbers."""
    data = GOLDEN.read_bytes()
    for _ in ways():
        decoded = decode_group(data, GOLDEN.name)
        assert fingerprint(decoded) == GOLDEN_SHA
        assert encode_group(decoded).data == data
    assert sum(len(scene) for scene in decoded.scenes) == 150


def trained_group(count: int = 1500) -> tuple[GroupAttributes, ContextModel]:
    """Attributes strewn around a field of the position, and a context model for them."""
    config = ContextConfig(features=12, offsets=4, grid=GridConfig((4, 8, 16), (16,), 12, 8), hidden=16)
    random = np.random.default_rng(0)
    grid = PositionGrid.box([-0.5] * 3, [0.5] * 3)
    scenes = []
    for name in ("TF01", "TF02"):
        positions = grid.positions(random.integers(0, 65536, (count, 3)))
        field = np.sin(5 * positions[:, :1] + np.arange(30)) * np.cos(4 * positions[:, 1:2])
        values = (field + 0.2 * random.normal(size=(count, 30))).astype(np.float32)
        scalings = (0.02 * np.exp(0.4 * values[:, 12:18])).astype(np.float32)
        offsets = values[:, 18:].reshape(count, 4, 3)
        scenes.append(SceneAttributes(name, positions, 0.5 * values[:, :12], scalings, offsets))
    model = ContextModel(config, torch.Generator().manual_seed(0))
    model.calibrate(*(Attributes(*attribute_tensors(one)) for one in scenes))
    with torch.no_grad():
        model.refinements.weight.normal_(std=0.3, generator=torch.Generator().manual_seed(1))
    return GroupAttributes(tuple(scenes), grid, CodedContext.of(model)), model


def test_length_is_within_a_percent_of_the_cross_entropy() -> None:
    data, model = trained_group()
    encoded = encode_group(data)
    assert encoded.ideal_bits <= encoded.attribute_bits <= 1.01 * encoded.ideal_bits
    # And the tables cost little against the float model's own estimate.
    model.coder_exact = True
    estimate = 0.0
    for one in data.scenes:
        codes = torch.from_numpy(data.grid.codes(one.positions))
        lookup = model.lookup(codes, data.grid.extent)
        estimate += float(model.rounded(Attributes(*attribute_tensors(one)), lookup)[1].sum())
    assert encoded.ideal_bits == pytest.approx(estimate, rel=0.01)


def test_a_model_goes_through_the_stream(splat: Any) -> None:
    """What the float twin rounds and what is decoded are the same but for refinements on a boundary."""
    data, model = trained_group(400)
    decoded = decode_group(encode_group(data).data)
    model.coder_exact = True
    for ours, theirs in zip(decoded.scenes, round_group(data).scenes, strict=True):
        codes = torch.from_numpy(data.grid.codes(theirs.positions))
        lookup = model.lookup(codes, data.grid.extent)
        tensors = Attributes(*attribute_tensors(ours))
        # Decoded values stay where they are when rounded again.
        again, _ = model.rounded(tensors, lookup)
        assert ((again.flat - tensors.flat).abs() < 1e-6).double().mean() > 0.999


def test_without_context_nothing_is_rounded() -> None:
    original = group()
    plain = replace(original, context=None)
    encoded = encode_group(plain)
    decoded = decode_group(encoded.data)
    assert decoded.context is None
    assert encoded.ideal_bits == 0
    same(decoded, round_group(plain))
    for ours, theirs in zip(decoded.scenes, original.scenes, strict=True):
        np.testing.assert_array_equal(np.sort(ours.values, axis=0), np.sort(theirs.values, axis=0))
    assert len(encoded.data) > len(encode_group(original).data)


@pytest.mark.parametrize("precision", ["float16", "int8"])
def test_decoder_weights_in_fewer_bits(precision: Any) -> None:
    random = np.random.default_rng(0)
    shapes = {"a/weight": (50, 103), "a/bias": (50,), "empty": (0, 4), "row": (1, 7)}
    decoders = {name: random.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    original = replace(group(), decoders=decoders)
    exact, small = encode_group(original), encode_group(original, weights=precision)
    decoded = decode_group(small.data).decoders
    assert list(decoded) == list(decoders)
    error = max(float(np.abs(decoded[name] - one).max(initial=0)) for name, one in decoders.items())
    assert 0 < error < (0.002 if precision == "float16" else 0.03)
    assert small.ledger["decoders"] < exact.ledger["decoders"] * (0.52 if precision == "float16" else 0.3)
    with pytest.raises(ValueError, match="beyond the range"):
        encode_group(replace(original, decoders={"w": np.array([1e6], np.float32)}), weights=precision)


@pytest.mark.parametrize("counts", [(0,), (1,), (0, 0), (1, 2)])
def test_small_scenes(counts: tuple[int, ...]) -> None:
    original = group(counts)
    same(decode_group(encode_group(original).data), round_group(original))


def test_anchors_at_one_place() -> None:
    original = group((40,))
    one = original.scenes[0]
    positions = np.repeat(one.positions[:4], 10, axis=0)
    original = replace(original, scenes=(replace(one, positions=positions),))
    decoded = decode_group(encode_group(original).data)
    same(decoded, round_group(original))
    assert len(decoded.scenes[0]) == 40


def test_extreme_values_escape() -> None:
    original = group((50,))
    one = original.scenes[0]
    features = one.features.copy()
    features[7, 3], features[11, 2] = 900.0, -1500.0
    encoded = encode_group(replace(original, scenes=(replace(one, features=features),)))
    decoded = decode_group(encoded.data).scenes[0].features
    assert abs(decoded.max() - 900) < 0.3
    assert abs(decoded.min() + 1500) < 0.3


def spoiled(name: str, value: float) -> GroupAttributes:
    original = group((30,))
    array = getattr(original.scenes[0], name).copy()
    array.flat[5] = value
    return replace(original, scenes=(replace(original.scenes[0], **{name: array}),))


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (lambda: spoiled("features", np.nan), "features hold a value that is not finite"),
        (lambda: spoiled("offsets", np.inf), "offsets hold a value"),
        (lambda: spoiled("scalings", 1e9), "over 2\\^24 steps"),
        (lambda: spoiled("positions", 7.0), "outside the grid"),
        (lambda: replace(group(), scenes=()), "without scenes"),
        (lambda: replace(group(), scenes=(replace(group().scenes[0], scalings=np.zeros((3, 6))),)), "shape"),
        (lambda: replace(group(), context=trained_group(5)[0].context), "other features"),
    ],
)  # fmt: skip
def test_what_cannot_be_encoded_is_named(bad: Any, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        encode_group(bad())


def test_a_stream_says_what_it_costs() -> None:
    encoded = encode_group(group((300, 200)))
    assert isinstance(encoded, Encoded)
    assert set(encoded.ledger) == {
        "container", "metadata", "context head", "hash grid", "decoders", "scene parameters", "positions",
        "features", "scalings", "offsets",
    }  # fmt: skip
