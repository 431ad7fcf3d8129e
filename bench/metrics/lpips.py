"""LPIPS by the official `lpips` package, without its downloads.

The package ships its linear layers but fetches the backbones through torchvision. Here the backbone
has to lie in the torch hub cache already (``bench fetch lpips`` puts it there), with the checksum that
its name promises; otherwise there is a reason and no number.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Backbone:
    """An ImageNet network that LPIPS compares features of.

    Attributes:
        file: name in the torch hub cache.
        sha256: first digits of the file's SHA-256 (torchvision puts them into the name).
        least: smallest image side in pixels that leaves a feature in every layer.
    """

    file: str
    sha256: str
    least: int

    @property
    def url(self) -> str:
        """Public address of the file."""
        return f"https://download.pytorch.org/models/{self.file}"


BACKBONES = {
    "vgg": Backbone("vgg16-397923af.pth", "397923af", 16),
    "alex": Backbone("alexnet-owt-7be5be79.pth", "7be5be79", 31),
}


def checkpoints() -> Path:
    """Where torch looks for downloaded weights, found without importing torch."""
    cache_home = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    home = os.environ.get("TORCH_HOME", os.path.join(cache_home, "torch"))
    return Path(home).expanduser() / "hub" / "checkpoints"


def distance(
    network: str, truth: NDArray[np.float32], render: NDArray[np.float32], *, unscaled: bool = False
) -> float | str:
    """LPIPS of two images, or why there is none.

    Args:
        network: a name in :data:`BACKBONES`.
        truth: (height, width, 3) in [0, 1].
        render: the same.
        unscaled: feed [0, 1] as it is, as splatting papers do, instead of [-1, 1].
    """
    least = BACKBONES[network].least
    if min(truth.shape[:2]) < least:
        return f"the images are smaller than {least} pixels"
    loaded = load(network, checkpoints())
    if isinstance(loaded, str):
        return loaded
    import torch

    def tensor(image: NDArray[np.float32]) -> torch.Tensor:
        scaled = image if unscaled else 2.0 * image - 1.0
        return torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)[None], dtype=np.float32))

    with torch.no_grad():
        return float(loaded(tensor(truth), tensor(render)).item())


def is_sound(backbone: Backbone, folder: Path) -> bool:
    """Whether the weights are there, with the hash that their name promises."""
    path = folder / backbone.file
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest().startswith(backbone.sha256)


@cache
def load(network: str, folder: Path) -> Any:
    """The `lpips.LPIPS` module with weights from ``folder``, or a string that tells why not; kept."""
    backbone = BACKBONES[network]
    path = folder / backbone.file
    if not path.is_file():
        return f"no backbone weights in {_short(folder)}: run `bench fetch lpips`"
    if not is_sound(backbone, folder):
        return f"backbone weights {_short(path)} are damaged: run `bench fetch lpips`"
    declare_torchvision_operators()
    try:
        import lpips

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the package uses torchvision's old `pretrained` argument
            return lpips.LPIPS(net=network, version="0.1", verbose=False)
    except Exception as error:  # any fault of the wheel or the file means: no number
        return f"LPIPS cannot be loaded: {type(error).__name__}: {error}".splitlines()[0]


_fragments: list[Any] = []


def declare_torchvision_operators() -> None:
    """Let torchvision be imported beside a torch that cannot load its compiled operators.

    A torchvision wheel built for CUDA cannot load its library on a CPU-only torch, and its import then
    fails on the missing schemas of two operators that no LPIPS backbone uses.
    """
    import torch

    for name in ("nms", "qnms"):
        try:
            torch._C._get_schema(f"torchvision::{name}", "")
        except RuntimeError:
            fragment = torch.library.Library("torchvision", "FRAGMENT")
            fragment.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
            _fragments.append(fragment)  # a schema lives as long as its fragment


def _short(path: Path) -> str:
    """With ~ for the home folder: reasons go into reports that travel."""
    try:
        return f"~/{path.relative_to(Path.home())}"
    except ValueError:
        return str(path)
