"""From anchors to the Gaussians of one view: decoders, activations, shading and culling as one function."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.anchors.decoders import NETWORKS, OFFSET_COLORS, Decoders
from econgs_bench.econgs.anchors.gaussians import UnshadedGaussians, ViewGaussians
from econgs_bench.econgs.anchors.shading import MAX_SHININESS, MAX_SPECULAR, Factors, unit
from econgs_bench.econgs.codec.symbols import SCALINGS
from econgs_bench.econgs.splat.composite import scale_depth
from econgs_bench.econgs.splat.rasterise import choose_backend, values_trusted

MIN_QUATERNION = 1e-12  # a shorter quaternion becomes the identity
Vector = Sequence[float] | NDArray[np.float64] | Tensor


def decode(
    anchors: Tensor,
    features: Tensor,
    scalings: Tensor,
    offsets: Tensor,
    decoders: Decoders,
    embedding: Tensor,
    palette: Tensor,
    eye: Vector,
    *,
    light: Vector | None = None,
    factors: Factors | None = None,
    backend: str | None = None,
) -> ViewGaussians:
    """The neural editable Gaussians of N anchors as one camera sees them (ECoNGS, after Scaffold-GS).

    * Mean: x_a + Δx · s, s the first three scalings of the anchor.
    * Opacity: tanh of F_o; Gaussians of opacity <= 0 are culled here, before the rasteriser.
    * Scale: the last three scalings · sigmoid of F_cov's first three outputs; the other four, normalised, are
      the quaternion.
    * Shading: offset color by ``decoders.offset_color``, k_a and k_d linear, k_s = 5 sigmoid, β = 50 sigmoid.
    * Color: :func:`.econgs.anchors.shading.shade` of palette + offset color.

    Gradients reach anchors, features, scalings, offsets, embedding, palette and every weight; not eye and
    light. All tensors share one floating dtype and device.

    Args:
        anchors: (N, 3) positions.
        features: (N, ``decoders.width``).
        scalings: (N, 6) activated, > 0.
        offsets: (N, K, 3); unused if ``decoders`` decode them.
        decoders: the four networks.
        embedding: (E,) TF embedding of the scene.
        palette: (3,) its palette color.
        eye: camera centre.
        light: unit vector to a directional light; None: a headlight.
        factors: edits.
        backend: "native" or "torch", as in :func:`.econgs.splat.rasterise` ("gsplat" means "torch" here).

    Raises:
        ValueError: a wrong shape, dtype or device, or NaN or infinity; the message names the tensor.
        econgs_bench.datasets.errors.UnknownName: no backend of that name.
    """
    inputs = {"anchors": anchors, "features": features, "scalings": scalings, "offsets": offsets}
    inputs |= {"embedding": embedding, "palette": palette}
    _check_shapes(inputs, decoders)
    view = _vector(eye, anchors, "eye")
    toward = None if light is None else _vector(light, anchors, "light")
    if light is not None and abs(math.hypot(*map(float, light)) - 1.0) > 1e-3:
        raise ValueError(f"light is {[float(x) for x in light]}, not a unit vector")
    factors = factors or Factors()
    if decoders.storage == "implicit":
        refuse_non_finite(inputs, decoders)
        inputs["offsets"] = decoders.implicit_offsets(features, embedding)
    elif decoders.storage != "hybrid":
        backend = "torch"
    if choose_backend(anchors, backend) == "native":
        from econgs_bench.econgs.anchors import native

        try:
            decoded = native.decode(
                *inputs.values(), decoders=decoders, eye=view, light=toward, factors=factors
            )
        except ValueError:
            refuse_non_finite(inputs, decoders)
            raise
    else:
        refuse_non_finite(inputs, decoders)
        decoded = _torch_decode(*inputs.values(), decoders=decoders, eye=view, light=toward, factors=factors)
    return replace(decoded, opacities=scale_depth(decoded.opacities, factors.opacity))


def _torch_decode(
    anchors: Tensor,
    features: Tensor,
    scalings: Tensor,
    offsets: Tensor,
    embedding: Tensor,
    palette: Tensor,
    *,
    decoders: Decoders,
    eye: Tensor,
    light: Tensor | None,
    factors: Factors,
) -> ViewGaussians:
    ready, raw = _unshaded(anchors, features, scalings, offsets, embedding, decoders, eye)
    if factors.opacity <= 0.0:
        ready = ready.of(ready.slots[:0])
    colors = ready.colors(palette, eye, light, factors, backend="torch")
    return ViewGaussians(
        ready.means, ready.quats, ready.scales, ready.opacities, colors, ready.slots, raw.detach()
    )


@torch.no_grad()
def decode_unshaded(
    anchors: Tensor,
    features: Tensor,
    scalings: Tensor,
    offsets: Tensor,
    decoders: Decoders,
    embedding: Tensor,
) -> UnshadedGaussians:
    """What decoders that do not see the direction give for all views; arguments as for :func:`decode`.

    Raises:
        ValueError: the decoders see the direction, or NaN or infinity; the message names the tensor.
    """
    if decoders.view_direction:
        raise ValueError("these decoders see the viewing direction: Gaussians differ from view to view")
    inputs = {"anchors": anchors, "features": features, "scalings": scalings, "offsets": offsets}
    refuse_non_finite(inputs, decoders)
    if decoders.storage == "implicit":
        offsets = decoders.implicit_offsets(features, embedding)
    ready, _ = _unshaded(anchors, features, scalings, offsets, embedding, decoders, anchors.new_zeros(3))
    return ready


def _unshaded(
    anchors: Tensor,
    features: Tensor,
    scalings: Tensor,
    offsets: Tensor,
    embedding: Tensor,
    decoders: Decoders,
    eye: Tensor,
) -> tuple[UnshadedGaussians, Tensor]:
    """The Gaussians with opacity > 0, and (N, K) opacities of all."""
    count, many = offsets.shape[:2]
    explicit = features[:, decoders.features :]
    inputs = features[:, : decoders.features]
    if decoders.view_direction:
        inputs = torch.cat([inputs, unit(anchors - eye)], dim=1)
    width = inputs.shape[1]
    names = [name for name in NETWORKS if name in decoders.names]
    networks = [decoders.network(name) for name in names]
    # One product for the first layers of all four; the embedding adds the same to every anchor.
    first = torch.cat([network.first_weight for network in networks])
    bias = torch.cat([network.first_bias for network in networks]) + first[:, width:] @ embedding
    first_layers = torch.relu(torch.addmm(bias, inputs, first[:, :width].T)).split(decoders.hidden, dim=1)
    hidden = dict(zip(names, first_layers, strict=True))

    def outputs(name: str) -> Tensor:
        network = decoders.network(name)
        return torch.addmm(network.second_bias, hidden[name], network.second_weight.T)

    raw = torch.tanh(outputs("opacity"))
    slots = (raw.detach() > 0.0).reshape(-1).nonzero()[:, 0]
    anchor = slots // many

    def by_slot_of(name: str) -> Tensor:
        attributes = NETWORKS[name]
        if name not in hidden:  # stored: normals first
            begin = 0 if name == "normal" else 3 * many
            by_slot = explicit[:, begin : begin + attributes * many].reshape(count * many, attributes)
        else:
            by_slot = outputs(name).view(count, attributes, many).transpose(1, 2)
            by_slot = by_slot.reshape(count * many, attributes)
        return by_slot.index_select(0, slots)

    scale = scalings.index_select(0, anchor)
    offset = offsets.reshape(-1, 3).index_select(0, slots)
    covariance, shading, normals = by_slot_of("covariance"), by_slot_of("shading"), by_slot_of("normal")
    ranges = shading.new_tensor([MAX_SPECULAR, MAX_SHININESS])
    ready = UnshadedGaussians(
        means=anchors.index_select(0, anchor) + offset * scale[:, :3],
        quats=rotation(covariance[:, 3:]),
        scales=scale[:, 3:] * torch.sigmoid(covariance[:, :3]),
        opacities=raw.reshape(-1).index_select(0, slots),
        normals=normals,
        offset_colors=OFFSET_COLORS[decoders.offset_color](shading[:, :3]),
        coefficients=torch.cat([shading[:, 3:5], torch.sigmoid(shading[:, 5:7]) * ranges], dim=1),
        slots=slots,
    )
    return ready, raw


def rotation(quats: Tensor) -> Tensor:
    """(M, 4) unit quaternions; a zero quaternion becomes the identity."""
    length = torch.linalg.vector_norm(quats, dim=-1, keepdim=True)
    sound = length > MIN_QUATERNION
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    return torch.where(sound, quats / torch.where(sound, length, 1.0), identity)


@torch.no_grad()
def visible_anchors(camera: Camera, anchors: Tensor, scalings: Tensor) -> Tensor:
    """(N,) mask of the anchors that may be visible in a view (filter of Scaffold-GS, without its rotation).

    An anchor passes if it lies deeper than the camera's near plane and the circle round its projected
    centre, three times its largest offset scaling, meets the image.

    Args:
        camera: the view.
        anchors: (N, 3).
        scalings: (N, 6) activated; the first three count.
    """
    pose = torch.as_tensor(camera.world_to_camera[:3], dtype=anchors.dtype, device=anchors.device)
    shifts = (camera.cx - 0.5 * camera.width) / camera.fx, (camera.cy - 0.5 * camera.height) / camera.fy
    edges = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    if choose_backend(anchors) == "native":
        from econgs_bench.econgs.anchors import native

        return native.visible_anchors(pose, camera.near, (*shifts, *edges), anchors, scalings)
    local = torch.addmm(pose[:, 3:], pose[:, :3], anchors.T)
    depth = local[2]
    reach = 3.0 * scalings[:, :3].amax(1)
    # At the anchor's depth: its distance from the image's middle, and the largest distance that passes.
    inside = depth > camera.near
    for place, shift, edge in zip(local, shifts, edges, strict=False):
        apart = torch.add(place, depth, alpha=shift).abs()
        inside &= apart <= torch.add(reach, depth, alpha=edge)
    return inside


def _vector(value: Vector, like: Tensor, name: str) -> Tensor:
    vector = torch.as_tensor(value, dtype=like.dtype).detach()
    numbers = vector.tolist()  # where the caller has it: a look at a GPU would wait for it
    if vector.shape != (3,) or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} must be three finite numbers, not {numbers}")
    return vector.to(like.device)


def _check_shapes(inputs: dict[str, Tensor], decoders: Decoders) -> None:
    anchors = inputs["anchors"]
    count = anchors.shape[0] if anchors.ndim else 0
    shapes = {
        "anchors": (count, 3),
        "features": (count, decoders.width),
        "scalings": (count, SCALINGS),
        "offsets": (count, decoders.offsets, 3),
        "embedding": (decoders.embedding,),
        "palette": (3,),
    }
    weight = {"decoders": decoders.network("opacity").first_weight}
    for name, tensor in (inputs | weight).items():
        if name in shapes and tuple(tensor.shape) != shapes[name]:
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}, not {shapes[name]}, for {count} anchors"
            )
        if not tensor.dtype.is_floating_point or tensor.dtype != anchors.dtype:
            raise ValueError(
                f"{name} is {tensor.dtype}; all tensors must share one floating dtype ({anchors.dtype})"
            )
        if tensor.device != anchors.device:
            raise ValueError(f"{name} is on {tensor.device} but anchors is on {anchors.device}")


@torch.no_grad()
def refuse_non_finite(inputs: dict[str, Tensor], decoders: nn.Module) -> None:
    """Raises for the first tensor that holds NaN or infinity, unless values are trusted.

    Raises:
        ValueError: the message names the tensor and the index.
    """
    if values_trusted():
        return
    weights = {f"decoders.{name}": tensor for name, tensor in decoders.named_parameters()}
    tensors = {**inputs, **weights}
    # A sum is finite only if every term is: one synchronisation for all.
    if math.isfinite(float(torch.stack([tensor.sum() for tensor in tensors.values()]).sum())):
        return
    for name, tensor in tensors.items():
        bad = (~torch.isfinite(tensor)).nonzero()
        if len(bad):
            index = bad[0].tolist()
            raise ValueError(f"{name}{index} is {tensor[tuple(index)].item()}: every value must be finite")
