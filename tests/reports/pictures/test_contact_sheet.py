"""Contact sheets: every tile's views and curves stand where they belong."""

from __future__ import annotations

import numpy as np

from econgs_bench.reports.pictures.contact_sheet import Tile, contact_sheet

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.2, 0.8)


def _view(color: tuple[float, float, float], side: int = 40) -> np.ndarray:
    return np.broadcast_to(np.asarray(color), (side, side, 3)).copy()


def _where(sheet: np.ndarray, color: tuple[float, float, float]) -> np.ndarray:
    return np.argwhere((sheet == np.rint(np.asarray(color) * 255)).all(axis=-1))


def _tile(color: tuple[float, float, float], **kwargs) -> Tile:
    return Tile("name", "variable", (_view(color), _view(color)), 0.125, **kwargs)


def test_views_stand_side_by_side_unscaled() -> None:
    at = _where(contact_sheet("set", [_tile(RED)]), RED)
    assert len(at) == 2 * 40 * 40
    assert np.ptp(at[:, 0]) == 39
    assert np.ptp(at[:, 1]) == 79


def test_tiles_fill_rows_from_the_left() -> None:
    sheet = contact_sheet("set", [_tile(RED)] * 3 + [_tile(BLUE)])
    red, blue = _where(sheet, RED), _where(sheet, BLUE)
    assert len(red) == 3 * len(blue)
    assert blue[:, 0].min() > red[:, 0].max()
    assert blue[:, 1].min() == red[:, 1].min()


def test_the_curve_has_color_and_height_of_the_transfer_function() -> None:
    table = np.zeros((1000, 4))
    table[:, :3] = BLUE
    table[500:750, 3] = 0.5
    at = _where(contact_sheet("set", [_tile(RED, transfer=table)]), BLUE)
    tile = 420
    start = _where(contact_sheet("set", [_tile(RED)]), RED)[:, 1].min()
    assert abs(at[:, 1].min() - start - 0.5 * tile) <= 2
    assert abs(at[:, 1].max() - start - 0.75 * tile) <= 2
    tall = _where(contact_sheet("set", [_tile(RED, transfer=table * (1, 1, 1, 2))]), BLUE)
    assert 1.7 < np.ptp(tall[:, 0]) / np.ptp(at[:, 0]) < 2.3


def test_a_peak_narrower_than_a_pixel_is_drawn() -> None:
    table = np.zeros((16384, 4))
    table[:, :3] = BLUE
    table[5000, 3] = 0.9
    assert len(_where(contact_sheet("set", [_tile(RED, transfer=table)]), BLUE)) > 20


def test_histogram_and_isosurfaces() -> None:
    counts = np.zeros(256, dtype=int)
    counts[:128] = 1000
    sheet = contact_sheet("set", [_tile(RED, histogram=counts, levels=((0.75, BLUE),))])
    bars = _where(sheet, (222 / 255,) * 3)
    level = _where(sheet, BLUE)
    assert len(bars) > 0.4 * 420 * 50
    assert bars[:, 1].max() < level[:, 1].min()


def test_long_names_do_not_leave_their_tile() -> None:
    tiles = [Tile("n" * 300, "v" * 300, (_view(RED),), 0.5)] * 2
    long, short = contact_sheet("t" * 500, tiles), contact_sheet("t", [_tile(RED)] * 2)
    assert long.shape == short.shape
    assert (long[:, -14:] == 255).all()
