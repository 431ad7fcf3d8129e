"""Rate control: lambda_e follows a target size or a target quality while the context model trains."""

from __future__ import annotations

from dataclasses import dataclass

STEPS = 20
"""Corrections of the second stage."""
_SIZE_POWER = 1.5
_PER_DB = 0.6  # decades of lambda_e per dB
_MOST = 3.0  # factor of one correction
_RANGE = 1e3  # total factor


@dataclass
class RateControl:
    """A factor on lambda_e.

    Attributes:
        target_bytes: size of the whole group; 0 = none.
        target_psnr: dB; 0 = none. With both, the size wins.
        factor: present factor on the option's lambda_e.
    """

    target_bytes: float = 0.0
    target_psnr: float = 0.0
    factor: float = 1.0

    @property
    def active(self) -> bool:
        return self.target_bytes > 0.0 or self.target_psnr > 0.0

    def correct(self, size: int, psnr: float) -> None:
        """Correct the factor by size and PSNR of the present model."""
        if self.target_bytes > 0.0:
            change = (size / self.target_bytes) ** _SIZE_POWER
        else:
            change = 10.0 ** (_PER_DB * (psnr - self.target_psnr))
        change = min(max(change, 1.0 / _MOST), _MOST)
        self.factor = min(max(self.factor * change, 1.0 / _RANGE), _RANGE)
