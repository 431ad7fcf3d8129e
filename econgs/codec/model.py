"""The context model: position → distribution and quantisation step of every attribute of an anchor.

A binary hash grid gives values at the anchor's position. A head of one hidden layer turns them into mean and
standard deviation of a normal distribution for each of the D attribute elements, and into one refinement r
for each attribute group; its step is q = Q (1 + tanh r) (HAC, Chen et al. 2024, with the grids of BiRF). In
training, attributes carry uniform noise of one step; afterwards they are rounded to multiples of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from econgs_bench.econgs.codec.hash_grid import (
    GRIDS,
    SMALL_GRID,
    GridConfig,
    HashGrid,
    Lookup,
    compiled,
    native,
)
from econgs_bench.econgs.codec.integer import (
    ACTIVATION_BITS,
    MOST_INPUTS,
    OUTPUT_LIMIT,
    IntegerHead,
    IntegerIntra,
    IntegerLayer,
    rounded_steps,
    rounded_weight,
)

STEPS = {"features": 0.1, "offset_scalings": 0.001, "gaussian_scalings": 0.001, "offsets": 0.2}
"""Base steps Q. The paper has 1 for features, which rounds nearly all of them to zero."""

MOST_ELEMENTS = 1024  # per anchor: bounds the allocations of a stream's reader
LEAST_PROBABILITY = 1e-6
LEAST_SIGMA = 1e-9
INTRA_HIDDEN = 30
"""Hidden units between the features of an anchor, in HAC++'s form for synthetic scenes."""


class Attributes(NamedTuple):
    """Coded attributes of M anchors: features (M, F), activated scalings (M, 6) and offsets (M, K, 3)."""

    features: Tensor
    scalings: Tensor
    offsets: Tensor

    @property
    def flat(self) -> Tensor:
        """(M, F + 6 + 3 K) all attributes."""
        return torch.cat([self.features, self.scalings, self.offsets.flatten(1)], 1)

    def of(self, rows: Tensor) -> Attributes:
        """Attributes of some anchors (indices or a mask)."""
        if rows.dtype == torch.bool:
            rows = rows.nonzero()[:, 0]
        features, scalings, offsets = (one.index_select(0, rows) for one in self)  # faster than [] backward
        return Attributes(features, scalings, offsets)


class CodingOptions(Protocol):
    """Options of a method that codes its anchors."""

    @property
    def feature_step(self) -> float: ...
    @property
    def scaling_step(self) -> float: ...
    @property
    def offset_step(self) -> float: ...
    @property
    def offsets(self) -> int: ...
    @property
    def grid(self) -> str: ...


@dataclass(frozen=True)
class ContextConfig:
    """Sizes of a context model.

    Attributes:
        features: F, values of an anchor's feature.
        offsets: K, Gaussians per anchor.
        steps: base steps Q of features, scalings of offsets, scalings of Gaussians, offsets.
        grid: the hash grids.
        hidden: width of the head's hidden layer.
        chunk: channels of a chunk of features, which are mixtures of what the position says and what earlier
            chunks say (HAC++); 0: the position alone.
    """

    features: int = 50
    offsets: int = 10
    steps: tuple[float, float, float, float] = field(default=tuple(STEPS.values()))  # type: ignore[assignment]
    grid: GridConfig = SMALL_GRID
    hidden: int = 50
    chunk: int = 0

    def __post_init__(self) -> None:
        if self.features < 1 or self.offsets < 1 or not all(0.0 < one < 1e6 for one in self.steps):
            raise ValueError("features, offsets and steps must be positive")
        if self.total > MOST_ELEMENTS:
            raise ValueError(
                f"{self.total} attribute elements per anchor; at most {MOST_ELEMENTS} are possible"
            )
        if not 1 <= self.hidden <= MOST_INPUTS:
            raise ValueError(f"a hidden layer of 1 to {MOST_INPUTS} is possible")
        if self.chunk < 0 or (self.chunk and self.features - self.chunk > MOST_INPUTS):
            raise ValueError(f"chunks with at most {MOST_INPUTS} channels before the last are possible")

    @classmethod
    def of(cls, options: CodingOptions, features: int, hidden: int, chunk: int = 0) -> ContextConfig:
        """Configuration with the steps, ``offsets`` and ``grid`` of a method's options."""
        scaling = options.scaling_step
        steps = (options.feature_step, scaling, scaling, options.offset_step)
        return cls(features, options.offsets, steps, GRIDS[options.grid], hidden, chunk)

    @property
    def chunks(self) -> tuple[int, ...]:
        """Channels of each chunk of features; none where these are no mixtures."""
        if not self.chunk:
            return ()
        return tuple(min(self.chunk, self.features - at) for at in range(0, self.features, self.chunk))

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
    """The context of M anchors, with a sample of S whose bits count.

    Attributes:
        steps: (M, 4) step q of each attribute group.
        grid_bits: bits of the present hash grid, a scalar.
        sample: (S,) indices among the M.
        sample_hidden: (S, H) hidden activations of the sample.
        sample_steps: (S, 4) steps of the sample.
    """

    steps: Tensor
    grid_bits: Tensor
    sample: Tensor
    sample_hidden: Tensor
    sample_steps: Tensor


@dataclass(frozen=True)
class Noisy:
    """Attributes with noise: those of all M anchors, and (S, D) flat ones of the sample."""

    values: Attributes
    sample: Tensor


@dataclass(frozen=True)
class MeanBits:
    """Estimated bits per attribute element.

    Attributes:
        attributes: mean over a sample of anchors; scalar with gradient.
        grid: bits of the hash grid over those of all anchors' elements; scalar with gradient.
        groups: (4,) bits per element of each attribute group, for display.
    """

    attributes: Tensor
    grid: Tensor
    groups: Tensor


class _NormalBits(torch.autograd.Function):
    """See :func:`normal_bits`. A function of its own: autograd's many small steps are slow."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, mean: Tensor, sigma: Tensor, step: Tensor) -> Tensor:  # type: ignore[override]
        scale = sigma.clamp_min(LEAST_SIGMA).reciprocal_()
        middle, half = (values - mean).mul_(scale), (0.5 * step).mul_(scale)
        # Symmetry moves the interval to the lower side, where a difference of erfc keeps its digits.
        low = middle.abs().sub_(half)
        root = 0.5**0.5
        probability = torch.erfc(low * root).sub_(torch.erfc((low + 2.0 * half).mul_(root))).mul_(0.5)
        probability.clamp_min_(LEAST_PROBABILITY)
        ctx.save_for_backward(scale, middle, half, probability)
        return probability.log2().neg_()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # type: ignore[override]
        scale, middle, half, probability = ctx.saved_tensors
        outer = (grad * scale).div_(probability).mul_(-1.0 / (math.log(2.0) * math.sqrt(2.0 * math.pi)))
        upper, lower = middle + half, middle - half
        above, below = (upper * upper).mul_(-0.5).exp_(), (lower * lower).mul_(-0.5).exp_()
        to_values = (above - below).mul_(outer)
        to_sigma = (lower.mul_(below)).sub_(upper.mul_(above)).mul_(outer)
        to_step = above.add_(below).mul_(outer).mul_(0.5)
        return to_values, -to_values, to_sigma, to_step


class Distribution(NamedTuple):
    """Means and standard deviations of normal distributions."""

    mean: Tensor
    sigma: Tensor


def normal_bits(values: Tensor, mean: Tensor, sigma: Tensor, step: Tensor) -> Tensor:
    """−log2 of the normal probability of the interval of one step around each value, at most 19.9 bits.

    All arguments have one shape. Below the least probability, the gradient is that of the probability divided
    by the least one, so that it still moves a wrong mean.
    """
    bits: Tensor = _NormalBits.apply(values, mean, sigma, step)
    return bits


def mixture_bits(values: Tensor, normals: Sequence[Distribution], weight: Tensor, step: Tensor) -> Tensor:
    """As :func:`normal_bits`, under mixtures of two normal distributions.

    Args:
        values: (M, F).
        normals: the two.
        weight: (M, F) of the first.
        step: (M, F).
    """

    def probability(of: Distribution) -> Tensor:
        scale = of.sigma.clamp_min(LEAST_SIGMA).reciprocal()
        low = ((values - of.mean).abs() - 0.5 * step) * scale
        root = 0.5**0.5
        return 0.5 * (torch.erfc(low * root) - torch.erfc((low + step * scale) * root))

    first, second = (probability(one) for one in normals)
    mixed = weight * first + (1.0 - weight) * second
    bounded = mixed + (mixed.clamp_min(LEAST_PROBABILITY) - mixed).detach()
    return -bounded.log2()


class IntraAnchor(nn.Module):
    """Features → distributions of later features of the same anchor, chunk by chunk (HAC++, its small form).

    Outputs of a chunk: means, logarithms of spreads and logits, one row per channel each. Nothing enters the
    first chunk.
    """

    def __init__(self, widths: Sequence[int], generator: torch.Generator | None) -> None:
        super().__init__()
        self.widths = tuple(widths)
        self.free = nn.Parameter(torch.zeros(3 * self.widths[0]))
        before = [sum(self.widths[:chunk]) for chunk in range(1, len(self.widths))]

        def weights(rows: int, inputs: int, share: float) -> Tensor:
            bound = share * inputs**-0.5
            return torch.empty(rows, inputs).uniform_(-bound, bound, generator=generator)

        after = self.widths[1:]
        self.first = nn.ParameterList([weights(INTRA_HIDDEN, one, 1.0) for one in before])
        self.first_bias = nn.ParameterList([torch.zeros(INTRA_HIDDEN) for _ in before])
        self.second = nn.ParameterList([weights(3 * one, INTRA_HIDDEN, 0.1) for one in after])
        self.second_bias = nn.ParameterList([torch.zeros(3 * one) for one in after])

    def layers(self) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Weights and biases of both layers of each later chunk."""
        return list(zip(self.first, self.first_bias, self.second, self.second_bias, strict=True))

    @torch.no_grad()
    def start(self, mean: Tensor, log: Tensor) -> None:
        """Set all biases to the mean and the logarithm of the spread (F,) of each channel."""
        biases = [self.free, *self.second_bias]
        for bias, *parts in zip(biases, mean.split(self.widths), log.split(self.widths), strict=True):
            bias.copy_(torch.cat([*parts, torch.zeros_like(parts[0])]))

    def forward(self, values: Tensor, exact: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Means, logarithms and logits (M, F).

        Args:
            values: (M, F) features, in the units of the context model.
            exact: whether weights are rounded as in the coder.
        """
        outputs = [self.free.expand(len(values), -1)]
        for first, first_bias, second, second_bias in self.layers():
            if exact:
                first, second = rounded_weight(first), rounded_weight(second)
            hidden = functional.linear(values[:, : first.shape[1]], first, first_bias).relu()
            outputs.append(functional.linear(hidden, second, second_bias))
        parts = zip(*(one.chunk(3, 1) for one in outputs), strict=True)
        means, logs, logits = (torch.cat(part, 1) for part in parts)
        return means, logs, logits


class Noise:
    """Uniform noise on (−½, ½) from random places of one pool: fresh draws are slow.

    Args:
        size: size of the pool; larger requests get fresh numbers.
        generator: CPU generator; its state determines all numbers.
    """

    def __init__(
        self, size: int = 1 << 21, *, generator: torch.Generator, device: torch.device | str = "cpu"
    ) -> None:
        self.generator = generator
        self.pool = torch.rand(size, generator=generator).sub_(0.5).to(device)

    def take(self, *shape: int) -> Tensor:
        """Noise of a shape, as a read-only view."""
        count = torch.Size(shape).numel()
        if count > len(self.pool):
            return torch.rand(shape, generator=self.generator).sub_(0.5).to(self.pool.device)
        start = int(torch.randint(len(self.pool) - count + 1, (), generator=self.generator))
        return self.pool[start : start + count].view(shape)


class _Head(torch.autograd.Function):
    """Hidden layer and refinements of all rows, hidden activations of the last: no dense gradients."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, values: Tensor, weight: Tensor, bias: Tensor, last: Tensor, last_bias: Tensor, tail: int
    ) -> tuple[Tensor, Tensor]:
        hidden = torch.addmm(bias, values, weight.T).relu_()
        ctx.save_for_backward(values, weight, last, hidden)
        ctx.tail = tail
        return torch.addmm(last_bias, hidden, last.T), hidden[len(hidden) - tail :].clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor, grad_tail: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        values, weight, last, hidden = ctx.saved_tensors
        inner = grad @ last
        inner[len(inner) - ctx.tail :] += grad_tail
        inner = torch.ops.aten.threshold_backward(inner, hidden, 0.0)
        to_values = inner @ weight if ctx.needs_input_grad[0] else None
        return to_values, inner.T @ values, inner.sum(0), grad.T @ hidden, grad.sum(0), None


class _AddNoise(torch.autograd.Function):
    """Values with noise of their groups' steps, and the same of a sample."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, values: Tensor, steps: Tensor, noise: Tensor, sample: Tensor, first: int, groups: int
    ) -> tuple[Tensor, Tensor]:
        flat, noise = values.detach().flatten(1), noise.flatten(1)
        ctx.native = compiled(flat)
        ctx.groups = first, groups
        ctx.save_for_backward(noise, steps, sample)
        if ctx.native:
            out = torch.empty_like(flat)
            arrays = [one.detach().contiguous().numpy() for one in (flat, noise, steps)]
            native().add_noise(*arrays, first, groups, out.numpy())
        else:
            each = steps[:, first : first + groups].repeat_interleave(flat.shape[1] // groups, 1)
            out = torch.addcmul(flat, noise, each)
        return out.view(values.shape), out[sample]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor, grad_sample: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        noise, steps, sample = ctx.saved_tensors
        first, groups = ctx.groups
        flat = grad.flatten(1)
        if len(sample):
            flat = flat.index_add(0, sample, grad_sample)
        if not ctx.needs_input_grad[1]:
            return flat.view(grad.shape), None, None, None, None, None
        to_steps = torch.zeros_like(steps)
        if ctx.native:
            part = steps.new_empty((len(steps), groups))
            arrays = [one.detach().contiguous().numpy() for one in (flat, noise, steps)]
            native().add_noise_backward(*arrays, first, groups, part.numpy())
        else:
            part = (flat * noise).unflatten(1, (groups, -1)).sum(2)
        to_steps[:, first : first + groups] = part
        return flat.view(grad.shape), to_steps, None, None, None, None


def draw_sample(count: int, generator: torch.Generator, share: float = 0.05) -> Tensor:
    """Random sample (with replacement) of ``count`` visible anchors whose bits count, at least 16.

    A share of 1 takes each of them once.
    """
    if share >= 1.0:
        return torch.arange(count)
    many = max(round(share * count), min(count, 16))
    return torch.randint(max(count, 1), (many,), generator=generator)


class ContextModel(nn.Module):
    """Hash grid and head, trained with the anchors of the scenes that share it.

    Attributes:
        config: its sizes.
        coder_exact: whether to round weights and steps as the coder does, with straight-through
            gradients; for the last phase of training and for measurements.

    Parameters for the optimiser: ``grid.table``, :attr:`head`, and those of ``intra`` where there is one.
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
        # Mean = unit · Q · output; a unit is the power of two near an element's deviation: all learn alike.
        self.register_buffer("unit", torch.ones(config.total))
        self.mixing: nn.Linear | None = None
        self.intra: IntraAnchor | None = None
        if config.chunk:
            self.mixing = nn.Linear(config.hidden, config.features)
            nn.init.zeros_(self.mixing.weight)
            nn.init.zeros_(self.mixing.bias)
            self.intra = IntraAnchor(config.chunks, generator)

    @property
    def head(self) -> list[nn.Parameter]:
        """Parameters of the head."""
        layers = [self.first, self.means, self.spreads, self.refinements]
        layers += [] if self.mixing is None else [self.mixing]
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
        """Set the head's biases to each element's mean and deviation over all anchors.

        Call it once, at the start of the second stage; otherwise training has to learn them first.
        """
        values = torch.cat([one.flat for one in scenes]) / self.base_steps()
        if not len(values):  # no anchors, no statistics
            return
        mean, deviation = values.mean(0), values.std(0, correction=0).clamp(2.0**-3, 2.0**16)
        self.unit.copy_(torch.exp2(deviation.log2().round()))
        self.means.bias.copy_(mean / self.unit)
        self.spreads.bias.copy_(deviation.log2())
        if self.intra is not None:
            width = self.config.features
            self.intra.start((mean / self.unit)[:width], deviation.log2()[:width])

    def lookup(self, codes: Tensor, extent: Any) -> Lookup:
        """Vertices and weights of anchor positions (``PositionGrid``: its codes and extent), for reuse."""
        return self.grid.lookup(codes.to(self.device), extent)

    def forward(self, lookup: Lookup, rows: Tensor | None = None, sample: Tensor | None = None) -> Context:
        """Context of the anchors ``rows`` of a scene.

        Args:
            lookup: lookup of the scene's anchors.
            rows: (M,) int64 indices; default: all.
            sample: (S,) sample of the rows whose bits count (:func:`draw_sample`); default: none.
        """
        sample = torch.empty(0, dtype=torch.int64) if sample is None else sample
        sample = sample.to(self.device)
        count = len(lookup) if rows is None else len(rows)
        if len(sample):
            every = torch.arange(count, device=self.device) if rows is None else rows
            rows = torch.cat([every, every[sample]])
        values, grid_bits = self.grid(lookup, rows)
        weight, last = self.first.weight, self.refinements.weight
        if self.coder_exact:
            weight, last = rounded_weight(weight), rounded_weight(last)
        refinements, hidden = _Head.apply(
            values, weight, self.first.bias, last, self.refinements.bias, len(sample)
        )
        factors = rounded_steps(refinements) if self.coder_exact else 1.0 + torch.tanh(refinements)
        steps = factors * factors.new_tensor(self.config.steps)
        first, sampled = steps.split([count, len(sample)])
        return Context(first, grid_bits, sample, hidden, sampled)

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

    def perturb(self, values: Attributes, context: Context, noise: Noise) -> Noisy:
        """Attributes of the M anchors with uniform noise of one step in place of rounding.

        Gradients reach the values and the steps.
        """
        parts = [
            _AddNoise.apply(one, context.steps, noise.take(*one.shape), context.sample, first, groups)
            for one, first, groups in zip(values, (0, 1, 3), (1, 2, 1), strict=True)
        ]
        whole, sampled = zip(*parts, strict=True)
        return Noisy(Attributes(*whole), torch.cat(sampled, 1))

    def round(self, values: Attributes, steps: Tensor) -> Attributes:
        """Attributes rounded to multiples of the steps.

        Gradients pass straight through to the values, and reach the steps as in :meth:`perturb`, with the
        rounding error in place of noise: without them only the bits would act on steps, and they would grow
        endlessly.
        """

        def rounded(one: Tensor, step: Tensor) -> Tensor:
            with torch.no_grad():
                exact = one / step
                whole = torch.floor(exact + 0.5)
                difference, noise = whole * step - one, whole - exact
            return one + difference + noise * (step - step.detach())

        scaling_steps = steps[:, 1:3].repeat_interleave(3, 1, output_size=6)
        features, scalings, offsets = values
        return Attributes(
            rounded(features, steps[:, :1]),
            rounded(scalings, scaling_steps),
            rounded(offsets, steps[:, 3:, None]),
        )

    def bits(self, values: Tensor, hidden: Tensor, steps: Tensor) -> Tensor:
        """(S, D) bits of noisy or rounded attributes (S, D), from hidden activations (S, H), steps (S, 4)."""
        mean, sigma = self.distribution(hidden)
        each = self.element_steps(steps)
        if self.intra is None or self.mixing is None:
            return normal_bits(values, mean, sigma, each)
        width = self.config.features
        features, step = values[:, :width], each[:, :width]
        others = normal_bits(values[:, width:], mean[:, width:], sigma[:, width:], each[:, width:])
        base = self.base_steps()[:width]
        unit = self.unit[:width] * base
        means, logs, logits = self.intra(features / unit, self.coder_exact)
        own = Distribution(means * unit, torch.exp2(logs.clamp(-14.0, 26.0)) * base)
        weight = self.mixing.weight
        mixing = functional.linear(
            hidden, rounded_weight(weight) if self.coder_exact else weight, self.mixing.bias
        )
        normals = Distribution(mean[:, :width], sigma[:, :width]), own
        bits = mixture_bits(features, normals, torch.sigmoid(mixing - logits), step)
        return torch.cat([bits, others], 1)

    def mean_bits(
        self, noisy: Noisy, context: Context, *, anchors: int, share: Tensor | None = None
    ) -> MeanBits:
        """Bits in the loss, from the sampled anchors.

        The paper's loss is L_rec + λ_e (L_entropy + L_hash) / (N d_A): add λ_e · (attributes + grid).

        Args:
            noisy: result of :meth:`perturb`.
            context: result of :meth:`forward`, with a sample.
            anchors: N, number of anchors of all scenes of this model.
            share: (S, D) weights of the bits of each element of the sample; default 1.
        """
        grid = context.grid_bits / float(max(anchors, 1) * self.config.total)
        if len(context.sample) == 0:
            return MeanBits(grid.new_zeros(()), grid, grid.new_zeros(4))
        bits = self.bits(noisy.sample, context.sample_hidden, context.sample_steps)
        if share is not None:
            bits = bits * share
        per_element = bits.detach().mean(0)
        groups = torch.stack([one.mean() for one in per_element.split(self.config.widths)])
        return MeanBits(bits.mean(), grid, groups)

    @torch.no_grad()
    def rounded(self, values: Attributes, lookup: Lookup) -> tuple[Attributes, Tensor]:
        """All anchors of a scene after rounding, and (4,) estimated bits of each attribute group."""
        pieces, bits = [], torch.zeros(4, dtype=torch.float64)
        for rows in torch.arange(len(lookup), device=self.device).split(8192):
            context = self(lookup, rows, torch.arange(len(rows)))
            piece = self.round(values.of(rows), context.steps)
            pieces.append(piece)
            each = self.bits(piece.flat, context.sample_hidden, context.sample_steps).sum(0)
            bits += torch.stack([one.sum() for one in each.split(self.config.widths)]).cpu()
        if not pieces:
            return values, bits
        return Attributes(*(torch.cat(part) for part in zip(*pieces, strict=True))), bits

    @torch.no_grad()
    def integer_head(self) -> IntegerHead:
        """The head in its coded form."""
        means = self.means.weight * self.unit[:, None]
        weight = torch.cat([means, self.spreads.weight, self.refinements.weight])
        bias = torch.cat([self.means.bias * self.unit, self.spreads.bias, self.refinements.bias])
        if self.mixing is not None:
            weight, bias = torch.cat([weight, self.mixing.weight]), torch.cat([bias, self.mixing.bias])
        return IntegerHead(
            IntegerLayer.of(self.first.weight, self.first.bias),
            IntegerLayer.of(weight, bias),
            self.config.widths,
        )

    @torch.no_grad()
    def integer_intra(self) -> IntegerIntra | None:
        """The networks between features in their coded form."""
        if self.intra is None:
            return None
        units = self.unit[: self.config.features]
        scales = [torch.cat([one, torch.ones_like(one).repeat(2)]) for one in units.split(self.intra.widths)]
        free = (self.intra.free * scales[0]).double() * (1 << ACTIVATION_BITS)
        layers = tuple(
            (
                IntegerLayer.of(first, first_bias),
                IntegerLayer.of(second * scale[:, None], second_bias * scale),
            )
            for (first, first_bias, second, second_bias), scale in zip(
                self.intra.layers(), scales[1:], strict=True
            )
        )
        return IntegerIntra(
            self.intra.widths,
            units.log2().round().to(torch.int8).cpu().numpy(),
            free.round().clamp(-OUTPUT_LIMIT, OUTPUT_LIMIT).to(torch.int32).cpu().numpy(),
            layers,
        )
