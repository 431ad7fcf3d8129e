"""Colors of the catalogue: eyes that lack a cone type tell the scenes of a dataset apart.

Dichromacy after Machado, Oliveira and Fernandes, "A Physiologically-based Model for Simulation of Color
Vision Deficiency", IEEE TVCG 15(6), 2009, at severity 1, as colour-science has it; differences are CIEDE2000.
"""

from __future__ import annotations

from itertools import combinations

import colour
import numpy as np
import pytest
from colour.blindness import CVD_MATRICES_MACHADO2010

from econgs_bench.datasets.auto_transfer import COLORS
from econgs_bench.datasets.catalogue import entries

EYES = {
    "normal": np.eye(3),
    "deuteranopia": np.asarray(CVD_MATRICES_MACHADO2010["Deuteranomaly"][1.0]),
    "protanopia": np.asarray(CVD_MATRICES_MACHADO2010["Protanomaly"][1.0]),
}
LEAST = 10.0  # several times what is just noticeable
MANY = 8  # more scenes than good palettes have colors


def _lab(color: tuple[float, ...], eyes: str) -> np.ndarray:
    linear = np.clip(EYES[eyes] @ colour.cctf_decoding(np.asarray(color), function="sRGB"), 0.0, 1.0)
    return np.asarray(colour.XYZ_to_Lab(colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ @ linear))


def _difference(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """The least over all eyes."""
    return min(float(colour.delta_E(_lab(a, e), _lab(b, e), method="CIE 2000")) for e in EYES)


def _mean_color(scene: dict) -> tuple[float, ...]:
    """Of the bumps, weighted by opacity; or of the isosurfaces."""
    parts = scene.get("bumps", scene.get("isosurfaces", []))
    weights = [part.get("opacity", 1.0) for part in parts]
    return tuple(np.average([part["color"] for part in parts], axis=0, weights=weights))


def _pairs(table: dict) -> set[tuple[str, str]]:
    """Scenes that must be told apart: all; of many, those of one variable or one named composition."""
    names = [scene["name"] for scene in table["scenes"]]
    if len(names) <= MANY:
        return set(combinations(names, 2))
    together = list(table.get("compositions", {}).values())
    variables = {scene["variable"] for scene in table["scenes"]}
    together += [[s["name"] for s in table["scenes"] if s["variable"] == v] for v in sorted(variables)]
    # A palette begins again where a single variable or composition has more than it holds.
    return {pair for part in together if len(part) <= MANY for pair in combinations(part, 2)}


@pytest.mark.parametrize("name", [n for n in entries.names() if entries.entry(n)["kind"] != "views"])
def test_scenes_are_told_apart_by_all_eyes(name: str) -> None:
    table = entries.entry(name)
    colors = {scene["name"]: _mean_color(scene) for scene in table["scenes"]}
    near = {
        pair: round(difference, 1)
        for pair in _pairs(table)
        if (difference := _difference(colors[pair[0]], colors[pair[1]])) < LEAST
    }
    assert not near


def test_automatic_colors_are_told_apart_by_all_eyes() -> None:
    assert min(_difference(a, b) for a, b in combinations(COLORS, 2)) >= LEAST


def test_red_and_green_of_like_lightness_would_not_be() -> None:
    red, green = (0.75, 0.35, 0.2), (0.45, 0.5, 0.2)
    assert (
        _difference(red, green)
        < LEAST
        < float(colour.delta_E(_lab(red, "normal"), _lab(green, "normal"), method="CIE 2000"))
    )
