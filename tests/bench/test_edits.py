"""Edits as people write them."""

from __future__ import annotations

import pytest

from econgs_bench.bench.suites.edits import parse_edits
from econgs_bench.datasets.edits import Edit
from econgs_bench.datasets.errors import DataError


def test_edits_of_a_scene_are_joined() -> None:
    edits = parse_edits(["a.palette=#ff8000", "a.opacity=0.5", "b.v2.light=0,3,4", "c.light=headlight"])
    assert edits == {
        "a": Edit(palette=(1.0, 128 / 255, 0.0), opacity=0.5),
        "b.v2": Edit(light=(0.0, 0.6, 0.8)),
        "c": Edit(light="headlight"),
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a.opacity", "not of the form scene.what=value"),
        ("opacity=1", "not of the form scene.what=value"),
        ("a.opacty=1", "Did you mean opacity"),
        ("a.palette=red", "'red' is no color"),
        ("a.palette=#ff880", "is no color"),
        ("a.light=0,0,0", "is no direction"),
        ("a.light=1,2", "is no direction"),
        ("a.light=nan,0,1", "is no direction"),
        ("a.opacity=-1", "'-1' is no factor"),
        ("a.opacity=inf", "'inf' is no factor"),
        ("a.opacity=1,2", "is no factor"),
        ("a.width=0", "no width"),
        ("a.shift=far", "no number of widths"),
    ],
)
def test_unusable_edits_are_named(text: str, words: str) -> None:
    with pytest.raises(DataError, match=words):
        parse_edits([text])
