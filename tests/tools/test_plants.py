"""The list of planted regressions stays true while the source changes."""

import csv
import re
from pathlib import Path

import pytest

from econgs_bench import econgs
from econgs_bench.methods.registry import Registry
from tools.proofs.planted import ROOT, Proof, plants


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


def _measured(name: str) -> list[list[str]]:
    """Rows of a file of reports/measured/reliability."""
    lines = (ROOT / "reports" / "measured" / "reliability" / name).read_text(encoding="utf-8").splitlines()
    return list(csv.reader(line for line in lines if not line.startswith("#")))[1:]


def test_the_records_list_every_plant_and_count_them_right():
    rows = _measured("plants.csv")
    assert {name: breaks for name, breaks, _, _ in rows} == {plant.name: plant.breaks for plant in plants()}
    by = [one for _, _, one, _ in rows]
    assert all(re.search(r"gate \(|`test_|fingerprint", one) for one in by)
    tested = [one for one in by if "`test_" in one]
    gate = [one for one in by if "gate (" in one and one not in tested]
    counts = {name: int(count) for name, count, _ in _measured("noticed.csv")}
    kinds = (len(tested), len(gate), len(by) - len(tested) - len(gate))
    assert list(counts.values()) == [count for count in kinds if count]
    assert _measured("noticed.csv")[0][2].startswith(f"{sum('gate (' in one for one in tested)} of them")


def test_a_copy_is_what_runs_unless_the_install_is_editable(tmp_path):
    """A plant in a copy that nothing runs would pass every gate."""
    proof = Proof(tmp_path, "gate")
    editable = Path(econgs.__file__).is_relative_to(ROOT / "econgs")
    assert proof.used(proof._copy("c")) != editable
    if editable:
        assert "plain install" in proof.prove(plants()[0], (), ()).trouble
