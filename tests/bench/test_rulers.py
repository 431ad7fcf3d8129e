"""Versions of the timing protocol: of which jobs they decide the identity, and what older records have."""

from __future__ import annotations

import pytest

from econgs_bench.bench.jobs.dvr import DvrResult
from econgs_bench.bench.machine.timing import RULERS
from econgs_bench.bench.store.records import Record
from econgs_bench.bench.store.store import Store, read_record
from econgs_bench.datasets.hashes import hash_of
from tests.bench.conftest import measured, plan


def keys(suite: str) -> dict[str, set[str]]:
    """Kind -> keys of a suite's jobs."""
    kinds: dict[str, set[str]] = {}
    for job in plan(suite, scenes=()):
        kinds.setdefault(job.kind, set()).add(job.key)
    return kinds


def test_another_ruler_measures_again_and_fits_nothing_again(suite, monkeypatch) -> None:
    text = suite("dvr = true\nparsimony = true")
    before = keys(text)
    assert before.keys() == {"views", "dvr", "complexity", "fit", "encode", "measure"}
    for part, kinds in (("frame", {"dvr", "measure"}), ("parts", {"measure"})):
        for kind in ("dvr", "measure"):
            monkeypatch.setattr(f"econgs_bench.bench.jobs.{kind}.RULERS", RULERS | {part: 99})
        after = keys(text)
        assert {kind for kind in before if before[kind].isdisjoint(after[kind])} == kinds
        assert {kind for kind in before if before[kind] != after[kind]} == kinds


def test_a_stored_measurement_of_another_ruler_is_replaced_in_the_tables(finished) -> None:
    (measure,) = finished.of_kind("measure")
    assert (measure.result.ruler, measure.result.parts_ruler) == (RULERS["frame"], RULERS["parts"])
    store = Store(finished.store)
    identity = {name: value for name, value in measure.job.identity.items() if name != "rulers"}
    older = measure.job.model_copy(update={"identity": identity, "key": hash_of(identity)})
    times = measure.result.model_copy(update={"ruler": None, "parts_ruler": None})
    store.set_aside(measure.job.id)
    store.finish(measure.model_copy(update={"job": older, "result": times, "finished": "2026-11-01T00:00"}))
    finished.run()
    done = finished.of_kind("measure")
    assert {one.job.id for one in done} == {measure.job.id, older.id}
    assert [len(finished.of_kind(kind)) for kind in ("views", "fit", "encode")] == [1, 1, 1]
    assert [row["job"] for row in finished.tables()["results"].to_dict("records")] == [measure.job.id]
    old = read_record(store.jobs / older.id / "record.json").result
    assert (old.ruler, old.parts_ruler) == (1, 1)


@pytest.mark.parametrize(
    ("finished", "parts"),
    [
        ("2026-11-28T09:25:50.999+00:00", 1),
        ("2026-11-28T09:25:51.000+00:00", 2),
        ("2027-01-01T00:00:00.000+00:00", 2),
    ],
)
def test_older_records_get_the_ruler_of_their_time(suite, finished, parts) -> None:
    jobs = {job.kind: job for job in plan(suite("dvr = true"))}

    def record(kind: str, **result: object) -> Record:
        job = jobs[kind]
        return job.migrated(
            Record(job=job, status="ok", started="", finished=finished, wall_seconds=1.0, **result)
        )

    old = record("measure", measure=measured(30.0, 1)).result
    assert (old.ruler, old.parts_ruler, old.reference_worst) == (1, parts, None)
    new = measured(30.0, 1).model_copy(update=dict(zip(("ruler", "parts_ruler"), (2, 3), strict=True)))
    assert record("measure", measure=new).result == new
    dvr = DvrResult(
        dims=(2, 2, 2), variables=[], dtype="u", volume_bytes=8, load_seconds=1.0, setup_seconds=1.0,
        renderer="", version="", backend="", frame_seconds=1.0, frame_seconds_p05=1.0, frame_seconds_p95=1.0,
        frames=1, warmup_stable=True, reference_seconds=None,
    )  # fmt: skip
    assert record("dvr", dvr=dvr).result.ruler == 1
    assert record("fit").result is None
