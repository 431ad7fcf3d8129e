"""Training one scene of factors on random rays of its views, from coarse to fine, resumable bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from econgs_bench.datasets.scene import RGB
from econgs_bench.datasets.views import ViewSet
from econgs_bench.econgs.losses import RESCUE, VANISHING
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.rays import PixelRays, Rays, camera_rays
from econgs_bench.methods.ccnerf.field import BANDS, SCALE, SHIFT, Factors, trace
from econgs_bench.methods.ccnerf.lines import Lines, dense, resampled
from econgs_bench.methods.ccnerf.model import CpModel
from econgs_bench.methods.ccnerf.rays import Corner, Region, hits
from econgs_bench.methods.ccnerf.schedule import Schedule
from econgs_bench.methods.ccnerf.spec import CpOptions
from econgs_bench.methods.interface import Checkpoint, Refused, SceneInput
from econgs_bench.methods.shared.densification import Drawn
from econgs_bench.methods.shared.training import (
    TrainingLoop,
    TrainingState,
    are_transparent,
    chosen_background,
)

MARGIN = 0.15
"""Room around the initial cloud, as a share of its longest side."""
BETAS = (0.9, 0.99)
EPS = 1e-8
MOST_ROWS = 256
"""Rows of a line at most, where empty cells are looked for."""
MOST_PROLONGED = 4096
"""Rows of a line at most, in a flat box."""


class Trainer(TrainingLoop[Drawn]):
    """A fit of the factors of one scene.

    Arguments: a scene, resolved options, and those of :class:`.methods.shared.training.TrainingLoop`.

    Attributes:
        region: box and occupied cells; one cell until empty ones are looked for.
        rays: numbers of the pixels (over all views) whose rays meet occupied cells.
        masked: how often empty cells were looked for.
        vanishing: most of what is to be seen in the last batch was not there: nothing is called empty.

    Raises:
        Refused: no views.
    """

    options: CpOptions
    schedule: Schedule

    def __init__(
        self, scene: SceneInput, options: CpOptions, iterations: int, seed: int, device: str
    ) -> None:
        super().__init__([scene], options, iterations, seed, device)
        self.scene = scene
        self.background = chosen_background(options.background, scene)
        self.schedule = Schedule(
            iterations,
            options.first_side,
            options.side,
            options.decay == "through",
            options.search == "always",
        )
        self.pixels = _Pixels(scene.train)
        self.transparent = are_transparent(self.pixels.values)
        self.region = _first_region(scene, options)
        self.masked, self.vanishing = 0, False
        self._optimise(self._start())
        self.rays = self.pixels.hitting(self.region, self._present().step)

    def _start(self) -> dict[str, list[Tensor]]:
        """First factors and coefficients."""
        options = self.options
        ranks = options.groups * options.ranks
        sizes = _sizes(self.region, options.first_side)

        def lines(count: int) -> list[Tensor]:
            return [options.first * torch.randn((size, count), generator=self.generator) for size in sizes]

        density, color = lines(options.density_ranks), lines(ranks)
        spread = options.ranks**-0.5
        harmonics = spread * (2.0 * torch.rand((BANDS, 3, ranks), generator=self.generator) - 1.0)
        start = {"density": density, "color": color, "harmonics": [harmonics]}
        return {name: [one.to(self.device) for one in values] for name, values in start.items()}

    def _optimise(self, parameters: dict[str, list[Tensor]]) -> None:
        """Begin to optimise these, without moments."""
        self.optimiser = Adam(parameters, dict.fromkeys(parameters, 0.0), betas=BETAS, eps=EPS)

    @property
    def count(self) -> int:
        """Number of ranks, of density and color together."""
        return self.options.density_ranks + self.options.groups * self.options.ranks

    def stage(self) -> str:
        return self.schedule.stage(self.iteration + 1)

    def views(self) -> list[Any]:
        """None: an iteration draws rays from all views."""
        return []

    def _present(self) -> Factors:
        """The scene as it is now, connected to the optimiser."""
        now, (label,) = self.optimiser.parameters, self.labels
        return _scene(
            label.name, label.background, self.region, now["density"], now["color"], now["harmonics"][0],
            self.options,
        )  # fmt: skip

    def draw(self) -> Drawn:
        back = torch.as_tensor(self.color_of(self.background), dtype=torch.float32, device=self.device)
        return Drawn(losses=self._losses(back))

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        share, options = self.schedule.learning_rate_share(self.iteration), self.options
        first = dict.fromkeys(self.optimiser.parameters, options.factor_lr)
        first["harmonics"] = options.harmonics_lr
        return {name: share * rate for name, rate in first.items()}

    def descend(self, drawn: Drawn, loss: Tensor) -> None:
        super().descend(drawn, loss)
        self._change()

    def _losses(self, back: Tensor) -> dict[str, Tensor]:
        """Parts of the loss of a batch of random rays."""
        count = self.options.rays
        shift = torch.rand(count, generator=self.generator, dtype=torch.float64)
        chosen = torch.randint(max(1, len(self.rays)), (count,), generator=self.generator)
        if len(self.rays) == 0:
            return {"image": torch.zeros((), device=self.device)}
        rays, truth = self.pixels.batch(self.rays[chosen])
        truth = truth.to(self.device)
        seen = trace(self._present(), rays, shift, self.options.groups)
        target = truth[:, :3] + (1.0 - truth[:, 3:]) * back
        drawn = seen.colors + ((1.0 - seen.alpha)[:, None] * back)[:, None]
        losses = {"image": (drawn - target[:, None]).square().mean()}
        if self.asks_alpha(self.transparent):
            weight = self.options.alpha_weight
            self.vanishing = float(seen.alpha.detach().sum()) < VANISHING * float(truth[:, 3].sum())
            if self.vanishing:
                weight = max(weight, RESCUE)
            losses["alpha"] = weight * (seen.alpha - truth[:, 3]).square().mean()
        if self.options.sparsity > 0.0:
            size = sum(
                (line.abs().mean() for line in self.optimiser.parameters["density"]), back.new_zeros(())
            )
            losses["sparsity"] = self.options.sparsity * size
        return losses

    # ------------------------------------------------------------------ boxes and sizes

    @torch.no_grad()
    def _change(self) -> None:
        """What the schedule does after an iteration."""
        masks = self.masked < self.schedule.masks(self.iteration) and not self.vanishing
        grows = self.schedule.grows(self.iteration)
        if not (masks or grows):
            return
        self.check_finite()
        now = {name: [one.detach() for one in group] for name, group in self.optimiser.parameters.items()}
        if masks:
            cells = self._occupied(now["density"])
            if bool(cells.any()):  # else there is nothing to be seen
                self.region = Region(self.region.low, self.region.high, cells)
                if self.masked == 0 or self.schedule.always:
                    self._shrink(now)
            self.masked += 1
        if grows:
            sizes = _sizes(self.region, self.schedule.rows(self.iteration))
            for name in ("density", "color"):
                now[name] = [resampled(line, size) for line, size in zip(now[name], sizes, strict=True)]
        self._optimise(now)
        self.rays = self.pixels.hitting(self.region, self._present().step)

    def _occupied(self, density: list[Tensor]) -> Tensor:
        """(z, y, x) cells between rows of which any corner, or a neighbour of it, is visible."""
        sizes = [min(len(line), MOST_ROWS) for line in density]
        x, y, z = (
            line if len(line) == size else resampled(line, size)
            for line, size in zip(density, sizes, strict=True)
        )
        values = torch.nn.functional.softplus(dense((x, y, z)) + SHIFT)
        opacity = -torch.expm1(-values * (SCALE * self._present().step))
        visible = (opacity > self.options.visible).float()[None, None]
        near = torch.nn.functional.max_pool3d(visible, 3, stride=1, padding=1)
        cells = torch.nn.functional.max_pool3d(near, 2, stride=1)[0, 0] > 0
        before = self.region.cells
        middles = [
            ((torch.arange(n) + 0.5) / n * old).long()
            for n, old in zip(cells.shape, before.shape, strict=True)
        ]
        known = before[middles[0][:, None, None], middles[1][None, :, None], middles[2][None, None]]
        return (cells.cpu() & (known > 0)).to(torch.uint8)

    def _shrink(self, now: dict[str, list[Tensor]]) -> None:
        """Cut the box, and with it lines and cells, to the occupied cells."""
        cells = self.region.cells
        low, high = list(self.region.low), list(self.region.high)
        for axis in range(3):
            along = cells.amax(dim=tuple(one for one in range(3) if one != 2 - axis)).nonzero()[:, 0]
            first, last = int(along[0]), int(along[-1]) + 1
            size = (high[axis] - low[axis]) / cells.shape[2 - axis]
            low[axis], high[axis] = low[axis] + first * size, low[axis] + last * size
            cells = cells.narrow(2 - axis, first, last - first)
            rows = len(now["density"][axis])
            for name in ("density", "color"):
                now[name][axis] = _cut(now[name][axis], first, last, self.region.cells.shape[2 - axis], rows)
        self.region = Region(_corner(low), _corner(high), cells.contiguous())

    # ------------------------------------------------------------------ what comes out

    @staticmethod
    def restored(state: TrainingState, options: CpOptions) -> CpModel:
        """All groups of ranks, in float32."""
        (label,) = state.scenes
        density, color = (
            [state.value(name, axis).detach().clone() for axis in range(3)] for name in ("density", "color")
        )
        harmonics = state.value("harmonics").detach().clone()
        region = _region(state.scalars["box"], state.arrays["cells"])
        scene = _scene(label.name, label.background, region, density, color, harmonics, options)
        return CpModel([scene])

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        state.arrays["cells"] = self.region.cells.clone()
        state.scalars["box"] = [list(self.region.low), list(self.region.high)]
        state.scalars["masked"] = self.masked
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        super().resume(checkpoint)
        self.region = _region(checkpoint.scalars["box"], checkpoint.arrays["cells"])
        self.masked = int(checkpoint.scalars["masked"])
        self.rays = self.pixels.hitting(self.region, self._present().step)


class _Pixels:
    """All pixels of training views, by number.

    Attributes:
        values: (n, 4) premultiplied.
    """

    def __init__(self, views: ViewSet) -> None:
        self.values = torch.from_numpy(views.images).reshape(-1, 4)
        self.cameras = views.cameras
        self.size = views.images.shape[1] * views.images.shape[2]
        self.rays_of = PixelRays(views.cameras)

    def hitting(self, region: Region, step: float) -> Tensor:
        """Numbers of the pixels whose rays have samples in a region."""
        found = [
            hits(region, step, camera_rays(camera)).nonzero()[:, 0] + view * self.size
            for view, camera in enumerate(self.cameras)
        ]
        return torch.cat(found)

    def batch(self, numbers: Tensor) -> tuple[Rays, Tensor]:
        """Rays and values of pixels."""
        return self.rays_of(numbers), self.values[numbers]


def _scene(
    name: str,
    background: RGB,
    region: Region,
    density: list[Tensor],
    color: list[Tensor],
    harmonics: Tensor,
    options: CpOptions,
) -> Factors:
    return Factors(
        name=name,
        background=background,
        region=region,
        density=_three(density),
        color=_three(color),
        harmonics=harmonics,
        group=options.ranks,
        spacing=options.step,
        threshold=options.weight_threshold,
    )


def _three(lines: list[Tensor]) -> Lines:
    x, y, z = lines
    return x, y, z


def _corner(values: list[float]) -> Corner:
    x, y, z = values
    return x, y, z


def _region(box: list[list[float]], cells: Tensor) -> Region:
    low, high = box
    return Region(_corner(low), _corner(high), cells.cpu().clone())


def _first_region(scene: SceneInput, options: CpOptions) -> Region:
    """The published box, or one around the initial cloud."""
    cells = torch.ones((1, 1, 1), dtype=torch.uint8)
    if options.start == "box":
        half = options.half_extent
        return Region((-half, -half, -half), (half, half, half), cells)
    points = np.asarray(scene.cloud.points, dtype=np.float64)
    if len(points) == 0:
        raise Refused("a box around the initial cloud needs points; start from a fixed box instead")
    low, high = points.min(axis=0), points.max(axis=0)
    # A single point has no extent: a tenth of the way to the cameras then.
    margin = max(MARGIN * float((high - low).max()), 0.01 * scene.extent)
    return Region(_corner((low - margin).tolist()), _corner((high + margin).tolist()), cells)


def _sizes(region: Region, side: int) -> tuple[int, int, int]:
    """Rows of the lines of a box of about side³ cubic cells."""
    sides = [high - low for low, high in zip(region.low, region.high, strict=True)]
    cell = float(np.prod(sides)) ** (1.0 / 3.0) / side
    x, y, z = (min(max(2, int(one / cell + 1e-6)), MOST_PROLONGED) for one in sides)
    return x, y, z


def _cut(line: Tensor, first: int, last: int, cells: int, rows: int) -> Tensor:
    """The part of a line over cells [first, last) of all."""
    if cells == rows - 1:
        return line[first : last + 1].contiguous()
    fine = resampled(line, cells + 1)[first : last + 1]
    return resampled(fine, max(2, round((last - first) / cells * (rows - 1)) + 1))
