"""The command line: what it prints, how it fails, and what it does not import."""

from __future__ import annotations

import subprocess
import sys

import pytest

from bench.__main__ import main

LISTS = ("methods", "datasets", "suites", "metrics")


@pytest.mark.parametrize("what", LISTS)
def test_lists_start_without_heavy_imports(bench, what: str) -> None:
    code = (
        "import sys; from bench.__main__ import main; main(['list', sys.argv[1]]);"
        "heavy = {'torch', 'pandas', 'scipy', 'mitsuba', 'matplotlib', 'pydantic', 'rich'};"
        "heavy &= set(sys.modules);"
        "assert not heavy, heavy"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, what], env=bench.environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert {"methods": "3dgs", "datasets": "vortices", "suites": "quick", "metrics": "psnr"}[
        what
    ] in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "quik"], "suite 'quik': unknown name. Did you mean quick?"),
        (
            ["plan", "quick", "--dataset", "vortice"],
            "dataset 'vortice': unknown name. Did you mean vortices, ",
        ),
        (["plan", "quick", "--method", "4dgs"], "Did you mean 3dgs?"),
        (["plan", "quick", "--set", "3dgs.sh_degre=2"], "Did you mean sh_degree?"),
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
    ],
)
def test_unusable_requests_are_one_line(tmp_path, monkeypatch, capsys, arguments, words) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("bench: ")
    assert captured.err.count("\n") == 1
    assert words in captured.err


def test_bad_data_ends_the_run_before_any_job(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short_8x8x8_uint8.raw").write_bytes(b"\0" * 100)
    assert main(["run", "quick", "--dataset", "./short_8x8x8_uint8.raw"]) == 2
    error = capsys.readouterr().err
    assert "short_8x8x8_uint8.raw" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_debug_shows_where_it_failed(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Exception, match="no run store"):
        main(["results", "--runs", "nowhere", "--debug"])


def test_a_folder_of_other_things_is_no_run_store(tmp_path, capsys) -> None:
    (tmp_path / "thesis.tex").touch()
    assert main(["run", "quick", "--out", str(tmp_path)]) == 2
    assert "neither empty nor a run store" in capsys.readouterr().err


@pytest.mark.parametrize("limit", ["0", "-3", "x", "nan", "1e999"])
def test_limits_are_checked(limit: str, capsys) -> None:
    with pytest.raises(SystemExit):
        main(["run", "quick", f"--time-limit={limit}"])
    assert "is not a time such as" in capsys.readouterr().err


def test_units_of_limits() -> None:
    from bench.__main__ import _bytes, _seconds

    assert [_seconds(t) for t in ("90", "90s", "1.5m", "2h")] == [90, 90, 90, 7200]
    assert [_bytes(t) for t in ("10", "2K", "500M", "8G", "8GB", "8GiB")] == [
        10, 2048, 500 * 2**20, 8 * 2**30, 8 * 2**30, 8 * 2**30,
    ]  # fmt: skip


def test_doctor_names_what_is_missing(bench) -> None:
    done = bench("doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    for name in (
        "Python",
        "torch",
        "native core",
        "Mitsuba",
        "GPU",
        "LPIPS weights",
        "data",
        "cache",
        "disk",
    ):
        assert f" {name} " in done.stdout
    lines = done.stdout.splitlines()
    lpips = next(i for i, line in enumerate(lines) if "LPIPS" in line)
    assert lines[lpips].startswith("lacks")
    assert "vgg16-397923af.pth" in lines[lpips + 1]
