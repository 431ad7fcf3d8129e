"""Axes, places of labels, and charts as SVG and PDF."""

import json
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pandas as pd
import pytest

from econgs_bench.reports.charts import files, svg
from econgs_bench.reports.charts.chart import (
    Axis,
    Chart,
    Panel,
    Series,
    Text,
    broken_axis,
    linear_axis,
    log_axis,
)
from econgs_bench.reports.charts.labels import overlap, place_labels, text_width
from econgs_bench.reports.sections.parts.chart import ledger, ledger_chart
from econgs_bench.reports.sections.section import Section, card, to_html
from econgs_bench.reports.style import MARKERS, Look
from tests.reports.sections.test_sections import texts, tradeoff

SVG = "{http://www.w3.org/2000/svg}"
LOOK = Look("#0072B2", "circle", "solid")


def parse(document):
    return ElementTree.fromstring(document)


def test_labels_do_not_overlap():
    points = [(100 + i % 3, 100 + i) for i in range(6)]
    boxes = [label.box for label in place_labels(points, ["method number"] * 6, (0, 0, 330, 250))]
    for i, box in enumerate(boxes):
        assert box[0] >= 0
        assert box[2] <= 330
        assert not overlap(box, np.array(boxes[:i]).reshape(-1, 4)).any()


def test_labels_too_long_for_their_chart_are_broken_at_spaces():
    long = "Scaffold-GS [configuration=paper] (incomplete)"
    for x in (5.0, 140.0, 275.0):
        (label,) = place_labels([(x, 100.0)], [long], (0, 0, 280, 200))
        assert " ".join(label.lines) == long
        assert len(label.lines) > 1
        assert label.box[2] - label.box[0] == pytest.approx(max(map(text_width, label.lines)))
        assert label.box[0] >= 0
        assert label.box[2] <= 280
    (label,) = place_labels([(5.0, 100.0)], ["ECoNGS (1 of 4)"], (0, 0, 280, 200))
    assert label.lines == ("ECoNGS (1 of 4)",)


def test_text_widths_are_those_of_helvetica():
    """Sums of the widths of Adobe's font metrics, in thousandths of the size."""
    assert text_width("PSNR [dB]", 1000) == pytest.approx(667 + 667 + 722 + 722 + 278 + 278 + 556 + 667 + 278)
    assert text_width("Million", 1000) == pytest.approx(833 + 222 * 4 + 556 * 2)


@pytest.mark.parametrize("ends", [(0.1, 0.4), (3.0, 700.0), (1e-7, 5.0), (42.0, 42.0)])
def test_axes_hold_their_values_and_ticks_read_as_numbers(ends):
    for axis in (log_axis(ends, "size [MiB]"), linear_axis(ends, "size [MiB]", least=0.5)):
        assert 0 < axis.share(ends[0]) <= axis.share(ends[1]) < 1
        assert 2 <= len(axis.ticks) <= 10
        assert all(-1e-9 <= axis.share(value) <= 1 + 1e-9 for value, _ in axis.ticks)
        assert [float(text.replace(",", "")) for _, text in axis.ticks] == pytest.approx(
            [value for value, _ in axis.ticks], abs=1e-12
        )
        assert axis.unit == "MiB"
    assert log_axis(ends, "").share((ends[0] * ends[1]) ** 0.5) == pytest.approx(0.5)


LEARNED = [[32.2], [31.5, 32.0, 32.7], [30.9, 31.8]]


@pytest.mark.parametrize("sign", [1, -1])
def test_far_values_are_drawn_and_do_not_press_the_others_into_a_line(sign):
    """Volume codecs reach from 28 to 90 dB, learned methods from 31 to 33; mirrored, they reach down."""
    volumes = [[28.8, 41.0, 49.2, 58.0, 89.6], [27.7, 38.2, 62.0, 89.5]]
    groups = [[sign * value for value in group] for group in (*LEARNED, *volumes)]
    values = sorted(value for group in groups for value in group)
    axis, plain = broken_axis(groups, "PSNR [dB]", least=2.0), linear_axis(values, "PSNR [dB]")
    shares = [axis.share(value) for value in values]
    assert 0 < min(shares) <= max(shares) < 1
    assert np.all(np.diff(shares) > 0)
    spread = abs(axis.share(sign * 32.7) - axis.share(sign * 30.9))
    assert spread > 0.2 > 5 * abs(plain.share(sign * 32.7) - plain.share(sign * 30.9))
    ((value, share),) = axis.bends
    assert axis.share(value) == pytest.approx(share)
    assert sum(tick > value for tick, _ in axis.ticks) >= 2
    assert sum(tick < value for tick, _ in axis.ticks) >= 2
    heights = sorted(258 * axis.share(tick) for tick, _ in axis.ticks)
    assert min(np.diff(heights)) > 11  # texts do not meet
    ((_, above, text),) = axis.remarks
    outer, inner = (axis.high - value) / (1 - share), (value - axis.low) / share
    assert above == (sign > 0)
    assert int(re.search(r"\d+", text)[0]) == round(outer / inner if above else inner / outer)


@pytest.mark.parametrize(
    "groups",
    [
        LEARNED,
        [[17.0], *([value] for value in (30.0, 31.0, 32.0, 33.0, 34.0, 35.0))],  # a mesh below
        [[20.0], [40.0]],
        [[30.0]],
        [],
        [[], [30.0, 90.0]],
        # Single points of volume codecs do not press the training of learned methods.
        [[49.0], [51.5], [26.0, 28.0, 31.0, 33.0], [17.0, 24.0, 32.0]],
        [[88.0], [90.0], [89.0], [18.0, 33.0], [19.0, 32.0], [17.0, 33.0], [20.0, 34.0]],
    ],
)
def test_an_axis_is_not_broken_without_need(groups):
    values = [value for group in groups for value in group]
    assert broken_axis(groups, "PSNR [dB]", least=2.0) == linear_axis(values, "PSNR [dB]", least=2.0)


def test_both_ends_of_an_axis_may_be_compressed():
    axis = broken_axis([*LEARNED, [-40.0], [90.0]], "PSNR [dB]")
    assert [share for _, share in axis.bends] == [0.25, 0.75]
    assert [above for _, above, _ in axis.remarks] == [False, True]
    assert 0 < axis.share(-40.0) < 0.25 < axis.share(30.9) < axis.share(32.7) < 0.75 < axis.share(90.0) < 1


def test_lines_have_corners_where_the_scale_changes():
    axis = broken_axis([*LEARNED, [28.8, 89.6]], "PSNR [dB]")
    ((value, _),) = axis.bends
    panel = Panel(
        "t", Axis("x", 0.0, 1.0), axis, [Series("s", [0.0, 1.0, 0.5], [28.8, 89.6, 30.0], LOOK, 1.0)]
    )
    path = panel.path([0.0, 1.0, 0.5], [28.8, 89.6, 30.0])
    up, down = (value - 28.8) / (89.6 - 28.8), 1.0 - 0.5 * (89.6 - value) / (89.6 - 30.0)
    expected = [(0.0, 28.8), (up, value), (1.0, 89.6), (down, value), (0.5, 30.0)]
    assert np.allclose(path, [panel.place(*spot) for spot in expected])
    assert panel.path([0.2], [30.0]) == [panel.place(0.2, 30.0)]
    assert panel.path([], []) == []
    document = svg.drawing(panel)
    assert axis.remarks[0][2] in [element.text for element in parse(f"<svg>{document}</svg>").iter("text")]
    points = json.loads(re.search(r'json">(.*)</script>', svg.page_panel(panel))[1])
    assert points["y"]["bends"] == [list(bend) for bend in axis.bends]


def test_remarks_on_a_chart_stand_below_it_as_wide_as_it_is(tmp_path):
    axis = linear_axis([0.0, 1.0], "x")
    note = "Left out: " + ", ".join(f"method <{i}> on 2 scenes, of another truth" for i in range(12)) + "."
    charts = [Chart([Panel("t", axis, axis)] * count, {"a": LOOK, "b": LOOK}, note) for count in (1, 3)]
    for chart in charts:
        document = parse(svg.file(chart))
        lines = [each for each in document.iter(f"{SVG}text") if each.text in note and len(each.text) > 9]
        assert " ".join(each.text for each in lines) == note
        heights = [float(each.get("y")) for each in lines]
        assert min(heights) > chart.panels[0].height
        assert max(heights) < float(document.get("height"))
        assert len(set(heights)) == len(heights)
        assert max(text_width(each.text) for each in lines) < float(document.get("width"))
    with files.output(tmp_path) as write:
        write({"many": Chart([Panel("t", axis, axis)] * 13, note="Left out: nothing.")})
    assert all("Left out: nothing." in path.read_text() for path in tmp_path.glob("many-?.svg"))


def test_a_section_of_the_page_has_the_remarks_of_its_charts_once():
    axis = linear_axis([0.0, 1.0], "x")
    charts = {
        name: Chart([Panel("t", axis, axis)], note=note)
        for name, note in zip("abc", ("<x>", "", "<x>"), strict=True)
    }
    html = to_html(Section("s", "S", html="<p>own</p>", charts=charts, layout=False))
    assert html == '<p>own</p><p class="note">&lt;x&gt;</p>'
    bare = Section("s", "S", html="<p>own</p>", charts={"b": charts["b"]}, layout=False)
    assert to_html(bare) == "<p>own</p>"


def test_room_for_labels_is_kept_free():
    assert 0.7 < linear_axis([0.0, 30.0], "", start=0.0, room=0.25).share(30.0) < 0.75
    assert log_axis([1.0, 100.0], "", room=0.5).share(100.0) == pytest.approx(0.5)


def test_points_are_drawn_where_their_values_are():
    x, y = Axis("x", 0.0, 10.0), Axis("y", 1.0, 100.0, log=True)
    panel = Panel("t", x, y, [Series("s", [0.0, 5.0, 10.0], [1.0, 10.0, 100.0], LOOK, line=1.0)])
    left, top, width, height = panel.box
    (path,) = [
        e for e in parse(f"<svg>{svg.drawing(panel)}</svg>").iter("path") if e.get("stroke") == LOOK.color
    ]
    spots = [tuple(map(float, pair.split())) for pair in path.get("d")[1:].split("L")]
    expected = [(left, top + height), (left + width / 2, top + height / 2), (left + width, top)]
    assert np.allclose(spots, expected, atol=0.06)


def test_every_marker_and_area_is_well_formed_and_texts_are_escaped():
    for marker in MARKERS:
        axes = Axis("x", 0.0, 1.0), Axis("y", 0.0, 1.0)
        area = Series("", [0.5, 1.0, 1.0], [0, 1, 0], LOOK, fill=True)
        point = Series("s", [0.5], [0.5], Look("#000000", marker, ""), mark=4.0)
        labels = [Text(0.5, 0.5, "<i>&", "#000000")]
        panel = Panel("a < b & c", *axes, [area, point], labels, stages=[(0.3, "</svg>")])
        chart = Chart([panel] * 4, {"<n>": Look("#000000", marker, "dash")})
        words = [element.text for element in parse(svg.file(chart)).iter(f"{SVG}text")]
        assert words.count("<i>&") == words.count("</svg>") == words.count("a < b & c") == 4
        assert "<n>" in words


def test_the_page_has_the_same_drawing_with_values_and_keys(maker):
    maker.run(scene="a", method="ivr-gs", rate=64, psnr=33.333333, fps=12.0, views=0)
    (panel,) = tradeoff(maker, "fps").panels
    html = card(panel, "PSNR & speed")
    assert svg.drawing(panel) in html
    assert "PSNR &amp; speed" in html
    points = json.loads(re.search(r'<script type="application/json">(.*)</script>', html)[1])
    means = points["series"][-1]
    assert (means["x"], means["y"], means["names"]) == ([12], [33.333], ["mean over scenes"])
    assert means["keys"] == [["vortex / iVR-GS @ 64 / quick / test"]]
    assert points["x"]["text"] == "frames per second {}"
    assert points["y"]["text"] == "{} dB"


def test_what_no_page_holds_is_in_several_files(tmp_path):
    axis = linear_axis([0.0, 1.0], "x")
    small = [Panel(f"set {i}", axis, axis) for i in range(13)]
    wide = [Panel(f"bars {i}", axis, axis, width=800.0, height=900.0) for i in range(2)]
    with files.output(tmp_path) as write:
        write({"many": Chart(small), "many-bars": Chart(wide[:1])})
    with files.output(tmp_path) as write:
        write({"many": Chart(small[:2]), "many-bars": Chart(wide)})
    names = ["many-bars-1", "many-bars-2", "many"]
    assert {path.name for path in tmp_path.iterdir()} == {f"{n}.{s}" for n in names for s in ("svg", "pdf")}
    with files.output(tmp_path) as write:
        write({"many": Chart(small)})
    assert "set 12" in (tmp_path / "many-2.svg").read_text()
    assert "set 11" in (tmp_path / "many-1.svg").read_text()
    for document in map(parse, (path.read_text() for path in tmp_path.glob("*.svg"))):
        assert float(document.get("height")) < 1.5 * float(document.get("width"))


def test_wide_panels_stand_below_each_other():
    axis = linear_axis([0.0, 1.0], "x")
    panels = [
        Panel(f"p {i}", axis, axis, width=width) for i, width in enumerate((800, 800, 380, 380, 380, 2000))
    ]
    document = parse(svg.file(Chart(panels)))
    moves = [each.get("transform") for each in document.iter(f"{SVG}g") if each.get("transform")]
    spots = [
        tuple(map(float, re.findall(r"[\d.]+", move))) for move in moves[:-1]
    ]  # the last is the legend's
    left, top = zip(*spots, strict=True)
    assert list(left) == [0.0, 0.0, 0.0, 394.0, 788.0, 0.0]
    assert top[0] < top[1] < top[2] == top[3] == top[4] < top[5]
    assert float(document.get("width")) == 2000.0
    assert svg.pages(panels[:2]) == [panels[:2]]
    assert svg.pages([]) == [[]]


def test_files_are_the_same_every_time_and_embed_their_font(maker, tmp_path, monkeypatch):
    # A folder of the working directory is not taken for the package.
    (tmp_path / "reports" / "charts").mkdir(parents=True)
    (tmp_path / "reports" / "__init__.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    for method in ("3dgs", "econgs", "hac"):
        for dataset in ("x", "y"):
            maker.run(dataset, method=method, views=0, psnr=30 + len(method))
    chart = tradeoff(maker, "fps")
    for name in "ab":
        with files.output(tmp_path / name) as write:
            write({"psnr-fps": chart})
    paths = [tmp_path / name / "psnr-fps.pdf" for name in "ab"]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert b"/FontFile" in paths[0].read_bytes()
    words = [element.text for element in parse(paths[0].with_suffix(".svg").read_text()).iter(f"{SVG}text")]
    assert {"x", "y", "3DGS", "ECoNGS-R", "HAC", "frames per second"} <= set(words)


def test_a_chart_that_cannot_be_converted_is_an_error(maker, tmp_path, monkeypatch):
    monkeypatch.setattr("econgs_bench.reports.charts.svg.file", lambda chart: "<svg")
    with pytest.raises(RuntimeError, match="PDF"), files.output(tmp_path) as write:
        write({"broken": Chart([])})


def test_charts_of_any_number_of_bars_and_panels(maker):
    for method in ("3dgs", "econgs", "hac"):
        for dataset in ("x", "y"):
            maker.run(dataset, method=method, psnr=30 + len(method))
    tables = maker.tables()
    bars = tables["ledger"]
    for size in (bars.head(1), bars, bars.assign(variant="an_option=with a very long value," * 4)):
        every = pd.concat([size, *(size.assign(part=f"part {i}", job=f"{i}") for i in range(9))])
        for table in (size, every):
            chart = ledger_chart(*ledger(table))
            (panel,) = chart.panels
            parse(svg.file(chart))
            assert panel.box[0] >= max(text_width(text) for _, text in panel.y.ticks)
            for _, place in panel.placed:
                assert place.box[2] <= panel.width


def test_many_variants_and_scenes_leave_no_label_on_another(maker):
    rng = np.random.default_rng(3)
    for method in ("3dgs", "econgs", "hac", "scaffold-gs", "ivr-gs"):
        for scene in "ab":
            psnr, size = float(rng.normal(33.0, 0.3)), int(rng.integers(1 << 20, 1 << 22))
            maker.run(scene=scene, method=method, psnr=psnr, size=size, views=0)
    (panel,) = tradeoff(maker).panels
    assert texts(panel) == {"3DGS", "ECoNGS-R", "HAC", "Scaffold-GS", "iVR-GS"}
    boxes = [place.box for _, place in panel.placed]
    assert not any(overlap(a, np.array(boxes[:i]).reshape(-1, 4)).any() for i, a in enumerate(boxes))
