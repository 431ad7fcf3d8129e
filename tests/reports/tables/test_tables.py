import json
import re

import pandas as pd
import pytest

from econgs_bench.reports.comparability import judged, notes
from econgs_bench.reports.style import mib, seconds
from econgs_bench.reports.tables.columns import quality
from econgs_bench.reports.tables.documents import to_latex, to_markdown
from econgs_bench.reports.tables.grid import needed
from econgs_bench.reports.tables.means import summary
from econgs_bench.reports.tables.ranks import ranks
from econgs_bench.reports.tables.results import display, for_terminal
from tests.reports.conftest import NO_LPIPS, fill
from tests.reports.page.test_page import page


def test_summary_means_quality_and_sums_sizes_and_times(maker):
    maker.run(scene="a", psnr=30.0, size=1000, seconds=10.0, fps=100.0)
    maker.run(scene="b", psnr=34.0, size=3000, seconds=20.0, fps=50.0, peak_host_bytes=900 << 20)
    row = summary(maker.tables()["results"]).iloc[0]
    assert row["psnr"] == 32.0
    assert row["fps"] == 75.0
    assert (row["size_bytes"], row["train_seconds"]) == (4000, 30.0)
    assert row["peak_host_bytes"] == 900 << 20
    assert row["complete"]
    assert row["scenes"] == "2 of 2"


def test_no_average_over_an_incomplete_set(maker):
    fill(maker, "failures")
    table = summary(maker.tables()["results"]).set_index("method")
    assert table.loc["econgs", "complete"]
    assert not table.loc["3dgs", "complete"]
    assert pd.isna(table.loc["3dgs", "psnr"])
    assert pd.isna(table.loc["3dgs", "size_bytes"])
    assert table.loc["3dgs", "note"].endswith("tf1: oom")
    assert table.loc["hac", "scenes"] == "0 of 2"


def test_a_scene_that_was_never_run_counts_as_missing(maker):
    maker.run(scene="a")
    maker.run(scene="b")
    maker.run(scene="a", method="hac")
    row = summary(maker.tables()["results"]).set_index("method").loc["hac"]
    assert (row["scenes"], row["complete"]) == ("1 of 2", False)
    assert "b: " in row["note"]
    assert "a: " not in row["note"]


def test_composed_rows_are_never_summed(maker):
    maker.run(scene="a", size=1000)
    maker.run(scene="a+b", size=5000, kind="composed")
    row = summary(maker.tables()["results"]).iloc[0]
    assert row["size_bytes"] == 1000


def test_seeds_are_averaged_with_their_spread(maker):
    fill(maker, "seeds")
    row = summary(maker.tables()["results"]).iloc[0]
    assert row["seeds"] == 3
    assert row["psnr"] == pytest.approx(34.0)
    assert row["psnr_std"] == pytest.approx(0.3)
    assert row["size_bytes"] == 8_000_000


def test_missing_lpips_lets_ssim_and_flip_lead(maker):
    maker.run()
    assert quality(maker.tables()["results"])[:2] == ("ssim", "flip")
    maker.run(scene="b", lpips=0.1)
    assert quality(maker.tables()["results"])[0] == "psnr"


def test_best_and_second_by_direction_and_only_among_finished_rows(maker):
    maker.run(method="a", psnr=30.0, size=100 << 20)
    maker.run(method="b", psnr=32.0, size=10 << 20)
    maker.run(method="c", psnr=31.0, size=50 << 20)
    maker.run(method="d", status="oom")
    marks = ranks(maker.tables()["results"])
    assert {i: marks.get((i, "psnr")) for i in range(4)} == {0: None, 1: 1, 2: 2, 3: None}
    assert {i: marks.get((i, "size_bytes")) for i in range(4)} == {0: None, 1: 1, 2: 2, 3: None}


def test_values_that_are_not_compared_are_not_ranked(maker):
    for method, psnr in (("a", 30.0), ("b", 32.0), ("c", 31.0)):
        maker.run(method=method, psnr=psnr)
    results = maker.tables()["results"]
    results["differences"] = ["", json.dumps({"psnr": "another metric: version 2"}), ""]
    marks = ranks(results)
    assert {i: marks.get((i, "psnr")) for i in range(3)} == {0: 2, 1: None, 2: 1}


def test_a_single_method_is_not_called_best(maker):
    fill(maker, "normal")
    assert ranks(maker.tables()["results"]) == {}


def test_markdown_marks_and_escapes(maker):
    maker.run(method="a|b", psnr=30.0)
    maker.run(method="c", psnr=32.0)
    *lines, blank, note = to_markdown(maker.tables()["results"]).splitlines()
    assert len(lines) == 4
    assert blank == ""
    assert note.startswith("lpips_vgg: ")  # once, though both rows lack it
    assert "**32.00**" in lines[3]
    assert "*30.00*" in lines[2]
    assert "a\\|b" in lines[2]
    assert len({line.replace("\\|", "").count("|") for line in lines}) == 1
    latex = to_latex(maker.tables()["results"])
    assert r"\textbf{32.00}" in latex
    assert r"\underline{30.00}" in latex


def test_other_tables_are_written_as_they_are():
    table = pd.DataFrame(
        {"file": ["a.png"], "psnr": [31.234], "lpips_vgg": pd.Series([None], dtype="Float64")}
    )
    assert "| a.png | 31.23 | \N{EN DASH} |" in to_markdown(table)
    assert "a.png & 31.23 & -- " in to_latex(table)


def test_a_terminal_shows_reasons_only_for_failures(maker):
    maker.run(reason=NO_LPIPS)
    shared, columns = _shown(maker.tables()["results"], 200)
    assert {"Reason", "LPIPS", "Status"}.isdisjoint(columns)
    assert columns["Training"] == ["42.0 s"]
    assert "status" not in shared
    maker.run(scene="b", status="oom", reason="limit")
    _, columns = _shown(maker.tables()["results"], 200)
    assert columns["Reason"] == ["", "limit"]
    assert columns["Status"] == ["ok", "oom"]


def test_a_narrow_terminal_has_fewer_columns_but_whole_numbers(maker):
    maker.run()
    results = maker.tables()["results"]
    everything = _shown(results, 200)[1]
    _, columns = _shown(results, 60)
    assert {"PSNR [dB]", "SSIM", "Size [MiB]", "Training", "FPS"} <= set(columns) < set(everything)
    assert columns["Training"] == ["42.0 s"]


def _shown(results, width):
    """What all rows share, and header -> cells."""
    shared, fields = for_terminal(results, width)
    assert needed(fields) <= width
    return shared, {field.header: field.cells for field in fields}


def test_empty_tables(maker):
    results = maker.tables()["results"]
    assert summary(results).empty
    assert display(results).empty
    assert all(cells == [] for cells in _shown(results, 200)[1].values())
    assert to_markdown(results).count("\n") == 2


def test_scores_without_a_metric_say_so_once():
    scores = pd.DataFrame(
        {
            "file": ["a.png", "b.png"],
            "psnr": [30.0, 31.0],
            "lpips_vgg": [None, None],
            "reason": ["lpips_vgg: no weights", "lpips_vgg: no weights"],
        }
    )
    for text in (to_markdown(scores), to_latex(scores)):
        assert "LPIPS" not in text
        assert text.count("no weights") == 1
        assert "31.00" in text


def test_times_of_several_processors_have_a_warning(maker) -> None:
    for scene, isa in (("a", ", avx2"), ("b", ", avx512"), ("c", ""), ("d", ", avx512")):
        maker.run(scene=scene, processor=f"EPYC, 2 cores{isa}", fit_processor="EPYC, 2 cores, avx2")
    tables = maker.tables()
    tables["results"] = judged(tables["results"])
    (note,) = (note for note in notes(tables["results"]) if "EPYC" in note)
    assert note.count("EPYC, 2 cores") == 2, "without the name that lacks the instruction set"
    assert {"avx2", "avx512"} <= set(re.findall(r"\w+", note))
    assert note in to_markdown(tables["results"])
    assert note in page(maker, tables=tables)[0]
    assert list(tables["results"]["differences"].map(bool)) == [True, False, False, False]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0042, "4.2 ms"),
        (0.0994, "99.4 ms"),
        (0.0996, "0.10 s"),
        (0.42, "0.42 s"),
        (12.34, "12.3 s"),
        (59.96, "1 min 00 s"),
        (200, "3 min 20 s"),
        (3599.7, "1 h 00 min"),
        (3900, "1 h 05 min"),
    ],
)
def test_durations(value, text):
    assert seconds(value) == text


def test_sizes_are_mib():
    assert mib(2**20) == "1.00"
    assert mib(126.92 * 2**20) == "127"
    assert mib(11.18 * 2**20) == "11.2"
