"""Growing and pruning of anchors (Lu et al. 2024, Scaffold-GS, section 4.3), shared by all anchor methods."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from econgs_bench.econgs.codec.symbols import SCALINGS
from econgs_bench.econgs.splat.rasterise import choose_backend

LEVELS = 3
HIERARCHY = 4


@dataclass(frozen=True)
class AnchorRules:
    """Thresholds of growing and pruning.

    Attributes:
        voxel: side of the finest cell, scene units.
        init_factor: the coarsest cell is ``voxel * init_factor``, then a quarter of it, then a sixteenth.
        gradient: mean screen-space gradient (normalised device coordinates) at which an offset grows an
            anchor of level 0; doubled at each further level.
        offset_visits: number of views with its Gaussian after which an offset is judged.
        anchor_visits: number of views with it after which an anchor is judged.
        prune_opacity: mean summed opacity per visit below which an anchor is pruned.
        limit: maximum number of anchors; 0 = none.
        levels: number of cell sizes, from the coarsest.
    """

    voxel: float = 0.001
    init_factor: int = 16
    gradient: float = 2e-4
    offset_visits: float = 40.0
    anchor_visits: float = 80.0
    prune_opacity: float = 0.005
    limit: int = 0
    levels: int = LEVELS

    def __post_init__(self) -> None:
        finest = HIERARCHY ** (self.levels - 1)
        if self.voxel <= 0.0 or self.init_factor // finest < 1:
            raise ValueError(
                f"voxel {self.voxel:g} with init_factor {self.init_factor}: cells of level {self.levels - 1} "
                f"would have no size; init_factor must be at least {finest}"
            )

    def cell(self, level: int) -> float:
        """Side of the cells of a level."""
        return self.voxel * float(self.init_factor // HIERARCHY**level)


@dataclass
class AnchorStatistics:
    """Statistics of N anchors with K offsets each since their last judgement.

    Attributes:
        gradients: (N, K) sum of screen-space gradient norms, normalised device coordinates.
        draws: (N, K) number of views with the Gaussian of that offset.
        opacities: (N,) sum over views of the summed opacities of the anchor's Gaussians.
        visits: (N,) number of views with the anchor.
    """

    gradients: Tensor
    draws: Tensor
    opacities: Tensor
    visits: Tensor

    @classmethod
    def zeros(cls, anchors: int, offsets: int, device: torch.device | str) -> AnchorStatistics:
        return cls(
            torch.zeros(anchors, offsets, device=device),
            torch.zeros(anchors, offsets, device=device),
            torch.zeros(anchors, device=device),
            torch.zeros(anchors, device=device),
        )

    @torch.no_grad()
    def record(
        self,
        visible: Tensor,
        opacities: Tensor,
        slots: Tensor,
        pixel_gradients: Tensor,
        radii: Tensor,
        size: tuple[int, int],
    ) -> None:
        """Add one view.

        Args:
            visible: (V,) indices of the visible anchors.
            opacities: (V, K) opacities of their Gaussians before culling (negative ones count as 0).
            slots: (M,) index v * K + k of each splatted Gaussian among those of the visible anchors.
            pixel_gradients: (M, 2) gradient of the loss with respect to its centre, in pixels.
            radii: (M,) radius in pixels; 0 for a Gaussian without a pixel.
            size: width and height of the view.
        """
        if choose_backend(pixel_gradients) == "native":
            from econgs_bench.econgs.anchors import native

            view = (visible, opacities, slots, pixel_gradients, radii)
            return native.record_view(vars(self).values(), view, size)
        offsets = self.gradients.shape[1]
        self.opacities.index_add_(0, visible, opacities.clamp_min(0.0).sum(1))
        self.visits.index_add_(0, visible, torch.ones_like(visible, dtype=self.visits.dtype))
        x, y = pixel_gradients.unbind(1)
        norms = ((0.5 * size[0] * x) ** 2 + (0.5 * size[1] * y) ** 2).sqrt()
        visible_slots = radii > 0
        at = (visible[slots // offsets] * offsets + slots % offsets)[visible_slots]
        self.gradients.view(-1).index_add_(0, at, norms[visible_slots])
        self.draws.view(-1).index_add_(0, at, torch.ones_like(norms[visible_slots]))

    def keep(self, rows: Tensor) -> AnchorStatistics:
        """Statistics of some anchors (mask or indices)."""
        return AnchorStatistics(*(values[rows] for values in vars(self).values()))

    def extended(self, count: int) -> AnchorStatistics:
        """The statistics with zeros for ``count`` new anchors."""
        return AnchorStatistics(
            *(torch.cat([v, v.new_zeros((count, *v.shape[1:]))]) for v in vars(self).values())
        )


@dataclass(frozen=True)
class GrownAnchors:
    """New anchors of a growth event.

    Attributes:
        anchors: (A, 3) positions, on the lattice of their level.
        log_scalings: (A, 6), the logarithm of the cell's side.
        features: (A, F) element-wise maximum over the anchors whose Gaussians grew it.
        limited: whether the limit dropped the candidates with the smallest gradients.
    """

    anchors: Tensor
    log_scalings: Tensor
    features: Tensor
    limited: bool


@torch.no_grad()
def grow(
    anchors: Tensor,
    log_scalings: Tensor,
    features: Tensor,
    offsets: Tensor,
    statistics: AnchorStatistics,
    rules: AnchorRules,
    generator: torch.Generator,
) -> GrownAnchors:
    """New anchors in empty cells that hold Gaussians with high gradients.

    The statistics of all judged offsets are reset.

    Args:
        anchors: (N, 3).
        log_scalings: (N, 6); the first three scale the offsets.
        features: (N, F).
        offsets: (N, K, 3).
        statistics: changed in place.
        rules: thresholds.
        generator: CPU generator of the random thinning (keeps half of the candidates of level 0, then three
            quarters, then seven eighths).
    """
    count, many = offsets.shape[:2]
    judged = statistics.draws > rules.offset_visits
    gradients = torch.where(judged, statistics.gradients / statistics.draws.clamp_min(1.0), 0.0)
    positions = anchors[:, None] + offsets * log_scalings[:, None, :3].exp()
    lattice = anchors
    added: list[tuple[Tensor, Tensor, Tensor]] = []
    room = max(rules.limit - count, 0) if rules.limit else math.inf  # a start may exceed the limit
    limited = False
    for level in range(rules.levels):
        chance = torch.rand((count, many), generator=generator).to(gradients.device)
        candidates = judged & (gradients >= rules.gradient * 2.0**level) & (chance > 0.5 ** (level + 1))
        candidate_slots = candidates.reshape(-1).nonzero()[:, 0]
        if not len(candidate_slots):
            continue
        cell = rules.cell(level)
        cells, place = torch.unique(
            torch.round(positions.reshape(-1, 3)[candidate_slots] / cell).to(torch.int64),
            dim=0,
            return_inverse=True,
        )
        occupied = torch.round(lattice / cell).to(torch.int64)
        free = ~_among(cells, occupied)
        new = cells[free].to(anchors.dtype) * cell
        best = features.new_full((len(cells), features.shape[1]), -math.inf)
        parents = features[candidate_slots // many]
        best.scatter_reduce_(0, place[:, None].expand_as(parents), parents, "amax")
        best = best[free]
        if len(new) > room:  # the strongest ones
            limited = True
            strengths = gradients.reshape(-1)[candidate_slots]
            strongest = strengths.new_zeros(len(cells)).scatter_reduce_(0, place, strengths, "amax")[free]
            strongest_rows = strongest.topk(int(room)).indices.sort().values
            new, best = new[strongest_rows], best[strongest_rows]
        room -= len(new)
        added.append((new, log_scalings.new_full((len(new), SCALINGS), math.log(cell)), best))
        lattice = torch.cat([lattice, new])
    statistics.gradients[judged] = 0.0
    statistics.draws[judged] = 0.0
    if not added:
        none = anchors.new_zeros((0, 3))
        return GrownAnchors(none, log_scalings.new_zeros((0, SCALINGS)), features[:0], limited)
    places, scalings, best = (torch.cat(column) for column in zip(*added, strict=True))
    return GrownAnchors(places, scalings, best, limited)


@torch.no_grad()
def prunable(statistics: AnchorStatistics, rules: AnchorRules) -> Tensor:
    """(N,) mask of the anchors with enough visits whose Gaussians add next to nothing.

    The visits of all other judged anchors are reset.
    """
    judged = statistics.visits > rules.anchor_visits
    faint = judged & (statistics.opacities < rules.prune_opacity * statistics.visits)
    reset = judged & ~faint
    statistics.opacities[reset] = 0.0
    statistics.visits[reset] = 0.0
    return faint


def lattice_anchors(points: Tensor, voxel: float) -> Tensor:
    """(A, 3) centres of the cells of side ``voxel`` that hold any of the (n, 3) points."""
    cells = torch.unique(torch.round(points.double() / voxel).to(torch.int64), dim=0)
    places: Tensor = (cells.double() * voxel).to(points.dtype)
    return places


def _among(cells: Tensor, others: Tensor) -> Tensor:
    """(A,) whether each (A, 3) integer cell occurs among (B, 3) others."""
    both = torch.cat([cells, others])
    low = both.amin(0)
    span = both.amax(0) - low + 1
    if math.prod(span.tolist()) >= 2**63:  # cannot be flattened to one integer
        _, place = torch.unique(both, dim=0, return_inverse=True)
        occurs: Tensor = torch.isin(place[: len(cells)], place[len(cells) :])
        return occurs
    flat = both - low
    key = (flat[:, 0] * span[1] + flat[:, 1]) * span[2] + flat[:, 2]
    shared: Tensor = torch.isin(key[: len(cells)], key[len(cells) :])
    return shared
