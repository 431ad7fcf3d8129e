"""Where a method breaks: cases made by hand."""

from __future__ import annotations

import pandas as pd
import pytest

from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import TABLES, frame
from econgs_bench.reports.sections.ladders.table import (
    COLUMNS_OF_LADDERS,
    FAILURES,
    at_shared_seeds,
    climbed,
    held,
    ladders,
    severity,
)

USUAL = {
    "ladder": "noise", "rungs": 4, "subject": "vortices/cores", "dataset": "vortices", "scene": "cores",
    "method": "a", "variant": "", "preset": "quick", "split": "test", "requested_views": 42, "seed": 0,
    "same_truth": True, "status": "ok", "psnr": 30.0, "missing": 0.05, "excess": 0.02, "primitives": 1000,
}  # fmt: skip


def table(*rows: dict) -> pd.DataFrame:
    """The table `rungs`: rows that differ from the usual in some columns; the job is named by number."""
    full = [USUAL | {"job": f"measure-{i}", "rung": f"r{row['place']}"} | row for i, row in enumerate(rows)]
    return frame("rungs", full)


def judged(**second) -> pd.Series:
    """The second rung after a usual first one."""
    return ladders(table({"place": 0}, {"place": 1} | second)).iloc[1]


@pytest.mark.parametrize(
    ("change", "failure"),
    [
        ({}, None),
        ({"psnr": 27.01}, None),
        ({"psnr": 27.0}, "quality"),
        ({"missing": 0.24}, None),
        ({"missing": 0.26}, "vanishing parts"),
        ({"missing": 0.6, "primitives": 9000}, "collapse"),
        ({"excess": 0.3, "psnr": 20.0}, "floaters"),
        ({"primitives": 5000}, None),
        ({"primitives": 5001, "psnr": 20.0}, "explosion"),
        ({"primitives": 5001, "same_truth": False}, None),
        ({"status": "diverged"}, "diverged"),
        ({"status": "oom"}, "memory"),
        ({"status": "timeout"}, "time"),
        ({"status": "refused"}, "refusal"),
        ({"status": "failed", "failed_step": "encode"}, "decode error"),
        ({"status": "failed", "failed_step": "measure", "stage": "load"}, "decode error"),
        ({"status": "failed", "failed_step": "measure", "reason": "values that are not finite"}, "diverged"),
        ({"status": "failed", "failed_step": "fit"}, "failure"),
        ({"psnr": None, "missing": None, "excess": None}, None),
    ],
)  # fmt: skip
def test_kinds_of_breaks(change, failure) -> None:
    if change.get("status", "ok") != "ok":
        change |= {"psnr": None, "missing": None, "excess": None, "primitives": None}
    row = judged(**change)
    assert (None if pd.isna(row["failure"]) else row["failure"]) == failure
    assert failure is None or failure in FAILURES


def test_other_test_pictures_are_compared_with_the_best_method() -> None:
    def rung(method, place, psnr):
        return {"method": method, "place": place, "psnr": psnr, "same_truth": place == 0}

    # On rung 1 all lose 10 dB: it is harder. On rung 2 only b loses.
    rows = [rung("a", 0, 35.0), rung("a", 1, 25.0), rung("a", 2, 36.0)]
    rows += [rung("b", 0, 33.0), rung("b", 1, 22.5), rung("b", 2, 28.0)]
    result = ladders(table(*rows)).set_index(["method", "place"])
    assert list(result["change"]) == pytest.approx([0.0, 0.0, 0.0, 0.0, -0.5, -6.0])
    assert list(result["failure"].fillna("")) == ["", "", "", "", "", "quality"]


def test_errors_below_an_8_bit_step_are_no_difference() -> None:
    result = ladders(
        table({"place": 0, "psnr": 100.0}, {"place": 1, "psnr": 49.0}, {"place": 2, "psnr": 45.0})
    )
    assert list(result["change"]) == pytest.approx([0.0, 0.0, -3.13])


def test_seeds_are_averaged_and_one_that_fails_is_the_rungs_failure() -> None:
    rows = [{"place": 0, "seed": s, "psnr": p} for s, p in enumerate((30.0, 31.0, 32.0))]
    rows += [{"place": 1, "seed": s, "psnr": p} for s, p in enumerate((27.0, 29.0, 31.0))]
    failed = {"place": 2, "seed": 1, "psnr": None, "status": "oom", "reason": "memory limit"}
    result = ladders(table(*rows, {"place": 2, "psnr": 31.0}, failed)).set_index("place")
    assert list(result["psnr"]) == [31.0, 29.0, 31.0]
    assert list(result["psnr_std"])[:2] == [1.0, 2.0]
    assert list(result["seeds"]) == [3, 3, 1]
    assert list(result["failure"].fillna("")) == ["", "", "memory"]
    assert (result["reason"][2], result["job"][2], result["first_job"][2]) == (
        "memory limit", "measure-7", "measure-0",
    )  # fmt: skip


def test_what_was_not_measured_decides_nothing() -> None:
    assert ladders(table({"place": 0})).empty  # the usual run alone is no ladder
    assert list(ladders(frame("rungs")).columns) == list(COLUMNS_OF_LADDERS)
    later = ladders(table({"place": 1, "psnr": 10.0}, {"place": 2, "missing": 0.9}))
    assert later["change"].isna().all()
    assert list(later["failure"].fillna("")) == ["", "collapse"]
    other = ladders(table({"place": 0, "preset": "standard"}, {"place": 1, "psnr": 10.0}))
    assert other["failure"].isna().all()  # of another preset


def test_the_worst_subject_decides_how_far_a_method_climbs() -> None:
    rows = []
    for subject, falls in (("vortices/cores", 3), ("vis_male/skin", 2)):
        for place in range(4):
            rows.append({"subject": subject, "place": place, "psnr": 20.0 if place >= falls else 30.0})
    rows += [{"method": "b", "place": place} for place in range(3)]
    first, second = climbed(ladders(table(*rows)))
    assert first["outcomes"] == {0: None, 1: None, 2: "quality", 3: "quality"}
    assert (held(first), first["place"], first["rungs"]) == (1, 2, 4)
    assert (first["subject"], first["failure"], first["rung"]) == ("vis_male/skin", "quality", "r2")
    assert second["outcomes"] == {0: None, 1: None, 2: None}
    assert (held(second), second["failure"], second["subject"]) == (2, None, None)


def test_the_gravest_kind_of_all_subjects_is_a_rungs() -> None:
    rows = [{"subject": subject, "place": place} for subject in ("x/x", "y/y") for place in range(3)]
    rows[1] |= {"psnr": 20.0}
    rows[4] |= {"excess": 0.9, "psnr": 29.0}
    (climb,) = climbed(ladders(table(*rows)))
    assert climb["outcomes"] == {0: None, 1: "floaters", 2: None}  # a rung above a break may hold
    assert (climb["subject"], climb["failure"], climb["change"]) == ("y/y", "floaters", -1.0)
    assert held(climb) == 1


def test_severity_is_the_share_of_rungs_before_the_break() -> None:
    def climb(place, rungs, failure="quality", change=-5.0):
        return {"place": place, "rungs": rungs, "failure": failure, "change": change}

    ordered = [
        climb(0, 3), climb(1, 4, "collapse"), climb(1, 2, change=-9.0), climb(1, 2), climb(2, 4), climb(2, 3),
        climb(None, 3, None, None),
    ]  # fmt: skip
    assert sorted([*ordered[3:], *ordered[:3]], key=severity) == ordered


def test_a_method_that_more_seeds_were_asked_of_breaks_no_more_often() -> None:
    rows = [{"place": place, "method": name, "seed": seed} for name in "ab" for place in range(3)
            for seed in ((0,) if name == "a" else (0, 1, 2))]  # fmt: skip
    rows = [
        row | ({"status": "diverged", "psnr": None} if row["seed"] == 2 and row["place"] else {})
        for row in rows
    ]
    tables = {name: frame(name) for name in TABLES} | {"rungs": table(*rows)}
    found = climbed(at_shared_seeds(Report(tables)))
    assert {one["method"]: held(one) for one in found} == {"a": 2, "b": 2}
    assert {one["method"]: held(one) for one in climbed(ladders(tables["rungs"]))} == {"a": 2, "b": 0}
