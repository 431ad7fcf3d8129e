"""Tables in the width of a terminal: nothing that is read or copied is cut."""

import pytest

from econgs_bench.bench.commands.results import print_results, print_stored
from econgs_bench.reports.schema import TABLES
from econgs_bench.reports.tables.grid import Field, needed, to_lines
from econgs_bench.reports.terminal import print_prose
from tests.reports.conftest import Maker

LABEL = "all light=1,0,0 ambient=1.5 diffuse=1.5 specular=1.5 palette=#2060e0 | light=1,0,0 opacity=0.3"
JOBS = ["measure-0123456789abcdef", "measure-fedcba9876543210"]


def _fields(label=LABEL):
    return [
        Field("Scene", [label, "b"]),
        Field("Method", ["3DGS, coded [iterations=300]", "HAC"]),
        Field("PSNR [dB]", ["42.36", "(9.10)"], "number"),
        Field("Job", JOBS, "name"),
    ]


@pytest.mark.parametrize("width", [60, 80, 120, 400])
def test_numbers_and_names_are_whole_and_labels_wrap(width):
    lines = to_lines(_fields(), width)
    assert max(map(len, lines)) <= width
    words = [line.split() for line in lines]
    for cell in ("42.36", "(9.10)", *JOBS):
        assert [cell in line for line in words].count(True) == 1
    assert (len(lines) == 3) == (width == 400)


def test_a_label_loses_no_sign_at_any_width():
    for width in range(2, 60):
        lines = to_lines([Field("Scene", [LABEL + "x" * 50])], width)
        assert "".join("".join(lines[1:]).split()) == (LABEL + "x" * 50).replace(" ", "")
        assert max(map(len, lines)) <= max(width, 12)


def test_wide_signs_count_twice():
    lines = to_lines([Field("Scene", ["渦" * 30, "b"]), Field("Job", JOBS, "name")], 60)
    assert "".join(line[:20].replace("measure", " ").split()[0] for line in lines[1:3]).startswith("渦" * 5)
    assert sum(line.count("渦") for line in lines) == 30
    assert all(len(line) + line.count("渦") <= 60 for line in lines)


def test_numbers_stand_on_the_right():
    header, first, second = to_lines([Field("N", ["1", "22,333"], "number"), Field("", ["a", "b"])], 80)
    assert (header, first, second) == ("     N", "     1  a", "22,333  b")


def test_what_is_needed_is_what_is_taken():
    for width in range(needed(_fields()), 130):
        assert max(map(len, to_lines(_fields(), width))) <= width


def _terminal(monkeypatch, columns):
    """Let standard output be a terminal of so many columns; None: a file."""
    monkeypatch.setenv("COLUMNS", str(columns or 500))
    monkeypatch.setattr("sys.stdout.isatty", lambda: columns is not None)


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """With two datasets, seeds, edits, failures and variants."""
    maker = Maker(tmp_path_factory.mktemp("store"))
    for seed in (0, 1):
        for dataset in ("isabel_wind_of_2003", "b"):
            maker.run(dataset, LABEL, method="3dgs-coded", variant="iterations=300,samples=16", seed=seed)
            maker.run(dataset, "a", method="hac", seed=seed, psnr=100.0, fps=123456.0)
    maker.run("b", "c", status="failed", reason="a reason of many words " * 8)
    return maker.tables()


@pytest.mark.parametrize(("columns", "terminal"), [(80, True), (120, True), (120, False)])
@pytest.mark.parametrize("name", TABLES)
def test_every_table_of_a_store_fits(tables, monkeypatch, capsys, name, columns, terminal):
    """In a file as wide as 120 columns."""
    _terminal(monkeypatch, columns if terminal else None)
    table = tables[name].copy()
    print_results(table, jobs=True) if name == "results" else print_stored(name, table)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= columns
    for job in table["job"]:
        assert any(job in line.split() for line in lines)
    if name == "results":
        assert sum("100.00" in line.split() for line in lines) == 4
        words = ("PSNR", "Seed", "Dataset", "Method", *(["Size", "FPS"] if columns == 120 else []))
        assert all(word in " ".join(lines) for word in words)


def test_sentences_wrap_between_words_on_a_terminal_alone(monkeypatch, capsys):
    text = "Smallest          " + "some words " * 20 + "\n\nshort"
    _terminal(monkeypatch, None)
    print_prose(text)
    assert capsys.readouterr().out == text + "\n"
    _terminal(monkeypatch, 60)
    print_prose(text)
    first, *others, empty, short = capsys.readouterr().out.splitlines()
    assert (empty, short) == ("", "short")
    assert all(len(line) <= 60 and line.startswith(" " * 18) for line in others)
    assert " ".join([first, *others]).split() == text.split()[:-1]
