"""Families of the parts that bytes and times are made of: what bars show, in which color."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import cycle

OTHER = "other"
LEAST_SHARE = 0.01
"""A family that is under this share of every bar is merged into :data:`OTHER`."""
# Muted, so that they are not taken for methods.
_COLORS = {
    "positions": "#A7BBD1",
    "color": "#4C6A92",
    "opacity": "#D9CBB3",
    "shape": "#C9D7B8",
    "shading": "#8C7AA9",
    "features": "#B5838D",
    "offsets": "#6D8B74",
    "scalings": "#E5C1BD",
    "networks": "#B08D57",
    "context": "#D98C5F",
    "codebooks": "#5E5A66",
    "unused": "#DDDDDD",
    "decode": "#4C6A92",
    "shade": "#A7BBD1",
    "rasterise": "#B5838D",
    OTHER: "#999999",
}
_SPARE = ("#7FA8A3", "#A65E5E", "#C7B26B", "#6B7FA8", "#CFA5C0")
_FAMILIES = {
    "sh_dc": "color", "sh_rest": "color", "sh1": "color", "sh2": "color", "sh3": "color",
    "offset color": "color", "spherical harmonics": "color",
    "scale": "shape", "rotation": "shape", "rotation real": "shape", "rotation imaginary": "shape",
    "ambient": "shading", "diffuse": "shading", "specular": "shading", "shininess": "shading",
    "normal": "shading",
    "decoders": "networks",
    "grid": "context", "hash grid": "context", "context head": "context",
    "masks": "offsets",
    "normals": "unused", "unused normals": "unused", "unused opacity": "unused", "unused rotation": "unused",
    "scene": OTHER, "scene parameters": OTHER, "group": OTHER, "header": OTHER, "container": OTHER,
    "metadata": OTHER,
}  # fmt: skip
"""Part, as methods name it -> its family; one that is not here is a family of its own."""


def family(part: str) -> str:
    """What a part belongs to."""
    return _FAMILIES.get(part, part)


def small(bars: Iterable[Mapping[str, float]]) -> set[str]:
    """The families that are too small to be drawn in any of the bars (amounts by family)."""
    largest: dict[str, float] = {}
    for amounts in bars:
        total = sum(amounts.values()) or 1.0
        for name, amount in amounts.items():
            largest[name] = max(largest.get(name, 0.0), amount / total)
    return {name for name, share in largest.items() if share < LEAST_SHARE}


def ordered(families: Iterable[str]) -> list[str]:
    """Families as they follow each other in every bar, what is unknown and the rest at the end."""
    place = {name: i for i, name in enumerate(_COLORS)} | {OTHER: len(_COLORS) + 1}
    return sorted(dict.fromkeys(families), key=lambda name: place.get(name, len(_COLORS)))


def colors(families: Iterable[str]) -> dict[str, str]:
    """Color of each family, the same in all reports for those that are known here."""
    spare = cycle(_SPARE)
    return {name: _COLORS.get(name) or next(spare) for name in families}
