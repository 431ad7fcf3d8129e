"""Sets of views: cameras with their background-free images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB

Split = Literal["train", "val", "trainval", "test"]


@dataclass(frozen=True)
class ViewRequest:
    """Selection of a scene's views.

    Attributes:
        split: "train" (without validation), "val" (every tenth training view), "trainval" (both,
            in camera order) or "test".
        train_views: number of training cameras before the validation split (6, 12, 42, 92).
        test_views: number of cameras on the test path (181 in the paper).
        width, height: image size in pixels. It must divide the size of pre-rendered views, which are
            averaged over areas.
        distance: factor on the usual distance of the cameras (of rendered views).
        step: degrees between test cameras in the middle of the path (of rendered views); 0 spreads them over
            the whole path.
        samples: rays a pixel of rendered views, a square; 0: as many as each pixel needs
            (:mod:`.datasets.ground_truth.sampling`).
    """

    split: Split
    train_views: int
    test_views: int
    width: int
    height: int
    distance: float = 1.0
    step: float = 0.0
    samples: int = 0


@dataclass(frozen=True, eq=False)
class ViewSet:
    """Ground-truth views of one scene.

    Attributes:
        cameras: one per image.
        images: (n, height, width, 4) float32, RGB in [0, 1] as displayed (sRGB-encoded)
            premultiplied by alpha, background-free.
        background: the scene's recorded background.
        key: content hash of the images' inputs (scene, cameras, renderer and its version).
        cost: what rendering them took, whenever that was: ``ms_per_view`` of launches that hold several small
            views, ``setup_seconds``, ``peak_host_bytes`` and ``peak_device_bytes`` of the process up to then,
            renderer, version and backend. None for pre-rendered views.
    """

    cameras: tuple[Camera, ...]
    images: NDArray[np.float32]
    background: RGB
    key: str
    cost: Mapping[str, Any] | None = None

    def __len__(self) -> int:
        return len(self.cameras)

    def composited(self, index: int, background: RGB | None = None) -> NDArray[np.float32]:
        """(height, width, 3) image over ``background`` (default: the scene's own)."""
        return over(self.images[index], self.background if background is None else background)


def over(premultiplied: NDArray[np.float32], background: RGB) -> NDArray[np.float32]:
    """Composite (..., 4) premultiplied RGBA over an opaque background, giving (..., 3)."""
    back = np.asarray(background, dtype=np.float32)
    return premultiplied[..., :3] + (1.0 - premultiplied[..., 3:4]) * back


def split_indices(n: int, split: Split) -> list[int]:
    """Indices of the n training (or test) cameras that belong to a split; every tenth is validation."""
    if split in ("trainval", "test"):
        return list(range(n))
    return [i for i in range(n) if (i % 10 == 9) == (split == "val")]


def evenly_spaced(available: int, count: int) -> list[int]:
    """``count`` of ``available`` indices, evenly spread from the first on; all if there are no more.

    Raises:
        DataError: fewer than one.
    """
    if count < 1:
        raise DataError(f"{count} views", "there must be at least one", "Ask for 16 or 92, say")
    if count >= available:
        return list(range(available))
    return [i * available // count for i in range(count)]
