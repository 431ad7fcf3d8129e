"""The device that a job runs on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from econgs_bench.methods.interface import Refused

if TYPE_CHECKING:
    from econgs_bench.methods.interface import MethodSpec


def prepare_device(device: str, spec: MethodSpec) -> None:
    """Check that a method can run on a device, and reset the device's memory statistics.

    Raises:
        Refused: the method does not support the device, or this machine lacks it.
    """
    if device.split(":")[0] not in spec.devices:
        raise Refused(f"{spec.name} runs on {', '.join(spec.devices)}, not on {device}")
    if device.startswith("cuda"):
        import torch

        if not torch.cuda.is_available():
            raise Refused(f"device {device} is not available: torch {torch.__version__} sees no CUDA device")
        torch.cuda.reset_peak_memory_stats(device)
