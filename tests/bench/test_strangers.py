"""Stores and bundles that a stranger made: they lead nowhere, and take no more than their size allows."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import zipfile
from hashlib import sha256

import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.bench.results.bundle import MANIFEST, write_bundle
from econgs_bench.bench.store.records import Record
from econgs_bench.bench.store.store import Store, read_record
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.seals import sealed, unsealed
from tests.bench.test_bundle import resigned, rewritten

LEAD_OUT = (
    "x/../../../victim",
    "../victim",
    "0123456789abcdef/..",
    "0123456789ABCDEF",
    "0123456789abcdef\n",
    "",
)


def changed(path, change) -> None:
    """A record with other values, and a checksum that fits."""
    record = json.loads(unsealed(path.read_text()))
    change(record)
    path.write_text(sealed(json.dumps(record)))


def files_of(folder):
    """Files -> bytes, symbolic links -> where they lead."""
    return {
        path.relative_to(folder): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in folder.rglob("*")
        if path.is_symlink() or path.is_file()
    }


@pytest.mark.parametrize("key", LEAD_OUT)
@pytest.mark.parametrize("field", ["key", "needs", "cause"])
def test_names_that_lead_out_of_a_store_make_no_job(finished, field, key) -> None:
    (record,) = finished.of_kind("measure")
    values = json.loads(record.model_dump_json())
    if field == "key":
        values["job"]["key"] = key
    elif field == "needs":
        values["job"]["needs"] = [f"views-{key}"]
    else:
        values["cause"] = f"fit-{key}"
    with pytest.raises(ValueError, match=r"String should match pattern"):
        Record.model_validate(values)


@pytest.mark.parametrize(
    "name", ["../../secret.png", "/etc/passwd", "a/b.png", "..\\b.png", "key.pem", ".\n.png"]
)
def test_truth_lies_in_the_folder_of_its_job(finished, name) -> None:
    (record,) = finished.of_kind("views")
    values = json.loads(record.model_dump_json())
    values["views"]["truth"]["test"][0] = name
    with pytest.raises(ValueError, match=r"String should match pattern"):
        Record.model_validate(values)


def failed_elsewhere(record) -> None:
    record["status"], record["cause"], record["job"]["key"] = (
        "failed",
        "views-" + "0" * 16,
        "x/../../../victim",
    )


def failed_as_another(record) -> None:
    record["status"], record["job"]["key"] = "failed", "0" * 16


@pytest.mark.parametrize("lie", [failed_elsewhere, failed_as_another])
def test_a_record_that_lies_about_its_place_is_damaged_and_moves_nothing(finished, tmp_path, lie) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "letter").write_text("dear")
    (views,) = finished.of_kind("views")
    folder = finished.store / "jobs" / views.job.id
    changed(folder / "record.json", lie)
    (finished.store / "partial" / "views-x").mkdir()  # what the path would lead through
    before = files_of(victim)
    store = Store(finished.store)
    assert store.record(views.job.id) is None
    assert views.job.id in store.damaged
    with pytest.raises(DataError, match="not a whole record"):
        read_record(folder / "record.json")
    if lie is failed_elsewhere:
        finished.run("--retry")
        assert files_of(victim) == before
        assert Store(finished.store).record(views.job.id).ok


# --------------------------------------------------------------------------- links

LINKS = {
    "a file of a model": "jobs/{encode}/model/weights.bin",
    "a folder of jobs": "jobs/views-x",
    "all jobs": "jobs",
    "partial": "partial",
    "a log": "partial/{fit}/log.txt",
    "locks": "locks",
    "tables": "tables",
    "ladders": "ladders.json",
    "the marker": "store.json",
    "studies": "studies",
    "damaged": "damaged",
}
COMMANDS = {
    "results": ("results", "--runs", "{store}"),
    "report": ("report", "--runs", "{store}"),
    "bundle": ("bundle", "--runs", "{store}", "--out", "{out}/b.zip", "--models"),
    "merge": ("merge", "{store}", "--out", "{out}/merged"),
    "merge into": ("merge", "{other}", "--out", "{store}"),
    "compare": ("compare", "{store}", "{other}"),
    "repair": ("repair", "--runs", "{store}"),
    "run": ("run", "quick", "--dataset", "{dataset}", "--scene", "a", "--method", "3dgs", "--out", "{store}"),
    "baseline": ("baseline", "{store}", "--out", "{out}/b.toml", "--reason", "none"),
    "render": ("render", "{dataset}", "--runs", "{store}", "--model", "{measure}"),
    "export": ("export", "{encode}", "--runs", "{store}", "--out", "{out}/e.ply"),
}


@pytest.fixture
def linked(finished, tmp_path):
    """Makes a link at a place of a finished store; everything outside of it; the words of a command."""
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "old-photos").mkdir()
    (outside / "old-photos" / "sea.jpg").write_bytes(b"waves")
    (outside / "id_rsa").write_text("a private key")
    shutil.copytree(finished.store, tmp_path / "other")
    jobs = {kind: finished.of_kind(kind)[0].job.id for kind in ("encode", "fit", "measure")}
    names = {
        **jobs, "store": finished.store, "other": tmp_path / "other", "out": tmp_path / "out",
        "dataset": finished.dataset,
    }  # fmt: skip
    (tmp_path / "out").mkdir()

    def link(place):
        path = finished.store / place.format(**jobs)
        path.parent.mkdir(parents=True, exist_ok=True)
        target = outside / "id_rsa" if path.suffix else outside
        if path.is_dir():
            shutil.move(path, outside / path.name)
            target = outside / path.name
        path.unlink(missing_ok=True)
        path.symlink_to(target)
        return path

    return link, outside, lambda words: [word.format(**names) for word in words]


@pytest.mark.parametrize("place", LINKS.values(), ids=LINKS)
def test_a_store_with_a_link_is_not_opened(linked, finished, place) -> None:
    link, _, _ = linked
    path = link(place)
    with pytest.raises(DataError) as info:
        Store(finished.store)
    assert str(path.relative_to(finished.store)) in info.value.reason


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_every_command_refuses_a_store_with_a_link(linked, finished, command, capsys) -> None:
    link, outside, words = linked
    link("jobs/{encode}/model/weights.bin")
    before = files_of(outside)
    assert main(words(command)) == 2
    assert "symbolic link" in capsys.readouterr().err
    assert files_of(outside) == before
    assert not list((outside.parent / "out").rglob("*"))


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_what_never_ends_is_not_read(finished, tmp_path, monkeypatch, kind) -> None:
    place = finished.store / "jobs" / "fit-0123456789abcdef"
    place.mkdir()
    if kind == "pipe":
        os.mkfifo(place / "record.json")
    else:
        monkeypatch.chdir(place)  # paths of sockets are short
        socket.socket(socket.AF_UNIX).bind("record.json")
    with pytest.raises(DataError, match="pipe, socket or device"):
        Store(finished.store)


def test_a_store_behind_a_link_and_hard_links_in_it_are_as_good_as_others(finished, tmp_path) -> None:
    (tmp_path / "link").symlink_to(finished.store)
    (file,) = finished.store.glob("jobs/measure-*/record.json")
    os.link(file, tmp_path / "second name")
    assert len(list(Store(tmp_path / "link").records())) == 4


# --------------------------------------------------------------------------- bombs


@pytest.fixture(scope="module")
def packed(_finished_store, tmp_path_factory):
    path = tmp_path_factory.mktemp("bundle") / "mine.zip"
    write_bundle(Store(_finished_store), path, models=True)
    return path


def deflated(files, out):
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out


def record_of(files):
    return next(name for name in files if name.startswith("jobs/fit-"))


def many_values(files) -> None:
    values = json.loads(unsealed(files[record_of(files)].decode()))
    text = json.dumps(values)
    files[record_of(files)] = sealed(
        text.replace('"identity": {', '"identity": {"x": [' + "[]," * 8_000_000 + "0],")
    ).encode()


def nested(files) -> None:
    values = json.loads(unsealed(files[record_of(files)].decode()))
    text = json.dumps(values).replace('"identity": {', '"identity": {"x": ' + "[" * 5000 + "]" * 5000 + ",")
    files[record_of(files)] = sealed(text).encode()


def zeros(files) -> None:
    name = next(name for name in files if "/model/" in name)
    files[name] = bytes(200 << 20)


def figures(files) -> None:
    values = json.loads(unsealed(files[record_of(files)].decode()))
    values["wall_seconds"], values["job"]["request"]["train_views"] = 1e308, 999_999_999
    files[record_of(files)] = sealed(json.dumps(values)).encode()


def columns(files) -> None:
    name = next(name for name in files if name.endswith("results.csv"))
    head, _, rest = files[name].partition(b"\n")
    files[name] = b",".join([head.split(b",")[0]] * 3_000_000) + b"\n" + rest


def cells(files) -> None:
    name = next(name for name in files if name.endswith("jobs.csv"))
    files[name] = files[name].partition(b"\n")[0] + b"\n" + b"ab," * (20 << 20)


def ladders(files) -> None:
    files["ladders.json"] = json.dumps([{"name": "a", "title": "", "rungs": [{}] * 300_000}]).encode()


def many_metrics(files) -> None:
    name = next(name for name in files if name.startswith("jobs/measure-"))
    values = json.loads(unsealed(files[name].decode()))
    values["measure"]["metrics"] = {f"m{number}": 1.0 for number in range(200_000)}
    values["measure"]["views"] *= 20_000
    files[name] = sealed(json.dumps(values)).encode()


def manifest_values(files) -> None:
    files[MANIFEST] = b'{"format": 1, "environments": [' + b"{}," * 10_000_000 + b"{}]}"


def manifest_depth(files) -> None:
    files[MANIFEST] = b"[" * 100_000


def manifest_length(files) -> None:
    files[MANIFEST] = b" " * (100 << 20)


BOMBS = (
    many_values,
    nested,
    zeros,
    figures,
    columns,
    cells,
    ladders,
    many_metrics,
    manifest_values,
    manifest_depth,
    manifest_length,
)


@pytest.mark.parametrize(
    ("command", "bomb"), [*(("verify", bomb) for bomb in BOMBS), ("merge", manifest_depth)]
)
def test_a_small_bundle_takes_little_memory(packed, tmp_path, command, bomb) -> None:
    with zipfile.ZipFile(packed) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    bomb(files)
    if not bomb.__name__.startswith("manifest"):
        resigned(files)
    path = deflated(files, tmp_path / "bomb.zip")
    assert path.stat().st_size < 1 << 20
    code = (
        "import resource, sys; from econgs_bench.bench.__main__ import main\n"
        "import econgs_bench.bench.results.bundle, pandas, econgs_bench.bench.results.tables\n"
        "size = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize() + (500 << 20)\n"
        "resource.setrlimit(resource.RLIMIT_AS, (size, size)); sys.exit(main(sys.argv[1:]))"
    )
    arguments = ["verify", path] if command == "verify" else ["merge", path, "--out", tmp_path / "all"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        encoding="utf-8",
        timeout=60,
        check=False,
    )
    assert done.returncode in (1, 2), done.stderr
    assert done.stderr.startswith("bench: "), done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "all" / "jobs").exists() or not list((tmp_path / "all" / "jobs").iterdir())


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA], ids=["bzip2", "lzma"])
@pytest.mark.parametrize("name", [MANIFEST, "store.json"])
def test_what_unpacks_without_bound_is_refused_unread(packed, tmp_path, method, name) -> None:
    with zipfile.ZipFile(packed) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for other, data in files.items():
            archive.writestr(other, data, method if other == name else zipfile.ZIP_DEFLATED)
    from econgs_bench.bench.results.bundle import verify_bundle

    with pytest.raises(DataError, match="neither stored nor deflated"):
        verify_bundle(path)


NUMBERS = (
    ("measure", '"psnr": ', "Infinity"),
    ("measure", '"frame_seconds": ', "NaN"),
    ("measure", '"primitives": ', "-5"),
    ("fit", '"seconds": ', "1e999"),
    ("fit", '"seconds": ', "-1E+400"),
    ("fit", '"loss": ', "-Infinity"),
    ("fit", '"iterations": ', "9" * 400),
    ("fit", '"iterations": ', str(2**63)),
    ("encode", '"total_bytes": ', "9" * 30),
)


@pytest.mark.parametrize(("kind", "key", "number"), NUMBERS)
def test_numbers_that_no_table_holds_make_no_record(finished, kind, key, number) -> None:
    (path,) = finished.store.glob(f"jobs/{kind}-*/record.json")
    values = json.dumps(json.loads(unsealed(path.read_text())))
    text = re.sub(re.escape(key) + r"[-\d.e]+", key + number, values)
    assert text != values
    path.write_text(sealed(text))
    with pytest.raises(DataError, match="not a whole record"):
        read_record(path)


def test_words_of_numbers_in_texts_are_texts(finished) -> None:
    (path,) = finished.store.glob("jobs/fit-*/record.json")
    changed(path, lambda record: record.update(reason="loss is NaN, 1e999, Infinity"))
    assert read_record(path).reason == "loss is NaN, 1e999, Infinity"


@pytest.mark.parametrize("kind", ["EPS", "PSD", "bomb"])
def test_a_stored_picture_is_a_png_of_bounded_size(finished, tmp_path, kind) -> None:
    """Pillow starts Ghostscript for EPS, whatever the name of the file."""
    from PIL import Image

    from econgs_bench.datasets.png import read_png
    from econgs_bench.reports.pictures.files import read

    path = next(finished.store.glob("jobs/measure-*/renders/*.png"))
    if kind == "EPS":
        Image.new("RGB", (8, 8)).save(path, "EPS")
    elif kind == "PSD":
        path.write_bytes(b"8BPS" + struct.pack(">H6xHIIHH", 1, 3, 8, 8, 8, 3) + bytes(400))
    else:
        Image.new("1", (20_000, 20_000)).save(path, "PNG")
    with pytest.raises((ValueError, OSError)):
        read(path, (0.0, 0.0, 0.0))
    if kind != "bomb":
        with pytest.raises(DataError, match="cannot be read as a picture"):
            read_png(path)
    else:
        assert main(["report", "--runs", str(finished.store)]) == 0


def test_stored_truth_takes_no_more_than_its_file_allows(finished) -> None:
    from econgs_bench.bench.jobs.truth import Truth

    (folder,) = (path.parent for path in finished.store.glob("jobs/views-*/record.json"))
    changed(
        folder / "views.json",
        lambda index: index["splits"]["test"]["pictures"].update(shape=[4, 10**6, 10**6, 4]),
    )
    with pytest.raises(DataError, match="cannot be read"):
        Truth(folder).views("test")


@pytest.mark.parametrize(
    "name",
    [
        "../out",
        "/out",
        "jobs/../../out",
        "a\\..\\out",
        "C:out",
        "jobs//out",
        "jobs/./out",
        "a\nb",
        "a\x1b[2J",
    ],
)
def test_no_file_of_a_bundle_leads_out_of_it(packed, tmp_path, name) -> None:
    def add(files):
        files[name] = b"payload"
        resigned(files)

    from econgs_bench.bench.results.bundle import unpack

    folder = tmp_path / "here" / "unpacked"
    folder.mkdir(parents=True)
    problems = unpack(rewritten(packed, tmp_path, add), folder).problems
    assert any("leads out" in line for line in problems)
    assert not list(folder.iterdir())
    assert not (tmp_path / "here" / "out").exists()


def test_the_bytes_that_are_hashed_are_those_that_are_unpacked(packed, tmp_path) -> None:
    from econgs_bench.bench.results.bundle import unpack

    (tmp_path / "unpacked").mkdir()
    assert unpack(packed, tmp_path / "unpacked").problems == []
    with zipfile.ZipFile(packed) as archive:
        listed = json.loads(archive.read(MANIFEST))["files"]
    hashes = {
        path.relative_to(tmp_path / "unpacked").as_posix(): sha256(path.read_bytes()).hexdigest()
        for path in (tmp_path / "unpacked").rglob("*")
        if path.is_file()
    }
    assert hashes == {name: entry["sha256"] for name, entry in listed.items()}
