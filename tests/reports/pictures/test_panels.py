"""Panels: which views, models and windows are shown follows from the numbers, and pictures are true."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from econgs_bench.reports.charts import svg
from econgs_bench.reports.charts.labels import text_width
from econgs_bench.reports.family import Family
from econgs_bench.reports.pictures import panel_files
from econgs_bench.reports.pictures.cieluv import cieluv, linear
from econgs_bench.reports.pictures.difference import colored, largest_window, scale
from econgs_bench.reports.pictures.files import read
from econgs_bench.reports.pictures.panels import choose, models, panels
from econgs_bench.reports.sections.pictures import section as scenes
from econgs_bench.reports.sections.section import Page
from tests.reports.conftest import frame

SVG = "{http://www.w3.org/2000/svg}"
# Machado, Oliveira and Fernandes (2009), severity 1, on linear RGB.
DEFICIENCIES = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                   [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                     [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                   [0.004733, 0.691367, 0.303900]],
}  # fmt: skip


def views(**psnr: list[float]):
    """Model -> PSNR of its views "0", "1", ..."""
    rows = [
        {"job": job, "view": str(i), "psnr": value}
        for job, values in psnr.items()
        for i, value in enumerate(values)
    ]
    return frame("views", rows)


def pictures_of(sheet):
    """Left, top, right and bottom of the pictures in a sheet's document, in points."""
    images = ElementTree.fromstring(sheet.document).iter(f"{SVG}image")
    boxes = [[float(one.get(name)) for name in ("x", "y", "width", "height")] for one in images]
    return [(left, top, left + width, top + height) for left, top, width, height in boxes]


def texts_of(sheet):
    """Each line of text in a sheet's document, and its box in points, from cap height to descender."""
    found = []
    for one in ElementTree.fromstring(sheet.document).iter(f"{SVG}text"):
        x, y, size = (float(one.get(name, svg.SIZE)) for name in ("x", "y", "font-size"))
        found.append((one.text, (x, y - 0.75 * size, x + text_width(one.text, size), y + 0.25 * size)))
    return found


def html(maker):
    """The section of pictures."""
    report = maker.report()
    return scenes.section(Page(report, Family(), root=maker.root, folder=maker.root)).html


def panels_of(maker):
    """The panels of a store of one scene."""
    tables = maker.tables()
    return list(panels(models(tables["results"]), tables["views"], maker.root))


def test_worst_and_median_views_are_those_of_all_models_together():
    table = views(a=[30, 20, 31, 40, 33], b=[30, 29, 21, 42, 35])
    # means: 30, 24.5, 26, 41, 34; the lowest single value is 20, in the worst view anyway
    assert choose(table) == {"median": "0", "worst": "1"}


def test_a_model_that_fails_in_another_view_shows_it():
    table = views(a=[30, 20, 31], b=[30, 21, 31], c=[8, 30, 31])
    assert choose(table) == {"median": "1", "worst": "0"}
    table = views(a=[30, 20, 34], b=[30, 20, 34], c=[18, 30, 31])
    assert choose(table) == {"median": "0", "worst": "1"}
    table = views(a=[40, 20, 24, 30], b=[40, 20, 24, 30], c=[17, 22, 24, 30])
    assert choose(table) == {"median": "3", "worst": "1", "lowest": "0"}


def test_views_are_not_repeated_and_need_no_metric():
    assert choose(views(a=[30])) == {"median": "0"}
    assert choose(views(a=[None, None])) == {"median": "0"}
    assert choose(views()) == {}


def test_one_row_per_model_is_shown(maker):
    for rate, size in ((1.0, 300), (2.0, 200), (4.0, 100)):
        maker.run(method="ivr-gs", rate=rate, size=size, views=1)
    maker.run(method="3dgs", seed=1, psnr=20, views=1)
    maker.run(method="3dgs", seed=0, psnr=33, views=1)
    maker.run(method="hac", seed=0, stale=True, psnr=22, views=1)
    maker.run(method="hac", seed=1, psnr=23, views=1)
    maker.run(method="veg", seed=0, status="oom")
    rows = models(maker.tables()["results"]).set_index("method")
    assert rows["rate"]["ivr-gs"] == 2.0
    assert rows["psnr"]["3dgs"] == 33
    assert rows["psnr"]["hac"] == 23
    assert rows["status"]["veg"] == "oom"
    assert len(rows) == 4


def test_of_several_rates_the_default_is_shown(maker):
    for variant, size in (("rate_weight=0.01", 100), ("", 400), ("rate_weight=0.001", 200)):
        maker.run(method="hac", variant=variant, size=size, views=1)
    for rate, size in ((1.0, 300), (2.0, 200), (None, 500)):
        maker.run(method="ivr-gs", rate=rate, size=size, views=1)
    for variant, size in (("a=1,rate_weight=0.01", 100), ("a=1,rate_weight=0.02", 50), ("a=2", 70)):
        maker.run(method="econgs", variant=variant, size=size, views=1)
    rows = models(maker.tables()["results"])
    assert list(rows["size_bytes"]) == [400, 500, 50, 70]


def test_all_models_are_shown_in_the_same_view_and_window(maker):
    maker.run(method="3dgs", views=3)
    maker.run(method="hac", views=3, psnr=30)
    maker.run(method="veg", status="oom")
    of_scene = panels_of(maker)
    assert {panel.which for panel in of_scene} == {"median", "worst"}
    for panel in of_scene:
        assert [shot.picture is None for shot in panel.shots] == [False, False, True]
        truth = read(maker.root / f"jobs/views-vortex-tf0/truth/{panel.view}.png", (1, 1, 1))
        assert np.array_equal(panel.truth, truth)
        for shot in panel.shots[:2]:
            file = maker.root / f"jobs/{shot.row['job']}/renders/{panel.view}.png"
            assert np.array_equal(shot.picture, read(file, (1, 1, 1)))
        assert panel.zoom(panel.truth).shape == (24, 24, 3)


def test_the_window_is_where_the_mean_difference_is_largest():
    rng = np.random.default_rng(4)
    difference = rng.random((20, 31)) ** 6
    means = {
        (top, left): difference[top : top + 5, left : left + 5].mean()
        for top in range(16)
        for left in range(27)
    }
    assert largest_window(difference, 5) == max(means, key=lambda place: means[place])


def test_a_picture_of_another_size_is_a_problem_that_names_both_sizes(maker):
    maker.run(views=1)
    maker.run(method="hac", views=1)
    Image.new("RGBA", (50, 50)).save(maker.root / maker.rows["views"][1]["render_file"])
    (panel,) = panels_of(maker)
    assert panel.shots[0].picture is not None
    assert panel.shots[1].picture is None
    assert "96" in panel.shots[1].problem
    assert "50" in panel.shots[1].problem


def test_pictures_are_composited(tmp_path):
    Image.fromarray(np.array([[[200, 100, 0, 128]]], np.uint8)).save(tmp_path / "a.png")
    expected = np.rint(np.array([200, 100, 0]) * 128 / 255 + 255 * (1 - 128 / 255))
    assert np.array_equal(read(tmp_path / "a.png", (1, 1, 1))[0, 0], expected)


def test_difference_maps_have_one_fixed_scale():
    assert np.array_equal(colored(np.array([[0.0, 20.0, 99.0, 10.0]]))[0], scale()[[0, 255, 255, 128]])


def test_the_scale_goes_from_blue_to_red_and_ever_lighter_in_equal_steps():
    low, high = scale()[0].astype(int), scale()[-1].astype(int)
    assert low[2] > 2 * max(low[0], low[1])
    assert high[0] > 2 * max(high[1], high[2])
    colors = cieluv(scale() / 255.0)
    assert np.all(np.diff(colors[::8, 0]) > 0)
    steps = np.linalg.norm(np.diff(colors[::5], axis=0), axis=1)
    assert steps.max() < 1.3 * steps.min()  # of 8-bit colors


@pytest.mark.parametrize("kind", DEFICIENCIES)
def test_the_color_blind_can_read_the_scale(kind):
    seen = np.clip(linear(scale() / 255.0) @ np.array(DEFICIENCIES[kind]).T, 0.0, 1.0)
    colors = cieluv(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))
    apart = np.linalg.norm(colors[:, None] - colors[None], axis=-1)
    first, second = np.triu_indices(256, 256 // 5)
    assert apart[first, second].min() > 10.0  # a fifth of the scale is ten just noticeable differences
    first, second = np.triu_indices(256, 256 // 10)
    assert apart[first, second].min() > 5.0


def test_where_room_is_short_median_views_stay(maker):
    for scene in "abc":
        maker.run(scene=scene, views=3)
    whole = html(maker)
    assert whole.count("Median view") == whole.count("Worst view") == 3
    assert '<p class="note">' not in whole
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "PICTURE_BYTES", len(whole) * 2 // 3)
        page = html(maker)
    assert page.count("Median view") == 3
    assert 0 < page.count("Worst view") < 3
    (note,) = re.findall(r'<p class="note">(.*?)</p>', page)
    assert re.findall(r"\d+", note) == [str(3 - page.count("Worst view"))]


def test_composed_scenes_are_shown_and_named(maker):
    maker.run(scene="both", kind="composed", views=2)
    page = html(maker)
    assert re.search(r"<h3>[^<]*both <span[^>]*>composed</span>", page)
    assert page.count('<figure class="card panel"') == 2


def test_captions_of_panels_for_papers_end_at_their_picture(maker):
    maker.run(views=1)
    (panel,) = panels_of(maker)
    sheet = panel_files.draw([replace(panel, which="lowest", view="test_003")], "x")
    (caption,) = [box for text, box in texts_of(sheet) if text.startswith("lowest")]
    (values,) = [box for text, box in texts_of(sheet) if " dB" in text]
    assert caption[2] < values[0]


def test_long_names_in_panels_for_papers_keep_off_their_neighbours_and_pictures(maker):
    for variant in ("configuration=paper random_half_extent=0.5", "storage=explicit"):
        maker.run(variant=variant, views=1)
    (panel,) = panels_of(maker)
    sheet = panel_files.draw([panel], "x")
    top = min(box[1] for box in pictures_of(sheet))
    names = [(text, box) for text, box in texts_of(sheet) if box[3] < top and text != "Ground truth"]
    assert "random_half_extent=0.5" in "".join(text for text, _ in names)
    columns = sorted({box[0] for _, box in names})
    assert len(columns) == 2
    assert max(box[2] for _, box in names if box[0] == columns[0]) < columns[1]
    assert all(0.0 < box[1] < box[3] < top for _, box in names)


def test_panels_for_papers_have_odd_names_and_failed_models(maker):
    maker.run("set@64", "a/b c", views=2)
    maker.run("set@64", "a/b c", method="hac", status="oom", reason="no memory")
    of_scene = panels_of(maker)
    name = panel_files.write(of_scene, "set@64 / a/b c", maker.root / "charts")
    assert name == "panel-set@64-a-b-c"
    assert (maker.root / "charts" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    with Image.open(maker.root / "charts" / f"{name}.png") as image:
        assert image.width > 600
    texts = [text for text, _ in texts_of(panel_files.draw(of_scene, "x"))]
    assert {"Ground truth", "3DGS", "HAC", "oom", "median view, 0000", "worst view, 0001"} <= set(texts)
