"""Which times count, on hand-made rows."""

import json
import re

import pytest

from econgs_bench.reports.clocks import BUSY, SPREAD, Clocks, decoding
from econgs_bench.reports.comparability import compared
from econgs_bench.reports.schema import frame
from tests.reports.sections.answers.test_conclusion import (
    DRAWING,
    TRAINING,
    contest,
    measured,
    pair,
    row,
    table,
)

EVEN = {"fps_p05": 80.0, "fps_p95": 120.0}
QUIET = [row("a", 30.0, scene=f"s{i}", **EVEN) for i in range(5)]


def reasons(column, **more):
    """Why a row's time beside five quiet ones is disturbed."""
    return Clocks(table(*QUIET)).disturbed(row("b", 30.0, **EVEN | more), column)


@pytest.mark.parametrize(
    ("column", "reference", "worst"),
    [
        ("fps", "reference_seconds", "reference_worst"),
        ("train_seconds", "fit_reference_seconds", "fit_reference_worst"),
    ],
)
def test_the_kernel_beside_a_time_or_amid_it_shows_that_it_was_disturbed(column, reference, worst):
    assert reasons(column) == ""
    for name in (reference, worst):
        assert reasons(column, **{name: BUSY - 0.01}) == ""
        assert f"took {BUSY + 0.2:.1f} times" in reasons(column, **{name: BUSY + 0.2})
    other = {"fps": "train_seconds", "train_seconds": "fps"}[column]
    assert reasons(other, **{reference: 9.0, worst: 9.0}) == ""
    assert reasons("psnr", **{reference: 9.0, worst: 9.0}) == ""


def test_frames_that_differ_in_time_show_that_fps_is_disturbed():
    assert reasons("fps", fps_p05=101.0, fps_p95=101.0 * SPREAD - 1.0) == ""
    assert "took 2.86 times the fastest" in reasons("fps", fps_p05=42.0, fps_p95=120.0)
    assert reasons("train_seconds", fps_p05=42.0, fps_p95=120.0) == ""
    both = reasons("fps", fps_p05=20.0, fps_p95=120.0, reference_seconds=3.0)
    assert "took 3 times its quiet time" in both
    assert "took 6 times the fastest" in both


def test_what_is_not_known_disturbs_nothing():
    """Another processor without quiet times, and a store of older tables."""
    assert reasons("fps", reference_worst=9.0, processor="Q") == ""
    few = table(*QUIET[:4])
    assert Clocks(few).disturbed(row("b", 30.0, reference_seconds=9.0), "fps") == ""
    older = table(*QUIET).drop(columns=["reference_worst", "fps_p05"], errors="ignore")
    assert Clocks(older).disturbed({"fps": 1.0, "processor": "P", "threads": 1}, "fps") == ""


def test_a_sentence_on_drawing_names_what_frames_contain():
    rows = [*pair([0.0] * 4)]
    before = measured(DRAWING, contest(*rows)).sentence
    for one in rows:
        once = one["method"] == "a"
        one |= {"decoding": "once", "fps_decoding": 81.0} if once else {"decoding": "per frame"}
    rows[0]["fps_decoding"] = 20.0  # of a busy moment
    condition = decoding(rows)
    assert re.search(r"once.* a \(0\.81 times .*frame: b\.$", condition)
    assert measured(DRAWING, contest(*rows)).sentence == f"{before} {condition}"
    assert condition not in measured(TRAINING, contest(*rows)).sentence


def test_what_a_disturbed_clock_measured_is_left_out_with_it():
    """Both rates of a model that is decoded once; else a rate with decoding has nothing to be a share of."""
    rows = [*pair([0.0] * 4)]
    for one in rows:
        one |= {"decoding": "once", "fps_decoding": 81.0, "differences": ""}
    rows[0]["differences"] = json.dumps({"fps": "disturbed: the machine was busy"})
    left = compared({"results": frame("results", rows)})["results"]
    for name in ("fps", "fps_decoding"):
        assert left[name].isna().tolist() == [True, *[False] * (len(rows) - 1)]
    assert "a (" in decoding(left.to_dict("records"))
