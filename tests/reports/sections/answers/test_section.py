"""The first screen: answers, the chart that decides, methods by criteria."""

import re

import pytest

from econgs_bench.reports.comparability import judged
from econgs_bench.reports.page.document import write_report
from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.answers import contest
from econgs_bench.reports.sections.answers.conclusion import to_text
from econgs_bench.reports.sections.order import answers
from tests.reports.page.test_page import page


def test_the_answers_come_first_with_their_evidence_and_all_else_is_folded(maker):
    for dataset in ("x", "y", "z"):
        maker.run(dataset, method="3dgs", psnr=30.0, size=4_000_000, views=0)
        maker.run(
            dataset, method="econgs", psnr=31.0 + len(maker.rows["results"]) / 10, size=1_000_000, views=0
        )
    out = write_report(maker.tables(), maker.root, maker.root / "r.html").read_text(encoding="utf-8")
    anchors = re.findall(r'<h2 id="([\w-]+)"', out)
    assert anchors[0] == "answers"
    assert re.findall(r'<section aria-labelledby="([\w-]+)"', out) == ["answers"]
    assert out.count('<details class="part">') == len(anchors) - 1
    matrix = re.search(r'<table class="matrix">.*?</table>', out)[0]
    best = re.search(r'<td class="shade4 first">0.95 MiB<br><small>(.*?)</small></td>', matrix)
    assert best[1] == "first on 3 of 3 scenes"
    assert set(re.findall(r'href="#([\w-]+)"', matrix)) <= set(anchors)
    assert out.count('type="radio" name="decision"') == 3
    assert (maker.root / "charts" / "decision-size.pdf").is_file()
    report = Report(maker.tables())
    lines = to_text(contest.of_report(report)[0], answers(report))
    assert len(lines) <= 10
    assert any("ECoNGS-R, 0.95 MiB: 4.0 times smaller than 3DGS" in line for line in lines)


def test_a_report_of_one_method_has_no_answers_and_nothing_folded(maker):
    maker.run(views=0)
    source, _ = page(maker)
    assert 'id="answers"' not in source
    assert '<details class="part">' not in source


def test_disturbed_times_are_marked(maker):
    for i in range(6):
        kernel = 0.02 if i == 5 else 0.01
        where = {"processor": "P", "fit_processor": "P", "fit_reference_seconds": 0.01}
        maker.run(scene=f"tf{i}", views=0, reference_seconds=kernel, **where)
    tables = maker.tables()
    tables["results"] = judged(tables["results"])
    source, _ = page(maker, tables=tables)
    marks = re.findall(r"(\S+) <abbr data-w=\d+>disturbed</abbr>", source)
    assert [mark.partition(">")[2] or mark for mark in marks] == ["(120)", "ms)"], "loading was timed beside"
    assert "2 times its quiet time" in source


@pytest.mark.parametrize(
    ("floors", "texts"),
    [
        ((50.0, 54.0), ["52.00 dB", "50.0 to 54.0 dB on 2 of 2 scenes"]),
        ((50.0, None), ["50.0 to 50.0 dB on 1 of 2 scenes"]),
        ((None, None), []),
    ],
)
def test_the_first_table_has_the_floor_of_the_truth(maker, floors, texts):
    for scene, floor in zip(("a", "b"), floors, strict=True):
        for method in ("3dgs", "econgs"):
            maker.run("d", scene, method, floor=floor, views=0)
    source, _ = page(maker)
    matrix = re.search(r'<table class="matrix">.*?</table>', source)[0]
    heads = [re.sub("<.*?>", "", head) for head in re.findall("<th scope=.col.>(.*?)</th>", matrix)]
    lines = re.findall(r'<tr class="soft">(.*?)</tr>', matrix)
    assert bool(lines) == bool(texts)
    for line in lines:
        cells = [re.sub("<[^>]*>", "|", cell).strip("|") for cell in re.findall("<td>(.*?)</td>", line)]
        assert len(cells) == len(heads) - 1
        place = heads.index("Best picture") - 1
        assert [text for text in cells[place].split("|") if text] == texts
        assert not any(cells[:place] + cells[place + 1 :])


def test_the_page_has_what_the_truth_reaches_in_each_metric(maker):
    maker.run("d", "a", floor=54.12, one_ray=30.81, samples=0, views=0)
    axes = {"dataset": "d", "scene": "a", "kind": "basic", "samples": 0}
    for job in ("views-1", "views-2"):  # of two splits, say
        maker.rows["floors"] += [
            axes | {"job": job, "picture": "truth", "psnr": 54.12, "ssim": 0.9991},
            axes | {"job": job, "picture": "one ray", "psnr": 30.81, "ssim": 0.95},
        ]
    source, _ = page(maker)
    table = re.search(r"<caption>What the truth itself reaches</caption>.*?</table>", source)[0]
    rows = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", line) for line in re.findall("<tr>(.*?)</tr>", table)]
    assert rows[0][2:] == ["PSNR [dB]", "SSIM"]
    assert [line[2:] for line in rows[1:]] == [["54.12", "0.9991"], ["30.81", "0.9500"]]
    assert "rays as needed" in rows[1][1]
    assert "54.12" in re.search(r"<tr class=\"row scene\".*?</tr>", source)[0]
