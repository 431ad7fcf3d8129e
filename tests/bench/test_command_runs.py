"""Runs of methods of commands: an external trainer beside 3DGS, and what a failing one leaves behind."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import numpy
import PIL
import psutil
import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.bench.run import redo
from econgs_bench.bench.store.store import Store
from econgs_bench.methods.contract.checks import COMMAND_CHECKS
from tests.bench.conftest import runs, wait_for

PROGRAM = Path(__file__).parents[1] / "methods" / "commands"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are watched on Linux")


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Interpreter of a virtual environment with numpy and Pillow, and without this project."""
    folder = tmp_path_factory.mktemp("environment") / "own"
    venv.create(folder, with_pip=False)
    packages = folder / Path(sysconfig.get_path("purelib")).relative_to(sys.prefix)
    for module in (numpy, PIL):
        source = Path(str(module.__file__)).parent
        for path in source.parent.iterdir():
            if path.name in (source.name, "numpy.libs", "pillow.libs"):
                (packages / path.name).exists() or (packages / path.name).symlink_to(path)
    python = folder / "bin" / "python"
    for name, code in (("numpy", 0), ("econgs_bench", 1), ("torch", 1)):
        done = subprocess.run([python, "-I", "-c", f"import {name}"], capture_output=True, check=False)
        assert done.returncode == code, done.stderr
    return python


def _with_python(folder: Path, python: Path | str) -> None:
    file = folder / "command.toml"
    lines = [line for line in file.read_text().splitlines() if not line.startswith("python = ")]
    lines.insert(lines.index("[environment]") + 1, f'python = "{python}"')
    file.write_text("\n".join(lines) + "\n")


@pytest.fixture
def toy(environment: Path, tmp_path: Path) -> Path:
    """What ``bench new-method --command`` writes, with that interpreter."""
    assert main(["new-method", "toy-commands", "--command", "--out", str(tmp_path)]) == 0
    _with_python(tmp_path / "toy_commands", environment)
    return tmp_path / "toy_commands"


def test_an_external_trainer_is_measured_and_drawn_twice(bench, toy: Path) -> None:
    bench.plugins = toy
    bench.run("--set", "toy-commands.iterations=40", method="toy-commands")
    rows = bench.tables()["results"].set_index("variant")
    own, here = rows.loc["iterations=40"], rows.loc["drawn=here,iterations=40"]
    assert list(rows["status"]) == ["ok"] * 2
    assert own["size_bytes"] == here["size_bytes"]
    assert own["primitives"] == here["primitives"] == 20
    assert own["train_seconds"] == here["train_seconds"] > 0
    assert own["cpu_seconds"] > 0
    assert 2**20 < own["group_peak_host_bytes"] < 2**28  # of numpy, not of this program's torch
    assert 0 < own["fps"] < 1e6
    assert own["ruler"] != here["ruler"]
    assert abs(own["psnr"] - here["psnr"]) < 6.0
    (fit,) = bench.of_kind("fit")
    assert fit.provenance.source
    assert [one.iteration for one in fit.result.losses][-1] == 40
    assert "iteration 40 loss" in (bench.store / "jobs" / fit.job.id / "log.txt").read_text()
    assert not list(bench.store.glob("jobs/*/scratch"))


@pytest.mark.slow
def test_an_external_trainer_beside_3dgs_in_one_report(bench, toy: Path) -> None:
    bench.plugins = toy
    settings = ("--method", "3dgs", "--set", "3dgs.iterations=20", "--set", "toy-commands.iterations=40")
    done = bench.run(*settings, method="toy-commands", report=True)
    assert "toy-commands" in done.stdout
    assert list(bench.tables()["results"]["status"]) == ["ok"] * 3
    assert "toy-commands" in (bench.store / "report.html").read_text(encoding="utf-8")
    again = bench.run(*settings, method="toy-commands")
    assert "ok after" not in again.stdout
    (measured,) = [one for one in bench.of_kind("measure") if one.job.overrides.get("drawn") == "here"]
    out = bench.store.parent / "pictures"
    bench("render", bench.dataset, "--scene", "a", "--views", 2, "--runs", bench.store, "--plugins", toy,
          "--model", measured.job.id, "--truth", "--out", out)  # fmt: skip
    assert len(list(out.rglob("*.png"))) == 4


def test_a_new_method_of_commands_keeps_its_promises(toy: Path, capfd) -> None:
    assert main(["check-plugin", "toy-commands", "--plugins", str(toy), "--set", "blobs=100"]) == 0
    output, _ = capfd.readouterr()
    assert output.count("passed ") == len(COMMAND_CHECKS)
    assert "59 iterations seen" in output


@pytest.fixture
def program(bench, tmp_path: Path) -> Path:
    """The hostile program as a plugin."""
    bench.plugins = shutil.copytree(PROGRAM, tmp_path / "program")
    _with_python(bench.plugins, sys.executable)
    return bench.plugins


@pytest.mark.slow
def test_failures_are_rows_and_nothing_else_is_lost(bench, program: Path) -> None:
    bench.run("--set", "program.render=half", "--set", "program.train=nan", method="program", code=1)
    (fit,) = bench.of_kind("fit")
    assert fit.status == "diverged"
    bench.run("--set", "program.render=half", method="program", code=1)
    rows = bench.tables()["results"].set_index("variant")
    assert rows.loc["render=half", "status"] == "failed"
    assert "drew 2 pictures of 4" in rows.loc["render=half", "reason"]
    assert rows.loc["drawn=here,render=half", "status"] == "ok"  # the harness draws all the same
    _with_python(program, "/nowhere/python")
    bench.run("--set", "program.note=/dev/zero", method="program", code=1)
    rows = bench.tables()["results"].set_index("variant")
    assert "interpreter /nowhere/python is not there" in rows.loc["note=/dev/zero", "reason"]
    assert rows.loc["drawn=here,render=half", "status"] == "ok"
    assert not list(bench.store.glob("*/*/scratch"))


def test_what_a_program_drew_without_alpha_is_drawn_again(
    bench, program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the program, and here: as each was measured."""
    bench.run("--set", "program.render=opaque", method="program")
    rows = bench.tables()["results"].set_index("variant")
    assert rows.loc["render=opaque", "psnr"] != rows.loc["drawn=here,render=opaque", "psnr"]
    monkeypatch.setattr(redo.Draw, "models", lambda *_: bench.of_kind("measure"))
    file = bench.store / "store.json"
    again = redo.redo(Store(bench.store), file, 2, datasets=[str(bench.dataset)], plugins=[str(program)])
    assert (again.problems, again.unverified) == ([], [])
    assert len(again.views) == 2


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_leaves_nothing_running_and_resumes(
    bench, program: Path, tmp_path: Path, number
) -> None:
    note = tmp_path / "pids"
    setting = ("--set", f"program.note={note}")
    process = bench.start(*setting, "--set", "program.train=hang", method="program")
    wait_for(lambda: note.exists() and len(note.read_text().split()) == 2)
    pids = [psutil.Process(int(one)) for one in note.read_text().split()]
    process.send_signal(number)
    process.communicate(timeout=120)
    for one in pids:
        wait_for(lambda one=one: not runs(one))
    assert not bench.of_kind("fit")
    if number == signal.SIGINT:
        assert not list(bench.store.glob("*/*/scratch"))
    text = (program / "program.py").read_text()
    (program / "program.py").write_text(text.replace('if how == "hang"', 'if how == "never"'))
    bench.run(*setting, "--set", "program.train=hang", method="program")
    (fit,) = bench.of_kind("fit")
    assert fit.ok
    assert fit.result.resumed == 0
    assert not list(bench.store.glob("*/*/scratch"))


@pytest.mark.slow
def test_a_limit_of_time_ends_the_program(bench, program: Path, tmp_path: Path) -> None:
    note = tmp_path / "pids"
    settings = ("--set", "program.train=hang", "--set", f"program.note={note}", "--time-limit", "3")
    bench.run(*settings, method="program", code=1)
    (fit,) = bench.of_kind("fit")
    assert fit.status == "timeout"
    assert not [one for one in note.read_text().split() if psutil.pid_exists(int(one))]
    assert not list(bench.store.glob("*/*/scratch"))
