"""Units of length, as files name them."""

from __future__ import annotations

from collections.abc import Sequence

_METRES = {
    "pm": 1e-12, "picometer": 1e-12, "å": 1e-10, "a": 1e-10, "angstrom": 1e-10, "nm": 1e-9, "nanometer": 1e-9,
    "µm": 1e-6, "μm": 1e-6, "um": 1e-6, "\\u00b5m": 1e-6, "micron": 1e-6, "micrometer": 1e-6, "mm": 1e-3,
    "millimeter": 1e-3, "cm": 1e-2, "centimeter": 1e-2, "dm": 1e-1, "decimeter": 1e-1, "m": 1.0, "meter": 1.0,
    "dam": 10.0, "decameter": 10.0, "hm": 100.0, "hectometer": 100.0, "km": 1e3, "kilometer": 1e3,
    "in": 0.0254, "inch": 0.0254, "ft": 0.3048, "foot": 0.3048, "yd": 0.9144, "yard": 0.9144, "mi": 1609.344,
    "mile": 1609.344, "pc": 3.0856775814913673e16, "parsec": 3.0856775814913673e16, "ly": 9.4607304725808e15,
    "ua": 149597870700.0, "au": 149597870700.0, "Mm": 1e6, "megameter": 1e6, "Gm": 1e9, "gigameter": 1e9,
    "Tm": 1e12, "Pm": 1e15, "Em": 1e18, "fm": 1e-15, "femtometer": 1e-15,
}  # fmt: skip


def metres(unit: str) -> float | None:
    """Metres of a unit of length, by its symbol or its English name; None for anything else.

    Symbols are those of the OME model; "micrometre", "microns" and capital letters are the same unit,
    but "Mm" is no "mm".
    """
    name = unit.strip().strip('"').replace("metre", "meter").rstrip(".")
    for spelling in (name, name.lower(), name.lower().removesuffix("s")):
        if spelling in _METRES:
            return _METRES[spelling]
    return 0.0254 if name.lower() == "inches" else None


def in_one_unit(lengths: Sequence[float], units: Sequence[str]) -> list[float] | None:
    """Lengths in the unit of the first; None where the units differ and one is no unit of length."""
    if len(set(units)) <= 1:
        return list(lengths)
    factors = [metres(unit) for unit in units]
    first = factors[0]
    if first is None or None in factors:
        return None
    return [n * (f / first) for n, f in zip(lengths, factors, strict=True) if f is not None]
