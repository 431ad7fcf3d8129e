"""Anchors with decoded colors, without shading (Scaffold-GS, Lu et al. 2024; HAC)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from econgs_bench.econgs.anchors.decode import Vector, refuse_non_finite, rotation
from econgs_bench.econgs.anchors.decoders import Decoder
from econgs_bench.econgs.anchors.gaussians import ViewGaussians
from econgs_bench.econgs.anchors.shading import unit
from econgs_bench.econgs.codec.symbols import SCALINGS
from econgs_bench.econgs.splat.composite import scale_depth
from econgs_bench.econgs.splat.rasterise import choose_backend

NETWORKS = {"opacity": 1, "covariance": 7, "color": 3}
"""Network → number of outputs per Gaussian."""


class ColorDecoders(nn.Module):
    """Three networks: opacity (tanh), scale and quaternion, color (sigmoid).

    Inputs: anchor feature (‖ distance camera → anchor) ‖ unit vector camera → anchor.

    Args:
        features: F, values of an anchor's feature.
        offsets: K, Gaussians per anchor.
        hidden: width of the hidden layers; 0 = F.
        distance: whether the distance is an input (HAC).
        generator: CPU generator of the initial weights.

    Raises:
        ValueError: a width that is not positive.
    """

    def __init__(
        self,
        features: int,
        offsets: int,
        *,
        hidden: int = 0,
        distance: bool,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if min(features, offsets) < 1 or hidden < 0:
            raise ValueError(
                f"decoders of {features} features, {offsets} offsets, {hidden} hidden units are not possible"
            )
        self.features = features
        self.offsets = offsets
        self.hidden = hidden or features
        self.distance = distance
        inputs = features + int(distance) + 3
        for name, attributes in NETWORKS.items():
            self.add_module(name, Decoder(inputs, self.hidden, attributes * offsets, generator))

    def network(self, name: str) -> Decoder:
        """One of :data:`NETWORKS`."""
        decoder = self.get_submodule(name)
        assert isinstance(decoder, Decoder)
        return decoder


def decode_colors(
    anchors: Tensor,
    features: Tensor,
    scalings: Tensor,
    offsets: Tensor,
    decoders: ColorDecoders,
    eye: Vector,
    *,
    opacity: float = 1.0,
    backend: str | None = None,
) -> ViewGaussians:
    """The Gaussians of N anchors as one camera sees them; see :func:`.econgs.anchors.decode.decode`.

    Means, culling, scales and quaternions equal those of ECoNGS; the color is the sigmoid of the color
    network. No gradient reaches the anchors' positions.

    Args:
        anchors: (N, 3) positions.
        features: (N, F).
        scalings: (N, 6) activated, >= 0.
        offsets: (N, K, 3).
        decoders: the three networks.
        eye: camera centre.
        opacity: factor on optical depths, as in :class:`.econgs.anchors.shading.Factors`.
        backend: "native" or "torch", as in :func:`.econgs.splat.rasterise`.

    Raises:
        ValueError: a wrong shape, or NaN or infinity among the inputs.
    """
    count = len(anchors)
    expected = {
        "anchors": (anchors, (count, 3)),
        "features": (features, (count, decoders.features)),
        "scalings": (scalings, (count, SCALINGS)),
        "offsets": (offsets, (count, decoders.offsets, 3)),
    }
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, not {shape}, for {count} anchors")
    anchors = anchors.detach()
    view = torch.as_tensor(eye, dtype=anchors.dtype, device=anchors.device).detach()
    if decoders.distance:
        away = torch.linalg.vector_norm(anchors - view, dim=1, keepdim=True)
        features = torch.cat([features, away], 1)
    inputs = (anchors, features, scalings, offsets)
    if choose_backend(anchors, backend) == "native":
        from econgs_bench.econgs.anchors import native

        weights = [one for name in NETWORKS for one in decoders.network(name).tensors()]
        decoded = native.decode_plain(inputs, weights, view, opacity > 0.0)
    else:
        names = ("anchors", "features", "scalings", "offsets")
        refuse_non_finite(dict(zip(names, inputs, strict=True)), decoders)
        decoded = _torch_decode(*inputs, decoders, view, opacity > 0.0)
    return replace(decoded, opacities=scale_depth(decoded.opacities, opacity))


def _torch_decode(
    anchors: Tensor,
    features: Tensor,
    scalings: Tensor,
    offsets: Tensor,
    decoders: ColorDecoders,
    eye: Tensor,
    visible: bool,
) -> ViewGaussians:
    count, many = offsets.shape[:2]
    inputs = torch.cat([features, unit(anchors - eye)], dim=1)

    def outputs(name: str) -> Tensor:
        first, first_bias, second, second_bias = decoders.network(name).tensors()
        return torch.addmm(second_bias, torch.relu(torch.addmm(first_bias, inputs, first.T)), second.T)

    raw = torch.tanh(outputs("opacity"))
    mask = raw.detach() > 0.0 if visible else torch.zeros_like(raw, dtype=torch.bool)
    slots = mask.reshape(-1).nonzero()[:, 0]
    anchor = slots // many

    def of_slots(name: str) -> Tensor:
        by_slot = outputs(name).view(count, NETWORKS[name], many).transpose(1, 2)
        return by_slot.reshape(count * many, NETWORKS[name]).index_select(0, slots)

    covariance = of_slots("covariance")
    scale = scalings.index_select(0, anchor)
    displacements = offsets.reshape(-1, 3).index_select(0, slots) * scale[:, :3]
    return ViewGaussians(
        anchors.index_select(0, anchor) + displacements,
        rotation(covariance[:, 3:]),
        scale[:, 3:] * torch.sigmoid(covariance[:, :3]),
        raw.reshape(-1).index_select(0, slots),
        torch.sigmoid(of_slots("color")),
        slots,
        raw.detach(),
    )
