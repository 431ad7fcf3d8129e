"""Tables, integer evaluation and the range coder."""

from __future__ import annotations

import hashlib
from typing import Any

import constriction
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from econgs_bench.econgs.codec import tables
from econgs_bench.econgs.codec.coder import (
    Decoder,
    Encoder,
    exact_model,
    flag_models,
    read_bits,
    read_residuals,
    write_bits,
    write_residuals,
)
from econgs_bench.econgs.codec.hash_grid import interpolate, make_lookup
from econgs_bench.econgs.codec.integer import (
    EXPONENT_RANGE,
    IntegerLayer,
    rounded_steps,
    rounded_weight,
    row_exponents,
    step_sizes,
    whole_values,
)
from tests.econgs.streams import CONFIG, coded_context

# Of all integer tables. It may change only together with the version of the format.
TABLES_SHA = "db464a0fd6f97751a802f242d8815f10b583379887ec8f1ea4f94e759de5cb12"


def spread_of(table: int) -> tuple[float, float]:
    """Sigma / q and mean of a table by its description, in floating point."""
    fine = 56 * 16
    spread, part = divmod(table, 16) if table < fine else (table - 56 * 15, 8)
    return 2.0 ** (spread / 8 - 4), (part - 8) / 16


def test_tables_are_the_same_everywhere() -> None:
    digest = hashlib.sha256()
    for one in (tables.step_table(), tables.step_log_table(), tables.spread_table()):
        digest.update(one.astype("<i8").tobytes())
    for table in range(tables.TABLES):
        low, frequencies = tables.coding_table(table)
        digest.update(np.array([low, tables.low_bits(table), *frequencies], "<i8").tobytes())
    assert digest.hexdigest() == TABLES_SHA


def test_tables_are_right() -> None:
    index = np.arange(-128, 128)
    assert np.abs(tables.step_table() / 65536 - 1 - np.tanh(index / 32)).max() <= 0.5 / 65536 + 1e-12
    assert (
        np.abs(tables.step_log_table() / 65536 - np.log2(tables.step_table() / 65536)).max()
        <= 0.5 / 65536 + 1e-12
    )
    for table in range(tables.TABLES):
        sigma, mean = spread_of(table)
        low, frequencies = tables.coding_table(table)
        shift = tables.low_bits(table)
        assert frequencies.sum() == 1 << 24
        assert frequencies.min() >= tables.FLOOR
        edges = np.arange(low, low + len(frequencies)) * 2.0**shift - 0.5
        exact = np.diff(norm.cdf(edges, mean, sigma))
        # Bits lost against the exact distribution.
        positive = exact > 0
        loss = (exact[positive] * np.log2(exact[positive] / (frequencies[:-1][positive] / 2**24))).sum()
        assert loss < 1e-4
        assert exact.sum() > 1 - 1e-7


def test_frequencies_are_exact() -> None:
    """The first word of a stream of one symbol lies in that symbol's own part of the unit interval."""
    for frequencies in (
        [1, 3, (1 << 24) - 5, 1],
        [7, 1, 1, (1 << 24) - 9],
        tables.coding_table(500)[1].tolist(),
    ):
        model = exact_model(np.array(frequencies))
        first = 0
        for symbol, frequency in enumerate(frequencies):
            encoder = constriction.stream.queue.RangeEncoder()
            encoder.encode(np.array([symbol] * 1, np.int32), model)
            word = int(encoder.get_compressed()[0])
            assert first << 8 <= word < (first + frequency) << 8
            # Both ends of that part, and nothing outside it, decode to the symbol.
            for end, expected in ((first << 8, True), (((first + frequency) << 8) - 1, True)):
                decoder = constriction.stream.queue.RangeDecoder(np.array([end, 0], np.uint32))
                assert (int(decoder.decode(model)) == symbol) is expected
            first += frequency
    flags = constriction.stream.model.Categorical(perfect=False)
    for share in (1, 24, 30000, 65535):
        rows = flag_models(np.array([share]))
        for end, symbol in (((65536 - share) << 16, 1), (((65536 - share) << 16) - 1, 0)):
            decoder = constriction.stream.queue.RangeDecoder(np.array([end, 0], np.uint32))
            assert decoder.decode(flags, rows)[0] == symbol
    with pytest.raises(ValueError, match="sum 2"):
        exact_model(np.array([5, 6]))


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_residuals_come_back(data: st.DataObject) -> None:
    many = data.draw(st.integers(0, 60))
    limit = st.one_of(st.integers(-20, 20), st.integers(-(2**25), 2**25))
    residuals = np.array(data.draw(st.lists(limit, min_size=many, max_size=many)), np.int32)
    indices = data.draw(st.lists(st.integers(0, tables.TABLES - 1), min_size=many, max_size=many))
    index = np.array(indices, np.uint16)
    encoder = Encoder()
    ideal = write_residuals(encoder, residuals, index)
    written = encoder.finish()
    decoder = Decoder(written)
    assert (read_residuals(decoder, index) == residuals).all()
    decoder.finish()
    assert 8 * len(written) <= ideal + 80


def test_length_is_the_cross_entropy() -> None:
    random = np.random.default_rng(0)
    index = random.integers(0, tables.TABLES, 60_000).astype(np.uint16)
    sigma, mean = np.array([spread_of(int(one)) for one in index]).T
    residuals = np.floor(random.normal(mean, sigma) + 0.5).astype(np.int32)
    residuals[:20] = 1 << 20  # escapes
    encoder = Encoder()
    ideal = write_residuals(encoder, residuals, index)
    exact = -np.log2(
        np.maximum(norm.cdf(residuals + 0.5, mean, sigma) - norm.cdf(residuals - 0.5, mean, sigma), 1e-300)
    )
    assert 0 <= 8 * len(encoder.finish()) - ideal < 100
    assert write_residuals(Encoder(), residuals[20:], index[20:]) == pytest.approx(
        exact[20:].sum(), rel=0.003
    )


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_bits_at_their_frequency(share: float) -> None:
    bits = np.random.default_rng(1).uniform(size=20_000) < share
    encoder = Encoder()
    measured = write_bits(encoder, bits)
    data = encoder.finish()
    assert (read_bits(Decoder(data), bits.size, measured) == bits).all()
    p = bits.mean()
    entropy = 0.0 if p in (0, 1) else -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
    assert 8 * len(data) <= bits.size * entropy * 1.001 + 64
    with pytest.raises(ValueError, match="frequency"):
        read_bits(Decoder(data), 5, 0)


def test_other_data_is_no_crash() -> None:
    random = np.random.default_rng(2)
    index = random.integers(0, tables.TABLES, 500).astype(np.uint16)
    caught = 0
    for size in range(0, 400, 7):
        try:
            decoder = Decoder(random.bytes(size))
            assert read_residuals(decoder, index).shape == (500,)
            decoder.finish()
        except ValueError:
            caught += 1
    assert caught > 40


@pytest.mark.parametrize("wild", [False, True])
def test_integer_model_is_bit_identical(wild: bool, ways: Any) -> None:
    """Fast path (float64 products) against int64 only, for every ISA, thread count and backend."""
    for seed in range(3):
        context = coded_context(seed=seed, wild=wild)
        random = np.random.default_rng(seed)
        codes = torch.from_numpy(random.integers(0, 1001, (700, 3)))
        lookup = make_lookup(CONFIG.grid, codes, (1000, 1000, 1000))
        table = torch.from_numpy(np.where(context.positive, 1.0, -1.0).astype(np.float32))
        # Interpolation in int64, by the weights' whole numbers.
        signs = np.where(context.positive, 1, -1).astype(np.int64)
        weights = (lookup.weights.double().numpy() * 2**21).astype(np.int64)
        products = signs[lookup.index.numpy()] * weights[..., None]
        ends = np.cumsum([2 ** len(axes) for axes, _, _ in CONFIG.grid.levels])
        whole = np.concatenate([one.sum(0) for one in np.split(products, ends[:-1])], 1)
        reference = context.head(whole)  # in int64
        for _ in ways():
            values = whole_values(interpolate(table, lookup)[0])
            assert (values == whole).all()
            coding = context.head(values)
            for ours, theirs in zip(vars(coding).values(), vars(reference).values(), strict=True):
                assert (ours == theirs).all()
        assert len(np.unique(reference.table)) > (4 if wild else 100)  # wild ones mostly saturate
        assert (reference.table < tables.TABLES).all()


def test_weights_use_the_range_of_eight_bits() -> None:
    random = torch.Generator().manual_seed(0)
    weight = torch.randn(40, 9, generator=random) * torch.exp2(torch.linspace(-14, 14, 40))[:, None]
    weight[3] = 0
    weight[4, 0], weight[4, 1:] = 127.5 / 128, 0.01  # rounds up to 128 with one exponent, fits with the next
    weight.requires_grad_(True)
    exponent = row_exponents(weight)
    rounded = rounded_weight(weight)
    whole = rounded.detach() * torch.exp2(exponent.float())[:, None]
    assert torch.equal(whole, whole.round())
    free = (exponent > EXPONENT_RANGE[0]) & (exponent < EXPONENT_RANGE[1])
    free[3] = False
    assert whole.abs().max() <= 127
    assert (whole.abs().amax(1)[free] >= 63).all()
    assert ((rounded - weight).abs() * torch.exp2(exponent.float())[:, None]).max() <= 0.5
    rounded.sum().backward()
    assert (weight.grad == 1).all()
    layer = IntegerLayer.of(weight, torch.zeros(40))
    assert (layer.weight == whole.numpy()).all()
    with pytest.raises(ValueError, match="not finite"):
        IntegerLayer.of(weight, torch.full((40,), float("nan")))


def test_steps_of_training_and_coding_are_the_same() -> None:
    refinements = torch.linspace(-6, 6, 999).requires_grad_(True)
    steps = rounded_steps(refinements)
    index = np.clip(np.floor(refinements.detach().numpy() * 32 + 0.5), -128, 127).astype(int) + 128
    assert (steps.detach().numpy() == step_sizes(tables.step_table()[index], 1.0)).all()
    steps.sum().backward()
    exact = 1 - np.tanh(refinements.detach().numpy()) ** 2
    np.testing.assert_allclose(refinements.grad.numpy(), exact, atol=1e-6)
