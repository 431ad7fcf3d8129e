"""Damaged files give a DataError or a valid volume, and no other exception."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import read_volume
from econgs_bench.datasets.volume import Volume

PROPERTY = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
KINDS = ("cut", "flip", "number", "set", "insert")
"""Ways to damage a file."""
_NUMBERS = (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"9999", b"\0\0\0\0")


@dataclass
class Outcome:
    """Counts of what readings of damaged files came to, the slowest one, and what must not be."""

    counts: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    slowest: float = 0.0


def array(dtype: str = "float32", shape: tuple[int, ...] = (4, 5, 6), seed: int = 0) -> np.ndarray:
    """Whole numbers that every type holds, not all the same."""
    values = np.random.default_rng(seed).integers(-60, 60, shape)
    values.flat[0], values.flat[1] = 5, 6
    return (np.abs(values) if dtype.startswith("u") else values).astype(dtype)


def check_damage(
    path: Path, write: Callable[[Path], object], check: Callable[[Path], None], *kinds: str, many: int = 40
) -> None:
    """Check a file that is written and then damaged, in many ways of these kinds, often near its head."""
    at = st.one_of(st.floats(0.0, 0.999), st.floats(0.0, 0.3))

    @settings(PROPERTY, max_examples=many)
    @example("cut", 0.5, 0)
    @given(st.sampled_from(kinds), at, st.integers(0, 255))
    def check_one(kind: str, at: float, value: int) -> None:
        write(path)
        damage(path, kind, at, value)
        check(path)

    check_one()


def damage(path: Path, kind: str, at: float, value: int) -> None:
    """Damage a file in one of :data:`KINDS`, at a share of its length."""
    data = bytearray(path.read_bytes())
    where = int(at * len(data))
    if kind == "cut":
        data = data[:where]
    elif kind == "insert":
        data[where:where] = bytes([value])
    elif kind == "set":
        data[where] = value
    elif kind == "flip":
        data[where] ^= 1 << value % 8
    else:
        data[where : where + 4] = _NUMBERS[value % 4]
    path.write_bytes(data)


def check_volumes(path: Path, read: Callable[[], Iterable[Volume]]) -> None:
    try:
        for volume in read():
            assert np.isfinite(volume.normalised()).all()
            assert min(volume.dims) >= 2
            assert np.isfinite(volume.extent).all()
    except DataError as error:
        assert str(path) in str(error) or "Choose" in str(error)  # noqa: PT017


def check_refused(path: Path, data: bytes, reason: str) -> None:
    """A file of these bytes is refused with its name, the reason and a remedy."""
    path.write_bytes(data)
    with pytest.raises(DataError) as caught:
        read_volume(path)
    assert reason in str(caught.value)
    assert str(path) in str(caught.value)
    assert caught.value.remedy
