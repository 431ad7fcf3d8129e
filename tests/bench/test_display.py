"""The line of a running job, and how many there are."""

from types import SimpleNamespace

import pytest

from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.plan.selection import Selection
from econgs_bench.bench.run.display import Display, status_line
from econgs_bench.bench.suites.suite import load_suite

STATE = {
    "stage": "growth under noise", "iteration": 549, "iterations": 1600, "left": 125.0, "psnr": 25.452,
    "primitives": 10272, "loss": 0.0356, "parts": {"image": 0.031, "alpha": 0.0045, "color": 1.5e-5},
}  # fmt: skip
TITLE = "10/13 fit econgs on vortices, cores + sheaths, seed 0"


@pytest.mark.parametrize("width", [40, 68, 80, 120, 200])
def test_it_fits_and_losses_yield_first(width):
    line = status_line(TITLE, STATE, width)
    assert len(line) <= width
    assert "34 %, 2:05 min left, 25.45 dB" in line
    words = ["growth under noise", "10272 primitives", "loss 0.0356", "image 0.031", "alpha 0.0045"]
    present = [word in line for word in words]
    assert present == sorted(present, reverse=True)
    assert all(present) == (width == 200)


def test_what_is_not_known_is_not_there():
    assert status_line("1/2 views", {"stage": "rendering"}, 80) == "1/2 views, rendering"
    assert status_line("1/2 views", {}, 80) == "1/2 views"


@pytest.mark.parametrize("groups", [[["cores", "sheaths"]], [["cores"], ["sheaths"]]])
def test_the_number_of_jobs_is_known_before_a_partition(groups):
    """At least so many; and no two of them have one title."""
    planner = Planner(Selection(load_suite("quick")), {"psnr": "1"})
    first = planner.jobs(None)
    assert len(first) == 9
    assert planner.total(first, None) == (13, True)
    done = SimpleNamespace(ok=True, of=lambda kind: kind(groups=groups, seconds=1.0))
    store = SimpleNamespace(record=lambda job: done if job.startswith("partition") else None)
    jobs = planner.jobs(store)
    assert planner.total(jobs, store) == (len(jobs), False) == (11 + 2 * len(groups), False)
    titles = [job.title for job in jobs]
    assert len(set(titles)) == len(titles)
    assert {"measure vortices/cores econgs", "measure vortices/sheaths econgs"} <= set(titles)


def test_a_number_of_jobs_that_may_grow_is_marked(finished, capsys):
    (job,) = (record.job for record in finished.of_kind("measure"))
    Display().begin(job, 9, "13+")
    assert capsys.readouterr().err == f"[9/13+] {job.title}\n"
