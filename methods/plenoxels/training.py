"""Training one scene: random rays, coarse to fine, resumable bit for bit."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.rays import PixelRays, camera_rays
from econgs_bench.methods.interface import Checkpoint, Diverged, SceneInput
from econgs_bench.methods.plenoxels.grid import SH, VoxelGrid, Voxels, bricks_of
from econgs_bench.methods.plenoxels.march import trace, voxel_weights
from econgs_bench.methods.plenoxels.model import VoxelModel, VoxelScene
from econgs_bench.methods.plenoxels.optimise import rms_step, variation
from econgs_bench.methods.plenoxels.region import Hull, first_grid
from econgs_bench.methods.plenoxels.schedule import Schedule
from econgs_bench.methods.plenoxels.spec import PlenoxelsOptions
from econgs_bench.methods.shared.densification import Drawn
from econgs_bench.methods.shared.training import (
    TrainingLoop,
    TrainingState,
    are_transparent,
    chosen_background,
)

FIRST_DENSITY = 0.1
BETA = 0.95
"""Decay of the means of RMSProp."""
TV_SHARE = 0.01
"""Of the vertices, in a row, whose total variation counts in an iteration."""
TV_RESOLUTION = 256.0
"""Vertices along a side at which differences count as they are."""


class Optimiser:
    """The voxels, their gradients, and the means of RMSProp."""

    def __init__(self, voxels: Voxels, moments: Voxels | None = None) -> None:
        self.voxels = voxels
        self.moments = Voxels.zeros(len(voxels), voxels.densities) if moments is None else moments
        self.grads = Voxels.zeros(len(voxels), voxels.densities)

    @property
    def parameters(self) -> dict[str, list[Tensor]]:
        """Name -> tensors."""
        return {name: [values] for name, values in vars(self.voxels).items()}

    def state(self) -> dict[str, Tensor]:
        """Values and means, without the unused numbers."""
        pairs = (("value", self.voxels), ("second", self.moments))
        state = {f"densities/0/{part}": voxels.densities for part, voxels in pairs}
        return state | {f"colors/0/{part}": voxels.colors[:, :SH].contiguous() for part, voxels in pairs}


class Trainer(TrainingLoop[Drawn]):
    """A fit of the grid of one scene, whose gradients are formulas.

    Arguments: a scene, resolved options, and those of :class:`.methods.shared.training.TrainingLoop`.

    Raises:
        Refused: no views.
    """

    options: PlenoxelsOptions
    schedule: Schedule
    optimiser: Optimiser  # type: ignore[assignment]
    background: RGB

    def __init__(
        self, scene: SceneInput, options: PlenoxelsOptions, iterations: int, seed: int, device: str
    ) -> None:
        super().__init__([scene], options, iterations, seed, device)
        self.scene, self.schedule = scene, Schedule(iterations)
        back = chosen_background(options.background, scene)
        assert back is not None
        self.background = back
        images = torch.from_numpy(scene.train.images)
        self.transparent = are_transparent(images)
        hull = Hull(scene)
        longest = max(4, options.resolution // 2)
        grid = first_grid(scene, hull, longest, options.start, FIRST_DENSITY)
        self.pixels = _pixels(hull, 2.0 * grid.spacing)
        self.truth = images.reshape(-1, 4)
        self.rays = PixelRays(scene.train.cameras, torch.float32)
        self._take(on(grid, device))

    def _take(self, grid: VoxelGrid, moments: Voxels | None = None) -> None:
        self.grid, self.optimiser = grid, Optimiser(grid.voxels, moments)

    @property
    def count(self) -> int:
        """Number of voxels."""
        return len(self.grid)

    def views(self) -> list[Any]:
        """None is drawn as a whole: rays come from all."""
        return []

    def stage(self) -> str:
        if self.count == 0:
            return "nothing to see"
        return "coarse" if self.iteration < self.schedule.finer else "fine"

    def draw(self) -> Drawn:
        """Random rays; their gradients are added to the optimiser's."""
        chosen = torch.randint(len(self.pixels), (self.options.rays,), generator=self.generator)
        pixels = self.pixels[chosen]
        seen = trace(self.grid, self.rays(pixels).to(self.device))
        truth = self.truth[pixels].to(self.device)
        back = torch.tensor(self.background, device=self.device)
        alpha = truth[:, 3:]
        target = torch.addcmul(truth[:, :3], 1.0 - alpha, back)
        far = torch.addcmul(seen.colors, 1.0 - seen.alpha[:, None], back) - target
        parts: dict[str, Tensor | float] = {"image": far.square().mean()}
        grad_colors = far * (2.0 / far.numel())
        grad_alpha = -(grad_colors @ back)
        if self.asks_alpha(self.transparent):
            missing = seen.alpha - alpha[:, 0]
            parts["alpha"] = self.options.alpha_weight * missing.square().mean()
            grad_alpha += missing * (2.0 * self.options.alpha_weight / len(missing))
        seen.backward(grad_colors, grad_alpha, self.optimiser.grads)
        if self.options.tv_stage == "both" or self.iteration <= self.schedule.finer:
            parts["variation"] = self._variation()
        return Drawn(losses=parts)

    def descend(self, drawn: Drawn, loss: Tensor) -> None:
        rates = (
            self.schedule.density_learning_rate(self.iteration, self.options.density_lr),
            self.schedule.sh_learning_rate(self.iteration, self.options.sh_lr),
        )
        rms_step(self.grid.voxels, self.optimiser.grads, self.optimiser.moments, rates, BETA)
        if self.iteration == self.schedule.finer:
            self.check_finite()
            self._refine()

    def _variation(self) -> float:
        """Total variation of some vertices in a row; its gradient is added."""
        total = self.grid.links.numel()
        count = max(1, round(TV_SHARE * total))
        begin = int(torch.randint(total, (), generator=self.generator))
        factors = (self.options.tv_density / count, self.options.tv_sh / count)
        spread = max(self.grid.size) / TV_RESOLUTION
        return variation(self.grid, begin, count, factors, spread, self.optimiser.grads)

    def _refine(self) -> None:
        """Prune what no training view shows, and go on with twice the vertices along each side."""
        most = torch.zeros(self.count, device=self.device)
        for camera in self.scene.train.cameras:
            half = camera.resized(max(1, camera.width // 2), max(1, camera.height // 2))
            voxel_weights(self.grid, camera_rays(half, torch.float32).to(self.device), most)
        keep = most >= self.options.prune_weight / max(self.grid.size)
        self._take(self.grid.finer(max(8, self.options.resolution), keep))

    # ------------------------------------------------------------------ what comes out

    @staticmethod
    def restored(state: TrainingState, options: PlenoxelsOptions) -> VoxelModel:
        """The scene as it will be stored: coefficients in half precision."""
        (label,) = state.scenes
        grid = _grid(state.arrays, state.scalars)
        colors = grid.voxels.colors.half().float()
        stored = replace(grid, voxels=Voxels(grid.voxels.densities, colors))
        return VoxelModel([VoxelScene(label.name, label.background, stored)])

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        if self.iteration == self.iterations:  # nothing goes on from there
            state.arrays = {name: v for name, v in state.arrays.items() if not name.endswith("/second")}
        state.arrays["links"] = self.grid.links.clone()
        state.scalars["grid"] = [*self.grid.origin, self.grid.spacing, self.grid.unit]
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        arrays = self.arrays(checkpoint)
        moments = _voxels(arrays, "second") if "optimiser/densities/0/second" in arrays else None
        self._take(_grid(arrays, checkpoint.scalars), moments)
        self.generator.set_state(checkpoint.arrays["generator"].cpu())
        self.iteration = checkpoint.iteration

    @torch.no_grad()
    def check_finite(self) -> None:
        for name, values in vars(self.grid.voxels).items():
            if not math.isfinite(float(values.sum())):
                raise Diverged(f"{name} hold NaN or infinite values at iteration {self.iteration}")


def _pixels(hull: Hull, radius: float) -> Tensor:
    """Numbers of the pixels whose rays may meet the hull; all, if none does."""
    count, height, width = hull.masks.shape
    views = [hull.widened(radius, view).reshape(-1) for view in range(count)]
    pixels = torch.cat(views).nonzero()[:, 0]
    return pixels if len(pixels) else torch.arange(count * height * width)


def on(value: Any, device: str) -> Any:
    """Voxels or a grid on a device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, Voxels | VoxelGrid):
        return replace(value, **{name: on(one, device) for name, one in vars(value).items()})
    return value


def _voxels(arrays: dict[str, Tensor], part: str) -> Voxels:
    densities = arrays[f"optimiser/densities/0/{part}"]
    voxels = Voxels.zeros(len(densities), densities)
    voxels.densities.copy_(densities)
    voxels.colors[:, :SH] = arrays[f"optimiser/colors/0/{part}"]
    return voxels


def _grid(arrays: dict[str, Tensor], scalars: dict[str, Any]) -> VoxelGrid:
    x, y, z, spacing, unit = scalars["grid"]
    links = arrays["links"].clone()
    return VoxelGrid(links, _voxels(arrays, "value"), bricks_of(links), (x, y, z), spacing, unit)
