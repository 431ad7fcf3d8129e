"""Transfer functions beside pictures: what is drawn is what the scene shows."""

from __future__ import annotations

import json

import numpy as np
import pytest

from econgs_bench.bench.jobs.scene_views import transfer_summary
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.reports.page.document import write_report
from econgs_bench.reports.pictures import panel_files
from econgs_bench.reports.pictures.transfer import transfer_picture
from tests.reports.conftest import frame
from tests.reports.page.test_page import undrawn

RED, BLUE = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]


def transfers(**parts) -> str:
    return json.dumps({name: {"transfer": [], "levels": []} | part for name, part in parts.items()})


def test_a_band_is_drawn_where_its_values_are() -> None:
    bins = [[*RED, 0.0]] * 40 + [[*RED, 0.5]] * 20 + [[*RED, 0.0]] * 40
    picture = transfer_picture(transfers(a={"transfer": bins}), 100)
    red = (picture[..., 0] > 100) & (picture[..., 1] == 0)
    columns = np.nonzero(red.any(axis=0))[0]
    assert columns.min() == pytest.approx(40, abs=1)
    assert columns.max() == pytest.approx(59, abs=1)
    assert red[:, 50].sum() == pytest.approx(50, abs=2)  # of 100 rows: opacity 0.5
    assert (picture[:-1, :35] == 255).all()


def test_a_white_band_has_an_outline() -> None:
    bins = [[1.0, 1.0, 1.0, 0.0]] * 40 + [[1.0, 1.0, 1.0, 0.5]] * 20 + [[1.0, 1.0, 1.0, 0.0]] * 40
    dark = (transfer_picture(transfers(a={"transfer": bins}), 100) < 200).all(axis=-1)[:-1]
    columns = np.nonzero(dark.sum(axis=0) > 30)[0]
    assert list(columns) == [pytest.approx(40, abs=1), pytest.approx(59, abs=1)]
    assert dark[:, 50].sum() == 1


def test_levels_are_lines_and_parts_are_strips() -> None:
    picture = transfer_picture(
        transfers(a={"levels": [[0.25, *RED]]}, b={"transfer": [[*BLUE, 1.0], [*BLUE, 1.0]]}), 100
    )
    assert (picture[10, 25] == [255, 0, 0]).all()
    assert (picture[80, 50] == [0, 0, 255]).all()
    assert (picture[10, 60] == 255).all()


@pytest.mark.parametrize("nothing", [None, "", "{}"])
def test_nothing_known_is_no_picture(nothing) -> None:
    assert transfer_picture(nothing, 50) is None


def test_what_a_scene_shows() -> None:
    dataset = open_dataset("shells@16")
    (part,) = transfer_summary(dataset, "middle").values()
    bins = np.array(part["transfer"])
    scene = dataset.scene("middle")
    (bump,) = scene.transfer.bumps
    peak = bins[:, 3].argmax() / len(bins)
    assert bump.start <= peak <= bump.end
    assert bins[int(peak * len(bins)), :3] == pytest.approx(bump.color, abs=1e-3)
    (blue,) = transfer_summary(dataset, "middle", "palette=#0000ff").values()
    assert np.array(blue["transfer"])[int(peak * len(bins)), 2] == pytest.approx(1.0)
    assert list(transfer_summary(dataset, next(iter(dataset.compositions)))) == [
        part.name for part in dataset.parts(next(iter(dataset.compositions)))
    ]


def drawn(maker, tables) -> tuple[int, int]:
    """The transfer functions of a page, and the pictures of its panels for papers."""
    with undrawn() as panels:
        page = write_report(tables, maker.root, maker.root / "report.html").read_text(encoding="utf-8")
    sheet = panel_files.draw(*panels.call_args.args[:2])
    return page.count('class="tf"'), sheet.document.count("<image ")


def test_the_page_and_panels_have_it_beside_the_ground_truth(maker) -> None:
    maker.run()
    tables = maker.tables()
    none, pictures = drawn(maker, tables)
    assert none == 0
    row = {"dataset": "vortex", "scene": "tf0", "preset": "quick", "split": "test"}
    tables["scenes"] = frame("scenes", [row | {"transfer": transfers(a={"transfer": [[*RED, 1.0]] * 2})}])
    views = 2  # the worst and the median one
    assert drawn(maker, tables) == (views, pictures + views)
