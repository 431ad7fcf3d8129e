"""ParaView's color and opacity maps (.json, .xml) as transfer functions."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.transfer import MOST_OPACITY, Bump, TransferFunction

SPACES = {
    "rgb": "RGB", "hsv": "HSV", "wrapped": "HSV", "lab": "Lab", "cielab": "Lab", "diverging": "Diverging",
    "lab/ciede2000": "LabCIEDE2000", "step": "Step",
}  # fmt: skip
"""Color space as files name it, in small letters -> as VTK does."""
_SAMPLES, _COARSE = 4097, 257
_OPACITY, _COLOR = 1 / 1024, 1 / 512
"""Largest errors of a map's opacity and color."""
_MOST_BYTES = 16 * 2**20
_REMEDY = "Export it anew (ParaView: Color Map Editor, Save to preset, Export)"


@dataclass(frozen=True)
class TransferMap:
    """A color map, and the opacities that belong to it.

    Attributes:
        source: file, and name within it, for error messages.
        space: color space of the interpolation, a value of :data:`SPACES`.
        wrap: HSV: the hue takes the shorter way around the circle.
        colors: (n, 4) value in units of the data, ascending, and displayed sRGB in [0, 1].
        opacities: (m, 4) value, ascending, opacity in [0, 1], midpoint and sharpness in [0, 1] of the way to
            the next point (``vtkPiecewiseFunction``). A map without any gets ParaView's default, a ramp from
            0 to 1 over the values of its colors.
    """

    source: str
    space: str
    wrap: bool
    colors: NDArray[np.float64]
    opacities: NDArray[np.float64]


def read_map(path: Path, preset: str = "") -> TransferMap:
    """A map of a file that ParaView exported.

    Args:
        path: ``.json`` (a list of presets) or ``.xml`` (``ColorMaps``); the content decides.
        preset: its name, where the file holds several.

    Raises:
        DataError: the file cannot be read, holds no such map, or one of categories.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise DataError(path, f"has more than {_MOST_BYTES >> 20} MiB", "Export fewer presets")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DataError(path, f"cannot be read ({error.strerror})", "Name a readable map") from error
    except UnicodeDecodeError as error:
        raise DataError(path, "is neither JSON nor XML", _REMEDY) from error
    presets = _of_xml(path, text) if text.lstrip().startswith("<") else _of_json(path, text)
    if not presets:
        raise DataError(path, "holds no color map with RGBPoints", _REMEDY)
    if preset:
        if preset not in (names := [name for name, _ in presets]):
            raise unknown("preset", preset, names, of=str(path))
        chosen = next(one for name, one in presets if name == preset)
    elif len(presets) > 1:
        listed = ", ".join(name for name, _ in presets[:8]) + (" ..." if len(presets) > 8 else "")
        raise DataError(path, f"holds {len(presets)} maps: {listed}", 'Choose one: preset = "NAME"')
    else:
        ((preset, chosen),) = presets
    source = f"{path} ({preset})" if preset else str(path)
    return _checked(source, chosen)


def transfer_of(
    chosen: TransferMap,
    name: str,
    value_range: tuple[float, float] | None,
    reference_length: float = 0.01,
) -> TransferFunction:
    """A map as a transfer function of narrow bumps, which follow its colors and opacities.

    Below its first and above its last point the map goes on as it is there, as ParaView draws it.

    Args:
        chosen: the map.
        name: of the transfer function.
        value_range: data values that are normalised to 0 and 1, in which the map's values are meant; None:
            its colors and its opacities are stretched over that range, whatever it is.
        reference_length: of the transfer function.

    Raises:
        DataError: the map shows nothing, or lies outside the range.
    """
    ends = [(points[0, 0], points[-1, 0]) for points in (chosen.colors, chosen.opacities)]
    if value_range is not None:
        low, high = value_range
        first, last = min(one for one, _ in ends), max(one for _, one in ends)
        scaled_alike = (first, last) == (0.0, 1.0) and high - low > 100.0
        if last < low or first > high or scaled_alike:
            raise DataError(
                chosen.source,
                f"is a map of values from {first:g} to {last:g}, the volume's go from {low:g} to {high:g}",
                "Give rescale = true, or export it with the data's own range",
            )
        ends = [value_range, value_range]
    colors, opacities = (
        np.column_stack([(points[:, 0] - low) / (high - low), points[:, 1:]])
        for points, (low, high) in zip((chosen.colors, chosen.opacities), ends, strict=True)
    )
    at, rgb, opacity = _sampled(chosen, colors, opacities)
    if not (opacity > 0.0).any():
        raise DataError(chosen.source, "is transparent everywhere", "Raise its opacities")
    before, after = np.r_[0.0, at[:-1]], np.r_[at[1:], 1.0]
    bumps = tuple(
        Bump(
            f"{name} {number}",
            start if number else 0.0,
            middle if number else 0.0,
            middle if number < len(at) - 1 else 1.0,
            end,
            (float(color[0]), float(color[1]), float(color[2])),
            min(float(height), MOST_OPACITY),
        )
        for number, (start, middle, end, color, height) in enumerate(
            zip(before.tolist(), at.tolist(), after.tolist(), rgb, opacity, strict=True)
        )
        if height > 0.0
    )
    return TransferFunction(name, bumps, reference_length)


def _sampled(
    chosen: TransferMap, colors: NDArray[np.float64], opacities: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Values in [0, 1], their colors and opacities: on a grid, at all points, and on both sides of steps.

    VTK, on which ParaView is built, interpolates.
    """
    from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
    from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

    color, opacity = vtkColorTransferFunction(), vtkPiecewiseFunction()
    getattr(color, f"SetColorSpaceTo{chosen.space}")()
    color.SetHSVWrap(chosen.wrap)
    for function in (color, opacity):
        function.AllowDuplicateScalarsOn()
    for point in colors.tolist():
        color.AddRGBPoint(*point)
    for point in opacities.tolist():
        opacity.AddPoint(*point)
    steps = opacities[:-1, 0] + opacities[:-1, 2] * np.diff(opacities[:, 0])
    halves = 0.5 * (colors[:-1, 0] + colors[1:, 0])
    points = np.concatenate([colors[:, 0], opacities[:, 0], steps, halves])
    points = np.concatenate([np.linspace(0.0, 1.0, _SAMPLES), points, points - 1e-7, points + 1e-7])
    at = np.unique(np.clip(points, 0.0, 1.0))
    if chosen.space == "LabCIEDE2000":  # a search for a path each time, in steps of 8 bits
        table = [0.0] * (3 * _COARSE)
        color.GetTable(0.0, 1.0, _COARSE, table)
        grid, values = np.linspace(0.0, 1.0, _COARSE), np.array(table).reshape(-1, 3)
        rgb = np.round(np.column_stack([np.interp(at, grid, channel) for channel in values.T]), 6)
    else:
        rgb = np.round([color.GetColor(value) for value in at.tolist()], 6)
    heights = np.round([opacity.GetValue(value) for value in at.tolist()], 6)
    kept = _kept(at, rgb, heights)
    return at[kept], rgb[kept], heights[kept]


def _kept(at: NDArray[np.float64], rgb: NDArray[np.float64], opacity: NDArray[np.float64]) -> list[int]:
    """Samples whose bumps give the others within the errors: neighbouring bumps mix by their opacities."""

    def spans(first: int, last: int) -> bool:
        part = slice(first, last + 1)
        share = (at[part] - at[first]) / (at[last] - at[first])
        weights = np.stack([opacity[first] * (1.0 - share), opacity[last] * share])
        height = weights.sum(axis=0)
        if np.abs(height - opacity[part]).max() > _OPACITY:
            return False
        mixed = weights.T @ rgb[[first, last]] / np.maximum(height, 1e-12)[:, None]
        seen = opacity[part] > 0.0
        return bool((np.abs(mixed - rgb[part])[seen] <= _COLOR).all())

    kept = [0]
    while kept[-1] < len(at) - 1:
        first = kept[-1]
        good, bad = first + 1, len(at)
        while bad - good > 1:  # the farthest by halves
            middle = min(2 * good - first, (good + bad) // 2)
            good, bad = (middle, bad) if spans(first, middle) else (good, middle)
        kept.append(good)
    return kept


def _checked(source: str, preset: dict[str, Any]) -> TransferMap:
    """A map whose numbers are what they should be."""
    if preset["indexed"]:
        raise DataError(source, "is a map of categories", "Choose one of continuous values")
    space = SPACES.get(str(preset["space"]).lower())
    if space is None:
        known = "RGB, HSV, Lab, Diverging, Lab/CIEDE2000 or Step"
        raise DataError(source, f"has the color space {preset['space']!r}", f"Choose {known}")
    colors = _points(source, preset["colors"], "RGBPoints", "x, red, green and blue")
    if preset["opacities"]:
        opacities = _points(source, preset["opacities"], "Points", "x, opacity, midpoint and sharpness")
    else:
        opacities = np.array([[colors[0, 0], 0.0, 0.5, 0.0], [colors[-1, 0], 1.0, 0.5, 0.0]])
    return TransferMap(source, space, bool(preset["wrap"]), colors, opacities)


def _points(source: str, values: Any, key: str, what: str) -> NDArray[np.float64]:
    """(n, 4) points by value; all but the value in [0, 1]."""
    if not isinstance(values, list) or len(values) % 4 or len(values) < 8:
        raise DataError(source, f"{key} are not two or more points of {what}", _REMEDY)
    if not all(isinstance(one, int | float) and math.isfinite(one) for one in values):
        raise DataError(source, f"{key} hold what is no finite number", _REMEDY)
    points = np.array(values, dtype=np.float64).reshape(-1, 4)
    points = points[np.argsort(points[:, 0], kind="stable")]
    if points[:, 1:].min() < 0.0 or points[:, 1:].max() > 1.0:
        raise DataError(source, f"{key} are {what}, all but x from 0 to 1; one is not", _REMEDY)
    if points[0, 0] == points[-1, 0]:
        raise DataError(source, f"{key} are all at {points[0, 0]:g}", _REMEDY)
    return points


def _of_json(path: Path, text: str) -> list[tuple[str, dict[str, Any]]]:
    """Name and parts of each preset of a JSON text."""
    try:
        content = json_of(text)
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"is no JSON ({error})", _REMEDY) from error
    listed = content if isinstance(content, list) else [content]
    return [
        (
            str(one.get("Name", "")),
            {
                "space": one.get("ColorSpace", "RGB"),
                "wrap": one.get("HSVWrap", False),
                "colors": one.get("RGBPoints"),
                "opacities": one.get("Points"),
                "indexed": "RGBPoints" not in one,
            },
        )
        for one in listed
        if isinstance(one, dict) and ("RGBPoints" in one or "IndexedColors" in one)
    ]


def _of_xml(path: Path, text: str) -> list[tuple[str, dict[str, Any]]]:
    """Name and parts of each ``ColorMap`` of an XML text."""
    if "<!" in text.replace("<!--", ""):
        raise DataError(path, "declares a document type or entities, which no map needs", _REMEDY)
    try:
        root = ElementTree.fromstring(text)
        maps = []
        for one in root.iter("ColorMap"):
            points = [dict(point.items()) for point in one.iter("Point")]
            numbers = [[float(point[key]) for key in ("x", "r", "g", "b")] for point in points]
            heights = [[float(point["x"]), float(point["o"])] for point in points if "o" in point]
            space = one.get("space", "RGB")
            parts = {
                "space": space,
                "wrap": space.lower() == "wrapped",
                "colors": [number for point in numbers for number in point],
                "opacities": [number for x, height in heights for number in (x, height, 0.5, 0.0)],
                "indexed": one.get("indexedLookup", "").lower() in ("1", "true"),
            }
            maps.append((one.get("name", ""), parts))
    except (ElementTree.ParseError, ValueError) as error:
        raise DataError(path, f"is no XML of color maps ({error})", _REMEDY) from error
    except KeyError as error:
        raise DataError(path, f"has a point without {error}", _REMEDY) from error
    return maps
