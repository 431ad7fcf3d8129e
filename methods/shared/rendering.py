"""How the Gaussians of a model are drawn, as stored beside its files."""

from __future__ import annotations

import math
import tomllib
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.splat import LINEAGE, LowPass

FILE = "rendering.toml"
_CHECK = b"\ncrc32="
"""Before the checksum of all before it, the last line of the file."""


@dataclass(frozen=True)
class Rendering:
    """How Gaussians are drawn.

    Attributes:
        units: scene units / units of the Gaussians (:mod:`.methods.shared.units`).
        low_pass: filters of the Gaussians.
    """

    units: float = 1.0
    low_pass: LowPass = LINEAGE

    def write(self, folder: Path) -> int:
        """Store what differs from the defaults; bytes of the file, 0 where nothing does."""
        lines = []
        if self.units != 1.0:
            lines.append(f"units={self.units!r}")
        if self.low_pass.variance != LINEAGE.variance:
            lines.append(f"low_pass={self.low_pass.variance!r}")
        if self.low_pass.compensated:
            lines.append("compensated=true")
        if self.low_pass.smoothing:
            lines.append(f"smoothing={self.low_pass.smoothing!r}")
        if self.low_pass.ray_power:
            lines.append(f"ray_power={self.low_pass.ray_power!r}")
        if self.low_pass.points != 1:
            lines.append(f"points={self.low_pass.points}")
        if not lines:
            return 0
        text = "\n".join(lines).encode()
        return (folder / FILE).write_bytes(text + _CHECK + str(zlib.crc32(text)).encode())

    @classmethod
    def read(cls, folder: Path) -> Rendering:
        """What :meth:`write` stored.

        Raises:
            DataError: the file cannot be read.
        """
        file = folder / FILE
        if not file.exists():
            return cls()
        try:
            text, _, check = file.read_bytes().rpartition(_CHECK)
            if check != str(zlib.crc32(text)).encode():
                raise ValueError("its checksum differs")
            facts: dict[str, Any] = tomllib.loads(text.decode())
            units = float(facts.pop("units", 1.0))
            variance, compensated = facts.pop("low_pass", LINEAGE.variance), facts.pop("compensated", False)
            smoothing, power = facts.pop("smoothing", 0.0), facts.pop("ray_power", 0.0)
            points = facts.pop("points", 1)
            if (
                facts
                or not (math.isfinite(units) and units > 0.0)
                or (type(compensated), type(points)) != (bool, int)
            ):
                raise ValueError(f"units {units}, compensated {compensated}, {', '.join(facts)}")
            return cls(units, LowPass(float(variance), compensated, float(smoothing), float(power), points))
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise DataError(file, f"cannot be used ({error})", "Save the model again") from error
