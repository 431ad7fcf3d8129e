"""The promises of the contract, as tests: the checks of ``bench check-plugin``."""

from pathlib import Path

import pytest

from econgs_bench.methods.contract.checks import CHECKS, Subject
from econgs_bench.methods.registry import Registry, load_method

PLUGINS = (
    [] if "toy-blobs" in Registry().names() else [Path(__file__).parent]
)  # installed, or from this folder
SMALL: dict[str, int | float | str | bool] = {}  # options that make a large method small enough for a test


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    """One examination for all checks: they share its first fit."""
    spec = Registry(PLUGINS).spec("toy-blobs")
    return Subject(spec, load_method(spec), tmp_path_factory.mktemp("models"), 16, SMALL, PLUGINS)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_contract(subject, check):
    """A promise."""
    check(subject)
