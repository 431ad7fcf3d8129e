"""3DGS, then quantisation at every codebook size, then fine-tuning of the words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from datasets.camera import Camera
from datasets.scene import RGB
from econgs.codebooks import Codebook, rounded
from econgs.optim import Adam
from econgs.splat.rasterise import rasterise
from econgs.splat.sh import spherical_harmonics
from methods.gaussian_splatting.model import SceneGaussians
from methods.gaussian_splatting.training import LEARNING_RATES, PARAMETERS, Trainer
from methods.interface import Checkpoint, SceneInput
from methods.shared.quantised_scene import QuantisedScene
from methods.vq_3dgs.model import GROUPS, VqModel, gaussians, quantised
from methods.vq_3dgs.spec import SIZES, VqOptions

_LAST = 0.1  # words end at this share of their first learning rates


class VqTrainer(Trainer):
    """A fit of 3DGS that ends in fine-tuning codebooks; arguments as there.

    While words are tuned, ids, positions and opacities stay as they are, and each step sees the codebooks
    of one size, in turn: what is saved at any size was trained at that size.
    """

    options: VqOptions

    def __init__(
        self, scene: SceneInput, options: VqOptions, iterations: int, seed: int, device: str
    ) -> None:
        self.total, self.seed = iterations, seed
        self.coded: dict[int, QuantisedScene] = {}
        super().__init__(scene, options, max(1, round((1.0 - options.tuning) * iterations)), seed, device)

    @property
    def iterations(self) -> int:
        return self.total

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(next(iter(self.coded.values())).positions) if self.coded else super().count

    def _stage(self) -> str:
        return "codebooks" if self.iteration >= self.schedule.iterations else super()._stage()

    def step(self) -> dict[str, float]:
        if self.iteration >= self.schedule.iterations and not self.coded:
            self._place({size: self._quantised(size) for size in SIZES})
        return super().step()

    def _losses(
        self, camera: Camera, truth: Tensor, back: RGB | Tensor
    ) -> tuple[dict[str, Tensor], Tensor | None, Tensor]:
        if not self.coded:
            return super()._losses(camera, truth, back)
        position = torch.as_tensor(camera.position, dtype=torch.float32, device=self.device)
        now = gaussians(self._now(SIZES[self.iteration % len(SIZES)]))
        splats = rasterise(
            now.means,
            now.quats,
            now.log_scales.exp(),
            now.logits.sigmoid(),
            spherical_harmonics(now.sh_degree, now.means, position, now.sh_dc, now.sh_rest),
            camera,
        )
        return {"image": self._image_loss(splats.features, splats.alpha, truth, back)}, None, splats.radii

    def _set_rates(self) -> None:
        if not self.coded:
            super()._set_rates()
            return
        done = (self.iteration - self.schedule.iterations) / max(1, self.total - self.schedule.iterations)
        for name, first in self._word_rates().items():
            self.optimiser.rates[name] = first * _LAST**done

    # ------------------------------------------------------------------ codebooks

    def _plain(self) -> SceneGaussians:
        values = {name: self.optimiser[name].detach().clone() for name in PARAMETERS}
        return SceneGaussians(self.scene.name, self.scene.train.background, self.schedule.sh_degree, **values)

    def _quantised(self, size: int) -> QuantisedScene:
        return quantised(self._plain(), size, self.options.stages, self.seed)

    def _place(self, coded: Mapping[int, QuantisedScene]) -> None:
        """Begin to optimise the words of these codebooks, and nothing else."""
        self.coded = dict(coded)
        words = {
            _name(size, group, stage): book.words.to(self.device)
            for size, scene in coded.items()
            for group in GROUPS
            for stage, book in enumerate(_books(scene, group))
        }
        self.optimiser = Adam(words, self._word_rates())

    def _word_rates(self) -> dict[str, float]:
        plain = LEARNING_RATES | {"sh_rest": self.options.sh_rest_lr}
        of_group = {"color": "sh_dc", "scale": "log_scales", "rotation": "quats"}
        share = self.options.tuning_lr
        return {
            _name(size, group, stage): share * plain[of_group.get(group, "sh_rest")]
            for size, scene in self.coded.items()
            for group in GROUPS
            for stage in range(len(_books(scene, group)))
        }

    def _now(self, size: int) -> QuantisedScene:
        """The scene at a size, with the words that are being optimised."""
        scene = self.coded[size]
        columns = dict(scene.columns)
        for group in GROUPS:
            columns[group] = tuple(
                replace(book, words=self.optimiser[_name(size, group, stage)])
                for stage, book in enumerate(_books(scene, group))
            )
        return replace(scene, columns=columns)

    # ------------------------------------------------------------------ what comes out

    def model(self) -> VqModel:  # type: ignore[override]
        """The present state: as 3DGS until it is quantised, then as it will be stored."""
        first = self.options.codebook_size
        sizes = [first, *(size for size in SIZES if size != first)]
        if self.coded:
            return VqModel.of([[_rounded(self._now(size)) for size in sizes]], self.device)
        if self.iteration >= self.total:
            return VqModel.of([[self._quantised(size) for size in sizes]], self.device)
        return VqModel([], [self._plain()], self.device)

    def checkpoint(self) -> Checkpoint:
        state = super().checkpoint()
        for size, scene in self.coded.items():
            state.arrays[f"positions/{size}"] = scene.positions.clone()
            for group, column in scene.columns.items():
                assert not isinstance(column, Tensor)
                for stage, book in enumerate(column):
                    state.arrays[f"ids/{_name(size, group, stage)}"] = book.ids.clone()
                    if group not in GROUPS:
                        state.arrays[f"words/{_name(size, group, stage)}"] = book.words.clone()
        return state

    def restore(self, checkpoint: Checkpoint) -> None:
        arrays = self.arrays(checkpoint)
        if f"positions/{SIZES[0]}" in arrays:
            self._place({size: self._stored(size, arrays) for size in SIZES})
        super().restore(checkpoint)

    def _stored(self, size: int, arrays: Mapping[str, Tensor]) -> QuantisedScene:
        """A coded scene of a checkpoint."""
        columns: dict[str, tuple[Codebook, ...]] = {}
        for group in ("opacity", *GROUPS):
            stages = self.options.stages if group in GROUPS else 1
            books = []
            for stage in range(stages):
                name = _name(size, group, stage)
                words = arrays[f"words/{name}" if group not in GROUPS else f"optimiser/{name}/0/value"]
                books.append(Codebook(words, arrays[f"ids/{name}"]))
            columns[group] = tuple(books)
        about = {"codebook size": size, "sh degree": self.schedule.sh_degree}
        background = self.scene.train.background
        positions = arrays[f"positions/{size}"]
        return QuantisedScene(self.scene.name, background, about, positions, columns, "entropy")


def _name(size: int, group: str, stage: int) -> str:
    return f"{size}-{group}-{stage}"


def _books(scene: QuantisedScene, group: str) -> tuple[Codebook, ...]:
    column = scene.columns[group]
    assert not isinstance(column, Tensor)
    return column


def _rounded(scene: QuantisedScene) -> QuantisedScene:
    columns = {group: tuple(rounded(book) for book in _books(scene, group)) for group in scene.columns}
    return replace(scene, columns=columns)
