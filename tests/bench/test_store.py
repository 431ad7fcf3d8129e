"""The store and its tables, without running anything."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import pytest

from econgs_bench.bench.jobs.costs import share
from econgs_bench.bench.jobs.encode import Encode, EncodeResult
from econgs_bench.bench.jobs.measure import Measure
from econgs_bench.bench.results.comparison import compared
from econgs_bench.bench.results.tables import build_tables, stored_tables
from econgs_bench.bench.store.records import Record, Request, derived_seed
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.methods.interface import check_ledger
from econgs_bench.reports.schema import frame, joined, read_tables

from .conftest import Bench


def _record(status: str = "ok", key: str = "0123" * 4, **changes) -> Record:
    job = Encode(
        key=key, identity={}, dataset="d", dataset_name="d", scenes=("a", "b", "c"),
        preset="quick", request=Request(train_views=1, test_views=1, width=1, height=1),
        group="a+b+c", method="m",
    )  # fmt: skip
    result = EncodeResult(seconds=1.0, total_bytes=30, ledger={"": {"net": 8}, "a": {"p": 22}})
    base = {"job": job, "started": "", "finished": "", "wall_seconds": 1.0, "encode": result}
    return Record.model_validate({**base, "status": status, **changes})


@pytest.fixture
def store(tmp_path) -> Store:
    return Store(tmp_path / "s", create=True)


@pytest.mark.parametrize(("total", "n"), [(0, 1), (7, 3), (10, 3), (11, 4), (2**53 + 1, 7)])
def test_shares_sum(total: int, n: int) -> None:
    names = [str(i) for i in range(n)]
    parts = [share(total, names, name) for name in names]
    assert sum(parts) == total
    assert max(parts) - min(parts) <= 1


def test_a_record_survives_its_file(store) -> None:
    record = _record()
    store.finish(record)
    assert Store(store.root).record(record.job.id) == record
    assert not list(store.partial.iterdir())


def test_a_record_that_was_cut_off_leaves_no_file_beside_the_next(store, monkeypatch) -> None:
    record = _record()

    def stop(*_: object) -> None:
        raise InterruptedError

    with monkeypatch.context() as killed:
        killed.setattr(os, "replace", stop)
        killed.setattr(Path, "unlink", lambda *_, **__: None)  # a killed process tidies nothing up
        with pytest.raises(InterruptedError):
            store.finish(record)
    assert len(list((store.partial / record.job.id).iterdir())) == 1
    store.finish(record)
    assert [path.name for path in (store.jobs / record.job.id).iterdir()] == ["record.json"]


def test_a_number_that_changed_in_a_record_is_damage_and_an_old_record_is_read(store) -> None:
    record = _record()
    store.finish(record)
    path = store.jobs / record.job.id / "record.json"
    text = path.read_text()
    changed = text.replace('"wall_seconds": 1', '"wall_seconds": 7')
    assert changed != text
    path.write_text(changed)
    assert Store(store.root).record(record.job.id) is None
    path.write_text(record.model_dump_json(indent=1))  # as it was before there was a checksum
    assert Store(store.root).record(record.job.id) == record


def test_a_damaged_record_blocks_nothing_and_is_kept(store, capsys) -> None:
    from econgs_bench.bench.__main__ import main

    whole, torn = _record(), _record(key="4567" * 4)
    for record in (whole, torn):
        store.finish(record)
    path = store.jobs / torn.job.id / "record.json"
    path.write_text(path.read_text()[:-40])
    (store.jobs / "notes.txt").write_text("a stray file")
    (store.jobs / "empty").mkdir()
    again = Store(store.root)
    assert list(again.records()) == [whole]
    assert again.record(torn.job.id) is None
    assert list(again.damaged) == [torn.job.id]
    assert main(["results", "--runs", str(store.root)]) == 0
    shown = capsys.readouterr().err
    assert f"{torn.job.id}: not a whole record" in shown
    assert "bench repair" in shown
    again.finish(torn)  # the job runs again
    assert list(Store(store.root).records()) == [whole, torn]
    (kept,) = (store.root / "damaged").iterdir()
    assert (kept / "record.json").is_file()
    path.write_bytes(b"\xff")
    assert main(["repair", "--runs", str(store.root)]) == 0
    assert "1 records are whole, 1 were set aside" in capsys.readouterr().out
    assert list(Store(store.root).records()) == [whole]
    assert len(list((store.root / "damaged").iterdir())) == 2


def test_a_disk_that_fills_while_tables_are_written_leaves_no_half_of_one(store, monkeypatch) -> None:
    store.finish(_record())
    (store.tables / ".results.0123").write_text("of a process that was killed")

    def full(table, path, **_) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pandas.DataFrame.to_parquet", full)
    with pytest.raises(OSError, match="No space"):
        build_tables(store)
    assert not list(store.tables.iterdir())


def test_a_store_of_another_schema_is_refused(store) -> None:
    (store.root / "store.json").write_text(json.dumps({"schema_version": 99}))
    with pytest.raises(DataError, match="schema version 99"):
        Store(store.root)


def test_runs_that_begin_together_share_a_new_store(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("os.fsync", lambda handle: time.sleep(0.05))

    def opened(delay: float) -> Store:
        time.sleep(delay)
        return Store(tmp_path / "s", create=True)

    with ThreadPoolExecutor(8) as pool:
        assert len(list(pool.map(opened, [0.01 * i for i in range(8)]))) == 8


def test_a_record_is_replaced_whole(store) -> None:
    store.finish(_record("failed"))
    store.finish(_record("ok"))
    assert store.record("encode-" + "0123" * 4).ok
    assert not list(store.partial.iterdir())


def test_keys_do_not_depend_on_order_and_refuse_nan() -> None:
    assert hash_of({"a": 1, "b": [1.5]}) == hash_of({"b": [1.5], "a": 1})
    assert hash_of({"a": 1}) != hash_of({"a": 1.5})
    with pytest.raises(ValueError, match="not JSON compliant"):
        hash_of({"a": float("nan")})


def test_seeds_depend_on_each_axis() -> None:
    seeds = {
        derived_seed(*axes) for axes in [("fit", "m", 0), ("fit", "m", 1), ("fit", "n", 0), ("cloud", "m", 0)]
    }
    assert len(seeds) == 4
    assert all(0 <= seed < 2**31 for seed in seeds)
    assert derived_seed("fit", "m", 0) == derived_seed("fit", "m", 0)


@pytest.mark.parametrize(
    ("ledger", "words"),
    [
        ({"": {"x": 9}}, "sums to 9 bytes, the saved files have 10"),
        ({"z": {"x": 10}}, "not in the group: z"),
        ({"a": {"x": 11, "y": -1}}, "negative entries: a/y"),
    ],
)
def test_wrong_ledgers(ledger, words: str) -> None:
    with pytest.raises(RuntimeError, match=words):
        check_ledger(ledger, 10, ("a",))


def test_rows_stand_in_the_order_people_expect() -> None:
    def measured(scene: str, seed: int, rate: float | None) -> Record:
        own = {"kind": "measure", "key": hash_of([scene, seed, rate]), "scenes": (scene,), "seed": seed}
        job = Measure.model_validate(_record().job.model_dump() | own | {"rate": rate})
        return _record("failed", encode=None, job=job)

    rows = [("core", 0, None), ("jet", 2, None), ("jet", 10, None), ("tf2", 0, None), ("tf2", 0, 0.5),
              ("tf2", 0, 10.0), ("tf10", 0, None)]  # fmt: skip
    tables = joined(stored_tables(measured(*axes) for axes in reversed(rows)))
    cells = tables["results"][["scene", "seed", "rate"]].itertuples(index=False, name=None)
    assert [(scene, seed, None if pd.isna(rate) else rate) for scene, seed, rate in cells] == rows


def _views(psnr: list[float], rate=None, **more) -> pd.DataFrame:
    return frame(
        "views",
        [
            {"dataset": "d", "scene": "a", "method": "m", "variant": "", "rate": rate, "preset": "quick",
             "split": "test", "seed": 0, "view": str(i), "psnr": p, "job": "j", "truth": "t-1",
             "metric_versions": '{"psnr": "1"}', **more}
            for i, p in enumerate(psnr)
        ],
    )  # fmt: skip


@pytest.mark.parametrize("rate", [None, 0.5])
def test_views_are_paired(rate) -> None:
    table = compared(_views([30.0, 31.0, 32.0], rate), _views([31.0, 31.0], rate))
    (row,) = table.to_dict("records")
    assert (row["metric"], row["views"], row["first"], row["second"]) == ("psnr", 2, 30.5, 31.0)
    assert (row["difference"], row["least"], row["greatest"]) == (0.5, 0.0, 1.0)
    assert compared(_views([30.0], 1.0), _views([30.0], 2.0)).empty


def test_fits_from_other_numbers_of_training_views_are_not_paired() -> None:
    few, many = (_views([psnr], None, requested_views=count) for psnr, count in ((20.0, 6), (30.0, 42)))
    assert compared(few, many).empty
    both = pd.concat([few, many], ignore_index=True)
    assert compared(both, both)["difference"].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"truth": "u-1"}, "truth differs"),
        ({"truth": None}, "not known"),
        ({"metric_versions": '{"psnr": "2"}'}, "psnr: version of the metric 1"),
    ],
)
def test_views_of_another_truth_or_metric_are_not_paired(change, words) -> None:
    table = compared(_views([30.0]), _views([31.0], **change))
    assert table.empty
    (line,) = table.attrs["differences"]
    assert words in line


def test_fewer_measured_views_are_paired_on_those_that_both_have() -> None:
    assert list(compared(_views([30.0, 31.0]), _views([30.5], truth="t-2"))["views"]) == [1]


def test_another_renderer_of_the_truth_is_named() -> None:
    table = compared(_views([30.0], renderer="mitsuba"), _views([31.0], renderer="reference"))
    assert list(table["difference"]) == [1.0]
    assert "mitsuba" in table.attrs["differences"][0]


def test_merge_joins_and_prefers_success(finished, inside, tmp_path) -> None:
    bench = finished
    other = Bench(tmp_path / "other", bench.dataset)
    other.store.parent.mkdir()
    other.run("--seed", "1", scenes=("a",))
    failed = other.store / "failed"
    shutil.copytree(bench.store, failed)
    store = Store(failed)
    (fit,) = [r for r in store.records() if r.job.kind == "fit"]
    store.finish(fit.model_copy(update={"status": "failed", "reason": "elsewhere", "result": None}))

    merged = tmp_path / "all"
    bench("merge", failed, bench.store, other.store, "--out", merged)
    records = list(Store(merged).records())
    assert all(r.ok for r in records)
    assert len(records) == 4 + 3  # the views job is common
    tables = read_tables(merged / "tables")
    table = tables["results"]
    assert list(table["seed"]) == [0, 1]
    views = tables["views"]
    assert all((merged / file).is_file() for file in [*views["truth_file"], *views["render_file"]])

    same = bench("compare", merged, merged)
    assert "psnr" in same.stdout
    assert "rate" not in same.stdout  # nobody has one
    written = bench("compare", merged, merged, "--format", "md")
    assert "| Metric | Views | First | Second | Difference |" in written.stdout
    apart = bench("compare", bench.store, other.store, code=2)
    assert "no view in common" in apart.stderr
