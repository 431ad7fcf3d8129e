"""Axes of jobs: rate knobs of any name, and records of the former schema."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from econgs_bench.bench.results.bundle import zip_of
from econgs_bench.bench.results.tables import stored_tables
from econgs_bench.bench.store.records import SCHEMA, PruningResult, Record
from econgs_bench.datasets.seals import unsealed
from econgs_bench.methods.gaussian_splatting.spec import SPEC
from econgs_bench.methods.interface import RateKnob, option
from econgs_bench.methods.options import label, resolve
from econgs_bench.reports.curves import at_default_rates, curves
from econgs_bench.reports.schema import PRUNED, joined, read_tables
from tests.bench.test_versions import version

MEASURED = sorted((Path(__file__).parents[2] / "reports" / "measured").rglob("*.zip.xz"))


@dataclass(frozen=True)
class Sparse:
    sparsity: float = option(0.0, "share of primitives that are dropped", minimum=0.0)
    other: int = option(1, "another option")


@pytest.fixture(scope="module")
def spec():
    knob = RateKnob("sparsity", (0.25, 0.5, 0.75), refit=True)
    return replace(SPEC, options=Sparse, presets={}, configurations={}, rate_knobs=(knob,))


def fitted(spec, number, **overrides):
    """All records of a fit with these settings."""
    settings = resolve(spec, "quick", overrides)
    axes = {"variant": settings.variant, "overrides": settings.overrides, "knob": settings.knob}
    return [
        one.model_copy(update={"job": one.job.model_copy(update=axes)})
        for one in version(number, number, shared=10 * number, joint=False, groups=(("a",), ("b",)))
    ]


def test_a_methods_own_knob_has_its_curve_whatever_its_name(spec):
    runs = [{}, {"sparsity": 0.5}, {"sparsity": 0.25}, {"other": 2}, {"other": 2, "sparsity": 0.5}]
    records = [one for i, run in enumerate(runs, 1) for one in fitted(spec, i, **run)]
    tables = joined(stored_tables(records))
    (found,) = curves(tables["results"]).values()
    assert [(curve.title, [point.rate for point in curve.points]) for curve in found] == [
        ("m", ["", "0.5", "0.25"]),
        ("m [other=2]", ["", "0.5"]),
    ]
    assert set(at_default_rates(tables["curve"])["variant"]) == {"", "other=2"}
    assert set(tables["results"]["knob"].dropna()) == {"sparsity"}


def test_stored_tables_are_read_as_they_were_derived(spec, tmp_path):
    stored = stored_tables(fitted(spec, 1, sparsity=0.5))
    for name, table in stored.items():
        table.to_parquet(tmp_path / f"{name}.parquet", index=False)
    for name, table in joined(stored).items():
        assert read_tables(tmp_path)[name].to_dict("list") == table.to_dict("list"), name


@pytest.mark.parametrize("path", MEASURED, ids=lambda path: path.stem)
def test_records_of_the_former_schema_have_their_settings(path):
    """Every label follows from the migrated settings, and every rate curve's knob is among them."""
    with zip_of(path) as archive:
        names = [name for name in archive.namelist() if name.startswith("jobs/fit-")]
        texts = [unsealed(archive.read(name).decode()) for name in names]
        records = [Record.model_validate_json(text) for text in texts]
    for record in records:
        job = record.job.migrated(record).job
        assert label(job.overrides) == record.job.variant
        assert job.knob in (*job.overrides, "")
        assert bool(job.knob) == any(
            knob in record.job.variant for knob in ("rate_weight", "codebook_size", "cap")
        )
        for name, value in job.overrides.items():
            assert value == record.job.options.get(name, value)


def test_a_record_of_this_schema_stays_as_it_is():
    record = version(1, 1)[0]
    assert record.schema_version == SCHEMA
    assert record.job.migrated(record) is record


def test_what_could_go_is_in_the_results_of_models_that_were_asked(spec):
    records = [one for one in fitted(spec, 1) if one.job.scenes == ("a",) or one.job.kind != "measure"]
    asked = PruningResult(gaussians=8, shares=dict.fromkeys(PRUNED, 0.5))
    plain, pruned = (
        joined(stored_tables(
            one.model_copy(update={"result": one.result.model_copy(update={"pruning": pruning})})
            if one.job.kind == "measure" else one for one in records
        ))["results"] for pruning in (None, asked)
    )  # fmt: skip
    columns = ["gaussians", *PRUNED]
    assert plain[columns].isna().all(axis=None)
    assert pruned[columns].iloc[0].tolist() == [8, 0.5, 0.5, 0.5]
