"""Fixtures of the tests of datasets."""

from __future__ import annotations

import pytest

from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher
from econgs_bench.datasets.view_cache import ViewCache
from tests.datasets.forked import use_forks
from tests.datasets.marching import mitsuba


@pytest.fixture
def forks(monkeypatch):
    """Readers' children as forks of this process: for tests that read many files."""
    use_forks(monkeypatch)


@pytest.fixture(params=["reference", "mitsuba"])
def marcher(request):
    return ReferenceMarcher if request.param == "reference" else mitsuba


@pytest.fixture
def cache(tmp_path):
    return ViewCache(tmp_path / "views")
