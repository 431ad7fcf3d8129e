"""Submission bundles: what is handed in can be checked, and what was changed is found."""

from __future__ import annotations

import csv
import io
import json
import lzma
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from econgs_bench.bench.results.bundle import MANIFEST, verify_bundle, write_bundle
from econgs_bench.bench.results.tables import stored_tables
from econgs_bench.bench.store.records import Task
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.seals import sealed, unsealed

from .conftest import suite_file


def rows(root):
    """Table -> its rows, of a store's folder; without the time of jobs, as views may be made again."""
    tables = stored_tables(Store(root).records())
    return {
        name: table.drop(columns="finished", errors="ignore").to_dict("records")
        for name, table in tables.items()
    }


@pytest.fixture
def packed(finished, tmp_path_factory):
    path = tmp_path_factory.mktemp("bundle") / "mine.zip"
    assert write_bundle(Store(finished.store), path, models=True) == len(finished.records())
    return path


def rewritten(path, folder, change):
    """The bundle with its files (name -> bytes) and its manifest changed."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    change(files)
    out = folder / "changed.zip"
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out


def resigned(files):
    """Hashes made anew, as one would who wants a change not to be seen."""
    import hashlib

    manifest = json.loads(files[MANIFEST])
    manifest["files"] = {
        name: {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
        for name, data in files.items()
        if name != MANIFEST
    }
    files[MANIFEST] = json.dumps(manifest).encode()


def first(files, start, end):
    return next(name for name in files if name.startswith(start) and name.endswith(end))


def test_a_bundle_holds_and_can_be_reported_on(packed, finished, tmp_path):
    assert verify_bundle(packed) == []
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(tmp_path)
        assert not [name for name in archive.namelist() if name.endswith(".png")]
    assert rows(tmp_path) == rows(finished.store)


def test_print_options_of_other_libraries_leave_tables_as_they_are(packed):
    import numpy as np

    before = np.get_printoptions()
    try:
        np.set_printoptions(legacy="1.13")  # what colour-science does when it is imported
        assert verify_bundle(packed) == []
    finally:
        np.set_printoptions(**before)


def test_bundles_are_merged_like_stores(bench, inside, packed, finished, tmp_path):
    bench("merge", packed, "--out", tmp_path / "all")
    assert rows(tmp_path / "all") == rows(finished.store)
    # A bundle lacks the jobs' files: the disk that they need cannot be estimated.
    output = bench.plan("c", tmp_path / "new", "--like", tmp_path / "all")
    assert re.search(r"4 to do, about .*, unknown room on disk, [1-9]\d* MiB of memory\n", output), output
    bad = rewritten(packed, tmp_path, lambda files: files.pop("store.json"))
    refusal = bench("merge", bad, "--out", tmp_path / "none", code=2).stderr
    assert "does not hold: store.json: missing" in refusal


@pytest.fixture
def unpacked(bench, inside, finished, tmp_path):
    """A store that has the finished one's records alone."""
    path = tmp_path / "numbers.zip"
    write_bundle(Store(finished.store), path)
    bench("merge", path, "--out", tmp_path / "all")
    bench.store = tmp_path / "all"
    return bench


def test_a_run_into_an_unpacked_bundle_makes_the_views_that_it_needs_again(unpacked):
    before = rows(unpacked.store)
    done = unpacked.run("--seed", 1)
    assert re.search(r"\] views .*\n.*  ok after", done.stderr), done.stderr
    after = rows(unpacked.store)
    assert [row["status"] for row in after["results"]] == ["ok", "ok"]
    for name in ("jobs", "results"):
        assert [row for row in after[name] if row in before[name]] == before[name]
    assert len(list(unpacked.store.glob("jobs/fit-*/checkpoint"))) == 1


def test_what_was_made_of_files_that_are_not_there_stays_as_it_is(unpacked, tmp_path):
    before = rows(unpacked.store)
    done = unpacked.run_suite(suite_file(tmp_path, f'"{unpacked.dataset}" = ["a"]', "sampled = 2"), code=1)
    assert re.search(r"not run: encode-\w+ came from a bundle, .*run into a new store \(--out\)", done.stderr)
    assert rows(unpacked.store) == before


def test_views_that_cannot_be_made_again_leave_their_record(unpacked):
    store = Store(unpacked.store)
    (views,) = unpacked.of_kind("views")
    folder = store.partial / views.job.id
    folder.mkdir()
    (folder / "job.json").write_text(Task(job=views.job, threads=1).model_dump_json())
    script = (
        "import sys, pathlib, econgs_bench.bench.run.worker as w;"
        "from econgs_bench.bench.store.store import Store;"
        "f = pathlib.Path(sys.argv[1]);"
        "r = Store(f.parent.parent).record(f.name); change = {'status': 'failed', 'reason': 'no volume'};"
        "w.run = lambda *a: r.model_copy(update=change); sys.exit(w.main(f))"
    )
    done = subprocess.run([sys.executable, "-c", script, str(folder)], env=unpacked.environment, check=False,
                          capture_output=True, encoding="utf-8")  # fmt: skip
    assert (done.returncode, done.stdout.strip()) == (1, "no volume"), done.stderr
    assert Store(unpacked.store).record(views.job.id) == views


def test_bundles_made_before_a_column_came_in_still_hold(packed, tmp_path):
    def older(files):
        table = csv.reader(io.StringIO(files["tables/results.csv"].decode()))
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(row[:-1] for row in table)
        files["tables/results.csv"] = text.getvalue().encode()
        resigned(files)

    def newer(files):
        head, _, rest = files["tables/results.csv"].decode().partition("\n")
        files["tables/results.csv"] = f"{head},dreamt\n{rest}".encode()
        resigned(files)

    assert verify_bundle(rewritten(packed, tmp_path, older)) == []
    assert verify_bundle(rewritten(packed, tmp_path, newer)) == [
        "tables/results.csv: does not follow from the records"
    ]


def test_the_command_says_what_does_not_hold(bench, inside, packed, tmp_path):
    assert bench("verify", packed).stdout.rstrip() == f"{packed}: all of it holds"
    changed = rewritten(packed, tmp_path, lambda files: files.pop(first(files, "tables/", ".csv")))
    assert "missing" in bench("verify", changed, code=1).stderr


def with_record(kind, change):
    """Change the record of a kind of job."""

    def changed(files):
        name = first(files, f"jobs/{kind}-", "record.json")
        record = json.loads(unsealed(files[name].decode()))
        change(record)
        files[name] = sealed(json.dumps(record)).encode()
        resigned(files)

    return changed


better_quality = with_record("measure", lambda record: record["measure"]["metrics"].update(psnr=99.0))
other_options = with_record("fit", lambda record: record["job"]["identity"].update(iterations=1))


def smaller_model(files):
    name = next(name for name in files if "/model/" in name)
    files[name] = files[name][:-1]
    resigned(files)


def longer_model(files):
    files[next(name for name in files if "/model/" in name)] += b"x"


def extra(files):
    files["more.txt"] = b"?"


def outside(files):
    files["../out.txt"] = b"?"
    resigned(files)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (better_quality, "tables/results.csv: does not follow from the records"),
        (other_options, "its name does not follow from what it ran"),
        (smaller_model, "bytes of model"),
        (longer_model, "bytes instead of"),
        (extra, "more.txt: not in bundle.json"),
        (outside, "leads out of the bundle"),
    ],
)
def test_changes_are_found(packed, tmp_path, change, words):
    problems = verify_bundle(rewritten(packed, tmp_path, change))
    assert any(words in problem for problem in problems), problems
    assert not (tmp_path.parent / "out.txt").exists()


def test_texts_beyond_any_bundle_are_refused_unread(packed, tmp_path, monkeypatch):
    def longer(files):
        name = first(files, "jobs/fit-", "record.json")
        files[name] += b" " * 100_000
        resigned(files)

    path = rewritten(packed, tmp_path, longer)
    monkeypatch.setattr("econgs_bench.bench.results.bundle.LONGEST", 100_000)
    (problem,) = verify_bundle(path)
    assert re.fullmatch(r"jobs/fit-\w+/record.json: \d+ bytes, more than any has", problem)
    monkeypatch.setattr("econgs_bench.bench.results.bundle.LONGEST", 100)
    with pytest.raises(DataError, match=r"is no bundle \(bundle.json: \d+ bytes, more than any has\)"):
        verify_bundle(path)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0.0, 1.0), cut=st.booleans())
@pytest.mark.parametrize("suffix", ["", ".xz"])
def test_damage_is_a_named_error_or_a_named_problem(packed, tmp_path, place, cut, suffix):
    data = bytearray(lzma.compress(packed.read_bytes()) if suffix else packed.read_bytes())
    at = min(int(place * len(data)), len(data) - 1)
    if cut:
        del data[at:]
    else:
        data[at] ^= 0x41
    path = tmp_path / f"damaged.zip{suffix}"
    path.write_bytes(data)
    try:
        problems = verify_bundle(path)
    except DataError:
        return
    # A flipped bit may hit what zip says twice (times, attributes): then nothing that counts has changed.
    assert not cut
    assert all(problems)


def test_a_bundle_in_xz_is_smaller_and_holds_the_same(finished, packed, tmp_path):
    pressed = tmp_path / "mine.zip.xz"
    write_bundle(Store(finished.store), pressed, models=True)
    assert pressed.stat().st_size < packed.stat().st_size
    assert verify_bundle(pressed) == []
    with (
        zipfile.ZipFile(packed) as own,
        zipfile.ZipFile(io.BytesIO(lzma.decompress(pressed.read_bytes()))) as plain,
    ):
        assert plain.testzip() is None
        assert {name: plain.read(name) for name in plain.namelist()} == {
            name: own.read(name) for name in own.namelist()
        }


LARGE = [{"id": lzma.FILTER_LZMA2, "dict_size": 192 << 20, "mf": lzma.MF_HC3, "nice_len": 8}]


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (lambda: lzma.compress(bytes(80 << 20)), "holds more than 67108864 bytes"),
        (lambda: lzma.compress(b"a", filters=LARGE), "[Mm]emory"),
        (lambda: lzma.compress(b"a")[:-9], "was cut"),
        (lambda: lzma.compress(b"a") * 2, "followed by other bytes"),
        (lambda: lzma.compress(b"a"), "not a zip file"),
    ],
    ids=["bomb", "memory", "cut", "more", "no zip"],
)
def test_streams_of_xz_that_are_no_bundle_are_refused(tmp_path, made, reason):
    path = tmp_path / "a.zip.xz"
    path.write_bytes(made())
    with pytest.raises(DataError, match=f"cannot be read as a bundle.*{reason}"):
        verify_bundle(path)


def test_what_is_no_bundle_is_refused(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        verify_bundle(tmp_path / "none.zip")
    empty = tmp_path / "empty.zip"
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("a.txt", "a")
    with pytest.raises(DataError, match="is no bundle"):
        verify_bundle(empty)
    with pytest.raises(DataError, match="holds no finished job"):
        write_bundle(Store(tmp_path / "runs", create=True), tmp_path / "out.zip")
    assert not (tmp_path / "out.zip").exists()


MEASURED = sorted((Path(__file__).resolve().parents[2] / "reports" / "measured").rglob("*.zip.xz"))


@pytest.mark.parametrize("path", MEASURED, ids=lambda path: path.stem)
def test_the_committed_bundles_still_follow_from_their_records(path):
    assert verify_bundle(path) == []


def test_there_are_committed_bundles():
    assert MEASURED
