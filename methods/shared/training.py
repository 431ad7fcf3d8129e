"""Base class of trainers: the loop over iterations, checkpoints, and models made from them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs_bench.datasets.camera import pixel_size
from econgs_bench.datasets.scene import RGB, WHITE
from econgs_bench.econgs.losses import view_losses
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat import LINEAGE, LowPass, trusted_values
from econgs_bench.methods.interface import Checkpoint, Diverged, Monitor, Refused, SceneInput
from econgs_bench.methods.shared.edits import Direction
from econgs_bench.methods.shared.rendering import Rendering
from econgs_bench.methods.shared.rent import Frame, Holding, Scene, worth_keeping
from econgs_bench.methods.shared.splatting import SplattingOptions

CHECK_EVERY = 100
"""Iterations between looks at whether parameters are finite."""
LOOK_EVERY = 20
"""Iterations between looks at the losses on a GPU, each of which waits until it has caught up."""
_BACKGROUNDS: dict[str, RGB] = {"white": WHITE, "black": (0.0, 0.0, 0.0)}
_LOGARITHMS = ("log_scales", "log_scalings")  # may be finite where their exponentials are not


@dataclass(frozen=True)
class SceneLabel:
    """The part of a scene's definition that models keep.

    Attributes:
        light: unit vector to its directional light, or None for a headlight.
    """

    name: str
    background: RGB
    light: Direction | None

    @classmethod
    def of(cls, scene: SceneInput) -> SceneLabel:
        """Name, background and light of a scene."""
        light = scene.scene.light
        return cls(scene.name, scene.train.background, None if light is None else light.direction)


class TrainingState:
    """The state that a :meth:`TrainingLoop.checkpoint` holds, from which a model is made.

    Args:
        checkpoint: the checkpoint of a fit.
        device: where its arrays go.

    Attributes:
        iteration: steps done.
        iterations: the budget.
        scenes: the group's scenes, in order.
        arrays: the checkpoint's arrays.
        scalars: the checkpoint's scalars.
    """

    def __init__(self, checkpoint: Checkpoint, device: str) -> None:
        self.device = device
        self.iteration = checkpoint.iteration
        self.iterations = int(checkpoint.scalars["iterations"])
        self.scenes = [
            SceneLabel(name, tuple(background), None if light is None else tuple(light))
            for name, background, light in checkpoint.scalars["scenes"]
        ]
        self.arrays = {name: values.to(device) for name, values in checkpoint.arrays.items()}
        self.scalars = checkpoint.scalars

    def value(self, name: str, place: int = 0) -> Tensor:
        """A tensor of the optimiser's group of that name."""
        return self.arrays[f"optimiser/{name}/{place}/value"]

    @torch.no_grad()
    def fill(self, name: str, tensors: Iterable[Tensor]) -> None:
        """Set tensors, such as the weights of a network, to the values of the optimiser's group."""
        for place, tensor in enumerate(tensors):
            tensor.copy_(self.value(name, place))


class TrainingLoop(ABC):
    """A fit that takes one view at a time and goes on bit for bit from a checkpoint.

    Args:
        scenes: the group, each with training views.
        iterations: the whole budget.
        seed: seed of the only generator.
        device: "cpu" or "cuda".

    Attributes:
        optimiser: holds the parameters.
        options: the method's options.
        schedule: phases of the fit.
        background: what training views are composited on; None: a random color each time.
        iteration: steps done.
        pending: views not yet drawn in this round.
        limited: growth has met its limit.
        look_every: iterations between two reports of losses.
        units: scene units / units of the fit (:mod:`.methods.shared.units`).
        pixel: size of a pixel of the training views at their mean distance, in units of the fit.

    Raises:
        Refused: a scene without training views.
    """

    optimiser: Adam
    options: Any
    schedule: Any
    background: RGB | None
    units: float = 1.0

    def __init__(self, scenes: Sequence[SceneInput], iterations: int, seed: int, device: str) -> None:
        for scene in scenes:
            if len(scene.train) == 0:
                raise Refused(f"scene {scene.name!r} has no training views")
        self.labels = [SceneLabel.of(scene) for scene in scenes]
        self.iterations, self.device = iterations, device
        self.generator = torch.Generator().manual_seed(seed)
        self.iteration = 0
        self.pending: list[Any] = []
        self.limited = False
        self.look_every = LOOK_EVERY if device.startswith("cuda") else 1
        self._sums: dict[str, Tensor | float] = {}
        self._unseen = 0
        # Rounded: models of the same cameras compose, whatever group they were in.
        self.pixel = float(f"{np.mean([pixel_size(scene.train.cameras) for scene in scenes]):.6g}")

    @property
    def low_pass(self) -> LowPass:
        """How models of this fit are drawn."""
        return low_pass_of(self.options, self.pixel)

    @property
    def fit_low_pass(self) -> LowPass:
        """How Gaussians are drawn in this iteration: at centres of pixels until half of the budget."""
        low_pass = self.low_pass
        late = 2 * self.iteration > self.schedule.iterations
        return low_pass if late else replace(low_pass, points=1)

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of primitives."""

    @property
    def may_pause(self) -> bool:
        """Whether a checkpoint can be taken after this iteration."""
        return True

    @abstractmethod
    def step(self) -> Mapping[str, float]:
        """One step of the optimiser on one view, and what the schedule adds to it.

        Returns:
            :meth:`report`: the loss ("loss") and, where it has several, its parts.

        Raises:
            Diverged: a loss or a parameter is not finite.
        """

    @staticmethod
    @abstractmethod
    def restored(state: TrainingState, options: Any) -> Any:
        """The model of a state: as it will be stored, once the fit is finished."""

    def model(self) -> Any:
        """The present state as a model of its own, in the units of the fit."""
        model = self.restored(TrainingState(self.checkpoint(), self.device), self.options)
        model.rendering = Rendering(low_pass=self.low_pass)
        return model

    def model_in_scene_units(self) -> Any:
        """The present state as a model of its own, for cameras of the scene."""
        model = self.model()
        model.rendering = replace(model.rendering, units=self.units)
        return model

    @abstractmethod
    def views(self) -> list[Any]:
        """Every view in a new random order, the first one last."""

    @abstractmethod
    def stage(self) -> str:
        """Name of the stage that the next iteration belongs to, for people."""

    def run(self, monitor: Monitor) -> None:
        """Train to the end of the budget.

        Raises:
            Diverged: a loss or a parameter is not finite.
        """
        with trusted_values() if self.device.startswith("cuda") else nullcontext():
            self._run(monitor)
        self.check_finite()

    def _run(self, monitor: Monitor) -> None:
        stage = ""
        while self.iteration < self.iterations:
            if stage != (stage := self.stage()):
                monitor.stage(stage)
            losses = self.step()
            monitor.progress(self.iteration, losses, self.count)
            if self.may_pause and monitor.due(self.iteration):
                monitor.pause(self.iteration, self.model_in_scene_units, self.checkpoint)

    def report(
        self, parts: Mapping[str, Tensor | float], figures: Mapping[str, Tensor] | None = None
    ) -> dict[str, float]:
        """What :meth:`step` returns. On a GPU: means since the last look, and nothing between two looks.

        Args:
            parts: parts of the loss of this iteration; where there are several, each is shown beside the sum.
            figures: other scalars to show.

        Raises:
            Diverged: a part is not finite.
        """
        held = {**parts, **(figures or {})}
        for name, value in held.items():
            now = value.detach() if isinstance(value, Tensor) else value
            self._sums[name] = self._sums[name] + now if name in self._sums else now
        self._unseen += 1
        if self._unseen < self.look_every and self.iteration < self.iterations:
            return {}
        numbers = dict(zip(self._sums, _read(list(self._sums.values())), strict=True))
        numbers = {name: value / self._unseen for name, value in numbers.items()}
        self._sums, self._unseen = {}, 0
        shown = {name: value for name, value in numbers.items() if name not in (figures or {})}
        for name, value in shown.items():
            if not math.isfinite(value):
                raise Diverged(f"the {name} loss is {value} at iteration {self.iteration}")
        return {"loss": sum(shown.values())} | (numbers if len(shown) > 1 else {})

    @torch.no_grad()
    def check_finite(self) -> None:
        for name, group in self.optimiser.parameters.items():
            for tensor in group:
                values = tensor.exp() if name.endswith(_LOGARITHMS) else tensor
                if not math.isfinite(float(values.sum())):
                    raise Diverged(f"{name} hold NaN or infinite values at iteration {self.iteration}")

    def settle_rent(self) -> bool:
        """Primitives that the pictures hardly show go, where the schedule says so; whether it does.

        Of methods with the option ``rent``.
        """
        due = bool(self.options.rent) and self.schedule.settles_rent(self.iteration)
        for one in self.holdings() if due else ():
            kept = worth_keeping(one.count, one.scenes, self.options.rent, self.low_pass, self.device)
            one.keep(kept)
        return due

    def holdings(self) -> Iterable[Holding]:
        """The primitives that may go, each asked for after those before it went: none here."""
        return ()

    def rent_scene(self, source: SceneInput, images: Tensor, transparent: bool, frame: Frame) -> Scene:
        """A scene whose training views say what a primitive is worth; arguments as they are named there."""
        return Scene(source.train, images, frame, asks_alpha=self.asks_alpha(transparent))

    def next_view(self) -> Any:
        """Views come in random order, none twice before all were seen."""
        if not self.pending:
            self.pending = self.views()
        return self.pending.pop()

    def chosen_background(self, scene: SceneInput) -> RGB | None:
        """The background that the option of that name chooses."""
        choice = self.options.background
        return scene.train.background if choice == "scene" else _BACKGROUNDS.get(choice)

    def asks_alpha(self, transparent: bool) -> bool:
        """Whether alpha is a target: opaque pictures have their background in them.

        Args:
            transparent: whether training views are transparent anywhere (:func:`are_transparent`).
        """
        return transparent and self.options.alpha_weight > 0.0

    def background_color(self) -> RGB | Tensor:
        """The background of this iteration."""
        return torch.rand(3, generator=self.generator) if self.background is None else self.background

    def view_losses(
        self, colors: Tensor, alpha: Tensor, truth: Tensor, back: RGB | Tensor, transparent: bool = False
    ) -> dict[str, Tensor]:
        """Parts of the loss of a drawn view by name: "image", and "alpha" where alpha is a target.

        Args:
            colors: (H, W, 3) premultiplied.
            alpha: (H, W).
            truth: (H, W, 4) of the view.
            back: what both are composited on.
            transparent: as for :meth:`asks_alpha`.
        """
        asked = self.asks_alpha(transparent)
        weight = self.options.alpha_weight if asked else 0.0
        image, distance = view_losses(
            colors, alpha, truth, back, ssim_weight=self.options.ssim_weight, alpha_weight=weight
        )
        return {"image": image, "alpha": distance} if asked else {"image": image}

    def shuffled(self, count: int) -> list[int]:
        order: list[int] = torch.randperm(count, generator=self.generator).tolist()
        return order

    def checkpoint(self) -> Checkpoint:
        """All that :meth:`resume` needs to go on as if nothing had happened, and :meth:`restored`."""
        arrays = {f"optimiser/{name}": values.clone() for name, values in self.optimiser.state().items()}
        arrays["generator"] = self.generator.get_state()
        scalars = {
            "pending": list(self.pending),
            "limited": self.limited,
            "iterations": self.iterations,
            "scenes": [[label.name, label.background, label.light] for label in self.labels],
            "units": self.units,
            "pixel": self.pixel,
        }
        return Checkpoint(self.iteration, arrays, scalars)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint of the same fit."""
        self.optimiser.load_state(under("optimiser/", self.arrays(checkpoint)))
        self.generator.set_state(checkpoint.arrays["generator"].cpu())
        self.pending = list(checkpoint.scalars["pending"])
        self.limited = bool(checkpoint.scalars["limited"])
        self.iteration = checkpoint.iteration

    def arrays(self, checkpoint: Checkpoint) -> dict[str, Tensor]:
        """Arrays of a checkpoint on the device of the fit."""
        return {name: values.to(self.device) for name, values in checkpoint.arrays.items()}


def low_pass_of(options: Any, pixel: float) -> LowPass:
    """The filters that options choose; that of the lineage, where they have none.

    Args:
        options: of a method.
        pixel: size of a pixel of the training views at their mean distance, in units of the fit.
    """
    if not isinstance(options, SplattingOptions):
        return LINEAGE
    smoothing = options.smoothing * pixel**2
    points = options.supersampling
    return LowPass(options.low_pass, options.antialiased, smoothing, options.ray_power, points)


def _read(values: Sequence[Tensor | float]) -> list[float]:
    """Scalars as numbers; those of a GPU come over together."""
    tensors = [value for value in values if isinstance(value, Tensor)]
    read = iter(torch.stack([one.double() for one in tensors]).tolist() if tensors else ())
    return [next(read) if isinstance(value, Tensor) else value for value in values]


def training_images(images: NDArray[np.float32], device: str) -> Tensor:
    """Views (n, H, W, 4) where iterations take them from: on a GPU, if half of its free memory holds them."""
    pictures = torch.from_numpy(images)
    if device.startswith("cuda") and pictures.nbytes <= torch.cuda.mem_get_info(device)[0] // 2:
        return pictures.to(device)
    return pictures


def are_transparent(images: Tensor) -> bool:
    """Whether some pixel of pictures (n, H, W, 4) is not opaque."""
    return bool((images[..., 3] < 1).any())


def to_numpy(tensor: Tensor) -> NDArray[np.float32]:
    """A copy as float32 array."""
    return tensor.detach().cpu().numpy().copy()


def under(prefix: str, arrays: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): v for name, v in arrays.items() if name.startswith(prefix)}
