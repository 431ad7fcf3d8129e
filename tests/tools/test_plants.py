"""The list of planted regressions stays true while the source changes."""

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


def test_the_page_lists_every_plant_and_counts_them_right():
    page = (ROOT / "docs" / "results" / "gate.md").read_text(encoding="utf-8")
    section = page.partition("## Planted regressions")[2].partition("### The full form")[0]
    lines = [line for line in section.splitlines() if re.match(r"\| [\w-]+ \| .*\|$", line)]
    rows = {cells[0]: cells[1:] for line in lines if len(cells := line.strip("| ").split(" | ")) == 4}
    assert {name: row[0] for name, row in rows.items() if name != "Plant"} == {
        plant.name: plant.breaks for plant in plants()
    }
    by = [row[1] for name, row in rows.items() if name != "Plant"]
    assert all(re.search(r"gate \(|`test_|fingerprint", one) for one in by)
    asked = [row for row in rows.values() if row[2].startswith(tuple(Registry().built_in()))]
    found = [row for row in asked if "gate (" in row[1]]
    tested = [one for one in by if "`test_" in one]
    assert re.findall(r"All (\d+) are noticed", page) == [str(len(by))]
    counts = [len(tested), sum("gate (" in one for one in tested)]
    assert re.findall(r"a test that names the mistake \| (\d+) \| (\d+) of them", page) == [
        tuple(map(str, counts))
    ]
    assert set(re.findall(r"asked about (\d+) and found (\d+)", page)) == {(str(len(asked)), str(len(found)))}
    assert set(re.findall(r"notices (\d+) of the (\d+)", page)) == {(str(len(found)), str(len(asked)))}


def test_a_copy_is_what_runs_unless_the_install_is_editable(tmp_path):
    """A plant in a copy that nothing runs would pass every gate."""
    proof = Proof(tmp_path, "gate")
    editable = Path(econgs.__file__).is_relative_to(ROOT)
    assert proof.used(proof._copy("c")) != editable
    if editable:
        assert "plain install" in proof.prove(plants()[0], (), ()).trouble
