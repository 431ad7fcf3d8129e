"""For all tests: children see what is installed; in CI nothing is skipped that it is there to test."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Generator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

# A child's working directory would come first on its path: the source tree, which has no compiled module.
os.environ["PYTHONSAFEPATH"] = "1"

# Two processes of tests on two cores: idle threads of OpenMP that spin take them from each other.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_WAIT_POLICY"] = "passive"
    os.environ["OMP_NUM_THREADS"] = "1"

MAY_BE_MISSING = (
    "no CUDA device with gsplat here",
    "no CUDA device here",
    "root may read everything",
    "no fork here",
    "neither libLLVM 15 nor 16 is installed here",
    "no Chromium here",
    "no splat-transform here",
    # Combinations that do not exist.
    "the format has no half precision",
    "a promise of the native backend",
    "gsplat clamps the Jacobian otherwise",
)
"""Reasons to skip that stand in CI too: what its machine does not have, or nobody has."""


def _refuse(report: Any) -> None:
    """Turn a skip for want of data, of the native core or of a package into a failure."""
    if not os.environ.get("CI") or not report.skipped or hasattr(report, "wasxfail"):
        return
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    if not any(words in reason for words in MAY_BE_MISSING):
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} may not be skipped in CI. {reason}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, Any, Any]:
    report = yield
    _refuse(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, Any, Any]:
    report = yield
    _refuse(report)
    return report


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The first folder of BENCH_DATA; skips without one (which CI does not allow)."""
    folder = os.environ.get("BENCH_DATA", "").split(os.pathsep)[0]
    if not folder:
        pytest.skip("BENCH_DATA is not set")
    return Path(folder)


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    """The script ``docs/generate.py``."""
    return _script("generate")


@pytest.fixture(scope="module")
def derived() -> ModuleType:
    """The module ``docs/derived.py``."""
    return _script("derived")


def _script(name: str) -> ModuleType:
    script = Path(__file__).parents[1] / "docs" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
