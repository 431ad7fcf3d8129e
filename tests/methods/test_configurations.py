"""Named configurations of a method."""

from dataclasses import make_dataclass, replace

import pytest

from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.methods.interface import Configuration, option
from econgs_bench.methods.options import resolve
from econgs_bench.methods.registry import Registry, check_spec
from econgs_bench.methods.scaffold_gs.spec import SPEC


def test_what_is_set_overlays_the_configuration_which_overlays_the_preset():
    spec = replace(
        SPEC,
        presets={"quick": {"voxel": 0.02, "offsets": 5}},
        configurations={"own": Configuration({"voxel": 0.03, "features": 8}, {"quick": 77})},
    )
    found = resolve(spec, "quick", {"features": "9", "configuration": "own"})
    assert (found.options.offsets, found.options.voxel, found.options.features) == (5, 0.03, 9)
    assert (found.iterations, found.variant) == (77, "configuration=own,features=9")
    assert resolve(spec, "paper", {"configuration": "own"}).iterations == spec.iterations["paper"]
    assert resolve(spec, "quick", {"configuration": "own", "iterations": 5}).iterations == 5


@pytest.mark.parametrize("name", Registry().names())
def test_every_method_has_a_fair_configuration_and_its_authors(name):
    spec = Registry().spec(name)
    fair, paper = (resolve(spec, "paper", {"configuration": one}) for one in ("fair", "paper"))
    assert fair == resolve(spec, "paper")
    assert fair.values.get("start", "cloud") in ("cloud", "hull")
    assert fair.values.get("background", "scene") == "scene"
    assert paper.variant == "configuration=paper"
    assert paper.options != fair.options


def test_unknown_configurations_come_with_near_matches():
    with pytest.raises(UnknownName, match="paper"):
        resolve(SPEC, "quick", {"configuration": "papre"})
    with pytest.raises(UnknownName, match="option 'configuration'"):
        resolve(replace(SPEC, configurations={}), "quick", {"configuration": "fair"})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"configurations": {"own": Configuration({"voxl": 0.1})}}, "voxl"),
        ({"configurations": {"own": Configuration({"voxel": 7.0})}}, "above the maximum"),
        ({"configurations": {"own": Configuration({}, {"quik": 3})}}, "quik"),
        ({"configurations": {"own": Configuration({}, {"quick": 0})}}, "0 iterations"),
        (
            {"options": make_dataclass("Own", [("configuration", str, option("a", "b"))], frozen=True)},
            "called",
        ),
    ],
)
def test_a_spec_that_contradicts_itself_is_refused(changes, words):
    with pytest.raises(DataError, match=words):
        check_spec(replace(SPEC, **changes), "here")
