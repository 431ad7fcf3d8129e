import contextlib
import html
import json
import re
from collections import Counter
from collections.abc import Iterator
from html.parser import HTMLParser
from itertools import pairwise
from unittest.mock import Mock, patch

import pytest
from PIL import Image

from econgs_bench.reports.charts import files
from econgs_bench.reports.charts.lines import lines
from econgs_bench.reports.page.document import write_report
from econgs_bench.reports.pictures import panel_files
from econgs_bench.reports.pictures.panels import ABSENT
from econgs_bench.reports.sections.anytime.table import anytime
from econgs_bench.reports.sections.parts import chart as parts
from econgs_bench.reports.sections.parts.chart import ledger_chart
from econgs_bench.reports.style import MISSING, look
from tests.reports.conftest import NO_LPIPS, fill
from tests.reports.sections.test_sections import texts, tradeoff


class Outline(HTMLParser):
    """What a page loads, whether its elements are closed, and its structure for a screen reader."""

    VOID = frozenset({"meta", "img", "br", "link", "input", "wbr"})

    def __init__(self, source: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.text: list[str] = []
        self.headings: list[int] = []
        self.wrong: list[str] = []
        self.tags: Counter[str] = Counter()
        self.ids: list[str] = []
        self.references: set[str] = set()
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags[tag] += 1
        self.sources += [values["src"]] if "src" in values else []
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if (tag == "img" and not values.get("alt")) or (tag == "th" and not values.get("scope")):
            self.wrong.append(self.get_starttag_text())
        if tag in ("select", "input") and "label" not in self.open:
            self.wrong.append(self.get_starttag_text())
        self.ids += [values["id"]] if "id" in values else []
        self.references |= {values[name] for name in ("aria-labelledby", "aria-controls") if name in values}
        if values.get("href", "").startswith("#"):
            self.references.add(values["href"][1:])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "script" not in self.open and "style" not in self.open:
            self.text.append(data)


@contextlib.contextmanager
def undrawn() -> Iterator[Mock]:
    """Reports without charts and panels for papers, which take seconds; yields what panels are given to."""
    with (
        patch.object(files, "output", return_value=contextlib.nullcontext(Mock())),
        patch.object(panel_files, "write", return_value="panel") as write,
    ):
        yield write


def page(maker, draw: bool = False, tables=None) -> tuple[str, str]:
    """The page's source and its text, of the maker's tables if of no others."""
    with contextlib.nullcontext() if draw else undrawn():
        tables = maker.tables() if tables is None else tables
        path = write_report(tables, maker.root, maker.root / "report.html")
    assert path.stat().st_size < 5e6
    return content(path)


def content(path) -> tuple[str, str]:
    """A page's source and its text."""
    source = path.read_text(encoding="utf-8")
    outline = Outline(source)
    assert outline.open == []
    assert all(value.startswith("data:image/") for value in outline.sources)
    return source, " ".join(" ".join(outline.text).split())


def hints(source, text) -> set[str]:
    """The explanations of a text in the table of results, which the page's script adds."""
    details = json.loads(re.search(r'<script type="application/json" id="details">(.*?)</script>', source)[1])
    return {details["reasons"][int(n)] for n in re.findall(rf"<abbr data-w=(\d+)>{text}<", source)}


def test_a_normal_report_is_whole_and_works_offline(maker):
    fill(maker, "normal")
    source, text = page(maker, draw=True)
    assert source.count('<svg xmlns="http://www.w3.org/2000/svg"') == 1 + 1
    assert "<link" not in source
    assert source.count('<figure class="card panel"') == 4
    for words in ("34.20", "31.70", "2 of 2", "32.95", "68a71d8fe012", "12.3 to 12.3 ms"):
        assert words in text
    charts = ["anytime-psnr", "ledger"]
    assert {p.name for p in (maker.root / "charts").iterdir()} == {
        *(f"{name}.{ending}" for name in charts for ending in ("pdf", "svg")),
        *(f"panel-vortex-tf{i}.{ending}" for i in (0, 1) for ending in ("pdf", "png")),
    }
    assert all((maker.root / f"results.{ending}").stat().st_size for ending in ("csv", "md", "tex"))


def test_the_page_in_markdown_has_its_answers_and_tables_and_names_files_that_are_there(maker):
    fill(maker, "normal")
    _, text = page(maker)
    written = (maker.root / "report.md").read_text(encoding="utf-8")
    titles = re.findall(r"^## (.*)$", written, re.MULTILINE)
    assert {"Results", "Uncertainty"} <= set(titles)
    assert all(title in text for title in titles)
    for row in re.findall(r"^\| (.*) \|$", written, re.MULTILINE):
        assert all(cell.replace("\\", "").replace("*", "") in text for cell in row.split(" | ")), row
    for file in re.findall(r"[^!]\[[^]]+\]\(([^)]+)\)", written):
        assert (maker.root / file).exists() or file == "charts/", file
    assert (maker.root / "report.tex").read_text(encoding="utf-8").count(r"\begin{tabular}") >= 2


def test_names_are_text_whatever_they_hold(maker):
    name = '$\\frac{x$ <!--<script>alert(1)</script> & "q"'
    for dataset in (name, "vortex"):
        for method in ("3dgs", "econgs"):
            maker.run(dataset=dataset, scene=name, method=method, views=1)
    source, text = page(maker, draw=True)
    assert name in text
    for body in re.findall(r"<script[^>]*>(.*?)</script>", source, re.S):
        assert "<!--" not in body
    assert Outline(source).tags["script"] == source.count("<script")
    assert list((maker.root / "charts").glob("panel-*.pdf"))


def test_a_screen_reader_finds_its_way(maker):
    fill(maker, "failures")
    maker.run("other", method="econgs")
    maker.dvr()
    outline = Outline(page(maker)[0])
    assert outline.headings[0] == 1
    assert outline.headings.count(1) == 1
    assert all(b <= a + 1 for a, b in pairwise(outline.headings))
    assert outline.wrong == []
    assert outline.tags["caption"] == outline.tags["table"] > 3
    assert {outline.tags[name] for name in ("header", "main", "nav")} == {1}
    assert len(outline.ids) == len(set(outline.ids))
    assert outline.references <= set(outline.ids)


def test_variants_are_counted_where_several_were_measured(maker):
    maker.run(method="3dgs", views=0)
    maker.run(method="hac", variant="configuration=paper", views=0)
    maker.run(method="econgs", views=0)
    maker.run(method="econgs", variant="shading=false", views=0)
    facts = re.findall(r"<dd>(.*?)</dd>", page(maker)[0])
    assert any(re.fullmatch(r"3DGS, HAC \(published\), ECoNGS-R\b[^,]*\b2\b[^,]*", fact) for fact in facts)


def test_a_missing_metric_is_a_dash_with_its_reason(maker):
    maker.run()
    source, text = page(maker)
    heads = text.partition("One row per scene")[2].partition("tf0")[0]
    assert "LPIPS" not in heads
    assert heads.index("PSNR [dB]") < heads.index("Size [MiB]") < heads.index("FPS") < heads.index("SSIM")
    assert NO_LPIPS in html.unescape(source), "a note"
    maker.run(scene="tf1", lpips=0.1)
    source, _ = page(maker)
    assert NO_LPIPS.partition(": ")[2] in hints(source, MISSING)


def test_failures_are_shown_escaped_with_reasons(maker):
    fill(maker, "failures")
    source, text = page(maker)
    assert "<b>cannot</b>" not in source
    for words in ("1 oom", "1 refused", "1 timeout", "1 stale", "the fit passed its limit of 8 GiB"):
        assert words in text
    assert any("tf1: oom" in why for why in hints(source, "incomplete")), "why 3DGS has no mean"
    assert re.search(r"class=first[^>]*>36.00", source)
    assert re.search(r"class=second[^>]*>33.98", source)


def test_the_page_of_an_empty_store_has_the_command_to_fill_it(maker):
    source, _ = page(maker)
    assert "<code>bench run quick</code>" in source
    assert "<section" not in source


def test_nothing_but_failures(maker):
    maker.run(status="failed", reason="boom")
    _, text = page(maker)
    assert "boom" in text


def test_a_store_without_pictures_has_one_note_and_no_empty_scenes(maker):
    for scene in "abc":
        maker.run(scene=scene)
    for view in maker.rows["views"]:
        (maker.root / view["render_file"]).unlink()
    source, _ = page(maker)
    (scenes,) = re.findall(r'<h2 id="scenes">.*?</section>', source, re.DOTALL)
    assert scenes.count('<p class="note">') == 1
    assert "<h3>" not in scenes
    assert str(maker.root) not in source
    assert "Errno" not in source


def test_scenes_without_pictures_are_counted_beside_others(maker):
    maker.run(scene="a")
    maker.run(scene="b")
    maker.run(scene="b", method="hac")
    for view in maker.rows["views"]:
        if view["scene"] == "a" or view["method"] == "hac":
            (maker.root / view["render_file"]).unlink()
    source, text = page(maker)
    assert re.search(r'<p class="note">[^<]*\b1 scene\b', source)
    assert ABSENT in text  # one model of a scene whose other model has a picture
    assert source.count("<h3>vortex / ") == 1


def test_a_broken_picture_has_a_note_without_its_path(maker):
    maker.run(views=1)
    (maker.root / maker.rows["views"][0]["render_file"]).write_bytes(b"none")
    source, _ = page(maker)
    assert len(re.findall(r'<div class="shot">(?:(?!<div).)*<p class="note">', source, re.DOTALL)) == 1
    assert str(maker.root) not in source


def test_long_lists_stand_in_wide_boxes(maker):
    for i in range(6):
        maker.run(dataset=f"a_dataset_{i}", views=0)
    source, _ = page(maker)
    assert source.count('class="fact long"') == 1


def test_details_follow_the_order_of_their_rows(maker):
    for scene, kind in (("a+b", "composed"), ("a", "basic"), ("a x=1", "edited"), ("b", "basic")):
        maker.run(scene=scene, kind=kind, edit="x=1" if kind == "edited" else "", views=0)
    source, _ = page(maker)
    kinds = re.findall(r'<tr class="row (\w+)"', source)
    details = json.loads(re.search(r'<script type="application/json" id="details">(.*?)</script>', source)[1])
    assert details["names"][0] == "Job"
    words = details["words"]
    jobs = [row[0] if isinstance(row[0], str) else words[row[0]] for row in details["rows"]]
    assert kinds == ["scene", "scene", "mean", "composed", "edited"]
    ids = {row["scene"]: row["job"] for row in maker.rows["results"]}
    assert jobs == [ids["a"], ids["b"], "", ids["a+b"], ids["a x=1"]]


def test_paths_out_of_the_store_are_not_read(maker, tmp_path):
    maker.run(views=1)
    Image.new("RGB", (96, 96)).save(tmp_path.parent / "secret.png")
    maker.rows["views"][0]["truth_file"] = "../secret.png"
    source, text = page(maker)
    assert "../secret.png" in text
    assert "<img src" not in source


def test_charts_hold_the_numbers(maker):
    maker.run(scene="a", psnr=30.0, size=2 << 20, fps=10)
    maker.run(scene="b", psnr=34.0, size=4 << 20, fps=10)
    scenes, means = tradeoff(maker).panels[0].series
    assert (scenes.x, scenes.y) == ((2.0, 4.0), (30.0, 34.0))
    assert (means.x, means.y) == ((3.0,), (32.0,))


def test_no_mean_is_drawn_where_scenes_are_missing(maker):
    fill(maker, "failures")
    (panel,) = tradeoff(maker).panels
    assert [len(each.x) for each in panel.series if each.line] == [1]
    assert "3DGS (incomplete)" in texts(panel)


def test_ledger_sums_to_the_bytes(maker):
    fill(maker, "normal")
    ledger = maker.tables()["ledger"]
    (panel,) = ledger_chart(*parts.ledger(ledger)).panels
    first = [bar for bar in panel.bars if bar.y == 0]
    assert sum(bar.end - bar.start for bar in first) == pytest.approx(100.0)
    assert first[-1].end == pytest.approx(100.0)
    assert "8.68 MiB" in texts(panel)
    counts = [int(re.search(r"\(([\d,]+) B\)", bar.about)[1].replace(",", "")) for bar in panel.bars]
    assert sum(counts) == ledger["bytes"].sum()


def test_a_method_keeps_its_color_where_others_are_missing(maker):
    maker.run(method="hac", status="oom")
    maker.run(method="3dgs")
    report = maker.report()
    curves = anytime(report.tables["curve"], report.results)
    line = lines(curves, "", "", report.models).panels[0].series[0]
    dot = tradeoff(maker).panels[0].series[0]
    colors = {each.method: look(each, report.models).color for each in report.models}
    assert line.look.color == dot.look.color == colors["3dgs"] != colors["hac"]
