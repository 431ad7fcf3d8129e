"""Folded embeddings: the same Gaussians from networks that are smaller."""

from __future__ import annotations

import pytest
import torch

from econgs_bench.econgs.anchors.decode import decode
from econgs_bench.econgs.anchors.folding import fold_embeddings

from .test_decode import EYE, NAMES, Case


@pytest.mark.parametrize("storage", ["hybrid", "implicit", "explicit"])
@pytest.mark.parametrize("scenes", [1, 2, 4])
def test_folded_networks_decode_the_same(storage: str, scenes: int) -> None:
    case = Case(count=60, features=8, offsets=5, embedding=6, hidden=16)
    decoders, inputs = case.make()
    generator = torch.Generator().manual_seed(3)
    decoders = type(decoders)(8, 5, 6, hidden=16, storage=storage, generator=generator)  # type: ignore[arg-type]
    inputs["features"] = torch.randn((60, decoders.width), generator=generator)
    embeddings = [torch.randn(6, generator=generator) for _ in range(scenes)]
    folded, shorter = fold_embeddings(decoders, embeddings)
    assert folded.embedding == scenes - 1
    assert [len(one) for one in shorter] == [scenes - 1] * scenes
    anchors, features, scalings, offsets, _, palette = inputs.values()
    for before, after in zip(embeddings, shorter, strict=True):
        expected = decode(anchors, features, scalings, offsets, decoders, before, palette, EYE)
        actual = decode(anchors, features, scalings, offsets, folded, after, palette, EYE)
        assert torch.equal(actual.slots, expected.slots)
        for name in NAMES:
            torch.testing.assert_close(getattr(actual, name), getattr(expected, name), rtol=2e-4, atol=2e-5)


def test_no_column_is_larger_than_its_rows_other_weights() -> None:
    decoders, _ = Case(features=8, offsets=5, embedding=6, hidden=16).make()
    generator = torch.Generator().manual_seed(3)
    folded, _ = fold_embeddings(decoders, [5.0 * torch.randn(6, generator=generator) for _ in range(3)])
    for name in folded.names:
        first = folded.network(name).first_weight
        assert bool((first[:, -2:].abs().amax(1) <= first[:, :-2].abs().amax(1) * (1 + 1e-6)).all())


def test_many_scenes_keep_their_embeddings() -> None:
    decoders, _ = Case(features=8, offsets=5, embedding=3, hidden=16).make()
    embeddings = [torch.randn(3) for _ in range(4)]
    folded, same = fold_embeddings(decoders, embeddings)
    assert folded is decoders
    assert all(a is b for a, b in zip(embeddings, same, strict=True))
