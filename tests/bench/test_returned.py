"""What a method gives back: the contract's forms pass, all others are failures in words."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from econgs_bench.bench.jobs import returned, views
from econgs_bench.bench.jobs.monitor import Progress, Stop
from econgs_bench.bench.jobs.views import ViewsResult
from econgs_bench.bench.run import worker
from econgs_bench.bench.store.records import Task
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.camera import Camera

from .conftest import SMALL, plan, suite_file

CAMERA = Camera.with_fov(np.eye(4), 0.6, 5, 3, "r_1")
RGB, ALPHA = np.zeros((3, 5, 3), np.float32), np.ones((3, 5), np.float32)


@pytest.mark.parametrize("part", [np.asarray, torch.from_numpy])
def test_a_picture_of_floats_passes(part) -> None:
    rgb, alpha = returned.picture((part(RGB), part(ALPHA)), CAMERA)
    assert (rgb == RGB).all()
    assert (alpha == ALPHA).all()


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, "renders a NoneType"),
        ((RGB,), "renders a tuple"),
        (("red", "all"), "colors"),
        ((RGB[:1, :1], ALPHA), r"colors \(1, 1, 3\)"),
        ((RGB, ALPHA[..., None]), r"alpha \(3, 5, 1\)"),
        ((RGB.astype(np.uint8), ALPHA), "uint8"),
        ((RGB * 1j, ALPHA), "complex64"),
        ((RGB.astype(object), ALPHA), "object"),
    ],
)
def test_no_picture(answer, words) -> None:
    with pytest.raises(RuntimeError, match=f"{words}.* in view r_1"):
        returned.picture(answer, CAMERA)


def test_a_picture_that_is_not_finite() -> None:
    with pytest.raises(FloatingPointError, match="not finite in view r_1"):
        returned.picture((RGB, ALPHA * np.inf), CAMERA)


@pytest.mark.parametrize(
    ("check", "good", "bad"),
    [
        (returned.primitives, (0, np.int64(3)), (-1, 1.0, float("nan"), "3", None)),
        (returned.timings, ({}, {"a": 1.0}), (None, [1.0], {"a": float("nan")}, {"a": "1"}, {1: 1.0})),
        (returned.ledger, ({}, {"": {"a": 1}}), (None, [1], {"": 1}, {"": {"a": 1.0}}, {"": {"a": "1"}})),
    ],
)
def test_counts_timings_and_ledgers(check, good, bad) -> None:
    for value in good:
        assert check(value) == value
    for value in bad:
        with pytest.raises(RuntimeError):
            check(value)


def test_attributes_are_finite_rows() -> None:
    assert returned.attributes({"a": torch.ones(2, 3)})["a"].shape == (2, 3)
    for value in (None, {"a": "red"}, {"a": np.ones(3)}, {"a": np.full((2, 2), np.nan)}):
        with pytest.raises(RuntimeError):
            returned.attributes(value)


def test_a_number_that_no_record_holds_is_a_failure_that_names_it(tmp_path, monkeypatch) -> None:
    (job,) = [job for job in plan(suite_file(tmp_path, SMALL)) if job.kind == "views"][:1]
    result = ViewsResult(view_keys={}, background=(1.0, 1.0, 1.0), truth={}, render_seconds=math.nan)
    monkeypatch.setattr(views.Views, "run", lambda job, context: result)
    store = Store(tmp_path / "runs", create=True)
    progress = Progress(tmp_path / "progress.jsonl")
    record = worker.run(Task(job=job, threads=1), tmp_path, store, Stop(), progress)
    assert record.status == "failed"
    assert "its results cannot be stored: views.render_seconds" in record.reason
    store.finish(record)
    assert Store(store.root).record(job.id) == record
