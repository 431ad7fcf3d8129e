"""What all formats hold of a scene: six tables of numbers; their check, and half turns between frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB
from econgs_bench.methods.gaussian_splatting.model import SH_REST, SceneGaussians
from econgs_bench.methods.gaussian_splatting.ply import LARGEST_LOG, no_turn

Tables = Mapping[str, NDArray[np.float32]]
"""``means`` (N, 3), ``log_scales`` (N, 3), ``quats`` (N, 4), ``logits`` (N,), ``sh_dc`` (N, 1, 3) and
``sh_rest`` (N, 15, 3): as of :class:`.methods.gaussian_splatting.model.SceneGaussians`, in float32."""
Frame = tuple[int, int, int]
"""Signs of x, y and z whose product is 1: a half turn about an axis."""

SAME: Frame = (1, 1, 1)
RIGHT_UP_BACK: Frame = (1, -1, -1)
"""Of a PLY's axes (right, down, front), those of SPZ."""
LEFT_UP_FRONT: Frame = (-1, -1, 1)
"""Of a PLY's axes, those of glTF."""
COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: SH_REST}
"""Degree -> coefficients above the constant one."""
SHAPES = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "logits": (),
    "sh_dc": (1, 3),
    "sh_rest": (SH_REST, 3),
}
_PARITIES = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""Axes in which each harmonic above the constant one is odd."""


class Contents(NamedTuple):
    """What a file holds.

    Attributes:
        tables: its Gaussians.
        antialiased: whether it says that viewers shall shrink opacities to compensate for their filter; a
            file without a mark is drawn without.
    """

    tables: Tables
    antialiased: bool = False

    @property
    def viewer(self) -> str:
        """Who draws it right, a key of :data:`.methods.baking.bake.VIEWERS`."""
        return "antialiased" if self.antialiased else "plain"


class Format(Protocol):
    """A file format; the modules of this package are ones.

    Attributes:
        SUFFIX: of its files.
    """

    SUFFIX: str

    @staticmethod
    def write(file: Path, scene: SceneGaussians, *, antialiased: bool = False) -> Mapping[str, int]:
        """Write a scene.

        Args:
            file: where to.
            scene: its Gaussians.
            antialiased: whether they are made for viewers that compensate for their filter. The file says so
                where the format has a mark; a file that is not for them has none.

        Returns:
            Bytes by part, which sum to the size of the file.

        Raises:
            Refused: a package that the format needs is not installed.
        """

    @staticmethod
    def read(file: Path) -> Contents:
        """Read what a writer of the format wrote.

        Raises:
            DataError: the file is missing, damaged or of another kind.
            Refused: a package that the format needs is not installed.
        """


def tables(scene: SceneGaussians, frame: Frame = SAME) -> Tables:
    """The tables of a scene after a half turn: unit quaternions, coefficients beyond its degree are zero."""
    signs = torch.tensor(frame, dtype=torch.float32)
    odd = [math.prod(frame["xyz".index(axis)] for axis in parity) for parity in _PARITIES]
    used = torch.arange(SH_REST) < COEFFICIENTS[scene.sh_degree]
    values = {name: getattr(scene, name).detach().float().cpu() for name in SHAPES}
    values["quats"] = torch.nn.functional.normalize(values["quats"], dim=1)
    values["means"] = values["means"] * signs
    values["quats"] = values["quats"] * torch.cat([torch.ones(1), signs])
    values["sh_rest"] = values["sh_rest"] * (torch.tensor(odd) * used)[:, None]
    return {name: np.ascontiguousarray(one.numpy()) for name, one in values.items()}


def scene_of(
    values: Tables, name: str, background: RGB, sh_degree: int, device: str = "cpu"
) -> SceneGaussians:
    """The scene of tables."""
    tensors = {one: torch.from_numpy(np.array(table, np.float32)).to(device) for one, table in values.items()}
    return SceneGaussians(name, background, sh_degree, **tensors)


def turned(values: Tables, frame: Frame) -> Tables:
    """Tables after a half turn, which is its own inverse."""
    return tables(scene_of(values, "", (0.0, 0.0, 0.0), 3), frame)


def degree_of(scene: SceneGaussians) -> int:
    """Least degree of spherical harmonics that shows the scene as it is."""
    used = scene.sh_rest.detach().abs().amax(dim=(0, 2)).nonzero() if len(scene) else torch.zeros(0, 1)
    last = int(used.max()) + 1 if len(used) else 0
    return min(scene.sh_degree, next(degree for degree, many in COEFFICIENTS.items() if last <= many))


def drawable(scene: SceneGaussians) -> SceneGaussians:
    """The Gaussians of a scene that can be seen: finite, of opacity 1/255 or more, with a rotation."""
    good = scene.logits.sigmoid() >= 1.0 / 255.0
    for name in SHAPES:
        values: Tensor = getattr(scene, name)
        good &= torch.isfinite(values).reshape(len(scene), -1).all(1)
    rows = (good & (scene.quats.square().sum(1) > 0)).nonzero()[:, 0]
    return replace(scene, **{name: getattr(scene, name).index_select(0, rows) for name in SHAPES})


def checked(file: Path, format: str, read: Callable[[], Contents]) -> Contents:
    """What a reader reads, if it is a scene.

    Raises:
        DataError: it cannot be read, has tables of other shapes, or a Gaussian that cannot be drawn.
    """
    try:
        contents = read()
        values = contents.tables
        count = len(values["means"])
        for name, shape in SHAPES.items():
            if values[name].shape != (count, *shape):
                raise ValueError(f"{name} of shape {values[name].shape}")
            if not np.isfinite(values[name]).all():
                raise ValueError(f"{name} that are not finite")
        if no_turn(values["quats"]):
            raise ValueError("a rotation that is zero, or too long")
        if count and float(values["log_scales"].max()) > LARGEST_LOG:
            raise ValueError("a scale that is not finite")
    except DataError:
        raise
    except Exception as error:  # libraries raise what they like for damaged data
        reason = f"cannot be read as {format} ({type(error).__name__}: {error})"
        raise DataError(file, reason, "Write or download it again") from error
    return contents
