"""Arrays that a child sends without holding them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

REFUSED = 4
"""Exit code of a child whose last line on stderr is an error, as JSON: too late for an answer."""


@dataclass(frozen=True, eq=False)
class Slabs:
    """An array in pieces along its first axis, or at a place of the file.

    Attributes:
        shape: of the whole.
        dtype: of the whole.
        pieces: the values, in order.
        offset: byte of the file from which the other process maps them; None where ``pieces`` has them.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    pieces: Iterable[NDArray[Any]] = ()
    offset: int | None = None
