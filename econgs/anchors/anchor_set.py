"""The anchors of one scene in training: parameters in an optimiser, statistics, growth."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from econgs_bench.econgs.anchors.growing import AnchorRules, AnchorStatistics, grow, lattice_anchors, prunable
from econgs_bench.econgs.anchors.scalings import Activation, activated, logarithms, of_logarithms
from econgs_bench.econgs.codec.symbols import SCALINGS
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.points import neighbour_distances

PARAMETERS = ("features", "log_scalings", "offsets")
MASKS = "masks"
FIRST_MASK = 1.0  # before the sigmoid (HAC)
SCALE_CAP = 0.05


class AnchorSet:
    """Anchors of one scene. Their parameters live in an optimiser under ``<key>/<parameter>``.

    Parameters: ``features`` (N, F), zero at first; ``log_scalings`` (N, 6), three factors of offsets and
    three of Gaussian scales before activation; ``offsets`` (N, K, 3), zero at first. Positions lie on the
    lattice of ``voxel`` and are constant (Scaffold-GS).

    Args:
        key: distinguishes the scenes of one optimiser.
        points: (n, 3) initial cloud, n >= 1.
        voxel: side of a lattice cell, scene units; points of one cell make one anchor.
        features: F, values of an anchor's feature.
        offsets: K, Gaussians per anchor.
        fallback: scaling of a lone anchor, scene units.
        scale: factor on the first scalings of Gaussian scales.
        activation: of scalings.
        masks: whether to train ``masks`` (N, K) too, one number per offset (HAC).
    """

    def __init__(
        self,
        key: str,
        points: Tensor,
        *,
        voxel: float,
        features: int,
        offsets: int,
        fallback: float,
        scale: float = 1.0,
        activation: Activation = "exp",
        masks: bool = False,
        device: torch.device | str = "cpu",
    ) -> None:
        self.parameters = (*PARAMETERS, MASKS) if masks else PARAMETERS
        self.key = key
        self.voxel = voxel
        self.activation = activation
        self.offsets = offsets
        positions = lattice_anchors(points, voxel)
        log_scalings = neighbour_distances(positions, fallback).log()[:, None].repeat(1, SCALINGS)
        log_scalings[:, 3:] += math.log(scale)
        count = len(positions)
        self.positions = positions.to(device)
        self.initial = {
            "features": torch.zeros((count, features), device=device),
            "log_scalings": of_logarithms(log_scalings, activation).to(device),
            "offsets": torch.zeros((count, offsets, 3), device=device),
        }
        if masks:
            self.initial[MASKS] = torch.full((count, offsets), FIRST_MASK, device=device)
        self.statistics = AnchorStatistics.zeros(count, offsets, device)

    def __len__(self) -> int:
        return len(self.positions)

    def scalings(self, optimiser: Adam) -> Tensor:
        """(N, 6) activated scalings."""
        return activated(optimiser[self.name("log_scalings")], self.activation)

    def name(self, parameter: str) -> str:
        """Name of one of its parameters in the optimiser."""
        return f"{self.key}/{parameter}"

    @property
    def names(self) -> list[str]:
        """Names of its parameters in the optimiser."""
        return [self.name(parameter) for parameter in self.parameters]

    def groups(self) -> dict[str, Tensor]:
        """The initial parameters by their names in the optimiser; a second call returns none."""
        groups = {self.name(parameter): values for parameter, values in self.initial.items()}
        self.initial = {}
        return groups

    @torch.no_grad()
    def grow_and_prune(
        self,
        optimiser: Adam,
        rules: AnchorRules,
        generator: torch.Generator,
        decoded_offsets: Tensor | None = None,
    ) -> bool:
        """One growth event (Scaffold-GS: growing first, then pruning).

        Args:
            optimiser: optimiser with the parameters.
            rules: thresholds.
            generator: generator of the random thinning.
            decoded_offsets: (N, K, 3) offsets of the Gaussians; None: the parameter ``offsets``.

        Returns:
            Whether the limit prevented some additions.
        """
        features, raw_scalings, offsets = (optimiser[self.name(parameter)] for parameter in PARAMETERS)
        log_scalings = logarithms(raw_scalings, self.activation)
        places = offsets if decoded_offsets is None else decoded_offsets
        new_anchors = grow(self.positions, log_scalings, features, places, self.statistics, rules, generator)
        added = len(new_anchors.anchors)
        if added:
            new = {
                "features": new_anchors.features,
                "log_scalings": of_logarithms(new_anchors.log_scalings, self.activation),
                "offsets": offsets.new_zeros((added, *offsets.shape[1:])),
                MASKS: offsets.new_full((added, self.offsets), FIRST_MASK),
            }
            optimiser.append({self.name(parameter): new[parameter] for parameter in self.parameters})
            self.positions = torch.cat([self.positions, new_anchors.anchors])
            self.statistics = self.statistics.extended(added)
        faint = prunable(self.statistics, rules)
        if bool(faint.any()):
            self.keep(optimiser, ~faint)
            optimiser[self.name("log_scalings")][:, 3:].clamp_(max=SCALE_CAP)
        return new_anchors.limited

    @torch.no_grad()
    def keep(self, optimiser: Adam, rows: Tensor) -> None:
        """Keep only these anchors (boolean mask)."""
        optimiser.keep(rows, self.names)
        self.positions = self.positions[rows]
        self.statistics = self.statistics.keep(rows)

    def state(self) -> dict[str, Tensor]:
        """Tensors of a checkpoint beside the optimiser's state."""
        saved = {f"statistics/{name}": values for name, values in vars(self.statistics).items()}
        return {f"{self.key}/{name}": v for name, v in ({"positions": self.positions} | saved).items()}

    def load_state(self, saved: dict[str, Tensor]) -> None:
        """Continue from :meth:`state`."""
        self.positions = saved[f"{self.key}/positions"].clone()
        names = ("gradients", "draws", "opacities", "visits")
        self.statistics = AnchorStatistics(
            *(saved[f"{self.key}/statistics/{name}"].clone() for name in names)
        )
