"""The list of planted regressions stays true while the source changes."""

import re
from pathlib import Path

import pytest

import econgs
from methods.registry import Registry
from tests.proofs.planted import ROOT, Proof, plants


@pytest.mark.parametrize("plant", plants(), ids=lambda plant: plant.name)
def test_a_plant_has_its_text_its_test_and_its_methods(plant):
    assert not plant.missing
    assert plant.old != plant.new
    assert plant.methods or plant.test
    assert set(plant.methods) <= set(Registry().built_in())
    if plant.test:
        file, _, name = plant.test.partition("::")
        function = re.escape(name.partition("[")[0])
        assert re.search(rf"^def {function}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE)


def test_a_copy_is_what_runs_unless_the_install_is_editable(tmp_path):
    """A plant in a copy that nothing runs would pass every gate."""
    proof = Proof(tmp_path, "gate")
    editable = Path(econgs.__file__).is_relative_to(ROOT)
    assert proof.used(proof._copy("c")) != editable
    if editable:
        assert "plain install" in proof.prove(plants()[0], (), ()).trouble
