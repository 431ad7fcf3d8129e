"""The noise floor of the truth in tables: from the views jobs to the results of the models on them."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest

from econgs_bench.bench.jobs.truth import FILES
from econgs_bench.bench.results.tables import derived
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Record
from econgs_bench.methods.registry import Registry
from econgs_bench.reports.schema import METRICS

from .planted_store import FLOOR, METHODS, ONE_RAY, SCENES, Plant, every

FEW = SCENES[:2]


def few(plant: Plant) -> list[Record]:
    return every(plant, FEW, (0,), (None,), (None,))


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return few(lambda facts: facts)


def tables(records: list[Record]) -> dict[str, pd.DataFrame]:
    return derived(Lineage(records), Registry().specs)


def test_every_model_has_the_floor_of_its_truth(records) -> None:
    results = tables(records)["results"]
    assert set(results["floor"]) == {FLOOR["psnr"]}
    assert set(results["one_ray"]) == {ONE_RAY["psnr"]}
    assert set(results["samples"]) == {0}


def test_the_table_of_floors_has_all_metrics_of_each_scene(records) -> None:
    floors = tables(records)["floors"].set_index(["scene", "picture"])
    assert sorted(floors.index) == sorted((scene, what) for scene in FEW for what in ("one ray", "truth"))
    for what, values in (("truth", FLOOR), ("one ray", ONE_RAY)):
        row = floors.loc[(FEW[1], what)]
        assert {name: None if pd.isna(row[name]) else row[name] for name in METRICS} == (
            dict.fromkeys(METRICS) | values
        )
    assert set(floors["samples"]) == {0}


def test_older_records_have_none(records) -> None:
    older = [
        one
        if one.job.kind != "views"
        else one.model_copy(update={"result": one.result.model_copy(update={"floor": {}, "one_ray": {}})})
        for one in records
    ]
    found = tables(older)
    assert found["results"][["floor", "one_ray"]].isna().all(axis=None)
    assert found["floors"].empty


def test_the_number_of_rays_is_that_of_every_job_behind_a_model() -> None:
    """Fits, encoded models and views of one ray are of the same dataset as their measurements."""
    found = tables(few(lambda facts: replace(facts, samples=1)))
    jobs = found["jobs"]
    own = jobs[jobs["method"] == METHODS[1]]
    assert set(own["step"]) == {"fit", "encode", "measure"}
    assert set(own["samples"]) == {1}
    assert own["dataset"].nunique() == 1
    assert set(jobs.loc[jobs["step"] == "views", "samples"]) == {0, 1}


def test_pre_rendered_views_have_no_number_of_rays(records) -> None:
    elsewhere = few(lambda facts: replace(facts, samples=1, renderer=FILES))
    measured = [one for one in elsewhere if one.job.kind == "measure" and one.job.method == METHODS[1]]
    rows = tables(measured)["results"]
    assert rows["samples"].isna().all()


@pytest.mark.parametrize(("dataset", "samples"), [("csafe_heptane", 1), ("vortex_views", None)])
def test_without_a_record_of_the_views_the_catalogue_decides(records, dataset, samples) -> None:
    """As in bundles of models alone."""
    every_one = few(lambda facts: replace(facts, samples=1))
    measured = [one for one in every_one if one.job.axes()["method"] == METHODS[1]]
    stripped = []
    for one in measured:
        job = one.job.model_copy(update={"dataset": dataset, "dataset_name": dataset})
        result = one.result
        if one.job.kind == "measure":
            result = result.model_copy(update={"renderer": "", "sketch": ""})
        stripped.append(one.model_copy(update={"job": job, "result": result}))
    found = {None if pd.isna(value) else value for value in tables(stripped)["jobs"]["samples"]}
    assert found == {samples}
