"""Suites with edits: edited models are measured against the ground truth of the edited scene."""

from __future__ import annotations

import pytest

from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.datasets.png import read_png

from .conftest import plan

EDITS = 'edits = ["palette=#ff0000", "opacity=0.5 light=1,0,0"]'


def test_every_scene_is_measured_as_it_is_and_edited(suite) -> None:
    jobs = {job.id: job for job in plan(suite(EDITS))}
    measured = [job for job in jobs.values() if job.kind == "measure"]
    assert sorted((job.subject, job.edit) for job in measured) == [
        (scene, edit)
        for scene in ("bubble", "shock")
        for edit in ("", "opacity=0.5 light=1,0,0", "palette=#ff0000")
    ]
    for job in measured:
        (views,) = [jobs[name] for name in job.needs if name.startswith("views-")]
        assert (views.subject, views.edit) == (job.subject, job.edit)
    # nobody trains on an edited scene, and what is not edited is the same job as without edits
    assert all(not jobs[name].edit for job in jobs.values() if job.kind == "fit" for name in job.needs)
    assert {job.id for job in jobs.values() if not job.edit} == {job.id for job in plan(suite())}


def test_compositions_have_edits_of_their_own(suite) -> None:
    chains = 'chains = ["opacity=0.5 | palette=#00ff00"]\ncompositions = "all"\n'
    jobs = {job.id: job for job in plan(suite(chains + EDITS))}
    (measured,) = [job for job in jobs.values() if job.kind == "measure" and job.edit and job.composition]
    assert measured.edit == "opacity=0.5 | palette=#00ff00"
    (views,) = [jobs[name] for name in measured.needs if name.startswith("views-")]
    assert (views.composition, views.edit) == (measured.composition, measured.edit)
    assert len([name for name in measured.needs if name.startswith("encode-")]) == len(measured.scenes)


def test_a_moved_bump_is_shown_by_the_trained_scenes_that_come_nearest(suite) -> None:
    jobs = plan(suite('edits = ["shift=0.5"]'), methods=("3dgs",))
    for job in (job for job in jobs if job.kind == "measure" and job.edit):
        assert job.recipe, "3DGS cannot move a bump"
        assert job.rendered == tuple(job.recipe)
        assert len([name for name in job.needs if name.startswith("encode-")]) == len(job.recipe)
        assert all(text.startswith("opacity=") for text in job.recipe.values())
    assert not any(job.recipe for job in jobs if job.kind == "measure" and not job.edit)


@pytest.mark.parametrize(
    ("edit", "error", "words"),
    [
        ("opacty=1", UnknownName, "Did you mean opacity"),
        ("", DataError, "changes nothing"),
    ],
)
def test_unusable_edits_are_named(suite, edit, error, words) -> None:
    with pytest.raises(error, match=words):
        plan(suite(f'edits = ["{edit}"]'))


def test_pre_rendered_views_have_no_edited_truth(suite, data_folder) -> None:
    views = str(data_folder / "vortex_views")
    assert not any(job.edit for job in plan(suite(EDITS), datasets=(views,), scenes=("TF01",)))


def test_a_run_with_edits(bench, suite) -> None:
    done = bench.run_suite(suite(EDITS))
    assert "fake: refused: fake cannot edit opacity, light" in done.stderr
    tables = bench.tables()
    results = tables["results"].set_index(["scene"])
    assert list(results["kind"]) == ["basic"] * 2 + ["edited"] * 4
    assert set(results["status"][results["edit"] == "opacity=0.5 light=1,0,0"]) == {"refused"}
    red = results.loc["shock palette=#ff0000"]
    assert (red["status"], red["edit"]) == ("ok", "palette=#ff0000")
    seen = tables["views"][tables["views"]["job"] == red["job"]]
    first = read_png(bench.store / seen["render_file"].iloc[0])
    assert (first[..., :3] == [1.0, 0.0, 0.0]).all()  # the model was edited
    plain = tables["views"][tables["views"]["job"] == results.loc["shock", "job"]]
    assert (
        read_png(bench.store / seen["truth_file"].iloc[0])[..., 1:3].sum()
        < 0.9 * read_png(bench.store / plain["truth_file"].iloc[0])[..., 1:3].sum()
    )  # and so was the truth
    assert set(tables["timing"]["scene"]) == {"shock", "bubble"}
    again = bench.run_suite(suite(EDITS))
    assert "nothing to run" in again.stderr
