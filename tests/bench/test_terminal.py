"""Output that its reader cannot show, does not read, or that a label tries to command."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from itertools import product
from pathlib import Path

import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.datasets.seals import sealed, unsealed
from econgs_bench.reports.terminal import LOST, terminal
from tests.bench.conftest import Bench


def shell(bench: Bench, line: str, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """A line of a shell in which ``$BENCH`` is the command."""
    command = " ".join((sys.executable, "-m", "econgs_bench.bench"))
    return subprocess.run(
        ["bash", "-c", line.replace("$BENCH", command)],
        env={**bench.environment, **environment}, cwd=bench.store.parent, capture_output=True,
        timeout=bench.patience, check=False,
    )  # fmt: skip


def hostile(finished: Bench, label: str) -> None:
    """Give the dataset of all records another label."""
    for path in (finished.store / "jobs").glob("*/record.json"):
        record = json.loads(unsealed(path.read_text(encoding="utf-8")))
        record["job"]["dataset_name"] = label
        path.write_text(sealed(json.dumps(record)), encoding="utf-8")


@pytest.fixture(scope="module")
def _seeds(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    bench = Bench(tmp_path_factory.mktemp("seeds"), dataset)
    bench.run("--seed", 0, "--seed", 1, "--seed", 2)
    bench("baseline", bench.store, "--out", bench.store.parent / "base.json", "--reason", "first")
    return bench.store


@pytest.fixture
def seeds(bench: Bench, _seeds: Path) -> Bench:
    """A store of its own with three seeds of scene a, and its baseline beside it."""
    shutil.copytree(_seeds, bench.store)
    shutil.copy(_seeds.parent / "base.json", bench.store.parent)
    return bench


@pytest.mark.parametrize(
    ("what", "encoding"),
    [
        *product(("list datasets", "list methods", "list metrics", "--help"), ("ascii",)),
        *product(("list datasets",), ("latin-1", "cp1252")),
    ],
)
def test_every_encoding_shows_what_it_can(bench: Bench, what: str, encoding: str) -> None:
    done = shell(bench, f"$BENCH {what}", PYTHONIOENCODING=encoding)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.decode(encoding).splitlines()) > 2


@pytest.mark.slow
def test_a_run_in_ascii_prints_its_table_and_writes_its_page(bench: Bench) -> None:
    source = "a\N{LATIN SMALL LETTER E WITH ACUTE}"
    (bench.store.parent / source).symlink_to(bench.dataset)
    line = f"$BENCH run quick --dataset {source} --scene a --method fake --plugins {bench.plugins} --out runs"
    done = shell(bench, line, PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert b"runs/report.html" in done.stdout
    assert (bench.store / "report.html").is_file()
    for form in ("md", "tex", "csv", "json"):
        done = shell(bench, f"$BENCH results --runs runs --format {form}", PYTHONIOENCODING="ascii")
        assert done.returncode == 0


@pytest.mark.parametrize("end", [">&-", ">/dev/full", "| true; exit ${PIPESTATUS[0]}"])
def test_output_that_nobody_reads_is_an_exit_code_and_files_are_written(seeds: Bench, end: str) -> None:
    files = "--markdown gate.md --junit gate.xml --without-times"
    done = shell(seeds, f"$BENCH gate --baseline base.json runs {files} {end}")
    assert done.returncode == LOST
    assert b"Traceback" not in done.stderr
    folder = seeds.store.parent
    ElementTree.parse(folder / "gate.xml")
    assert (folder / "gate.md").read_text(encoding="utf-8").startswith("### ")
    if end == ">/dev/full":  # a long output, which breaks off before its end
        done = shell(seeds, f"$BENCH report --runs runs --plugins {seeds.plugins} --out page {end}")
        assert done.returncode == LOST
        assert (folder / "page/report.html").is_file()


@pytest.mark.parametrize("file", ["--markdown", "--junit"])
def test_a_gate_that_cannot_write_its_files_is_an_error_and_no_verdict(seeds: Bench, file: str) -> None:
    done = shell(seeds, f"$BENCH gate --baseline base.json runs --without-times {file} none/here")
    assert done.returncode == 3
    assert done.stderr.count(b"\n") == 1
    assert b"cannot be written" in done.stderr


def test_a_failure_keeps_its_code_without_a_reader(bench: Bench) -> None:
    assert shell(bench, "$BENCH run quik >&- 2>&-").returncode == 2
    assert shell(bench, "$BENCH --help | true; exit ${PIPESTATUS[0]}").returncode == LOST


def test_jobs_go_on_without_a_reader(bench: Bench) -> None:
    line = " ".join(bench.run_arguments("--no-report")[3:])
    done = shell(bench, f"$BENCH {line} 2>&1 | true; exit ${{PIPESTATUS[0]}}")
    assert done.returncode == LOST
    assert [record.status for record in bench.records().values()] == ["ok"] * 4


def test_a_label_is_no_command(seeds: Bench, capfdbinary) -> None:
    label = "\x1b]0;title\x07\x1b[2J<script>x</script>\u202e\x9b2J"
    hostile(seeds, label)
    runs = str(seeds.store)
    base = str(seeds.store.parent / "labelled.json")
    junit, page = seeds.store.parent / "gate.xml", seeds.store.parent / "page"
    for arguments in (
        ["results", "--runs", runs],
        *(["results", "--runs", runs, "--format", form] for form in ("md", "tex", "json")),
        ["baseline", "--out", base, "--reason", label, runs],
        ["gate", "--baseline", base, runs, "--without-times", "--junit", str(junit)],
        ["compare", runs, runs],
        ["report", "--runs", runs, "--plugins", str(seeds.plugins), "--out", str(page)],
    ):
        assert main(arguments) == 0
        out, err = (part.decode("utf-8") for part in capfdbinary.readouterr())
        assert out + err
        assert not any(sign in out + err for sign in "\x1b\x07\u202e\x9b")
        assert not ("md" in arguments and "<script" in out)  # remarks of a noisy machine are no Markdown
    ElementTree.parse(junit)
    charts = sorted((page / "charts").glob("*.svg"))
    assert charts
    assert all(ElementTree.parse(path) and path.with_suffix(".pdf").is_file() for path in charts)
    written = "".join(path.read_text(encoding="utf-8") for path in page.rglob("*.md"))
    assert "<script" not in written


def test_a_folder_with_a_line_break_in_its_name_has_a_report(finished: Bench, capsys) -> None:
    out = finished.store.parent / "two\nlines"
    report = ["report", "--runs", str(finished.store), "--plugins", str(finished.plugins)]
    assert main([*report, "--out", str(out)]) == 0
    assert (out / "report.html").is_file()
    charts = list((out / "charts").glob("*.svg"))
    assert charts
    assert all(path.with_suffix(".pdf").is_file() for path in charts)
    assert main(["results", "--runs", str(out / "none\nhere")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_colors_of_rich_pass_and_the_streams_come_back(capsys) -> None:
    before = sys.stdout
    with terminal() as streams:
        sys.stdout.write("a\x1bb")
        sys.stdout.styled.write("\x1b[1mbold")  # type: ignore[attr-defined]
    assert sys.stdout is before
    assert streams.code(0) == 0
    assert capsys.readouterr().out == "a\\x1bb\x1b[1mbold"


def test_the_log_of_a_job_is_utf8_whatever_the_terminal_has(bench: Bench, tmp_path: Path) -> None:
    from econgs_bench.bench.run.runner import _environment

    code = "print('\N{MULTIPLICATION SIGN}\\udce9')"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**_environment(1)}, capture_output=True, check=False
    )
    assert done.stdout.decode("utf-8") == "\N{MULTIPLICATION SIGN}\\udce9\n"
