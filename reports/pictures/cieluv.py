"""CIE 1976 L*u*v* color differences of displayed images, in plain numpy.

colour-science is the oracle in the tests. It is no dependency, because its import takes longer than all
metrics of a scene.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# IEC 61966-2-1, rounded as published there.
_RGB_TO_XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]], dtype=np.float64
)
_WHITE_XY = (0.3127, 0.3290)  # D65, CIE 1931 2 degree observer
_EPSILON = 216.0 / 24389.0
_KAPPA = 24389.0 / 27.0


def linear(srgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Decode sRGB in [0, 1] to linear light."""
    values = np.asarray(srgb, dtype=np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4)


def cieluv(srgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """(..., 3) L* in [0, 100], u*, v* relative to D65, from (..., 3) sRGB in [0, 1]."""
    xyz = linear(srgb) @ _RGB_TO_XYZ.T
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    lightness = np.where(y > _EPSILON, 116.0 * np.cbrt(y) - 16.0, _KAPPA * y)
    total = x + 15.0 * y + 3.0 * z
    safe = np.where(total > 0.0, total, 1.0)
    white_x, white_y = _WHITE_XY
    white = -2.0 * white_x + 12.0 * white_y + 3.0
    # Black has no chromaticity. L* = 0 makes u* = v* = 0 for any value here.
    u = np.where(total > 0.0, 4.0 * x / safe, 0.0) - 4.0 * white_x / white
    v = np.where(total > 0.0, 9.0 * y / safe, 0.0) - 9.0 * white_y / white
    return np.stack([lightness, 13.0 * lightness * u, 13.0 * lightness * v], axis=-1)


def delta_e_uv(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """(...) Euclidean CIELUV distance of two (..., 3) sRGB images in [0, 1]."""
    difference = cieluv(a) - cieluv(b)
    distance: NDArray[np.float64] = np.sqrt((difference * difference).sum(axis=-1))
    return distance
