"""``bench baseline``, ``bench gate`` and the pytest plugin on runs of the method fake."""

from __future__ import annotations

import json
import platform
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from econgs_bench.bench.gate.audit import audit
from econgs_bench.bench.gate.baseline import read
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.seals import sealed, unsealed
from tests.bench.conftest import PATIENCE, Bench

SEEDS = ("--seed", 0, "--seed", 1, "--seed", 2)


@pytest.fixture(scope="module")
def first(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store of three seeds and its baseline."""
    bench = Bench(tmp_path_factory.mktemp("gate"), dataset)
    bench.run(*SEEDS, scenes=("a", "b"))
    folder = bench.store.parent
    bench("baseline", bench.store, "--out", folder / "base.json", "--reason", "first")
    return folder


@pytest.fixture
def gate(first: Path, bench: Bench, inside: None, tmp_path: Path) -> Bench:
    """The command on copies."""
    shutil.copytree(first / "runs", tmp_path / "runs")
    shutil.copy(first / "base.json", tmp_path)
    return bench


def change(store: Path, kind: str, edit) -> None:
    """Edit the records of a kind."""
    for path in (store / "jobs").glob(f"{kind}-*/record.json"):
        record = json.loads(unsealed(path.read_text()))
        edit(record)
        path.write_text(sealed(json.dumps(record)))


def test_a_baseline_is_small_readable_and_the_same_every_time(gate: Bench, tmp_path: Path) -> None:
    text = (tmp_path / "base.json").read_text()
    assert max(map(len, text.splitlines())) < 300
    baseline = read(tmp_path / "base.json")
    assert all(cell.options["iterations"] > 0 for cell in baseline.cells)
    assert [(cell.scene, cell.seeds) for cell in baseline.cells] == [("a", [0, 1, 2]), ("b", [0, 1, 2])]
    gate("baseline", "runs", "--out", tmp_path / "base.json", "--reason", "a better method")
    again = read(tmp_path / "base.json")
    assert [change.reason for change in again.changes] == ["first", "a better method"]
    assert again.cells == baseline.cells


def test_the_same_run_passes_and_its_models_are_equal(gate: Bench) -> None:
    done = gate("gate", "--baseline", "base.json", "--without-times", code=0)
    assert "all 6 models equal" in done.stdout
    assert done.stdout.splitlines()[-1].startswith("pass: 2 results; nothing differs")


@pytest.mark.parametrize("form", ["bmf", "github-benchmark"])
def test_values_are_printed_for_services_that_chart_them(gate: Bench, form: str) -> None:
    done = gate("gate", "--baseline", "base.json", "--without-times", "--format", form, code=0)
    assert done.stderr.splitlines()[-1].startswith("pass: 2 results")
    values = json.loads(done.stdout)
    results = gate.tables()["results"]
    psnr = results[results["scene"] == "a"]["psnr"]
    if form == "bmf":
        (own,) = (own for title, own in values.items() if title.startswith("tiny/a "))
        assert own["psnr"]["value"] == pytest.approx(psnr.mean())
        assert own["psnr"]["lower_value"] == pytest.approx(psnr.min())
    else:
        (own,) = (one for one in values if one["name"].startswith("tiny/a ") and "RMSE" in one["name"])
        assert own["value"] == pytest.approx(255 * 10 ** (-psnr.mean() / 20))
        assert all(isinstance(one["value"], float | int) for one in values)


def test_a_loss_is_found_and_reported_in_three_forms(gate: Bench, tmp_path: Path) -> None:
    def darker(record) -> None:
        for view in record["measure"]["views"]:
            view["metrics"]["psnr"] -= 3.0
        record["measure"]["metrics"]["psnr"] -= 3.0

    change(tmp_path / "runs", "measure", darker)
    done = gate(
        "gate", "--baseline", "base.json", "--without-times", "--junit", "j.xml", "--markdown", "m.md", code=1
    )
    assert all("PSNR" in line for line in done.stdout.splitlines() if line.startswith("worse  "))
    cases = ElementTree.parse(tmp_path / "j.xml").findall("testcase")
    assert len(cases) == 2
    assert all(case.find("failure") is not None for case in cases)
    assert "**Worse (6)**" in (tmp_path / "m.md").read_text()


def test_means_and_shares_must_follow_from_their_parts(gate: Bench, tmp_path: Path) -> None:
    tables = gate.tables()
    assert list(audit(tables)) == []
    change(tmp_path / "runs", "measure", lambda record: record["measure"]["metrics"].update(psnr=99.0))
    findings = [finding.text for finding in audit(gate.tables())]
    assert findings
    assert all(text.startswith("psnr is 99") for text in findings)
    tables["results"].loc[0, "size_bytes"] += 5
    assert [finding.text.split()[0] for finding in audit(tables)] == ["size_bytes"]


def test_a_default_that_changed_is_found_by_its_name(gate: Bench, tmp_path: Path) -> None:
    def more(record) -> None:
        record["job"]["iterations"] += 1

    change(tmp_path / "runs", "measure", more)
    done = gate("gate", "--baseline", "base.json", "--without-times", code=1)
    losses = [line for line in done.stdout.splitlines() if line.startswith("worse  ")]
    assert len(losses) == 2
    assert all("options differ: iterations" in line for line in losses)


def test_a_baseline_has_one_version_of_a_method(gate: Bench, tmp_path: Path) -> None:
    def older(record) -> None:
        if record["job"]["seed"] == 2:
            record["job"]["identity"]["method"][1] += "-older"

    change(tmp_path / "runs", "fit", older)
    done = gate("baseline", "runs", "--out", "new.json", "--reason", "r", code=2)
    assert "-older of the method" in done.stderr
    assert "note" in gate("gate", "--baseline", "base.json", "--without-times", code=0).stdout


def test_the_power_of_a_baseline_needs_no_run(gate: Bench) -> None:
    power = ("--power", "--without-times")
    lines = gate("gate", "nowhere", "--baseline", "base.json", *power).stdout.splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert {len(row) for row in cells} == {7}
    assert {row[1] for row in cells[2:]} == {"a scene", "a method's mean", "a view"}
    assert {row[2] for row in cells[2:] if row[1] == "a scene"} == {"2"}
    gate("gate", "--baseline", "nothing.json", "--power", code=3)


def test_what_cannot_be_compared_has_codes_of_its_own(gate: Bench, tmp_path: Path) -> None:
    assert "no run store" in gate("gate", "empty", "--baseline", "base.json", code=3).stderr
    gate("gate", "runs", "--baseline", "nothing.json", code=3)
    (tmp_path / "bad.json").write_text('{"format": 1, "changes": []}')
    assert "environment" in gate("gate", "runs", "--baseline", "bad.json", code=3).stderr
    baseline = json.loads((tmp_path / "base.json").read_text())
    baseline["cells"][0]["scene"] = "another"
    (tmp_path / "base.json").write_text(json.dumps(baseline))
    assert (
        "not measured  tiny/another"
        in gate("gate", "--baseline", "base.json", "--without-times", code=2).stdout
    )
    baseline["cells"][0]["models"].pop()
    (tmp_path / "base.json").write_text(json.dumps(baseline))
    with pytest.raises(DataError, match=r"tiny/another.*differ in length"):
        read(tmp_path / "base.json")


def test_a_baseline_needs_seeds_and_finished_runs(gate: Bench, tmp_path: Path) -> None:
    for path in (tmp_path / "runs" / "jobs").glob("measure-*/record.json"):
        if json.loads(unsealed(path.read_text()))["job"]["seed"] > 0:
            shutil.rmtree(path.parent)
    done = gate("baseline", "runs", "--out", "new.json", "--reason", "r", code=2)
    assert "1 seeds show no spread" in done.stderr
    assert not (tmp_path / "new.json").exists()
    gate("baseline", "runs", "--out", "new.json", code=2)


def test_times_of_a_disturbed_clock_are_counted_and_left_out(gate: Bench, tmp_path: Path) -> None:
    def busy(record) -> None:
        if record["job"]["seed"] == 2 and record["job"]["scenes"] == ["a"]:
            record["measure"]["reference_seconds"] *= 1000.0

    change(tmp_path / "runs", "measure", busy)
    done = gate("baseline", "runs", "--out", "new.json", "--reason", "r")
    assert int(re.findall(r"without (\d+) times? of", done.stdout)[0]) >= 1
    a, _ = read(tmp_path / "new.json").cells
    assert a.values.get("frame_ratio", [None] * 3)[2] is None


def test_an_update_keeps_what_its_store_lacks(gate: Bench, tmp_path: Path) -> None:
    before = read(tmp_path / "base.json").cells
    change(tmp_path / "runs", "measure", lambda record: record["measure"]["metrics"].update(psnr=9.0))
    for path in (tmp_path / "runs" / "jobs").glob("measure-*/record.json"):
        if json.loads(unsealed(path.read_text()))["job"]["scenes"] == ["b"]:
            shutil.rmtree(path.parent)
    done = gate("baseline", "runs", "--out", "base.json", "--reason", "a alone")
    assert "2 results" in done.stdout
    assert "1 as before, which runs lacks" in done.stdout
    after = read(tmp_path / "base.json").cells
    assert [cell.scene for cell in after] == ["a", "b"]
    assert (after[0].values["psnr"], after[1]) == ([9.0] * 3, before[1])

    text = (tmp_path / "base.json").read_text()
    other = text.replace(f'"python": "{platform.python_version()}"', '"python": "2.7"')
    assert other != text
    (tmp_path / "base.json").write_text(other)
    done = gate("baseline", "runs", "--out", "base.json", "--reason", "a alone", code=2)
    assert "base.json: 1 result of it, as tiny/b" in done.stderr
    assert "came from other software (python 2.7 → " in done.stderr
    assert (tmp_path / "base.json").read_text() == other


def test_pytest_has_a_test_per_result(gate: Bench, tmp_path: Path) -> None:
    (tmp_path / "test_own.py").write_text("def test_own(): pass\n")

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        installed = "bench-gate" in {entry.name for entry in entry_points(group="pytest11")}
        plugin = [] if installed else ["-p", "econgs_bench.bench.gate.pytest_plugin"]
        command = [sys.executable, "-m", "pytest", *plugin, "-p", "no:cacheprovider"]
        command += ["--rootdir", str(tmp_path), "test_own.py", "--bench-gate", "base.json", *more]
        return subprocess.run(
            command, cwd=tmp_path, env=gate.environment, capture_output=True, encoding="utf-8",
            timeout=PATIENCE, check=False,
        )  # fmt: skip

    done = run()
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 passed" in done.stdout
    change(tmp_path / "runs", "measure", lambda record: record["measure"]["metrics"].update(psnr=9.0))
    done = run("-k", "tiny/a")
    assert done.returncode == 1
    assert "1 failed, 2 deselected" in done.stdout
    assert "psnr is 9" in done.stdout
    assert run("--bench-store", "nowhere").returncode == 4
