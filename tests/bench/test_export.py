"""bench export: a finished model as a file of splats, baked where plain viewers would draw it otherwise."""

from __future__ import annotations

import gzip
import os
import re
import sys
from pathlib import Path

import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.bench.commands import export
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.view.sources import found
from econgs_bench.methods.baking.bake import VIEWERS
from econgs_bench.methods.formats import ply, sog, spz

SUITE = """
title = "t"
methods = ["3dgs"]
preset = "quick"
[datasets]
"shells@16" = ["core"]
[presets.quick]
train_views = 6
test_views = 2
width = 24
height = 24
prerendered_limit = 16
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A run store with a model that is drawn as clouds, and one that is drawn as plain viewers draw."""
    folder = tmp_path_factory.mktemp("export")
    (folder / "suite.toml").write_text(SUITE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BENCH_LOCKS", str(folder / "locks"))
        patch.setenv("BENCH_CACHE", str(folder / "cache"))
        for options in ((), ("--set", "3dgs.configuration=paper", "--set", "3dgs.random_points=300")):
            command = ["run", str(folder / "suite.toml"), "--set", "3dgs.iterations=40", *options]
            assert main([*command, "--out", str(folder / "runs"), "--no-report"]) == 0
    return folder / "runs"


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """A run store that keeps its test views closed, with three scenes and their composition."""
    folder = tmp_path_factory.mktemp("closed")
    suite = SUITE.replace("train_views = 6", "train_views = 12")
    suite = suite.replace('["core"]', '["outer", "middle", "core"]').replace(
        "[datasets]", 'compositions = "all"\n[datasets]'
    )
    (folder / "suite.toml").write_text(suite)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BENCH_LOCKS", str(folder / "locks"))
        patch.setenv("BENCH_CACHE", str(folder / "cache"))
        command = ["run", str(folder / "suite.toml"), "--set", "3dgs.iterations=4", "--split", "val"]
        assert main([*command, "--out", str(folder / "runs"), "--no-report"]) == 0
    return folder / "runs"


def job(store, variant):
    """The encode job of a configuration."""
    opened = Store(store)
    records = [opened.record(path.name) for path in (store / "jobs").glob("encode-*")]
    (found,) = [one.job.id for one in records if one.job.overrides.get("configuration", "fair") == variant]
    return found


def encodes(store, scene):
    """The finished encode jobs of a scene."""
    records = Store(store).records()
    return [one for one in records if one.job.kind == "encode" and one.ok and scene in one.job.scenes]


def table(capsys):
    """The head of what was printed, and the rows: numbers and a title."""
    _, _, head, *rows = capsys.readouterr().out.splitlines()
    return head, [
        re.split(r"\s+", row.strip(), maxsplit=len(row[: row.rindex("  ")].split())) for row in rows
    ]


@pytest.mark.parametrize("form", ["ply", "spz", "sog", "glb"])
def test_each_format_is_written_and_its_cost_told(store, tmp_path, capsys, form):
    file = tmp_path / f"core.{form}"
    command = ["export", job(store, "fair"), "--runs", str(store), "--distil", "4"]
    assert main([*command, "--out", str(file)]) == 0
    head, rows = table(capsys)
    sizes = "1x 2x 4x"
    assert re.sub(" +", " ", head) == f" truth antialiased {sizes} plain {sizes} bytes primitives"
    assert [row[-1] for row in rows] == ["3dgs, as it is", "baked", "distilled, 4 iterations", str(file)]
    assert [len(row) for row in rows] == [4, 10, 10, 10]
    assert rows[-1][-3] == f"{file.stat().st_size:,}"
    psnr = [float(value) for value in rows[1][1:7]]
    assert min(psnr[:3]) > min(psnr[3:])  # baked for viewers that compensate
    assert list(tmp_path.iterdir()) == [file]
    readers = {"ply": ply, "spz": spz, "sog": sog}
    if form in readers:
        assert len(readers[form].read(file).tables["means"]) > 0


def test_a_model_that_is_plain_is_exported_as_it_is(store, tmp_path, capsys):
    file = tmp_path / "core.ply"
    command = ["export", job(store, "paper"), "--runs", str(store), "--out", str(file)]
    assert main(command) == 0
    _, (first, last) = table(capsys)
    assert first[0] == last[0]
    assert [float(value) for value in last[4:7]] == [100.0] * 3  # as high as PSNR goes
    assert main([*command, "--distil", "0", "--viewer", "antialiased"]) == 0
    _, rows = table(capsys)
    assert [row[-1] for row in rows[1:]] == ["baked", str(file)]


def test_a_page_is_written_and_its_cost_told(store, tmp_path, capsys):
    file = tmp_path / "core.html"
    assert main(["export", job(store, "fair"), "--runs", str(store), "--out", str(file)]) == 0
    *_, row, size = capsys.readouterr().out.splitlines()
    own, shown, between = (float(value) for value in row.split()[:3])
    assert abs(own - shown) < 0.01
    assert between > 60.0
    assert f"core.html: {file.stat().st_size:,} bytes" in size
    assert list(tmp_path.iterdir()) == [file]


def test_rows_of_a_report_link_to_their_models(store, tmp_path, capsys):
    capsys.readouterr()
    command = ["report", "--runs", str(store), "--out", str(tmp_path), "--models"]
    assert main(command) == 0
    pages = sorted((tmp_path / "models").iterdir())
    encoded = {f"{record.job.id}.html" for record in Store(store).records() if record.job.kind == "encode"}
    assert {page.name for page in pages} == encoded
    report = (tmp_path / "report.html").read_text()
    assert all(f"models/{name}" in report for name in encoded)
    times = [page.stat().st_mtime_ns for page in pages]
    assert main(command) == 0
    assert [page.stat().st_mtime_ns for page in pages] == times, "they were written again"
    assert "have no page" not in capsys.readouterr().err


@pytest.mark.parametrize("form", ["ply", "spz", "sog"])
@pytest.mark.parametrize("viewer", ["antialiased", "plain"])
def test_a_file_is_shown_by_the_viewers_that_it_is_for(store, tmp_path, form, viewer):
    file = tmp_path / f"core.{form}"
    more = ["--distil", "0", "--viewer", viewer, "--out", str(file)]
    assert main(["export", job(store, "fair"), "--runs", str(store), *more]) == 0
    (source,) = found([str(file)], store, (), "cpu")
    assert source.open().model.rendering.low_pass == VIEWERS[viewer]


@pytest.mark.parametrize("form", ["ply", "html"])
def test_a_store_whose_test_views_are_closed_is_exported(closed, tmp_path, capsys, form):
    (encode,) = encodes(closed, "core")
    more = ["--distil", "0", "--out", str(tmp_path / f"core.{form}")]
    assert main(["export", encode.job.id, "--runs", str(closed), *more]) == 0
    assert "val views" in capsys.readouterr().out


def test_a_scene_of_a_composition_costs_the_bytes_of_its_own_group(closed, tmp_path, capsys):
    (encode,) = encodes(closed, "core")
    (composed,) = [
        one for one in Store(closed).records() if one.job.kind == "measure" and one.job.composition
    ]
    rows = []
    for one in (encode, composed):
        more = ["--scene", "core", "--distil", "0", "--out", str(tmp_path / "core.ply")]
        assert main(["export", one.job.id, "--runs", str(closed), *more]) == 0
        rows.append(table(capsys)[1][0])
    assert rows[0][1:3] == rows[1][1:3]  # bytes and primitives


@pytest.mark.parametrize(("version", "viewer"), [(3, "plain"), (4, "antialiased")])
def test_spz_says_for_whom_it_is(store, tmp_path, version, viewer):
    file = tmp_path / "core.spz"
    more = ["--distil", "0", "--viewer", viewer, "--spz-version", str(version)]
    assert main(["export", job(store, "fair"), "--runs", str(store), *more, "--out", str(file)]) == 0
    data = file.read_bytes()
    data = gzip.decompress(data) if version == 3 else data
    assert (data[4], data[14]) == (version, viewer == "antialiased")


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--out", "x.xyz"], "its suffix names no format. Give --format, one of ply, spz, sog, glb, html"),
        (["--out", "x.ply", "--scene", "cor"], "Did you mean core"),
        (["--out", "x.html", "--scene", "cor"], "Did you mean core"),
        (
            ["--out", "x.html", "--viewer", "plain"],
            "--viewer of the format html, which draws as the model does",
        ),
        (["--out", "x.ply", "--spz-version", "4"], "x.ply: --spz-version of the format ply. Leave it out"),
    ],
)
def test_what_cannot_be_exported_is_refused(store, capsys, more, says):
    assert main(["export", job(store, "fair"), "--runs", str(store), *more]) == 2
    assert says in capsys.readouterr().err


@pytest.fixture
def untouched(monkeypatch):
    """Export fails as soon as it begins to work."""

    def loaded(*_):
        raise AssertionError("a model was loaded")

    monkeypatch.setattr(export, "load", loaded)


def test_a_target_that_cannot_be_written_is_refused_before_any_work(untouched, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe.ply")
    Path("link.ply").symlink_to("pipe.ply")
    Path("circle.ply").symlink_to("circle.ply")
    before = sorted(path.name for path in tmp_path.iterdir())
    for out, says in {
        "folder.ply": "is a folder. Name a file in it",
        "pipe.ply": "is a device or a pipe",
        "link.ply": "is a device or a pipe",
        "circle.ply": "cannot be written",
        "file/a.ply": "cannot be written",
        "-": "names no file",
    }.items():
        for form in ("ply", "html"):
            assert main(["export", "job", "--runs", "runs", "--format", form, "--out", out]) == 2
            assert f"{out}: {says}" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert (tmp_path / "pipe.ply").is_fifo()


def test_a_package_that_is_missing_is_named_before_any_work(untouched, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "gsply", None)
    assert main(["export", "job", "--runs", str(tmp_path), "--out", str(tmp_path / "a.spz")]) == 2
    assert "econgs-bench[rivals]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", ["ply", "html"])
def test_a_link_keeps_pointing_to_the_file_that_is_written(store, tmp_path, form):
    link, file = tmp_path / f"link.{form}", tmp_path / "below" / f"core.{form}"
    file.parent.mkdir()
    file.write_text("old")
    link.symlink_to(file)
    more = ["--out", str(link), *(["--distil", "0"] if form == "ply" else [])]
    assert main(["export", job(store, "fair"), "--runs", str(store), *more]) == 0
    assert link.is_symlink()
    assert file.stat().st_size > 1000
    assert list(file.parent.iterdir()) == [file]


def test_a_negative_number_of_iterations_is_refused(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["export", "job", "--out", "x.ply", "--distil", "-1"])
    assert "'-1' is not a number of at least 1" in capsys.readouterr().err


def test_a_job_that_is_not_there_is_named(store, capsys):
    assert main(["export", "encode-nothing", "--runs", str(store), "--out", "x.ply"]) == 2
    assert "is no finished encode or measure job" in capsys.readouterr().err
