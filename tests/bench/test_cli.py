"""The command line: what it prints, how it fails, and what it does not import."""

from __future__ import annotations

import csv
import errno
import gzip
import io
import os
import re
import subprocess
import sys
from importlib.metadata import version
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from econgs_bench.bench.__main__ import COMMANDS, main
from econgs_bench.bench.commands.run import _state
from econgs_bench.bench.run.display import Display
from econgs_bench.bench.run.experiment import _announce
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth import probe
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.datasets.png import read_png
from econgs_bench.reports.comparability import replaced
from tests.datasets.views_folder import random_views

LISTS = ("methods", "datasets", "suites", "metrics")


@pytest.mark.parametrize("what", LISTS)
def test_lists_start_without_heavy_imports(bench, what: str) -> None:
    code = (
        "import sys; from econgs_bench.bench.__main__ import main; main(['list', sys.argv[1]]);"
        "heavy = {'torch', 'pandas', 'scipy', 'mitsuba', 'matplotlib', 'optuna', 'pydantic', 'rich'};"
        "heavy &= set(sys.modules);"
        "assert not heavy, heavy"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, what],
        env=bench.environment,
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert {"methods": "3dgs", "datasets": "vortices", "suites": "quick", "metrics": "psnr"}[
        what
    ] in done.stdout


@pytest.mark.parametrize("columns", [80, 120])
@pytest.mark.parametrize("what", LISTS)
@pytest.mark.parametrize("data", [True, False])
def test_lists_have_heads_and_fit(monkeypatch, capsys, what: str, columns: int, data: bool) -> None:
    if not data:
        monkeypatch.delenv("BENCH_DATA", raising=False)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert main(["list", what]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split()[0] == "Name"
    assert set(head) > set("Name ")
    assert max(map(len, lines)) <= columns


@pytest.mark.parametrize("columns", [80, 120])
@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("methods fake sz3", ("A color", "palette", "digits", "SZ3: A Modular Framework", "1e-06")),
        ("datasets vortices", ("cores, sheaths, halos, walls", "built in")),
        ("suites quick unseen-data", ("3dgs", "Seeds     0, 1, 2", "engine_ct")),
        ("metrics psnr_fg", ("dB", "higher", "alpha of truth or model")),
    ],
)
def test_what_is_known_of_names_is_listed(bench, monkeypatch, capsys, what: str, columns: int, words) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert main(["list", *what.split(), "--plugins", str(bench.plugins)]) == 0
    text = capsys.readouterr().out
    assert [name for name in what.split()[1:] if f"Name  {name}" not in re.sub(" +", "  ", text)] == []
    assert [word for word in words if word not in text and word not in " ".join(text.split())] == []
    assert max(map(len, text.splitlines())) <= columns


@pytest.mark.parametrize("what", LISTS)
def test_unknown_names_are_refused(what: str, capsys) -> None:
    assert main(["list", what, "no-such"]) == 2
    printed = capsys.readouterr()
    assert "no-such" in printed.err
    assert "Known: " in printed.err
    assert printed.out == ""


def test_no_command_prints_the_help(monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.argv", ["bench"])
    assert main() == 2
    printed = capsys.readouterr()
    assert printed.err == ""
    assert printed.out.startswith("usage: bench")
    assert all(f"\n    {command}" in printed.out for command in COMMANDS)


def test_the_version_is_that_of_the_installation(capsys) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"econgs-bench {version('econgs-bench')}\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "quik"], "suite 'quik': unknown name. Did you mean quick?"),
        (
            ["plan", "quick", "--dataset", "vortice"],
            "dataset 'vortice': unknown name. Did you mean vortices, ",
        ),
        (["plan", "quick", "--method", "4dgs"], "Did you mean 3dgs"),
        (["plan", "quick", "--set", "3dgs.sh_degre=2"], "Did you mean sh_degree"),
        (["plan", "quick", "--set", "3dgs.sh_degree=9"], "above the maximum 3"),
        (["plan", "quick", "--set", "sh_degree=2"], "not of the form method.option=value"),
        (["plan", "quick", "--set", "fake.pace=2"], "method 'fake' of this run (--set)"),
        (["plan", "quick", "--scene", "nowhere"], "scene 'nowhere' of vortices"),
        (["plan", "quick", "--plugins", "nowhere"], "not a folder"),
        (["results", "--runs", "nowhere"], "no run store"),
        (["report", "--runs", "nowhere"], "no run store"),
        (["merge", "nowhere", "--out", "all"], "no run store"),
        (["compare", "nowhere", "elsewhere"], "no run store"),
        (["score", "nowhere", "elsewhere"], "is no folder"),
        (["render", "nowhere"], "dataset 'nowhere'"),
        (["render"], "names no dataset"),
        (["render", "shells@16", "--automatic"], "is for contact sheets. Add --contact-sheet"),
        (["render", "--contact-sheet", "shells@16", "--scene", "cor"], "Did you mean core, "),
        (["render", "--contact-sheet", "shells@16", "--model", "x"], "shows ground truth only"),
        (["plan", "quick", "--dataset", "gone_8x8x8_uint8.raw"], "no such file. Check the path"),
        (["resutls"], "invalid choice: 'resutls'"),
        (["run"], "required: suite. See `bench run --help`"),
        (["plan", "quick", "--dataset", "my.tml"], "my.tml: no such file. Check the path"),
        (["plan", "quick", "--preset", "ultra"], "invalid choice: 'ultra'"),
        (["run", "quick", "--presets", "quick"], "Did you mean --preset? See `bench run --help`"),
        (["results", "--formt=csv"], "--formt=csv. Did you mean --format? See `bench results --help`"),
        (["list", "methods", "--zzz"], "unrecognized arguments: --zzz. See `bench list --help`"),
        (["plan", "quick", "--seed=-1"], "'-1' is not a whole number of at least 0"),
        (["plan", "quick", "--seed", "x"], "'x' is not a whole number of at least 0"),
        (["plan", "quick", "--device", "gpu"], "'gpu' is not cpu, cuda or cuda:<number>"),
        *(
            (["run", "quick", f"--time-limit={limit}"], f"{limit!r} is not a time such as")
            for limit in ("90 parsecs", "0", "-3", "x", "nan", "1e999")
        ),
        (["cache", "prune", "--max-size", "much"], "'much' is not a size such as"),
        (["render", "fuel", "--views", "0"], "'0' is not a number of at least 1"),
    ],
)
def test_unusable_requests_are_one_line(tmp_path, monkeypatch, capsys, arguments, words) -> None:
    monkeypatch.chdir(tmp_path)
    _refusal(arguments, capsys, words)


def _refusal(arguments: list[str], capsys, words: str) -> str:
    """The one line that a request ends with, and nothing else."""
    try:
        code = main(arguments)
    except SystemExit as exit:  # argparse
        code = exit.code
    assert code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("bench: ")
    assert captured.err.count("\n") == 1
    assert words in captured.err
    return captured.err


def _samples(kind: str = "u1", **changes) -> bytes:
    values = np.arange(512).reshape(8, 8, 8).astype(kind)
    for value in changes.values():
        values[1, 2, 3] = value
    return values.tobytes()


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


BAD_FILES = {
    "short_8x8x8_uint8.raw": (b"\0" * 100, "holds 100 bytes where 8 x 8 x 8 values of uint8 need 512"),
    "long_8x8x8_uint8.raw": (b"\0" * 600, "holds 600 bytes"),
    "nan_8x8x8_float32.raw": (_samples("f4", at=np.nan), "1 of 512 values are NaN or infinite"),
    "inf_8x8x8_float32.raw": (_samples("f4", at=np.inf), "1 of 512 values are NaN or infinite"),
    "same_8x8x8_uint8.raw": (b"\7" * 512, "all values are 7"),
    "none_0x8x8_uint8.raw": (b"\7", "has no samples (size 0 x 8 x 8)"),
    "empty_8x8x8_uint8.raw": (b"", "is empty"),
    "what_8x8x8_uint9.raw": (_samples(), "unknown type 'uint9'. Known types: uint8"),
    "nameless.raw": (_samples(), "its name does not say the dims and type"),
    "cut_8x8x8_uint8.raw.gz": (gzip.compress(_samples())[:-40], "its gzip stream is damaged"),
    "plain_8x8x8_uint8.raw.gz": (_samples(), "its gzip stream is damaged"),
    "flat.npy": (_npy(np.eye(8)), "is 2-D data (8 x 8)"),
    "text.npy": (b"hello", "is not a readable .npy file"),
    "cut.nrrd": (b"NRRD0004\ntype: foo\n", "has no readable NRRD header"),
    "cut.nii.gz": (b"\1" * 300, "is not a readable NIfTI image"),
    "other.obj": (b"1", "unknown volume format '.obj'. Convert it"),
    "folder/notes.txt": (b"1", "is a folder without pre-rendered views"),
    "views/transforms_train.json": (b'{"frames": 3', "is not readable JSON"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_unusable_files_are_one_line(tmp_path, monkeypatch, capsys, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    content, words = BAD_FILES[name]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    source = path if path.parent == tmp_path else path.parent
    message = _refusal(["run", "quick", "--dataset", str(source)], capsys, words)
    assert str(source) in message
    assert not (tmp_path / "runs").exists()
    with pytest.raises(DataError):
        main(["run", "quick", "--dataset", str(source), "--debug"])


def test_folders_that_cannot_be_written_are_one_line(tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "file").touch()
    inside = str(tmp_path / "file" / "inside")
    monkeypatch.setenv("BENCH_CACHE", inside)
    render = ["render", "shells@16", "--scene", "core", "--views", "1", "--size", "8"]
    _refusal(render, capsys, "cannot be written (Not a directory). Set BENCH_CACHE to another folder")
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    _refusal([*render, "--out", inside], capsys, f"{inside}/shells@16/core: Not a directory. Check that")
    with pytest.raises(NotADirectoryError):
        main([*render, "--out", inside, "--debug"])
    _refusal(["run", "quick", "--out", inside], capsys, "cannot be written (Not a directory)")
    _refusal(["run", "quick", "--out", str(tmp_path)], capsys, "neither empty nor a run store")


def test_pre_rendered_views_are_shown_in_their_own_size(tmp_path) -> None:
    random_views(tmp_path / "views", size=10)
    render = ["render", str(tmp_path / "views"), "--views", "2", "--out"]
    assert main([*render, str(tmp_path / "own")]) == 0
    assert main([*render, str(tmp_path / "half"), "--size", "5"]) == 0
    for name, size in (("own", 10), ("half", 5)):
        shapes = {read_png(path).shape[:2] for path in (tmp_path / name).rglob("*.png")}
        assert shapes == {(size, size)}


def test_a_machine_without_locks_is_one_line(tmp_path, monkeypatch, capsys) -> None:
    def lost(*_) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setenv("BENCH_LOCKS", str(tmp_path / "locks"))
    monkeypatch.setattr("fcntl.flock", lost)
    words = f"{tmp_path / 'locks'}: has no locks for this machine's timing (No locks available). Set"
    _refusal(["run", "quick", "--out", str(tmp_path / "runs")], capsys, words)
    assert not (tmp_path / "runs").exists()


def test_a_torn_record_is_one_line_wherever_it_is_met(finished, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    store = str(finished.store)
    (path,) = (finished.store / "jobs").glob("measure-*/record.json")
    path.write_text("{")
    for arguments in (
        ["results", "--runs", store],
        ["report", "--runs", store],
        ["merge", store, "--out", "all"],
        ["bundle", "--runs", store, "--out", "b.zip"],
    ):
        assert main(arguments) == 0
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{path.parent}: not a whole record" in line
        assert f"`bench repair --runs {store}` sets them aside" in line


def _report(bench) -> list[str]:
    return ["report", "--runs", str(bench.store), "--plugins", str(bench.plugins)]


def test_a_torn_table_is_made_again(finished, capsys) -> None:
    table = finished.store / "tables" / "results.parquet"
    whole = pd.read_parquet(table)
    table.write_bytes(b"no table")
    assert main(_report(finished)) == 0
    assert len(pd.read_parquet(table)) == len(whole) == 1
    assert str(finished.store / "report.html") in capsys.readouterr().out


@pytest.mark.parametrize(("given", "page"), [("folder", "folder/report.html"), ("mine.html", "mine.html")])
def test_a_report_goes_into_a_folder_or_under_a_name(finished, tmp_path, capsys, given, page) -> None:
    assert main([*_report(finished), "--out", str(tmp_path / given)]) == 0
    assert str(tmp_path / page) in capsys.readouterr().out
    assert (tmp_path / page).read_text(encoding="utf-8").startswith("<!doctype html>")
    assert (tmp_path / page).with_name("results.csv").exists()


def test_claims_are_listed_where_they_are_asked_for(finished, capsys) -> None:
    """With a verdict each, and why those are not evaluated that are not."""
    assert main(_report(finished)) == 0
    assert "uni-ivrgs-psnr" not in capsys.readouterr().out
    assert main([*_report(finished), "--check-claims"]) == 0
    output = capsys.readouterr().out
    assert re.search(r"^not measured +uni-ivrgs-psnr +0\.9 to 2\.2 dB above iVR-GS$", output, re.MULTILINE)
    assert "[a setting, no result]" in output
    counts = next(line for line in output.splitlines() if line.endswith(" not evaluated"))
    found = dict(reversed(part.split(" ", 1)) for part in counts.split("; "))
    assert {found[word] for word in found if not word.startswith("not ")} == {"0"}
    assert found["not decided"] == "0"
    listed = re.findall(r"^not (?:measured|evaluated) ", output, re.MULTILINE)
    assert sum(map(int, re.findall(r"\d+", counts))) == len(listed)
    with (finished.store / "claims.csv").open(encoding="utf-8", newline="") as file:
        assert {row["verdict"] for row in csv.DictReader(file)} == {"not measured", "not evaluated"}


def test_superseded_rows_are_counted_and_can_be_listed(finished, capsys) -> None:
    (measure,) = finished.of_kind("measure")
    again = measure.model_copy(update={"finished": "2999"})
    identity = {**measure.job.identity, "metrics": {}}
    again.job = measure.job.model_copy(update={"identity": identity, "key": hash_of(identity)})
    Store(finished.store).finish(again)
    report = _report(finished)
    assert main(report) == 0
    note = replaced(pd.DataFrame(index=[0]))
    assert note in capsys.readouterr().out
    for file in ("report.html", "results.md", "results.tex"):
        assert note in (finished.store / file).read_text(encoding="utf-8")
    assert len(pd.read_csv(finished.store / "results.csv")) == 1
    assert main(["results", "--table", "superseded", *report[1:]]) == 0
    listed = capsys.readouterr()
    assert measure.job.id in listed.out
    assert again.job.id not in listed.out


def test_a_report_does_not_go_into_a_file(finished, tmp_path, capsys) -> None:
    (tmp_path / "file").write_text("mine")
    _refusal([*_report(finished), "--out", str(tmp_path / "file")], capsys, "is not a folder. Name another")
    assert (tmp_path / "file").read_text() == "mine"


def test_units_of_limits() -> None:
    from econgs_bench.bench.commands.arguments import byte_size, seconds

    assert [seconds(t) for t in ("90", "90s", "1.5m", "2h")] == [90, 90, 90, 7200]
    assert [byte_size(t) for t in ("10", "2K", "500M", "8G", "8GB", "8GiB")] == [
        10, 2048, 500 * 2**20, 8 * 2**30, 8 * 2**30, 8 * 2**30,
    ]  # fmt: skip


def test_doctor_names_what_is_missing_in_any_encoding(bench) -> None:
    bench.environment["PYTHONIOENCODING"] = "ascii"
    done = bench("doctor")
    names = ("Python", "torch", "native core", "Mitsuba", "GPU", "LPIPS weights", "data", "cache", "disk")
    for name in names:
        assert f" {name} " in done.stdout
    lines = done.stdout.splitlines()
    lpips = next(i for i, line in enumerate(lines) if "LPIPS" in line)
    assert lines[lpips].startswith("lacks")
    assert "vgg16-397923af.pth" in lines[lpips]
    assert "`bench fetch lpips`" in lines[lpips + 1]


@pytest.mark.parametrize(
    ("renders", "record", "warned"), [(True, None, True), (False, None, False), (True, "done", False)]
)
def test_the_slow_marcher_announces_itself_before_it_renders(
    monkeypatch, capsys, renders, record, warned
) -> None:
    monkeypatch.setattr(probe, "find_backend", lambda: probe.Backend("none", reason="no libLLVM was found"))
    jobs = [SimpleNamespace(kind="views", id="views-1")]
    planner = SimpleNamespace(renders=renders, jobs=lambda _: jobs)
    _announce(planner, SimpleNamespace(record=lambda _: record), Display())
    assert ("slow reference marcher" in capsys.readouterr().err) == warned


def test_a_plan_distinguishes_running_jobs_from_interrupted_ones(tmp_path) -> None:
    store, job = Store(tmp_path / "s", create=True), SimpleNamespace(id="fit-1")
    assert _state(job, None, None, store) == "to do"
    (store.partial / job.id).mkdir()
    assert _state(job, None, None, store) == "interrupted"
    with store.lease(job.id):
        assert _state(job, None, None, store) == "running"
    assert _state(job, None, None, store) == "interrupted"
