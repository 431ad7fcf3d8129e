"""Offset colors on their own are those that decoding shades with."""

from __future__ import annotations

import pytest
import torch

import econgs_bench.econgs.anchors.gaussians as gaussians
from econgs_bench.econgs.anchors.colors import offset_colors
from econgs_bench.econgs.anchors.decode import decode
from econgs_bench.econgs.anchors.decoders import Decoders

from .test_decode import EYE, Case


@pytest.mark.parametrize("storage", ["hybrid", "partial", "explicit"])
@pytest.mark.parametrize("activation", ["tanh", "sigmoid"])
@pytest.mark.parametrize("direction", [True, False])
def test_offset_colors_are_those_of_decoding(monkeypatch, storage, activation, direction) -> None:
    case = Case(count=40, features=8, offsets=5, embedding=4, hidden=16)
    _, inputs = case.make()
    generator = torch.Generator().manual_seed(5)
    options = {"view_direction": direction, "offset_color": activation, "storage": storage}
    decoders = Decoders(8, 5, 4, hidden=16, generator=generator, **options)
    inputs["features"] = torch.randn((40, decoders.width), generator=generator)
    arguments = {}

    def shade(means, normals, base, *more):
        arguments["base"] = base
        return base

    monkeypatch.setattr(gaussians, "shade", shade)
    anchors, features, scalings, offsets, embedding, palette = inputs.values()
    decoded = decode(anchors, features, scalings, offsets, decoders, embedding, palette, EYE, backend="torch")
    colors = offset_colors(decoders, anchors, features, embedding, torch.tensor(EYE))
    by_slot = colors.transpose(1, 2).reshape(-1, 3)[decoded.slots]
    torch.testing.assert_close(by_slot, arguments["base"] - palette)
