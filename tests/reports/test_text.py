"""Labels that would be commands of a terminal, of XML, of Markdown or of a spreadsheet."""

from __future__ import annotations

import csv
import io
import re
import xml.etree.ElementTree as ElementTree
from html import escape
from html.parser import HTMLParser
from pathlib import Path

import pandas as pd
import pytest

from econgs_bench.reports.charts import files
from econgs_bench.reports.charts.chart import Axis, Chart, Panel
from econgs_bench.reports.inputs import read_results
from econgs_bench.reports.tables.documents import to_csv, to_markdown
from econgs_bench.reports.tables.table import tex
from econgs_bench.reports.text import (
    csv_cell,
    csv_text,
    markdown_cell,
    one_line,
    printable,
    short_name,
    xml_text,
)

TERMINAL = "\x1b]0;title\x07\x1b[2J \x9b31m \r \x00 \u202e \u2028 \ud800"


def test_no_control_character_reaches_a_terminal() -> None:
    assert not any(sign in "\x1b\x07\x9b\r\0\u202e\u2028\ud800" for sign in printable(TERMINAL))
    assert printable("rén\t512x512 … 🙂\n") == "rén\t512x512 … 🙂\n"
    assert one_line("a\nb\tc\x1b") == r"a\nb\tc\x1b"
    assert one_line("rén 512x512 …") == "rén 512x512 …"


def test_long_names_of_files_are_cut_and_stay_different(tmp_path) -> None:
    for name in ("a" * 130, "rén-1"):
        assert short_name(name) == name
    names = {short_name(sign * 5000 + end) for sign in "aé\U0001f600" for end in "xy"}
    assert len(names) == 6
    for name in names:
        (tmp_path / f"{name}.pdf").touch()


def test_every_character_is_valid_xml_and_what_xml_knows_stays() -> None:
    every = "".join(map(chr, [*range(0xD800, 0xD900), *range(0x20), 0x7F, 0xFFFE, 0xFFFF, 0x1F600, 0xE9]))
    document = f"<a>{xml_text(escape(every))}</a>"
    text = ElementTree.fromstring(document.encode("utf-8")).text
    assert text is not None
    assert text.endswith("\x7f\\ufffe\\uffff\U0001f600é")
    assert "\t\n" in text


class _Markup(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.found.append(tag)


MARKUP = (
    "<script>alert(1)</script>", "<img src=x onerror=alert(1)>", "<https://example.org>", "a | b | c",
    "*bold* **b** _i_ __b__ ~~gone~~", "[text](javascript:alert(1))", "![](http://example.org/x.png)",
    "[text][1]", "&lt;b&gt; &#60;b&#62;", "line\n\n# heading\r\n- item", "back\\slash \\| pipe",
)  # fmt: skip


def _rendered(text: str) -> str:
    """Plain text of escaped Markdown, by CommonMark's rule for backslashes, after a check for live markup."""
    markup = _Markup()
    markup.feed(text)
    assert not markup.found
    bare = re.sub(r"\\[!-/:-@[-`{-~]", "", text)
    assert "\n" not in bare
    assert not re.search(r"[|*`]|~~|\][(\[]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])", bare)
    plain = re.sub(r"\\([!-/:-@[-`{-~])", r"\1", text)
    return plain.replace("&lt;", "<").replace("&amp;", "&")


@pytest.mark.parametrize("text", MARKUP)
def test_a_cell_of_markdown_is_what_it_says(text: str) -> None:
    expected = " ".join(text.replace("\r", "").split("\n")).replace("  ", " ")
    assert _rendered(markdown_cell(text)).replace("  ", " ") == expected


def test_names_of_the_field_stay_readable_in_markdown() -> None:
    assert markdown_cell("one ` alone") == "one ' alone"
    for text in (
        "run `bench fetch`",
        "hac_plus",
        "my [3f2a]",
        "PSNR [dB] ↑",
        "36.74 ± 0.05",
        "3dgs, sh_degree=2 & more",
    ):
        assert markdown_cell(text) == text


FORMULAS = (
    "=1+1",
    "+1+1",
    "-2+3",
    "@SUM(A1)",
    "\tx",
    "\rx",
    "'=1",
    "''=1",
    "'quoted'",
    "plain",
    "-",
    "-2 +cmd",
    "-50 to -4.5e-05",
    "",
)


@pytest.mark.parametrize("text", FORMULAS)
def test_no_cell_of_csv_is_a_formula_and_each_is_read_back(text: str) -> None:
    number = text == "-50 to -4.5e-05"
    assert number or csv_cell(text)[:1] not in ("=", "+", "-", "@", "\t", "\r")
    assert csv_text(csv_cell(text)) == text
    if text in ("plain", "'quoted'", "", "-50 to -4.5e-05"):
        assert csv_cell(text) == text


def test_tables_with_hostile_labels_survive(tmp_path: Path) -> None:
    row = {"dataset": "=cmd()", "scene": "<b>s</b>", "method": "-m", "psnr": -3.5, "size_bytes": 100}
    path = tmp_path / "results.csv"
    path.write_text(to_csv(pd.DataFrame([row])), encoding="utf-8")
    ((dataset, _, method, psnr, _),) = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))[1:]
    assert (dataset, method, psnr) == ("'=cmd()", "'-m", "-3.5")
    tables = read_results(path)
    results = tables["results"]
    assert results[["dataset", "scene", "method"]].iloc[0].tolist() == ["=cmd()", "<b>s</b>", "-m"]
    assert results["psnr"].iloc[0] == -3.5
    written = to_markdown(results)
    assert "<b>" not in written
    assert "&lt;b>s&lt;/b>" in written
    assert "\x1b" not in tex("a\x1bb")


@pytest.mark.parametrize("folder", ["plain", "new\nline é"])
def test_charts_with_control_characters_become_files(tmp_path: Path, folder: str) -> None:
    axis = Axis("x\x1b[2J", 0.0, 1.0)
    chart = Chart([Panel("title\x1b[31m\x00", axis, axis)])
    with files.output(tmp_path / folder) as write:
        write({"one": chart})
    root = ElementTree.fromstring((tmp_path / folder / "one.svg").read_bytes())
    assert r"title\x1b[31m\x00" in "".join(root.itertext())
    assert (tmp_path / folder / "one.pdf").read_bytes().startswith(b"%PDF")
