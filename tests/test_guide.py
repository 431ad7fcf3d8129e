"""The commands of docs/guide/add-a-method.md, as printed, in a folder that holds nothing."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from econgs_bench.methods.contract.checks import CHECKS, COMMAND_CHECKS

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "add-a-method.md"


def _blocks() -> list[str]:
    return re.findall(r"^```sh\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)


class Shell:
    """A user's shell in a folder of its own; ``pip`` installs beside it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "anywhere"
        programs, installed = folder / "bin", folder / "installed"
        for path in (self.folder, programs, installed):
            path.mkdir()
        for name, module in (("bench", "econgs_bench.bench"), ("pip", "pip")):
            (programs / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {module} "$@"\n')
            (programs / name).chmod(0o755)
        self.environment = os.environ | {
            "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(installed)])),
            "PIP_TARGET": str(installed),
            "PIP_NO_BUILD_ISOLATION": "0",  # no network
            "XDG_STATE_HOME": str(folder / "state"),
            "BENCH_LOCKS": str(folder / "locks"),
        }

    def __call__(self, commands: str) -> str:
        done = subprocess.run(
            ["sh", "-e", "-c", commands], cwd=self.folder, env=self.environment,
            capture_output=True, encoding="utf-8", check=False, timeout=600,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    return Shell(tmp_path)


@pytest.mark.slow
def test_a_new_method_keeps_the_contract_from_a_folder_and_installed(shell: Shell) -> None:
    output = "".join(shell(block) for block in _blocks() if "bench run" not in block)
    assert len(re.findall(r"^passed ", output, re.M)) == 2 * len(CHECKS) + len(COMMAND_CHECKS)
    (line,) = re.findall(r"^toy-blobs .*", output, re.M)
    assert "installed: toy-blobs 0.1.0" in line


@pytest.mark.slow
def test_all_commands_of_the_page_run_in_turn(shell: Shell) -> None:
    output = "".join(map(shell, _blocks()))
    assert re.search(r"^cores +toy-blobs +\d+\.\d+ ", output, re.M), output
    assert "toy-blobs" in (shell.folder / "runs" / "report.html").read_text(encoding="utf-8")
    page = (shell.folder / "both" / "report.html").read_text(encoding="utf-8")
    assert all(name in page for name in ("toy-commands", "drawn=here", "ECoNGS-R"))
    assert re.search(r"^pass: 4 results; nothing differs", output, re.M), output
