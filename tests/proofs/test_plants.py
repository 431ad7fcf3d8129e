"""The list of planted regressions stays true while the source changes."""

import re

import pytest

from methods.registry import Registry
from tests.proofs.planted import ROOT, plants


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
