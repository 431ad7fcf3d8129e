"""What ladders say about a method, on tables made by hand."""

from __future__ import annotations

import pytest

from econgs_bench.reports.sections.ladders.conclusion import (
    by_method,
    contrasts,
    flickering,
    summary,
    verdict,
    words,
)
from econgs_bench.reports.sections.ladders.table import climbed, ladders
from tests.reports.sections.ladders.test_table import table


def climbs(*rows):
    return climbed(ladders(table(*rows)))


def one(*psnr, **more):
    """Rungs of a ladder, from the usual run on."""
    return [{"place": place, "psnr": value, "rungs": len(psnr)} | more for place, value in enumerate(psnr)]


def test_the_earliest_and_gravest_break_comes_first() -> None:
    rows = [
        *one(30.0, 29.0, 20.0, ladder="late"),
        *one(30.0, 20.0, ladder="soon"),
        *one(30.0, 30.0, ladder="never"),
    ]
    collapse = one(30.0, 25.0, ladder="grave")
    collapse[1] |= {"missing": 0.9}
    (own,) = by_method(climbs(*rows, *collapse)).values()
    assert [climb["ladder"] for climb in own] == ["grave", "soon", "late", "never"]
    assert verdict(own) == (
        "a breaks first on “grave” and “soon”, at the first rung above the usual run; it breaks on 3 of 4 "
        "ladders and holds all rungs of “never”."
    )


def test_a_single_first_break_is_described() -> None:
    rows = [*one(30.0, 29.0, 20.0, ladder="late"), *one(30.0, 29.0, 29.0, 20.0, ladder="later")]
    (own,) = by_method(climbs(*rows)).values()
    text = verdict(own)
    assert text.startswith(
        "a breaks first on “late” (r2 on vortices/cores: quality, \N{MINUS SIGN}10.0 dB); it"
    )
    assert text.endswith("; it breaks on 2 of 2 ladders.")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"psnr": 26.0}, "quality, \N{MINUS SIGN}4.0 dB"),
        ({"missing": 0.43}, "vanishing parts, 43 % missing"),
        ({"missing": 0.9}, "collapse, 90 % missing"),
        ({"excess": 0.3}, "floaters, 30 % excess"),
        ({"primitives": 9000}, "explosion"),
        ({"status": "oom", "psnr": None}, "memory"),
    ],
)
def test_a_break_is_described_by_what_decides_it(change, text) -> None:
    (climb,) = climbs({"place": 0}, {"place": 1} | change)
    assert words(climb) == f"r1 on vortices/cores: {text}"


def test_what_was_not_measured_is_said() -> None:
    (own,) = by_method(climbs({"place": 0, "rungs": 4}, {"place": 1, "rungs": 4})).values()
    text = "a breaks on none of 1 ladder; 2 rungs are not measured."
    assert verdict(own) == text


def test_ladders_that_break_none_all_and_some_are_told_apart() -> None:
    rows = []
    for method, late in (("a", 29.0), ("b", 20.0)):
        rows += one(30.0, 29.0, ladder="easy", method=method)
        rows += one(30.0, 29.0, 29.0, ladder="easier", method=method)
        rows += one(30.0, 20.0, ladder="hard", method=method)
        rows += one(30.0, late, ladder="half", method=method)
        rows += one(30.0, late, 20.0, ladder="order", method=method)
    rows += [*one(30.0, 20.0, ladder="alone"), *one(30.0, 20.0, ladder="hard", method="c")]
    floaters = one(30.0, 29.0, ladder="half", method="c")
    floaters[1] |= {"excess": 0.5}
    stopped = one(30.0, 29.0, ladder="order", method="c")
    rows += [*floaters, *(rung | {"rungs": 3} for rung in stopped)]
    assert contrasts(climbs(*rows)) == [
        "No method breaks on “easy” and “easier”.",
        "Every method breaks on “hard” at r1.",
        "“half”: c breaks at r1 (floaters); b breaks at r1; a holds.",
        "“order”: b breaks at r1; a breaks at r2; c is not measured on all rungs.",
        "“alone”: a breaks at r1.",
    ]
    assert contrasts([]) == []


def test_a_line_per_method_for_a_terminal() -> None:
    failed = one(30.0, 29.0, 28.0, ladder="x", method="b")
    failed[1] |= {"status": "oom", "psnr": None}
    rows = [*one(30.0, 29.0, 20.0, ladder="x"), *one(30.0, 29.0, ladder="y"), *failed]
    assert summary(climbs(*rows)) == [
        "a  holds 2 of 3 rungs; breaks at r2 (quality)",
        "b  holds 1 of 2 rungs; breaks at r1 (memory)",
    ]


def test_flicker_is_compared_on_shared_scenes() -> None:
    amounts = {("a", ""): {"x": 1.0, "y": 5.0}, ("b", ""): {"x": 2.0, "y": 2.0, "z": 9.0}}
    assert flickering(amounts) == "a flickers most, 3.00, and b least, 2.00 (mean over 2 scenes)."
    assert flickering({("a", ""): {"x": 1.0}}) == "No scene compares two methods."
    assert flickering({("a", ""): {"x": 1.0}, ("b", ""): {"y": 1.0}}) == "No scene compares two methods."
