"""Fixtures of the tests of datasets."""

from __future__ import annotations

import pytest

from datasets.ground_truth.reference import ReferenceMarcher
from datasets.view_cache import ViewCache
from tests.datasets.marching import mitsuba


@pytest.fixture(params=["reference", "mitsuba"])
def marcher(request):
    return ReferenceMarcher if request.param == "reference" else mitsuba


@pytest.fixture
def cache(tmp_path):
    return ViewCache(tmp_path / "views")
