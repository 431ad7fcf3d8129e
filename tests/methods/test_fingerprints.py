"""Every method fits as recorded in tests/fingerprints.json; a changed constant does not pass for noise."""

from __future__ import annotations

import copy

import pytest

from econgs_bench.methods.registry import Registry
from tests.methods import fingerprints


@pytest.mark.parametrize("method", Registry().built_in())
def test_results_are_as_recorded_for_their_version(method):
    problem = fingerprints.verdict(method, fingerprints.measure(method), fingerprints.recorded().get(method))
    assert not problem, problem


@pytest.fixture
def recorded():
    return fingerprints.recorded()["econgs"]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("fits", "fair", "primitives"), 290),
        (("fits", "fair", "losses", 20), 0.2),
        (("fits", "fair", "pictures", 0, 3), 0.2),
        (("fits", "fair", "sha256"), None),
    ],
    ids=lambda value: "/".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_a_change_is_reported_with_its_remedy(recorded, path, value):
    now = copy.deepcopy(recorded)
    place = now
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    problem = fingerprints.verdict("econgs", now, recorded)
    assert "raise its version or undo it" in problem
    assert not fingerprints.verdict("econgs", recorded, recorded)


def test_another_choice_of_a_preset_asks_for_a_new_record_and_no_version(recorded):
    now = copy.deepcopy(recorded)
    now["settings"]["paper fair"]["rate_weight"] = 1.01e-4
    now["settings"]["paper paper"]["iterations"] = 20_001
    problem = fingerprints.verdict("econgs", now, recorded)
    assert problem.startswith("options of econgs changed: undo it or run")
    assert "paper fair: rate_weight is 0.000101, recorded 0.0003" in problem
    assert "paper paper: iterations is 20001, recorded 20000" in problem
    now["fits"]["fair"]["primitives"] = 290
    problem = fingerprints.verdict("econgs", now, recorded)
    assert "by options of presets alone, run" in problem
    assert "--write econgs --keep-version" in problem


def test_rounding_of_other_software_passes(recorded):
    now = copy.deepcopy(recorded)
    now["arithmetic"]["libc"] = "another"
    for fit in now["fits"].values():
        fit["losses"] = [loss * (1 + 1e-5) for loss in fit["losses"]]
        fit["sha256"] = "another"
    assert not fingerprints.verdict("econgs", now, recorded)


def test_a_new_version_asks_for_a_new_record(recorded):
    problem = fingerprints.verdict("econgs", {**recorded, "version": "next"}, recorded)
    assert "--write econgs" in problem
