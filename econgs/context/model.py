"""The context model: position → distribution and quantisation step of every attribute of an anchor.

A binary hash grid is looked up at the anchor's position; a head of one hidden layer gives, for each of the D
attribute elements, mean and standard deviation of a normal distribution, and for each attribute group one
refinement r, from which the step is q = Q (1 + tanh r) (HAC, Chen et al. 2024, equations 6 to 8, with the grids
of BiRF). While it is trained, attributes carry uniform noise of one step; afterwards they are rounded to
multiples of the step.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from econgs.context.hash_grid import SMALL_GRID, GridConfig, HashGrid, Lookup
from econgs.context.integer import MOST_INPUTS, IntegerHead, IntegerLayer, rounded_steps, rounded_weight

STEPS = {"features": 0.1, "offset_scalings": 0.001, "gaussian_scalings": 0.001, "offsets": 0.2}
"""Base steps Q. The paper's are these with 1 for features, which rounds nearly all trained features to zero."""

LEAST_PROBABILITY = 1e-6
LEAST_SIGMA = 1e-9


class Attributes(NamedTuple):
    """What is coded of M anchors: features (M, F), activated scalings (M, 6) and offsets (M, K, 3)."""

    features: Tensor
    scalings: Tensor
    offsets: Tensor

    @property
    def flat(self) -> Tensor:
        """All in one, (M, F + 6 + 3 K)."""
        return torch.cat([self.features, self.scalings, self.offsets.flatten(1)], 1)

    def __getitem__(self, rows: Any) -> Any:  # the anchors, not the fields
        """Of some anchors: indices or a mask. (Fields are taken by name.)"""
        return Attributes(self.features[rows], self.scalings[rows], self.offsets[rows])


@dataclass(frozen=True)
class ContextConfig:
    """Sizes of a context model.

    Attributes:
        features: F, of an anchor.
        offsets: K.
        steps: base step Q of features, of the three scalings of offsets, of the three of Gaussians, of offsets.
        grid: the hash grids.
        hidden: width of the head's hidden layer.
    """

    features: int = 50
    offsets: int = 10
    steps: tuple[float, float, float, float] = field(default=tuple(STEPS.values()))  # type: ignore[assignment]
    grid: GridConfig = SMALL_GRID
    hidden: int = 50

    def __post_init__(self) -> None:
        if self.features < 1 or self.offsets < 1 or not all(0.0 < one < 1e6 for one in self.steps):
            raise ValueError("features, offsets and steps must be positive")
        if not 1 <= self.hidden <= MOST_INPUTS:
            raise ValueError(f"a hidden layer of 1 to {MOST_INPUTS} is possible")

    @property
    def widths(self) -> tuple[int, int, int, int]:
        """Elements of each attribute group."""
        return self.features, 3, 3, 3 * self.offsets

    @property
    def total(self) -> int:
        """D: attribute elements of an anchor."""
        return sum(self.widths)


@dataclass(frozen=True)
class Context:
    """The context of M anchors: hidden activations (M, H) and steps q (M, 4), one per attribute group."""

    hidden: Tensor
    steps: Tensor

    def __getitem__(self, rows: Tensor) -> Context:
        return Context(self.hidden[rows], self.steps[rows])


@dataclass(frozen=True)
class Rate:
    """Estimated rate, in bits per attribute element.

    Attributes:
        attributes: mean over a sample of anchors; scalar with gradient.
        grid: bits of the hash grid over those of all anchors' elements; scalar with gradient.
        groups: (4,) bits per element of each attribute group, for display.
    """

    attributes: Tensor
    grid: Tensor
    groups: Tensor


class _AtLeast(torch.autograd.Function):
    """Lower bound whose gradient passes where it would lift the value."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, least: float) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(values >= least)
        return values.clamp_min(least)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        (above,) = ctx.saved_tensors
        return torch.where(above | (grad < 0.0), grad, 0.0), None


def normal_bits(values: Tensor, mean: Tensor, sigma: Tensor, step: Tensor) -> Tensor:
    """−log2 of the normal probability of the interval of one step around each value, at most 19.9 bits."""
    scale = (sigma.clamp_min(LEAST_SIGMA) * 2.0**0.5).reciprocal()
    middle, half = (values - mean) * scale, 0.5 * step * scale
    # By symmetry taken on the lower side, where a difference of erfc keeps its digits.
    low = middle.abs() - half
    probability = 0.5 * (torch.erfc(low) - torch.erfc(low + 2.0 * half))
    return -_AtLeast.apply(probability, LEAST_PROBABILITY).log2()


class Noise:
    """Uniform noise on (−½, ½), drawn once and handed out from random places: fresh draws cost more than all else.

    Args:
        size: numbers in store; larger requests are drawn afresh.
        generator: of the CPU; its state decides all.
    """

    def __init__(
        self, size: int = 1 << 21, *, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> None:
        self.generator = generator
        self.pool = torch.rand(size, generator=generator).sub_(0.5).to(device)

    def take(self, *shape: int) -> Tensor:
        """Noise of a shape; a view, not to be changed."""
        count = torch.Size(shape).numel()
        if count > len(self.pool):
            return torch.rand(shape, generator=self.generator).sub_(0.5).to(self.pool.device)
        start = int(torch.randint(len(self.pool) - count + 1, (), generator=self.generator))
        return self.pool[start : start + count].view(shape)


class ContextModel(nn.Module):
    """Hash grid and head, trained with the anchors of the scenes that share it.

    Attributes:
        config: its sizes.
        coder_exact: evaluate with the weights and steps rounded as the coder will use them, with straight-through
            gradients; for the last phase of training and whatever is measured without coding.

    Parameters for the optimiser: ``grid.table``, and :attr:`head`.
    """

    unit: Tensor

    def __init__(self, config: ContextConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.config = config
        self.coder_exact = False
        self.grid = HashGrid(config.grid, generator)
        self.first = nn.Linear(config.grid.outputs, config.hidden)
        self.means = nn.Linear(config.hidden, config.total)
        self.spreads = nn.Linear(config.hidden, config.total)
        self.refinements = nn.Linear(config.hidden, len(config.widths))
        with torch.no_grad():
            bound = (1.0 / config.grid.outputs) ** 0.5
            self.first.weight.uniform_(-bound, bound, generator=generator)
            self.first.bias.uniform_(-bound, bound, generator=generator)
            for layer in (self.means, self.spreads, self.refinements):
                layer.weight.zero_()
                layer.bias.zero_()
            out = (1.0 / config.hidden) ** 0.5
            self.means.weight.uniform_(-0.1 * out, 0.1 * out, generator=generator)
            self.spreads.weight.uniform_(-0.1 * out, 0.1 * out, generator=generator)
        # The mean is unit · Q · output: powers of two near each element's spread, so that all learn alike.
        self.register_buffer("unit", torch.ones(config.total))

    @property
    def head(self) -> list[nn.Parameter]:
        """Parameters of the head."""
        layers = (self.first, self.means, self.spreads, self.refinements)
        return [one for layer in layers for one in layer.parameters()]

    @property
    def device(self) -> torch.device:
        return self.grid.table.device

    def base_steps(self) -> Tensor:
        """(D,) base step Q of each element."""
        steps, widths = self.unit.new_tensor(self.config.steps), torch.tensor(self.config.widths)
        return steps.repeat_interleave(widths.to(steps.device))

    @torch.no_grad()
    def calibrate(self, *scenes: Attributes) -> None:
        """Set the head's biases so that it starts from each element's own mean and spread over all anchors.

        Call it once, when the context model is switched on. Without it training has to find them first.
        """
        values = torch.cat([one.flat for one in scenes]) / self.base_steps()
        mean, spread = values.mean(0), values.std(0, correction=0).clamp(2.0**-3, 2.0**16)
        self.unit.copy_(torch.exp2(spread.log2().round()))
        self.means.bias.copy_(mean / self.unit)
        self.spreads.bias.copy_(spread.log2())

    def lookup(self, codes: Tensor, extent: Any) -> Lookup:
        """Vertices and weights of anchor positions (``PositionGrid.codes``, ``PositionGrid.extent``), kept for reuse."""
        return self.grid.lookup(codes.to(self.device), extent)

    def forward(self, lookup: Lookup, rows: Tensor | None = None) -> Context:
        """Context of the anchors ``rows`` (indices, default all) of a scene: cheap enough for all visible ones."""
        values = self.grid(lookup, rows)
        weight, last = self.first.weight, self.refinements.weight
        if self.coder_exact:
            weight, last = rounded_weight(weight), rounded_weight(last)
        hidden = torch.relu(functional.linear(values, weight, self.first.bias))
        refinements = functional.linear(hidden, last, self.refinements.bias)
        factors = rounded_steps(refinements) if self.coder_exact else 1.0 + torch.tanh(refinements)
        return Context(hidden, factors * factors.new_tensor(self.config.steps))

    def distribution(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (M, D) of every attribute element, in its own unit."""
        base = self.base_steps()
        means, spreads = self.means.weight * self.unit[:, None], self.spreads.weight
        if self.coder_exact:
            means, spreads = rounded_weight(means), rounded_weight(spreads)
        mean = functional.linear(hidden, means, self.means.bias * self.unit)
        log = functional.linear(hidden, spreads, self.spreads.bias)
        return mean * base, torch.exp2(log.clamp(-14.0, 26.0)) * base

    def element_steps(self, steps: Tensor) -> Tensor:
        """(M, D) step of every element from those of the groups (M, 4)."""
        widths = torch.tensor(self.config.widths, device=steps.device)
        return steps.repeat_interleave(widths, 1, output_size=self.config.total)

    def perturb(self, values: Attributes, steps: Tensor, noise: Noise) -> Attributes:
        """Attributes with uniform noise of one step (M, 4), which stands for rounding; gradients reach both."""
        features, scalings, offsets = values
        count, width = features.shape
        scaling_steps = steps[:, 1:3].repeat_interleave(3, 1, output_size=6)
        return Attributes(
            torch.addcmul(features, noise.take(count, width), steps[:, :1]),
            torch.addcmul(scalings, noise.take(count, 6), scaling_steps),
            torch.addcmul(offsets, noise.take(*offsets.shape), steps[:, 3:, None]),
        )

    def round(self, values: Attributes, steps: Tensor) -> Attributes:
        """Attributes rounded to multiples of the steps; straight-through gradients to the values."""

        def rounded(one: Tensor, step: Tensor) -> Tensor:
            with torch.no_grad():
                difference = torch.floor(one / step + 0.5) * step - one
            return one + difference

        scaling_steps = steps[:, 1:3].repeat_interleave(3, 1, output_size=6)
        features, scalings, offsets = values
        return Attributes(
            rounded(features, steps[:, :1]),
            rounded(scalings, scaling_steps),
            rounded(offsets, steps[:, 3:, None]),
        )

    def bits(self, values: Tensor, context: Context) -> Tensor:
        """(M, D) bits of noisy or rounded attributes (M, D) (:attr:`Attributes.flat`)."""
        mean, sigma = self.distribution(context.hidden)
        return normal_bits(values, mean, sigma, self.element_steps(context.steps))

    def rate(
        self,
        values: Attributes,
        context: Context,
        *,
        anchors: int,
        generator: torch.Generator,
        share: float = 0.05,
    ) -> Rate:
        """The rate terms of the loss, from a random share of the anchors at hand.

        The paper's loss is L_rec + λ_e (L_entropy + L_hash) / (N d_A): add λ_e · (attributes + grid).

        Args:
            values: noisy (or rounded) attributes of M anchors.
            context: theirs.
            anchors: N, number of anchors of all scenes that share this model.
            generator: of the CPU.
            share: how many of the M are sampled, with replacement; at least 16.
        """
        count = len(values.features)
        grid = self.grid.bits() / float(max(anchors, 1) * self.config.total)
        if count == 0:
            return Rate(grid.new_zeros(()), grid, grid.new_zeros(4))
        many = max(round(share * count), min(count, 16))
        sample = torch.randint(count, (many,), generator=generator).to(self.device)
        bits = self.bits(values[sample].flat, context[sample])
        per_element = bits.detach().mean(0)
        groups = torch.stack([one.mean() for one in per_element.split(self.config.widths)])
        return Rate(bits.mean(), grid, groups)

    @torch.no_grad()
    def integer_head(self) -> IntegerHead:
        """The head as it is coded."""
        means = self.means.weight * self.unit[:, None]
        weight = torch.cat([means, self.spreads.weight, self.refinements.weight])
        bias = torch.cat([self.means.bias * self.unit, self.spreads.bias, self.refinements.bias])
        return IntegerHead(
            IntegerLayer.of(self.first.weight, self.first.bias),
            IntegerLayer.of(weight, bias),
            self.config.widths,
        )
