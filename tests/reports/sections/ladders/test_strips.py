"""Which pictures of ladders are shown, and the flicker between frames, on tables and files made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from econgs_bench.reports.schema import frame, records
from econgs_bench.reports.sections.ladders.strips import (
    FACTOR,
    choose,
    flicker,
    strip,
    until_break,
    views_of_jobs,
    worst_subject,
)
from econgs_bench.reports.sections.ladders.table import ladders
from tests.reports.sections.ladders.test_table import table


def rows(*rungs):
    return records(ladders(table(*rungs)))


def views(psnr, **more):
    """The table `rung_views`: job -> PSNR by view."""
    return views_of_jobs(
        frame(
            "rung_views",
            [
                {"job": job, "view": view, "psnr": value} | {key: f(job, view) for key, f in more.items()}
                for job, own in psnr.items()
                for view, value in own.items()
            ],
        )
    )


def test_pictures_end_at_the_first_break() -> None:
    own = rows({"place": 0}, {"place": 1, "psnr": 20.0}, {"place": 2}, {"method": "b", "place": 0},
               {"method": "b", "place": 2})  # fmt: skip
    assert {name: list(places) for (name, _), places in until_break(own).items()} == {
        "a": [0, 1],
        "b": [0, 2],
    }


def test_ladders_of_scenes_have_all_pictures() -> None:
    own = rows(*({"place": place, "psnr": 30.0 - 5 * place, "subject": ""} for place in range(3)))
    assert list(until_break(own)["a", ""]) == [0, 1, 2]


def test_the_scene_is_that_where_most_methods_break() -> None:
    def pair(subject, method, psnr):
        common = {"subject": subject, "method": method}
        return [{"place": 0} | common, {"place": 1, "psnr": psnr} | common]

    every = [
        *pair("x/x", "a", 20.0),
        *pair("x/x", "b", 30.0),
        *pair("y/y", "a", 20.0),
        *pair("y/y", "b", 20.0),
    ]
    assert worst_subject(rows(*every)) == "y/y"
    assert worst_subject(rows(*every[:2], *every[4:6])) == "x/x"


def test_the_view_is_that_of_the_largest_loss() -> None:
    own = rows({"place": 0}, {"place": 1, "psnr": 20.0}, {"place": 2, "psnr": 10.0})
    psnr = {
        "measure-0": {"v0": 30.0, "v1": 40.0}, "measure-1": {"v0": 10.0, "v1": 15.0},
        "measure-2": {"v0": 0.0, "v1": 15.0},
    }  # fmt: skip
    assert set(choose(own, views(psnr)).values()) == {"v1"}
    assert choose(own, {}) == {}


def test_other_test_pictures_have_a_view_for_each_rung() -> None:
    own = rows({"place": 0}, {"place": 1, "same_truth": False})
    psnr = {"measure-0": {"v0": 30.0, "v1": 40.0}, "measure-1": {"w0": 30.0, "w1": 20.0}}
    assert choose(own, views(psnr)) == {0: "v0", 1: "w1"}


@pytest.fixture
def store(tmp_path):
    """Makes flat gray pictures; returns views of jobs whose picture differs from the truth by an error."""

    def make(errors):
        def save(name, value):
            Image.fromarray(np.full((4, 6, 3), value, np.uint8)).save(tmp_path / name)
            return name

        return views(
            {job: dict.fromkeys(own, 30.0) for job, own in errors.items()},
            truth_file=lambda job, view: save(f"{view}.png", 100 + 10 * int(view[1:])),
            render_file=lambda job, view: save(
                f"{job}-{view}.png", 100 + 10 * int(view[1:]) + errors[job][view]
            ),
            background=lambda job, view: "#ffffff",
        )

    return make


def test_the_truth_appears_once_where_it_is_the_same(store, tmp_path) -> None:
    errors = {"measure-0": {"v0": 1, "v1": 2}, "measure-1": {"v0": 3, "v1": 4}}
    same = strip(rows({"place": 0}, {"place": 1}), store(errors), tmp_path)
    assert [rung.truth is None for rung in same.values()] == [False, True]
    assert [int(rung.pictures["a", ""].max()) for rung in same.values()] == [101, 103]
    other = strip(rows({"place": 0}, {"place": 1, "same_truth": False}), store(errors), tmp_path)
    assert [rung.truth is None for rung in other.values()] == [False, False]


def test_without_files_there_is_no_strip(store, tmp_path) -> None:
    of_jobs = store({"measure-0": {"v0": 1}, "measure-1": {"v0": 3}})
    for path in tmp_path.glob("measure*"):
        path.unlink()
    own = rows({"place": 0}, {"place": 1, "flicker": 1.0})
    assert strip(own, of_jobs, tmp_path) == {}
    assert flicker(own[1:], of_jobs, tmp_path) is None


def test_flicker_is_the_change_of_the_error(store, tmp_path) -> None:
    own = rows({"place": 0}, {"place": 1, "flicker": 1.0}, {"method": "b", "place": 0},
               {"method": "b", "place": 1, "flicker": 1.0})  # fmt: skip
    steady, popping = {"v0": 5, "v1": 5, "v2": 5}, {"v0": 0, "v1": 2, "v2": -1}
    pair = flicker([own[1], own[3]], store({"measure-1": steady, "measure-3": popping}), tmp_path)
    assert pair is not None
    assert pair.views == ("v1", "v2")
    assert pair.amounts == {("a", ""): 0.0, ("b", ""): pytest.approx(3.0)}
    assert int(pair.changes["a", ""].max()) == 0
    assert set(pair.changes["b", ""].ravel()) == {3 * FACTOR}
    assert set(pair.truth.ravel()) == {120}
