"""One version of each model in the tables, however many a store holds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from econgs_bench.bench.jobs.encode import EncodeResult
from econgs_bench.bench.jobs.fit import FitResult
from econgs_bench.bench.jobs.partition import PartitionResult
from econgs_bench.bench.results.tables import build_tables, stored_tables
from econgs_bench.bench.results.versions import changes
from econgs_bench.bench.store.records import CurvePoint, Provenance, Record, Request, kind_of
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.methods.interface import MethodSpec, option
from econgs_bench.reports.comparability import notes
from econgs_bench.reports.style import label
from econgs_bench.reports.tables.means import summary
from econgs_bench.reports.tables.protocols import by_protocol
from tests.bench.conftest import measured

REQUEST = Request(train_views=12, test_views=4, width=8, height=8)
GROUPS = (("a", "b"), ("c",))
REFUSED = "options that are refused today"


@dataclass(frozen=True)
class Options:
    size: float = option(1.0, "how much", minimum=0.5)


def spec(version, **quick):
    return MethodSpec(
        name="m", title="M", reference="", version=version, implementation="m:M", uses_alpha="no",
        options=Options, presets={"quick": quick}, iterations={"quick": 1, "standard": 2, "paper": 3},
    )  # fmt: skip


def record(kind, identity, day, made_by="1", status="ok", **said):
    results = ("partition", "fit", "encode", "measure")
    job_fields = {name: value for name, value in said.items() if name not in results}
    result = {name: value for name, value in said.items() if name in results and status == "ok"}
    identity = {"kind": kind, "method": ["m", made_by], **identity}
    job = kind_of(kind)(
        kind=kind, key=hash_of(identity), identity=identity, dataset="d", dataset_name="d", request=REQUEST,
        preset="quick", method="m", **job_fields,
    )  # fmt: skip
    where = Provenance(
        machine="x", cpu="", cores=1, threads=1, memory_bytes=1, gpu=None, system="", python="", versions={},
        isa=None, commit=None, source=None,
    )  # fmt: skip
    time = f"2026-01-{day:02d}T00:00:00"
    return Record(
        job=job, status=status, started=time, finished=time, wall_seconds=1.0, provenance=where, **result
    )


def hashed(scenes):
    """Scenes with the hashes of their contents, as fits have them."""
    return [[scene, f"content of {scene}"] for scene in scenes]


def version(number, day, made_by="1", groups=GROUPS, joint=True, shared=10, failed=(), rate=None, done=True):
    """All records of a method's models of one version: each group's shared bytes and 100 per scene."""
    made = []
    scenes = tuple(scene for group in groups for scene in group)
    common = {"options": number}
    partition = record(
        "partition", {**common, "scenes": hashed(scenes)}, day, made_by, scenes=scenes,
        partition=PartitionResult(groups=[list(group) for group in groups], seconds=0.0),
    )  # fmt: skip
    if joint:
        made.append(partition)
    for group in groups:
        name = "+".join(group)
        point = CurvePoint(iteration=1, train_seconds=1.0, loss=None, psnr={}, primitives=1)
        fit = record(
            "fit",
            {**common, "scenes": hashed(group), "partition": partition.job.key if joint else None},
            day, made_by, scenes=group, group=name, needs=(partition.job.id,) if joint else (),
            fit=FitResult(seconds=60.0, iterations=1, primitives={}, train_views=12, curve=[point], resumed=0,
                          reference_seconds=None),
        )  # fmt: skip
        ledger = {"": {"net": shared}, **{scene: {"own": 100} for scene in group}}
        encode = record(
            "encode", {"fit": fit.job.key, "rate": rate}, day, made_by, scenes=group, group=name, rate=rate,
            needs=(fit.job.id,),
            encode=EncodeResult(seconds=0.0, total_bytes=shared + 100 * len(group), ledger=ledger),
        )  # fmt: skip
        made += [fit, encode]
        for scene in group if done else ():
            status = "failed" if scene in failed else "ok"
            made.append(
                record(
                    "measure", {"encode": encode.job.key, "scene": scene, "views": f"of {scene}"}, day,
                    made_by, status,
                    scenes=(scene,), group=name, rate=rate, needs=(encode.job.id,),
                    measure=measured(30.0 + number, 5),
                )
            )  # fmt: skip
    return made


@pytest.fixture
def tables_of(tmp_path):
    def make(*runs, current="1", **quick):
        store = Store(tmp_path / "s", create=True)
        for one in (one for records in runs for one in records):
            store.finish(one)
        return build_tables(store, {"m": spec(current, **quick)}, write=False)

    return make


def sizes(tables):
    return dict(zip(tables["results"]["scene"], tables["results"]["size_bytes"], strict=True))


def test_a_cell_of_two_versions_is_counted_once(tables_of):
    tables = tables_of(version(1, 1), version(2, 2, shared=30))
    assert sizes(tables) == {"a": 115, "b": 115, "c": 130}
    (mean,) = summary(tables["results"]).to_dict("records")
    assert (mean["size_bytes"], mean["train_seconds"], mean["primitives"]) == (360, 120.0, 15)
    assert tables["ledger"]["bytes"].sum() == 360
    assert len(tables["curve"]) == 3
    assert len(tables["timing"]) == 3
    assert list(tables["superseded"]["scene"]) == ["a", "b", "c"]
    assert list(tables["superseded"]["psnr"]) == [31.0] * 3
    assert any("3 rows" in note for note in notes(tables["results"], tables["superseded"]))
    assert list(tables["differences"]["quantity"]) == ["row"] * 3


def test_records_as_such_are_all_there():
    """What a bundle's tables are checked against."""
    assert len(stored_tables([*version(1, 1), *version(2, 2)])["results"]) == 6


def test_the_current_version_goes_before_a_newer_run_of_another(tables_of):
    tables = tables_of(version(1, 1, "2"), version(2, 2, "1"), current="2")
    assert list(tables["results"]["psnr"]) == [31.0] * 3
    assert list(tables["results"]["method_version"]) == ["2"] * 3
    assert not tables["results"]["stale"].any()


def test_rows_are_stale_for_their_version_and_not_for_changed_source(tables_of):
    records = version(1, 1)
    for one in records:
        one.provenance.source, one.provenance.commit = "changed", "changed"
    assert not tables_of(records)["results"]["stale"].any()
    results = tables_of(records, current="2")["results"]
    assert results["stale"].all()
    assert set(results["changes"]) == {"version 1 (today 2)"}


@pytest.mark.parametrize(
    ("options", "overrides", "changes"),
    [
        ({"size": 1.0}, {}, "size 1 (today 2)"),
        ({"size": 2.0}, {}, ""),
        ({"size": 1.0}, {"size": 1.0}, ""),
        ({"size": 2.0, "former": 3}, {}, ""),
        ({}, {}, "size 1 (today 2)"),
        ({"size": 0.1}, {"size": 0.1}, REFUSED),
        ({"size": 2.0, "former": 3}, {"former": 3}, REFUSED),
    ],
)
def test_rows_are_stale_where_their_preset_has_other_options_today(tables_of, options, overrides, changes):
    records = version(1, 1)
    for one in records:
        one.job.options, one.job.overrides = options, overrides
    results = tables_of(records, size=2.0)["results"]
    assert set(results["changes"]) == {changes}
    assert set(results["stale"]) == {bool(changes)}


@pytest.mark.parametrize(
    ("iterations", "overrides", "stress", "changes"),
    [
        (1, {}, "", ""),
        (2, {}, "", "iterations 2 (today 1)"),
        (2, {"iterations": 2}, "", ""),
        (2, {}, "budget=0.5", ""),
    ],
)
def test_rows_are_stale_where_their_preset_has_other_iterations_today(
    tables_of, iterations, overrides, stress, changes
):
    records = version(1, 1)
    for one in records:
        if one.job.kind == "fit":
            one.job.iterations, one.job.overrides, one.job.stress = iterations, overrides, stress
    assert set(tables_of(records)["results"]["changes"]) == {changes}


@dataclass(frozen=True)
class NewOptions(Options):
    points: int = option(2, "how many; older fits had one", before=1)


def test_fits_older_than_an_option_had_what_it_declares_for_them():
    today = replace(spec("1"), options=NewOptions)
    fit = next(one for one in version(1, 1) if one.job.kind == "fit")
    fit.job.options = {"size": 1.0}
    assert changes([fit], {"m": today}) == "points 1 (today 2)"
    fit.job.overrides = {"points": 1}
    assert changes([fit], {"m": today}) == ""


def test_options_of_today_go_before_a_newer_run_with_others(tables_of):
    today, newer = version(1, 1), version(2, 2)
    for records, size in ((today, 2.0), (newer, 1.0)):
        for one in records:
            one.job.options = {"size": size}
    tables = tables_of(today, newer, size=2.0)
    assert list(tables["results"]["psnr"]) == [31.0] * 3
    assert len(tables["superseded"]) == 3


def test_presets_that_a_suite_names_itself_are_compared_by_version_alone(tables_of):
    records = version(1, 1)
    for one in records:
        one.job.preset, one.job.options = "small", {"size": 1.0}
    assert not tables_of(records, size=2.0)["results"]["stale"].any()


def models(tables):
    """Method with options and grouping -> scene -> bytes."""
    found = {}
    for row in by_protocol(tables)["results"].to_dict("records"):
        found.setdefault(label(row["method"], row["variant"]), {})[row["scene"]] = row["size_bytes"]
    return found


def test_a_scene_fitted_alone_is_a_model_beside_those_fitted_together(tables_of):
    alone = version(2, 2, "2", groups=(("a",),))
    tables = tables_of(version(1, 1), alone, current="2")
    assert models(tables) == {"m": {"a": 105, "b": 105, "c": 110}, "m [scenes alone]": {"a": 110}}
    assert tables["superseded"].empty


def test_what_was_fitted_together_is_taken_whole_or_not_at_all(tables_of):
    """Of other groups of the same scenes, a scene must not stand beside two thirds of what three shared."""
    tables = tables_of(version(1, 1), version(2, 2, "2", groups=(("a",), ("b", "c"))), current="2")
    assert sizes(tables) == {"a": 110, "b": 105, "c": 105}
    assert sorted(tables["superseded"]["scene"]) == ["a", "b", "c"]


def test_a_newer_fit_of_fewer_scenes_hides_nothing(tables_of):
    tables = tables_of(version(1, 1), version(2, 2, groups=(("a",),)))
    assert models(tables)["m"] == {"a": 105, "b": 105, "c": 110}
    assert len(tables["results"]) == 4


def test_scenes_fitted_alone_are_filled_up(tables_of):
    apart = (("a",), ("b",), ("c",))
    newer = version(2, 2, "2", groups=(("a",),), joint=False)
    tables = tables_of(version(1, 1, groups=apart, joint=False), newer, current="2")
    assert list(tables["results"]["psnr"]) == [32.0, 31.0, 31.0]
    assert list(tables["results"]["stale"]) == [False, True, True]


def test_a_failure_of_the_current_version_is_not_hidden_by_an_older_success(tables_of):
    tables = tables_of(version(1, 1), version(2, 2, failed=("b",)))
    assert list(tables["results"]["status"]) == ["ok", "failed", "ok"]


def test_what_is_not_measured_yet_takes_nobodys_place(tables_of):
    tables = tables_of(version(1, 1), version(2, 2, "2", done=False), current="2")
    assert list(tables["results"]["psnr"]) == [31.0] * 3
    assert len(tables["superseded"]) == 0


def test_other_rates_of_the_same_models_stay(tables_of):
    tables = tables_of(version(1, 1), version(1, 1, rate=0.5))
    assert len(tables["results"]) == 6
    assert tables["superseded"].empty


def test_a_model_measured_twice_has_its_newest_row(tables_of):
    first = version(1, 1)
    again = []
    for one in first:
        if one.job.kind == "measure":
            identity = {**one.job.identity, "metrics": 2}
            job = one.job.model_copy(update={"identity": identity, "key": hash_of(identity)})
            again.append(one.model_copy(update={"job": job, "finished": "2026-02-01"}))
    tables = tables_of(first, again)
    assert set(tables["results"]["job"]) == {one.job.id for one in again}


def test_fewer_scenes_learned_together_are_a_model_of_their_own(tables_of):
    """Joint learning of two scenes and of three are no versions of each other."""
    part = version(1, 1, groups=(("a", "b"),))
    alone = version(3, 3, groups=(("a",), ("b",), ("c",)), joint=False)
    for one in alone:
        one.job.method = "other"
    tables = tables_of(part, version(2, 2, shared=30, groups=(("a", "b", "c"),)), alone)
    assert tables["superseded"].empty
    means = summary(by_protocol(tables)["results"]).set_index(["method", "variant"])["size_bytes"].to_dict()
    assert means == {("m", ""): 330, ("other", ""): 330, ("m", "2 scenes together"): None}
    assert set(by_protocol(tables)["ledger"]["variant"]) == {"", "2 scenes together"}


def test_a_scene_learned_alone_is_not_averaged_with_joint_models(tables_of):
    joint = version(1, 1, groups=(("a", "b", "c"),))
    same, other = version(2, 2, groups=(("a",),)), version(3, 3, groups=(("a",),))
    for one in other:
        one.job.seed = 1
    tables = tables_of(joint, same, other)
    assert tables["superseded"].empty
    found = by_protocol(tables)["results"]
    assert set(zip(found["variant"], found["psnr"], strict=True)) == {
        ("", 31.0), ("scenes alone", 32.0), ("scenes alone", 33.0),
    }  # fmt: skip
    assert sorted(tables["results"]["scenes_together"].fillna(0)) == [0, 0, 0, 1, 1]


def test_scenes_that_are_all_learned_alone_are_the_usual_models(tables_of):
    apart = [version(1, 1, groups=((scene,),)) for scene in "abc"]
    assert models(tables_of(*apart)) == {"m": {"a": 110, "b": 110, "c": 110}}


def test_other_sets_of_as_many_scenes_are_models_with_their_names(tables_of):
    two = [version(1, 1, groups=(("a", "b"),)), version(1, 2, groups=(("b", "c"),))]
    three = version(1, 3, groups=(("a", "b", "c"),))
    assert {name: set(scenes) for name, scenes in models(tables_of(*two, three)).items()} == {
        "m": {"a", "b", "c"},
        "m [2 scenes together: a, b]": {"a", "b"},
        "m [2 scenes together: b, c]": {"b", "c"},
    }
