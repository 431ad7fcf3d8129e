"""Vector quantisation, against scikit-free oracles: exhaustive search, distortion, entropy."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from econgs_bench.econgs.codebooks import (
    Codebook,
    code_ids,
    decode_ids,
    decoded,
    nearest,
    pack_ids,
    quantise,
    quantise_scalars,
    unpack_ids,
)


def cloud(count, width, seed=0):
    return torch.randn((count, width), generator=torch.Generator().manual_seed(seed))


def distortion(values, stages):
    return float((decoded(stages) - values).square().sum(1).mean())


@pytest.mark.parametrize("width", [1, 3])
def test_every_value_takes_its_nearest_word(width):
    values = cloud(500, width)
    (book,) = quantise(values, 16, 0)
    exhaustive = torch.cdist(values.double(), book.words.double()).argmin(1)
    assert torch.equal(book.ids, exhaustive)
    assert len(book.words) <= 16
    assert torch.equal(book.words, book.words.half().float())


def test_scalars_reach_the_optimum_of_a_gaussian():
    """The optimal quantiser of a unit Gaussian has distortion 0.009497 at 16 levels (Max 1960)."""
    book = quantise_scalars(cloud(200_000, 1), 16, 0)
    assert distortion(cloud(200_000, 1), [book]) == pytest.approx(0.009497, rel=0.03)


def test_clusters_are_found():
    centers = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10.0]])
    values = centers.repeat_interleave(50, 0) + 0.1 * cloud(200, 3)
    best = min(distortion(values, quantise(values, 4, seed)) for seed in range(6))
    assert best < 0.04


@pytest.mark.parametrize("width", [1, 5])
def test_more_words_and_more_stages_lose_less(width):
    values = cloud(3000, width)
    by_size = [distortion(values, quantise(values, size, 0)) for size in (4, 16, 64)]
    by_stages = [distortion(values, quantise(values, 16, 0, stages)) for stages in (1, 2, 3)]
    assert by_size == sorted(by_size, reverse=True)
    assert by_stages[1] < 0.6 * by_stages[0]
    assert by_stages[2] < 0.6 * by_stages[1]


def test_few_distinct_values_are_kept_as_they_are():
    values = torch.tensor([[1.0, 2.0], [0.5, 0.25], [1.0, 2.0]])
    (book,) = quantise(values, 8, 0)
    assert len(book.words) == 2
    assert torch.equal(book.decoded(), values)
    (none,) = quantise(torch.zeros((0, 3)), 8, 0)
    assert none.decoded().shape == (0, 3)
    skewed = torch.cat([torch.zeros(5000, 1), torch.linspace(1, 2, 50)[:, None]])
    assert distortion(skewed, quantise(skewed, 32, 0)) < 1e-5


def test_a_seed_decides_and_nothing_else():
    values = cloud(2000, 4)
    books = []
    for run, seed in enumerate((1, 1, 2)):
        torch.manual_seed(run)
        books.append(quantise(values, 8, seed)[0])
    assert torch.equal(books[0].words, books[1].words)
    assert torch.equal(books[0].ids, books[1].ids)
    assert not torch.equal(books[0].words, books[2].words)


def test_words_learn_by_the_values_that_take_them():
    book = Codebook(torch.zeros((2, 1), requires_grad=True), torch.tensor([0, 1, 1]))
    book.decoded().sum().backward()
    assert book.words.grad.tolist() == [[1.0], [2.0]]


def test_gradients_of_words_are_the_same_each_time_on_several_threads():
    generator = torch.Generator().manual_seed(0)
    words = torch.randn(16, 21, generator=generator, requires_grad=True)
    ids = torch.randint(0, 16, (100_000,), generator=generator)
    upstream = torch.randn(100_000, 21, generator=generator)
    threads = torch.get_num_threads()
    gradients = []
    try:
        for count in (1, 4, 4, 4):
            torch.set_num_threads(count)
            gradients += torch.autograd.grad(Codebook(words, ids).decoded(), words, upstream)
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(gradient, gradients[0]) for gradient in gradients[1:])


def test_nearest_in_one_dimension_takes_unsorted_words():
    words = torch.tensor([[3.0], [-1.0], [0.5]])
    assert nearest(torch.tensor([[2.9], [-7.0], [0.0], [100.0]]), words).tolist() == [0, 1, 2, 0]


@given(st.integers(1, 700), st.integers(0, 300), st.integers(0, 9))
def test_ids_come_back_from_their_bytes(words, count, seed):
    ids = torch.from_numpy(np.random.default_rng(seed).integers(0, words, count))
    book = Codebook(torch.zeros((words, 1)), ids)
    fixed, coded = pack_ids(book), code_ids(book)
    assert len(fixed) == -(-count * book.bits // 8)
    assert unpack_ids(fixed, count, words).tolist() == ids.tolist()
    assert decode_ids(coded, count, words).tolist() == ids.tolist()


def test_256_words_take_one_byte_each():
    ids = torch.arange(256)
    assert pack_ids(Codebook(torch.zeros((256, 1)), ids)) == bytes(range(256))


def test_coded_ids_approach_their_entropy():
    shares = np.random.default_rng(0).dirichlet(np.full(64, 0.3))
    ids = np.random.default_rng(1).choice(64, 50_000, p=shares)
    counts = np.bincount(ids, minlength=64)
    shares = counts[counts > 0] / len(ids)
    ideal = -len(ids) * float((shares * np.log2(shares)).sum()) / 8
    coded = code_ids(Codebook(torch.zeros((64, 1)), torch.from_numpy(ids)))
    assert len(coded) < 1.002 * ideal + 2 * 64 + 8


@given(st.binary(max_size=80), st.integers(0, 40), st.integers(0, 20))
def test_foreign_bytes_are_refused_or_give_known_ids(data, count, words):
    for read in (unpack_ids, decode_ids):
        try:
            ids = read(data, count, words)
        except ValueError:
            continue
        assert len(ids) == count
        assert ((ids >= 0) & (ids < max(words, 1))).all()


def test_sizes_out_of_range():
    for size in (0, 1 << 17):
        with pytest.raises(ValueError, match="words"):
            quantise(cloud(5, 1), size, 0)
