"""The parts of the training loss: what is a part, where stages begin, and how the chart shows them."""

import json
import re

import pandas as pd
import pytest

from econgs_bench.reports.charts import svg
from econgs_bench.reports.charts.labels import text_width
from econgs_bench.reports.sections.losses.chart import losses_chart
from econgs_bench.reports.sections.losses.table import losses, steps
from econgs_bench.reports.style import MOST_NAMED
from tests.reports.conftest import settings
from tests.reports.sections.test_sections import curve_table, sections


def losses_of(curve, stretches=()):
    """The losses of a curve, and of (job, method, stage, first, iteration, parts)."""
    table = pd.DataFrame(stretches, columns=["job", "method", "stage", "first", "iteration", "losses"])
    table["losses"] = [json.dumps(parts) for parts in table["losses"]]
    table = table.assign(dataset="d", scene="a", preset="quick", seed=0, **settings(""))
    return losses(steps({"curve": curve, "losses": table}))


def test_loss_parts_without_figures_that_are_no_part_and_with_the_start_of_the_rate():
    early = json.dumps({"image": 0.02, "scale": 1e-9})
    late = json.dumps({"image": 0.01, "scale": 1e-9, "rate": 0.002, "bits per attribute": 3.0})
    rows = [
        ("j", s, "econgs", i, 1.0, 30.0, None, early if i < 300 else late) for s in "ab" for i in (100, 300)
    ]
    (panel,) = losses_of(curve_table(rows))
    assert [part.name for part in panel.parts] == ["loss", "image", "rate"]
    assert panel.parts[0].y == pytest.approx([0.02 + 1e-9, 0.012 + 1e-9])
    assert panel.marks == [(300.0, "rate first seen")]
    assert panel.small == ["scale"]
    assert losses_chart([panel]).panels[0].stages == panel.marks


def test_parts_that_join_together_share_a_mark():
    late = json.dumps({"image": 0.01, "rate": 0.002, "masks": 0.001})
    early = json.dumps({"image": 0.02})
    rows = [("j", "a", "hac", i, 1.0, 30.0, None, early if i < 300 else late) for i in (100, 300)]
    (panel,) = losses_of(curve_table(rows))
    assert panel.marks == [(300.0, "rate, masks first seen")]


def test_losses_are_means_over_stretches_with_marks_where_stages_begin():
    steps = [("j", "a", "econgs", 100, 1.0, 30.0, None, json.dumps({"image": 9.0, "scale": 1.0}))]
    stretches = [
        (job, "econgs", stage, i - 9, i, {"loss": base + rate, "image": base, "rate": rate})
        for job, base in (("j", 0.02), ("k", 0.04))
        for stage, i, rate in (
            ("warm-up", 10, 0.0),
            ("growth", 20, 0.0),
            ("noise", 30, 0.01),
            ("noise", 40, 0.01),
        )
    ]
    (panel,) = losses_of(curve_table(steps), stretches)
    assert panel.marks == [(11.0, "growth"), (21.0, "noise")]
    loss, image, rate = panel.parts
    assert (loss.x, loss.y) == ([10.0, 20.0, 30.0, 40.0], pytest.approx([0.03, 0.03, 0.04, 0.04]))
    assert image.y == pytest.approx([0.03] * 4)
    assert rate.x == [30.0, 40.0]
    # A stage of a single step has a mark, with its neighbour, and no point.
    short = [("j", "m", stage, first, last, {"loss": loss, "image": loss}) for stage, first, last, loss in
             (("a", 1, 100, 1.0), ("b", 101, 101, 9.0), ("c", 102, 200, 1.0))]  # fmt: skip
    (panel,) = losses_of(curve_table([]), short)
    assert panel.marks == [(101.0, "b, c")]
    assert panel.parts[0].y == [1.0, 1.0]
    # A method that has none there is drawn from its steps.
    other = curve_table(
        [("m", "a", "hac", i, 1.0, 30.0, None, '{"image": 1.0, "scale": 0.5}') for i in (1, 2)]
    )
    assert [panel.title for panel in losses_of(other, stretches)] == ["ECoNGS-R", "HAC"]


def test_a_part_of_the_loss_has_one_color_in_all_panels():
    both, one = '{"image": 0.1, "color": 0.05, "rate": 0.01}', '{"image": 0.1, "rate": 0.01}'
    rows = [(m, "s", m, i, 1.0, 30.0, None, text) for m, text in (("a", both), ("b", one)) for i in (1, 2)]
    panels = losses_chart(losses_of(curve_table(rows))).panels
    colors = [{part.title: part.look.color for part in panel.series} for panel in panels]
    assert colors[1] == {name: shade for name, shade in colors[0].items() if name != "color"}
    assert len(set(colors[0].values())) == 4


def test_losses_of_many_variants_are_those_of_the_default():
    text = '{"image": 0.1, "rate": 0.01}'
    variants = ["", *(f"hidden={i}" for i in range(MOST_NAMED))]
    each = [
        curve_table([(f"j{v}", "s", "econgs", i, 1.0, 30.0, None, text) for i in (1, 2)]).assign(variant=v)
        for v in variants
    ]
    assert [panel.title for panel in losses_of(pd.concat(each))] == ["ECoNGS-R"]
    assert len(losses_of(pd.concat(each[:MOST_NAMED]))) == MOST_NAMED


def test_titles_of_panels_are_broken_before_they_are_cut():
    rows = [("j", "s", "econgs", i, 1.0, 30.0, None, '{"image": 0.1, "rate": 0.01}') for i in (1, 2)]
    table = curve_table(rows).assign(variant="decoder_precision=float32", dataset="a dataset of a long name")
    chart = losses_chart(losses_of(table))
    (panel,) = chart.panels
    document = svg.file(chart)
    lines = re.findall(r'stroke-width="0.4">([^<]+)<', document)
    assert " ".join(lines) == panel.title
    assert max(map(text_width, lines)) < panel.width


def test_the_section_names_what_is_too_small_and_what_is_single_steps(maker):
    maker.run("d", "a", "econgs", views=0)
    rows = [("j", "a", "econgs", i, 1.0, 30.0, None, '{"image": 0.02, "scale": 1e-9}') for i in (1, 2)]
    html = sections(maker.tables() | {"curve": curve_table(rows)})["losses"]
    assert "they are under 1e-05 of it: scale." in html
    assert "there are single steps" in html
