"""The toy method of docs/guide/add-a-method.md: installed from outside, held to the contract."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from methods.contract.checks import CHECKS

TOY = Path(__file__).parents[2] / "examples" / "toy_blobs"


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """``bench`` in an environment where the toy is installed."""
    target, source = tmp_path_factory.mktemp("installed"), tmp_path_factory.mktemp("source") / "toy"
    for file in [TOY / "pyproject.toml", *(TOY / "toy_blobs").glob("*.py")]:
        copy = source / file.relative_to(TOY)  # a build writes beside its source
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(file.read_bytes())
    install = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--target", target, source]
    subprocess.run([sys.executable, *map(str, install)], check=True)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(target), str(TOY.parents[1])])}

    def run(*arguments):
        done = subprocess.run(
            [sys.executable, "-m", "bench", *arguments],
            cwd=target, env=environment, capture_output=True, text=True, check=False, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


def test_it_is_listed_as_installed(bench):
    (line,) = [line for line in bench("list", "methods").splitlines() if line.startswith("toy-blobs")]
    assert "installed: toy-blobs 0.1.0" in line


def test_it_keeps_the_contract(bench):
    outcomes = bench("check-plugin", "toy-blobs", "--iterations", "16").splitlines()
    assert len(outcomes) == len(CHECKS)
    assert all(line.startswith("passed") for line in outcomes)


def test_it_keeps_the_contract_from_a_folder_that_is_named_relative_to_the_present_one(tmp_path):
    (tmp_path / "plugins").symlink_to(TOY)
    command = [sys.executable, "-m", "bench", "check-plugin", "toy-blobs", "--plugins", "plugins"]
    done = subprocess.run(
        [*command, "--iterations", "16"], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(TOY.parents[1])},
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
