"""Base class of trainers: the loop over iterations, checkpoints, and models made from them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs_bench.datasets.camera import pixel_size
from econgs_bench.datasets.scene import RGB, WHITE
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat import LINEAGE, LowPass, trusted_values
from econgs_bench.methods.interface import Checkpoint, Diverged, Monitor, Refused, SceneInput
from econgs_bench.methods.shared.densification import Densification, Drawn
from econgs_bench.methods.shared.edits import Direction
from econgs_bench.methods.shared.rendering import Rendering
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


D = TypeVar("D", bound=Drawn)


class LossOptions(Protocol):
    """Options that every trainer reads."""

    @property
    def alpha_weight(self) -> float:
        """Weight of the error of alpha."""


class TrainingLoop(ABC, Generic[D]):
    """A fit that goes on bit for bit from a checkpoint. Its steps draw something, of type ``D``.

    Args:
        scenes: the group, each with training views; in units of the fit.
        options: the method's options.
        iterations: the whole budget.
        seed: seed of the only generator.
        device: "cpu" or "cuda".

    Attributes:
        optimiser: holds the parameters.
        densification: decides on the number of primitives.
        background: what training views are composited on; None: a random color each time.
        iteration: iterations done.
        batch: iterations whose gradients a step of the optimiser sums.
        pending: views not yet drawn in this round.
        look_every: iterations between two reports of losses.
        units: scene units / units of the fit.
        pixel: size of a pixel of the training views at their mean distance, in units of the fit.

    Raises:
        Refused: a scene without training views.
    """

    optimiser: Adam
    options: LossOptions
    background: RGB | None
    batch: int = 1

    def __init__(
        self, scenes: Sequence[SceneInput], options: Any, iterations: int, seed: int, device: str
    ) -> None:
        for scene in scenes:
            if len(scene.train) == 0:
                raise Refused(f"scene {scene.name!r} has no training views")
        self.labels = [SceneLabel.of(scene) for scene in scenes]
        self.options, self.iterations, self.device = options, iterations, device
        self.generator = torch.Generator().manual_seed(seed)
        self.densification: Densification[Any, D] = Densification(self)
        self.iteration = 0
        self.pending: list[Any] = []
        self.look_every = LOOK_EVERY if device.startswith("cuda") else 1
        self.units = 1.0
        self._sums: dict[str, Tensor | float] = {}
        self._unseen = 0
        self._fresh = True  # no gradients wait for the rest of a batch
        # Rounded: models of the same cameras compose, whatever group they were in.
        self.pixel = float(f"{np.mean([pixel_size(scene.train.cameras) for scene in scenes]):.6g}")

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of primitives."""

    @property
    def may_pause(self) -> bool:
        """Whether a checkpoint can be taken now: no gradients wait for the rest of a batch."""
        return self._fresh

    @abstractmethod
    def draw(self) -> D:
        """What this iteration draws, with its losses.

        Raises:
            Diverged: a parameter is not finite.
        """

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        """Learning rates of this iteration that have changed.

        Args:
            scene: place of the drawn scene in the group.
        """
        return {}

    def begin_step(self) -> None:
        """Change what the schedule changes before this iteration."""

    def step(self) -> dict[str, float]:
        """One iteration.

        Returns:
            :meth:`report`: the loss ("loss") and, where it has several, its parts.

        Raises:
            Diverged: a loss or a parameter is not finite.
        """
        self.iteration += 1
        self.begin_step()
        drawn = self.draw()
        losses = {**drawn.losses, **self.densification.before_backward()}
        report = self.report(losses, drawn.figures)
        loss: Any = sum(losses.values(), torch.zeros((), device=self.device))
        self.descend(drawn, loss)
        self.densification.after_step(drawn)
        if self.iteration % CHECK_EVERY == 0:
            self.check_finite()
        return report

    def descend(self, drawn: D, loss: Tensor) -> None:
        """Take the gradients of a loss, and step where they complete a batch."""
        if self._fresh:
            self.optimiser.zero_grad()
        if loss.requires_grad:
            (loss / self.batch).backward()  # type: ignore[no-untyped-call]
            self.densification.after_backward(drawn)
            self.optimiser.learning_rates.update(self.learning_rates(drawn.scene))
        self._fresh = self.completes_batch()
        if self._fresh:
            self.optimiser.step()

    def completes_batch(self) -> bool:
        """Whether the optimiser steps in this iteration."""
        return True

    @staticmethod
    @abstractmethod
    def restored(state: TrainingState, options: Any) -> Any:
        """The model of a state, in units of the fit: as it will be stored, once the fit is finished."""

    def model(self) -> Any:
        """The present state as a model of its own, in the units of the fit."""
        model = self.restored(TrainingState(self.checkpoint(), self.device), self.options)
        return model.drawn_by(Rendering(low_pass=low_pass_of(self.options, self.pixel)))

    @classmethod
    def scene_model(cls, checkpoint: Checkpoint, options: Any, device: str) -> Any:
        """The model of a checkpoint, for cameras of the scene."""
        scalars = checkpoint.scalars
        low_pass = low_pass_of(options, scalars.get("pixel", 0.0))
        model = cls.restored(TrainingState(checkpoint, device), options)
        return model.drawn_by(Rendering(scalars.get("units", 1.0), low_pass))

    def model_in_scene_units(self) -> Any:
        """The present state as a model of its own, for cameras of the scene."""
        return self.scene_model(self.checkpoint(), self.options, self.device)

    @abstractmethod
    def views(self) -> list[Any]:
        """Every view in a new random order, the first one last."""

    def stage(self) -> str:
        """Name of the stage that the next iteration belongs to, for people."""
        return self.densification.stage()

    def run(self, monitor: Monitor, units: float = 1.0) -> None:
        """Train to the end of the budget.

        Args:
            monitor: takes reports at every iteration.
            units: scene units / units of the fit (:mod:`.methods.shared.units`).

        Raises:
            Diverged: a loss or a parameter is not finite.
        """
        self.units = units
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

    def next_view(self) -> Any:
        """Views come in random order, none twice before all were seen."""
        if not self.pending:
            self.pending = self.views()
        return self.pending.pop()

    def asks_alpha(self, transparent: bool) -> bool:
        """Whether alpha is a target: opaque pictures have their background in them.

        Args:
            transparent: whether training views are transparent anywhere (:func:`are_transparent`).
        """
        return transparent and self.options.alpha_weight > 0.0

    def color_of(self, background: RGB | None) -> RGB | Tensor:
        """The color that this iteration composites on; None: a random one."""
        return torch.rand(3, generator=self.generator) if background is None else background

    def shuffled(self, count: int) -> list[int]:
        order: list[int] = torch.randperm(count, generator=self.generator).tolist()
        return order

    def checkpoint(self) -> Checkpoint:
        """All that :meth:`resume` needs to go on as if nothing had happened, and :meth:`restored`."""
        arrays = {f"optimiser/{name}": values.clone() for name, values in self.optimiser.state().items()}
        arrays["generator"] = self.generator.get_state()
        arrays |= {name: values.clone() for name, values in self.densification.state().items()}
        scalars = {
            "pending": list(self.pending),
            "limited": self.densification.limited,
            "iterations": self.iterations,
            "scenes": [[label.name, label.background, label.light] for label in self.labels],
            "units": self.units,
            "pixel": self.pixel,
        }
        return Checkpoint(self.iteration, arrays, scalars)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint of the same fit."""
        arrays = self.arrays(checkpoint)
        self.optimiser.load_state(under("optimiser/", arrays))
        self.generator.set_state(checkpoint.arrays["generator"].cpu())
        self.pending = list(checkpoint.scalars["pending"])
        self.densification.limited = bool(checkpoint.scalars["limited"])
        self.densification.load_state(arrays)
        self.iteration = checkpoint.iteration

    def arrays(self, checkpoint: Checkpoint) -> dict[str, Tensor]:
        """Arrays of a checkpoint on the device of the fit."""
        return {name: values.to(self.device) for name, values in checkpoint.arrays.items()}


def chosen_background(choice: str, scene: SceneInput) -> RGB | None:
    """The background that a value of the option ``background`` chooses; None: a random one each time."""
    return scene.train.background if choice == "scene" else _BACKGROUNDS.get(choice)


def low_pass_of(options: object, pixel: float) -> LowPass:
    """The filters that options choose; that of the lineage, where they have none.

    Args:
        options: of a method.
        units: scene units / units of the fit.
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
