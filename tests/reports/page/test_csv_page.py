"""The page of another tool's table has nothing that the table lacks."""

import re

import pytest

from reports.__main__ import main
from tests.reports.page.test_page import Checker

TABLE = """dataset,scene,method,psnr,size_bytes,fps
engine,bone,alpha,32.1,1048576,100
engine,bone,beta,31,524288,
"""


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(TABLE)
    return path


def test_the_page_has_no_empty_column_fact_or_section(table, tmp_path):
    assert main(["--table", str(table), "--out", str(tmp_path / "out")]) == 0
    checker = Checker()
    source = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    checker.feed(source)
    text = " ".join(" ".join(checker.text).split())
    for words in ("Preset", "Machine", "Image size", "LPIPS", "SSIM", "FLIP", "ΔE", "Primitives", "Load",
                  "Host mem", "Reference kernel"):  # fmt: skip
        assert words not in text, words
    assert not {"scenes", "editing", "provenance"} & set(re.findall(r'<h2 id="(\w+)"', source))
    assert "32.10" in text
    heads = (tmp_path / "out" / "results.md").read_text(encoding="utf-8").splitlines()[0]
    assert heads == "| Dataset | Scene | Method | PSNR [dB] | Size [MiB] | FPS | Status |"


def test_a_file_where_the_folder_shall_be_is_an_error(table, capsys):
    assert main(["--table", str(table), "--out", str(table)]) == 2
    assert main(["--table", str(table), "--out", str(table / "deeper")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert all(line.startswith(f"error: {table}") and "--out" in line for line in lines)
