"""Vector quantisation: k-means codebooks in one or several stages, and their ids as bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from econgs_bench.econgs.codec.coder import Decoder, Encoder, exact_model
from econgs_bench.econgs.codec.tables import FREQUENCY_BITS

MOST_WORDS = 1 << 16
TOLERANCE = 1e-4
"""k-means ends when no word moves by more than this share of the values' standard deviation."""
SCALAR_ROUNDS = 500
VECTOR_ROUNDS = 15
_SAMPLES = 128  # random values per word for learning vectors; every value takes its nearest word
_DISTANCES = 1 << 24  # in memory at a time


@dataclass(frozen=True, eq=False)
class Codebook:
    """Words, and the word of each value.

    Attributes:
        words: (K, D) float32, exact in half precision.
        ids: (N,) int64 in 0 ... K - 1.
    """

    words: Tensor
    ids: Tensor

    def decoded(self) -> Tensor:
        """(N, D) the word of each value; differentiable with respect to the words."""
        # Gradients are summed in the same order each time: threads race in indexing on a CPU, and in
        # index_select on a GPU.
        if self.words.device.type == "cpu":
            return self.words.index_select(0, self.ids)
        return self.words[self.ids]

    @property
    def bits(self) -> int:
        """Bits of an id of fixed length: 8 for 129 to 256 words, 0 for a single one."""
        return max(0, len(self.words) - 1).bit_length()

    def to(self, device: str) -> Codebook:
        return Codebook(self.words.to(device), self.ids.to(device))


def decoded(stages: Sequence[Codebook]) -> Tensor:
    """(N, D) sum of the words of all stages."""
    total = stages[0].decoded()
    for stage in stages[1:]:
        total = total + stage.decoded()
    return total


# --------------------------------------------------------------------------- learning


def quantise(values: Tensor, size: int, seed: int, stages: int = 1) -> tuple[Codebook, ...]:
    """Residual quantisation: each stage is a codebook of the remainder of the stages before it.

    Runs on the CPU, so that neither the device nor a GPU's order of summation matters.

    Args:
        values: (N, D) finite; D = 1 is scalar quantisation, solved exactly per round on sorted values.
        size: maximum number of words of each codebook, 1 to 65536.
        seed: seed of the initial words.
        stages: number of codebooks, at least 1.
    """
    residuals = values.detach().float().cpu()
    books = []
    for stage in range(stages):
        words = _half(_learn(residuals, size, seed + stage))
        ids = nearest(residuals, words)
        words_used = torch.unique(ids)
        renumbered = torch.zeros(len(words), dtype=torch.int64).index_fill_(0, words_used, 1).cumsum(0) - 1
        book = Codebook(words[words_used], renumbered[ids])
        books.append(book)
        residuals = residuals - book.decoded()
    return tuple(book.to(str(values.device)) for book in books)


def quantise_scalars(values: Tensor, size: int, seed: int) -> Codebook:
    """One codebook of single numbers for all elements of (N, D) values; ids run over rows first."""
    (book,) = quantise(values.reshape(-1, 1), size, seed)
    return book


def rounded(book: Codebook) -> Codebook:
    """The codebook with words in half precision, as in files."""
    return replace(book, words=_half(book.words.detach()))


def nearest(values: Tensor, words: Tensor) -> Tensor:
    """(N,) index of the word nearest to each value."""
    if not len(values):
        return torch.zeros(0, dtype=torch.int64)
    if words.shape[1] == 1:
        order = words[:, 0].argsort()
        ordered = words[order, 0]
        return order[torch.searchsorted((ordered[1:] + ordered[:-1]) / 2, values[:, 0].contiguous())]
    chunk = max(1, _DISTANCES // max(1, len(words)))
    lengths = words.square().sum(1)
    # |v - w|^2 less |v|^2, which is constant over words. NumPy's argmin is vectorised, torch's is not.
    distances = (torch.addmm(lengths, part, words.T, alpha=-2.0) for part in values.split(chunk))
    return torch.cat([torch.from_numpy(part.numpy().argmin(1)) for part in distances])


def _half(words: Tensor) -> Tensor:
    largest = torch.finfo(torch.float16).max
    return words.clamp(-largest, largest).half().float()


def _learn(values: Tensor, size: int, seed: int) -> Tensor:
    """(K, D) words."""
    if not 1 <= size <= MOST_WORDS:
        raise ValueError(f"a codebook of {size} words; 1 to {MOST_WORDS} are possible")
    scalars = values.shape[1] == 1
    if scalars or len(values) <= size:
        distinct: Tensor = torch.unique(values, dim=0)
        if len(distinct) <= size:
            return distinct
    return _learn_scalars(values[:, 0], size) if scalars else _learn_vectors(values, size, seed)


def _learn_scalars(values: Tensor, size: int) -> Tensor:
    """Lloyd's algorithm on sorted numbers, where a cluster is an interval, from quantiles."""
    ordered = np.sort(values.double().numpy())
    sums = np.concatenate([[0.0], np.cumsum(ordered - ordered.mean())])
    words = np.unique(ordered[((np.arange(size) + 0.5) / size * len(ordered)).astype(np.int64)])
    if len(words) < size:  # many equal values: further words from the distinct ones
        others = np.setdiff1d(ordered, words)
        places = np.linspace(0, len(others) - 1, size - len(words)).astype(np.int64)
        words = np.sort(np.concatenate([words, others[places]]))
    least = TOLERANCE * ordered.std()
    for _ in range(SCALAR_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (words[1:] + words[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        means = np.diff(sums[ends]) / np.maximum(counts, 1) + ordered.mean()
        new_words = np.where(counts > 0, means, words)
        far = np.abs(new_words - words).max()
        words = new_words
        if far <= least:
            break
    return torch.from_numpy(words[:, None].astype(np.float32))


def _learn_vectors(values: Tensor, size: int, seed: int) -> Tensor:
    """Lloyd's algorithm from random values; an unused word moves to the value with the largest error."""
    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(values), generator=generator)
    values = values[order[: _SAMPLES * size]]
    words = values[:size].clone()
    least = TOLERANCE * float(values.double().std(0).norm())
    exact, ones, places = values.double().numpy(), np.ones(len(values)), np.arange(len(values))
    for _ in range(VECTOR_ROUNDS):
        ids = nearest(values, words)
        # A sparse product sums in the order of the values, whatever the number of threads.
        counts = torch.bincount(ids, minlength=size)
        members = csr_array((ones, (ids.numpy(), places)), shape=(size, len(values)))
        new_words = (torch.from_numpy(members @ exact) / counts.clamp(min=1)[:, None]).float()
        bare = (counts == 0).nonzero()[:, 0]
        if len(bare):
            worst = (values - words[ids]).square().sum(1).argsort(descending=True, stable=True)
            new_words[bare] = values[worst[: len(bare)]]
        far = float((new_words - words).norm(dim=1).max())
        words = new_words
        if far <= least:
            break
    return words


# --------------------------------------------------------------------------- ids as bytes


def pack_ids(book: Codebook) -> bytes:
    """Ids of fixed length, ``book.bits`` each, highest bit first, padded to a whole byte."""
    ids = book.ids.cpu().numpy().astype(np.uint32)
    shifts = np.arange(book.bits - 1, -1, -1, dtype=np.uint32)
    return np.packbits(((ids[:, None] >> shifts) & 1).astype(np.uint8)).tobytes()


def unpack_ids(data: bytes, count: int, words: int) -> NDArray[np.int64]:
    """Inverse of :func:`pack_ids`.

    Raises:
        ValueError: the data have another length, or an id exceeds the words.
    """
    bits = max(0, words - 1).bit_length()
    if len(data) != (count * bits + 7) // 8 or (count and not words):
        raise ValueError(f"{len(data)} bytes do not hold {count} ids of {bits} bits")
    flags = np.unpackbits(np.frombuffer(data, np.uint8), count=count * bits).reshape(count, bits)
    ids = np.zeros(count, np.int64)
    for column in flags.T:
        ids = (ids << 1) | column
    return _check_ids(ids, words)


def code_ids(book: Codebook) -> bytes:
    """Frequencies of the ids (2 bytes per word), then the ids, entropy-coded at them."""
    ids = book.ids.cpu().numpy()
    counts = np.bincount(ids, minlength=len(book.words))
    # Scaled down so that the commonest fits 16 bits; every word keeps at least 1.
    shares = np.maximum(1, counts * 65535 // max(1, int(counts.max(initial=0)))).astype("<u2")
    if len(shares) < 2:
        return shares.tobytes()
    encoder = Encoder()
    encoder.symbols(ids, _model(shares))
    return shares.tobytes() + encoder.finish()


def decode_ids(data: bytes, count: int, words: int) -> NDArray[np.int64]:
    """Inverse of :func:`code_ids`.

    Raises:
        ValueError: the data hold other numbers of ids or words, or are damaged.
    """
    shares = np.frombuffer(data[: 2 * words], "<u2")
    if len(shares) != words or (words and shares.min() < 1) or (count and not words):
        raise ValueError("frequencies of ids are missing or zero")
    if words < 2:
        if len(data) != 2 * words:
            raise ValueError("ids of a single word take no bytes")
        return np.zeros(count, np.int64)
    decoder = Decoder(data[2 * words :])
    ids = decoder.symbols(count, _model(shares)).astype(np.int64)
    decoder.finish()
    return _check_ids(ids, words)


def _model(shares: NDArray[np.uint16]) -> Any:
    """Whole frequencies in proportion to the shares; the commonest id takes the rounding error."""
    whole = shares.astype(np.int64)
    frequencies = 1 + whole * ((1 << FREQUENCY_BITS) - len(whole)) // whole.sum()
    frequencies[whole.argmax()] += (1 << FREQUENCY_BITS) - frequencies.sum()
    return exact_model(frequencies)


def _check_ids(ids: NDArray[np.int64], words: int) -> NDArray[np.int64]:
    if len(ids) and int(ids.max()) >= words:
        raise ValueError(f"id {int(ids.max())} has no word among {words}")
    return ids
