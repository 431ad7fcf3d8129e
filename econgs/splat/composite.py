"""Putting a picture over its background."""

from __future__ import annotations

import torch

from datasets.scene import RGB


def over(premultiplied: torch.Tensor, alpha: torch.Tensor, background: RGB | torch.Tensor) -> torch.Tensor:
    """Composite (H, W, 3) premultiplied color with (H, W) alpha over an opaque background."""
    back = torch.as_tensor(background, dtype=premultiplied.dtype, device=premultiplied.device)
    return torch.addcmul(premultiplied, (1.0 - alpha)[..., None], back)
