"""Features as mixtures of two normal distributions: their coder, their stream, and their bits in training."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.codec.coder import Decoder, Encoder
from econgs_bench.econgs.codec.container import Kind, Section, read_container, write_container
from econgs_bench.econgs.codec.group import CodedContext, GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.integer import ACTIVATION_BITS, HIDDEN_LIMIT, OUTPUT_LIMIT, MixedCoding
from econgs_bench.econgs.codec.mixture import Mixture, first_weight, read_mixture, write_mixture
from econgs_bench.econgs.codec.model import (
    Attributes,
    ContextConfig,
    ContextModel,
    Distribution,
    mixture_bits,
)
from econgs_bench.econgs.codec.positions import PositionGrid
from econgs_bench.econgs.codec.quantiser import round_group
from econgs_bench.econgs.codec.stream import decode_group, encode_group
from econgs_bench.econgs.codec.tables import SPREADS, spread_table, step_log_table, step_table
from tests.econgs.streams import CONFIG, GRID, arrays_of, coded_context, group, with_culling, with_masks

MIXED = replace(CONFIG, chunk=3)
STREAM_SHA = "6b4c08909540177a6e7566d020b15ee7eb42387bae2045fd31a286a3d3b9de43"
"""Of the bytes of a stream of version 4: they may not change while it is read."""


def drawn(count: int, seed: int, spreads: tuple[int, int] = (0, SPREADS)) -> tuple[Mixture, np.ndarray]:
    """Mixtures anywhere, and a symbol of each drawn from it."""
    random = np.random.default_rng(seed)
    parts = (16 * random.normal(0, 30, (2, count))).astype(np.int64)
    index = random.integers(*spreads, (2, count))
    weight = first_weight(random.integers(-(2**20), 2**20, count))
    which = (random.uniform(size=count) >= weight / 2**17).astype(int)
    at = which, np.arange(count)
    values = random.normal(parts[at] / 16, spread_table()[index[at]] / 65536)
    return Mixture(parts, index, weight), np.floor(values + 0.5).astype(np.int32)


def chances(mixture: Mixture, symbols: np.ndarray) -> np.ndarray:
    """Probabilities of symbols, by scipy."""
    mean, sigma = mixture.parts / 16, spread_table()[mixture.spreads] / 65536
    first, second = stats.norm.cdf(symbols + 0.5, mean, sigma) - stats.norm.cdf(symbols - 0.5, mean, sigma)
    weight = mixture.weight / 2**17
    return weight * first + (1 - weight) * second


@pytest.mark.parametrize("spreads", [(0, 40), (30, 70), (0, SPREADS)])
def test_symbols_come_back_at_the_cost_of_their_mixtures(spreads: tuple[int, int]) -> None:
    mixture, symbols = drawn(20_000, 1, spreads)
    encoder = Encoder()
    ideal = write_mixture(encoder, symbols, mixture)
    data = encoder.finish()
    decoder = Decoder(data)
    assert (read_mixture(decoder, mixture) == symbols).all()
    decoder.finish()
    entropy = -np.log2(np.maximum(chances(mixture, symbols), 2.0**-20)).sum()
    assert ideal == pytest.approx(entropy, rel=0.004)
    assert 8 * len(data) == pytest.approx(ideal, rel=1e-4, abs=64)


def test_symbols_far_from_their_mixtures_come_back_too() -> None:
    mixture, symbols = drawn(3_000, 2)
    symbols[::3] = np.random.default_rng(3).integers(-(2**24) + 1, 2**24, 1000)
    encoder = Encoder()
    write_mixture(encoder, symbols, mixture)
    assert (read_mixture(Decoder(encoder.finish()), mixture) == symbols).all()
    none = Mixture(*(one[..., :0] for one in (mixture.parts, mixture.spreads, mixture.weight)))
    assert write_mixture(Encoder(), symbols[:0], none) == 0
    assert len(read_mixture(Decoder(b""), none)) == 0


def test_other_data_is_no_crash() -> None:
    mixture, _ = drawn(300, 4)
    random = np.random.default_rng(5)
    caught = 0
    for size in range(0, 400, 7):
        try:
            decoder = Decoder(random.bytes(size))
            assert read_mixture(decoder, mixture).shape == (300,)
            decoder.finish()
        except ValueError:
            caught += 1
    assert caught > 40


def test_weights_are_those_of_their_logits() -> None:
    sixteenths = np.arange(-128, 128)
    expected = 1 / (1 + np.exp(-sixteenths / 16))
    for within in (-2048, 0, 2047):  # of the same sixteenth
        np.testing.assert_allclose(first_weight((sixteenths << 12) + within) / 2**17, expected, atol=1e-5)
    ends = first_weight(np.array([-(2**31), 2**31]))
    assert 0 < ends[0] < ends[1] < 2**17


# --------------------------------------------------------------------------- the stream


def mixed_group() -> GroupAttributes:
    return with_masks(group(context=coded_context(MIXED)))


def test_decoding_gives_what_was_rounded() -> None:
    original = mixed_group()
    encoded = encode_group(original)
    decoded = decode_group(encoded.data)
    for ours, theirs in zip(arrays_of(decoded), arrays_of(round_group(original)), strict=True):
        np.testing.assert_array_equal(ours, theirs, strict=True)
    assert sum(encoded.ledger.values()) == len(encoded.data)
    assert encode_group(decoded).data == encoded.data
    assert encoded.attribute_bits - 64 * 9 <= encoded.ideal_bits <= encoded.attribute_bits
    assert int.from_bytes(encoded.data[8:10], "little") == 4
    assert hashlib.sha256(encoded.data).hexdigest() == STREAM_SHA


def test_features_of_one_chunk_and_of_unequal_ones() -> None:
    for chunk in (1, 5, 8, 100):
        original = group((20,), context=coded_context(replace(CONFIG, chunk=chunk)))
        decoded = decode_group(encode_group(original).data)
        for ours, theirs in zip(arrays_of(decoded), arrays_of(round_group(original)), strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("wild", [False, True])
def test_networks_between_features_are_those_of_whole_numbers(wild: bool) -> None:
    """Against Python's integers, number by number."""
    intra = coded_context(MIXED, seed=3, wild=wild).intra
    assert intra is not None
    random = np.random.default_rng(0)
    index = random.integers(0, 256, (9, 1))
    step, log = step_table()[index], step_log_table()[index]
    symbols = random.integers(-(2**24), 2**24, (9, 6)) if wild else random.integers(-20, 21, (9, 6))
    got = intra(2, symbols, step, log)
    first, second = intra.layers[1]

    def layer(weights, exponents, biases, inputs):
        for row, exponent, bias in zip(weights.tolist(), exponents.tolist(), biases.tolist(), strict=True):
            total = sum(w * x for w, x in zip(row, inputs, strict=True))
            total = (total + (1 << exponent >> 1)) >> exponent if exponent > 0 else total << -exponent
            yield max(-OUTPUT_LIMIT, min(OUTPUT_LIMIT, total + bias))

    for anchor in range(9):
        values = []
        for symbol, unit in zip(symbols[anchor].tolist(), intra.units[:6].tolist(), strict=True):
            value = symbol * int(step[anchor, 0])
            value = value >> unit if unit > 0 else value << -unit
            values.append(max(-OUTPUT_LIMIT, min(OUTPUT_LIMIT, value)))
        hidden = [
            max(0, min(HIDDEN_LIMIT, one)) for one in layer(first.weight, first.exponent, first.bias, values)
        ]
        outputs = list(layer(second.weight, second.exponent, second.bias, hidden))
        width = len(outputs) // 3
        q = int(step[anchor, 0])
        for channel in range(width):
            mean = (32 * outputs[channel] + q) // (2 * q)
            assert got.parts[anchor, channel] == max(-(2**26), min(2**26, mean))
            spread = ((outputs[width + channel] - int(log[anchor, 0]) + 2**12) >> (ACTIVATION_BITS - 3)) + 32
            assert got.spreads[anchor, channel] == max(0, min(SPREADS - 1, spread))
            assert got.logits[anchor, channel] == outputs[2 * width + channel]


def error_of(data: bytes) -> str | None:
    """What decoding complains of, if of anything."""
    try:
        decode_group(data, "bad")
    except DataError as error:
        return str(error)
    return None


def test_damaged_contents_are_named() -> None:
    """Random bytes in place of a section's, checksums right: an error that names it, or other values."""
    sections = read_container(encode_group(mixed_group()).data, "test")
    random = np.random.default_rng(0)
    named = 0
    for kind in (Kind.CONTEXT, Kind.FEATURES, Kind.GROUP):
        for place in range(12):
            changed = []
            for one in sections:
                payload = bytearray(one.payload)
                if (one.kind, one.scene) == (kind, 0):
                    at = int(random.integers(len(payload)))
                    payload[at] ^= int(random.integers(1, 256))
                    payload = payload[: len(payload) - 4 * (place % 2)]
                changed.append(Section(one.kind, one.scene, bytes(payload)))
            error = error_of(write_container(changed, 4))
            assert error is None or error.startswith("bad: ")
            named += error is not None
    assert named > 18
    with pytest.raises(DataError, match="culling"):
        encode_group(with_culling(group(context=coded_context(MIXED))))


# --------------------------------------------------------------------------- training


def test_bits_are_those_of_the_mixture_and_so_are_their_gradients() -> None:
    random = torch.Generator().manual_seed(0)

    def numbers(low: float, high: float) -> torch.Tensor:
        return (low + (high - low) * torch.rand(6, 3, generator=random, dtype=torch.float64)).requires_grad_()

    values, step, weight = numbers(-1, 1), numbers(0.2, 0.6), numbers(0.1, 0.9)
    parameters = [numbers(-1, 1), numbers(0.2, 2), numbers(-1, 1), numbers(0.2, 2)]

    def bits(values, a, b, c, d, weight, step):
        return mixture_bits(values, (Distribution(a, b), Distribution(c, d)), weight, step)

    a, b, c, d, v, w, q = (one.detach().numpy() for one in (*parameters, values, weight, step))
    mixed = sum(
        share * (stats.norm.cdf(v + q / 2, mean, sigma) - stats.norm.cdf(v - q / 2, mean, sigma))
        for share, mean, sigma in ((w, a, b), (1 - w, c, d))
    )
    got = bits(values, *parameters, weight, step)
    np.testing.assert_allclose(got.detach().numpy(), -np.log2(mixed), rtol=1e-9)
    assert torch.autograd.gradcheck(bits, (values, *parameters, weight, step))


def test_far_values_cost_no_more_than_the_least_probability() -> None:
    far = torch.tensor([[500.0]], requires_grad=True)
    one = Distribution(torch.zeros(1, 1), torch.ones(1, 1))
    bits = mixture_bits(far, (one, one), torch.full((1, 1), 0.5), torch.ones(1, 1))
    assert bits.item() == pytest.approx(-np.log2(1e-6), rel=1e-5)
    bits.sum().backward()
    assert torch.isfinite(far.grad).all()


def trained(chunk: int) -> tuple[float, int]:
    """Estimated bits and bytes of features whose second half follows from the first, after some training.

    Places say nothing of the features: only earlier ones do.
    """
    random = torch.Generator().manual_seed(0)
    grid = PositionGrid((0.0, 0.0, 0.0), (1 / 1023,) * 3, (1023, 1023, 1023))
    codes = torch.randint(0, 1024, (300, 3), generator=random).unique(dim=0)
    half = 2.0 * torch.randn(len(codes), 4, generator=random)
    features = torch.cat([half, half.flip(1).abs() + 0.2 * torch.randn(half.shape, generator=random)], 1)
    values = Attributes(
        features, torch.rand(len(codes), 6, generator=random), torch.randn(len(codes), 2, 3, generator=random)
    )
    config = ContextConfig(8, 2, (0.4, 0.1, 0.1, 0.2), GRID, 12, chunk)
    model = ContextModel(config, random)
    model.calibrate(values)
    parameters = [*model.head, *([] if model.intra is None else model.intra.parameters())]
    optimiser = torch.optim.Adam(parameters, 2e-2)
    lookup = model.lookup(codes, grid.extent)
    every = torch.arange(len(codes))
    for step in range(150):
        model.coder_exact = step > 120
        context = model(lookup, None, every)
        rounded = model.round(values, context.steps.detach())
        bits = model.bits(rounded.flat, context.sample_hidden, context.sample_steps.detach())
        optimiser.zero_grad()
        bits[:, :8].mean().backward()
        optimiser.step()
    model.coder_exact = True
    _, estimated = model.rounded(values, lookup)
    scene = SceneAttributes("one", grid.positions(codes.numpy()), *(one.numpy() for one in values))
    encoded = encode_group(GroupAttributes((scene,), grid, CodedContext.of(model)))
    decode_group(encoded.data)
    return float(estimated[0]), encoded.ledger["features"]


def test_contexts_within_an_anchor_save_what_its_features_share() -> None:
    estimated, size = trained(chunk=4)
    assert 8 * size == pytest.approx(estimated, rel=0.01)
    _, alone = trained(chunk=0)
    assert size < 0.9 * alone


def test_coding_of_mixtures_says_what_the_position_says() -> None:
    context = coded_context(MIXED)
    coding = context.coding(np.zeros((3, 3), np.int64), group().grid)
    assert isinstance(coding, MixedCoding)
    assert coding.normals.parts.shape == coding.normals.logits.shape == (3, MIXED.features)
    near = (coding.normals.parts + 8) >> 4
    assert (near == coding.center[:, : MIXED.features]).all()
