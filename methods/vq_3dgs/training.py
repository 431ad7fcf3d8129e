"""3DGS, then quantisation, then fine-tuning of the words."""

from __future__ import annotations

from dataclasses import asdict, replace

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.anchors.gaussians import Gaussians
from econgs_bench.econgs.codebooks import Codebook, rounded
from econgs_bench.econgs.codec.positions import PositionGrid
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat.sh import spherical_harmonics
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.gaussian_splatting.schedule import Schedule
from econgs_bench.methods.gaussian_splatting.training import (
    LEARNING_RATES,
    PARAMETERS,
    Trainer,
    plain_gaussians,
)
from econgs_bench.methods.interface import Checkpoint, SceneInput
from econgs_bench.methods.shared.quantised_scene import QuantisedScene
from econgs_bench.methods.shared.training import TrainingState
from econgs_bench.methods.vq_3dgs.model import GROUPS, VqModel, gaussians, quantised
from econgs_bench.methods.vq_3dgs.spec import VqOptions

_LAST = 0.1  # words end at this share of their first learning rates


class VqTrainer(Trainer):
    """A fit of 3DGS that ends in fine-tuning codebooks; arguments as there.

    While words are tuned, ids, positions and opacities stay as they are.
    """

    options: VqOptions

    def __init__(
        self, scene: SceneInput, options: VqOptions, iterations: int, seed: int, device: str
    ) -> None:
        self.seed = seed
        self.coded: QuantisedScene | None = None
        super().__init__(scene, options, iterations, seed, device)

    def _schedule(self, iterations: int) -> Schedule:
        return super()._schedule(max(1, round((1.0 - self.options.tuning) * iterations)))

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return super().count if self.coded is None else len(self.coded.positions)

    def stage(self) -> str:
        return "codebooks" if self.iteration >= self.schedule.iterations else super().stage()

    def begin_step(self) -> None:
        if self.iteration > self.schedule.iterations and self.coded is None:
            self.check_finite()
            self._place(quantised(self._plain(), self.options, self.seed))
        super().begin_step()

    def in_view(self, camera: Camera) -> Gaussians:
        if self.coded is None:
            return super().in_view(camera)
        position = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        now = gaussians(self._now(self.coded))
        scales, opacities = now.log_scales.exp(), now.logits.sigmoid()
        colors = spherical_harmonics(now.sh_degree, now.means, position, now.sh_dc, now.sh_rest)
        return Gaussians(now.means, now.quats, scales, opacities, colors)

    def learning_rates(self, scene: int = 0) -> dict[str, float]:
        if self.coded is None:
            return super().learning_rates(scene)
        tuning = max(1, self.iterations - self.schedule.iterations)
        done = (self.iteration - self.schedule.iterations) / tuning
        return {name: first * _LAST**done for name, first in self._word_learning_rates(self.coded).items()}

    # ------------------------------------------------------------------ codebooks

    def _plain(self) -> SceneGaussians:
        values = {name: self.optimiser[name].detach().clone() for name in PARAMETERS}
        return SceneGaussians(self.scene.name, self.scene.train.background, self.schedule.sh_degree, **values)

    def _place(self, coded: QuantisedScene) -> None:
        """Begin to optimise the words of the codebooks, and nothing else."""
        self.coded = coded
        words = {
            _name(group, stage): book.words.to(self.device)
            for group in GROUPS
            for stage, book in enumerate(_books(coded, group))
        }
        self.optimiser = Adam(words, self._word_learning_rates(coded))

    def _word_learning_rates(self, coded: QuantisedScene) -> dict[str, float]:
        plain = LEARNING_RATES | {"sh_rest": self.options.sh_rest_lr}
        of_group = {"color": "sh_dc", "scale": "log_scales", "rotation": "quats"}
        share = self.options.tuning_lr
        return {
            _name(group, stage): share * plain[of_group.get(group, "sh_rest")]
            for group in GROUPS
            for stage in range(len(_books(coded, group)))
        }

    def _now(self, coded: QuantisedScene) -> QuantisedScene:
        """The scene with the words that are being optimised."""
        columns = dict(coded.columns)
        for group in GROUPS:
            columns[group] = tuple(
                replace(book, words=self.optimiser[_name(group, stage)])
                for stage, book in enumerate(_books(coded, group))
            )
        return replace(coded, columns=columns)

    # ------------------------------------------------------------------ what comes out

    @staticmethod
    def restored(state: TrainingState, options: VqOptions) -> VqModel:  # type: ignore[override]
        """As 3DGS until it is quantised, then as it will be stored."""
        if _is_coded(state):
            return VqModel.of([_rounded(_coded(state, options))], state.device)
        plain = plain_gaussians(state, options.sh_degree)
        if state.iteration < state.iterations:
            return VqModel([], [plain], state.device)
        return VqModel.of([quantised(plain, options, int(state.scalars["seed"]))], state.device)

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        state.scalars["seed"] = self.seed
        if self.coded is not None:
            state.arrays["positions"] = self.coded.positions.clone()
            state.scalars["grid"] = None if self.coded.grid is None else asdict(self.coded.grid)
            for group in self.coded.columns:
                for stage, book in enumerate(_books(self.coded, group)):
                    state.arrays[f"ids/{_name(group, stage)}"] = book.ids.clone()
                    if group not in GROUPS:
                        state.arrays[f"words/{_name(group, stage)}"] = book.words.clone()
        return state

    def resume(self, checkpoint: Checkpoint) -> None:
        state = TrainingState(checkpoint, self.device)
        if _is_coded(state):
            self._place(_coded(state, self.options))
        super().resume(checkpoint)


def _is_coded(state: TrainingState) -> bool:
    return "positions" in state.arrays


def _coded(state: TrainingState, options: VqOptions) -> QuantisedScene:
    """The coded scene, with the words that are being optimised."""
    columns: dict[str, tuple[Codebook, ...]] = {}
    for group in ("opacity", *GROUPS):
        names = [_name(group, stage) for stage in range(options.stages if group in GROUPS else 1)]
        columns[group] = tuple(
            Codebook(
                state.value(name) if group in GROUPS else state.arrays[f"words/{name}"],
                state.arrays[f"ids/{name}"],
            )
            for name in names
        )
    about = {"codebook size": options.codebook_size, "sh degree": options.sh_degree}
    (label,) = state.scenes
    grid = state.scalars["grid"]
    return QuantisedScene(
        label.name,
        label.background,
        about,
        state.arrays["positions"],
        columns,
        "entropy",
        None if grid is None else PositionGrid(**{name: tuple(values) for name, values in grid.items()}),
    )


def _name(group: str, stage: int) -> str:
    return f"{group}-{stage}"


def _books(scene: QuantisedScene, group: str) -> tuple[Codebook, ...]:
    column = scene.columns[group]
    assert not isinstance(column, Tensor)
    return column


def _rounded(scene: QuantisedScene) -> QuantisedScene:
    columns = {group: tuple(rounded(book) for book in _books(scene, group)) for group in scene.columns}
    return replace(scene, columns=columns)
