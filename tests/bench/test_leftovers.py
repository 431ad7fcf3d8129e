"""Hostile plugins: what a job leaves behind is ended, and a record that is written ends the wait."""

from __future__ import annotations

import re
import sys

import psutil
import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="no fork here")


def _fit(bench):
    (fit,) = bench.of_kind("fit")
    return fit, (bench.store / "jobs" / fit.job.id / "log.txt").read_text()


@pytest.mark.parametrize(
    ("method", "behaviour", "status"), [("fake-torch", "child", "ok"), ("fake", "child-abort", "failed")]
)
def test_children_are_ended_wherever_they_went(bench, method, behaviour, status) -> None:
    bench.run("--set", f"{method}.behaviour={behaviour}", method=method, code=status == "failed")
    fit, log = _fit(bench)
    assert fit.status == status, fit.reason
    children = [int(pid) for pid in re.findall(r"left behind: (\d+)", log)]
    assert len(children) == 3
    assert not [pid for pid in children if psutil.pid_exists(pid)]
    (note,) = re.findall(r"bench: ended what the job left behind: (.*)", log)
    assert {int(pid) for pid in re.findall(r"\((\d+)\)", note)} <= set(children)


@pytest.mark.parametrize(("method", "behaviour"), [("fake", "thread"), ("fake-torch", "hang")])
def test_a_written_record_ends_the_wait(bench, method, behaviour) -> None:
    bench.run("--set", f"{method}.behaviour={behaviour}", method=method)  # 600 s would be too long for it
    assert all(record.ok for record in bench.records().values())
    _, log = _fit(bench)
    assert ("after its record was written" in log) is (behaviour == "hang")
