"""Which pictures show a method's first breaks, on tables and files made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from econgs_bench.reports.schema import records
from econgs_bench.reports.sections.ladders.breaks import breaks_of, draw_breaks, draw_flicker
from econgs_bench.reports.sections.ladders.conclusion import by_method
from econgs_bench.reports.sections.ladders.strips import Flicker
from econgs_bench.reports.sections.ladders.table import climbed, ladders
from tests.reports.pictures.test_panels import pictures_of, texts_of
from tests.reports.sections.ladders.test_strips import views
from tests.reports.sections.ladders.test_table import table


def made(rungs, psnr, folder):
    """Breaks of the method "a", of flat pictures whose gray is the PSNR, before truths of 100."""

    def save(name, value):
        Image.fromarray(np.full((4, 6, 3), value, np.uint8)).save(folder / name)
        return name

    of_jobs = views(
        psnr,
        truth_file=lambda job, view: save(f"truth-{view}.png", 100),
        render_file=lambda job, view: save(f"{job}-{view}.png", round(psnr[job][view])),
        background=lambda job, view: "#ffffff",
    )
    every = ladders(table(*rungs))
    (climbs,) = by_method(climbed(every)).values()
    return breaks_of(climbs, records(every), of_jobs, folder)


def grays(one):
    return [None if picture is None else int(picture.max()) for picture in (one.truth, one.broken, one.usual)]


def test_the_view_is_that_of_the_largest_loss(tmp_path) -> None:
    rungs = [{"place": 0, "psnr": 30.0}, {"place": 1, "psnr": 29.0}, {"place": 2, "psnr": 20.0}]
    psnr = {
        "measure-0": {"v0": 20.0, "v1": 40.0},
        "measure-1": {"v0": 20.0},
        "measure-2": {"v0": 15.0, "v1": 25.0},
    }
    (one,) = made(rungs, psnr, tmp_path)
    assert (one.ladder, one.rung, one.subject) == ("noise", "r2", "vortices/cores")
    assert one.kind == "quality, \N{MINUS SIGN}10.0 dB"
    assert grays(one) == [100, 25, 40]  # v1 fell by 15 dB, v0 by 5


def test_other_test_pictures_have_a_view_for_each_rung(tmp_path) -> None:
    rungs = [{"place": 0, "psnr": 30.0}, {"place": 1, "psnr": 29.0, "excess": 0.5, "same_truth": False}]
    psnr = {"measure-0": {"v0": 30.0, "v1": 28.0}, "measure-1": {"w0": 30.0, "w1": 24.0}}
    (one,) = made(rungs, psnr, tmp_path)
    assert one.kind.startswith("floaters")
    assert grays(one) == [100, 24, 28]


def test_a_failed_step_has_no_pictures(tmp_path) -> None:
    rungs = [{"place": 0, "psnr": 30.0}, {"place": 1, "psnr": None, "status": "failed", "reason": "x"}]
    assert made(rungs, {"measure-0": {"v0": 30.0}}, tmp_path) == []


@pytest.mark.parametrize("count", [1, 2, 5])
def test_every_picture_is_drawn_inside_the_figure(tmp_path, count) -> None:
    rungs = [{"place": 0, "psnr": 30.0}, {"place": 1, "psnr": 20.0}]
    (one,) = made(rungs, {"measure-0": {"v0": 30.0}, "measure-1": {"v0": 20.0}}, tmp_path)
    figure = draw_breaks([one] * count)
    assert len(boxes_of(figure)) == 3 * count


def test_flicker_has_a_picture_of_each_method() -> None:
    picture = np.zeros((4, 6, 3), np.uint8)
    changes = {(name, ""): picture for name in ("3dgs", "hac")}
    pair = Flicker("vortices/cores", ("v1", "v2"), picture, changes, dict.fromkeys(changes, 2.5))
    figure = draw_flicker(pair)
    assert len(boxes_of(figure)) == 3
    assert {"truth", "3DGS: 2.50", "HAC: 2.50"} <= {text for text, _ in texts_of(figure)}


def boxes_of(sheet):
    """Places of the pictures, each of which is inside the sheet, no two alike."""
    boxes, right, bottom = pictures_of(sheet), 72 * sheet.width, 72 * sheet.height
    assert all(0 <= a < c <= right and 0 <= b < d <= bottom for a, b, c, d in boxes)
    assert len(set(boxes)) == len(boxes)
    return boxes
