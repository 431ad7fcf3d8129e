"""Decoders without shading: against formulas written out in float64, and the kernel against PyTorch."""

import numpy as np
import pytest
import torch

from econgs_bench.econgs.anchors.direct import ColorDecoders, decode_colors
from econgs_bench.econgs.anchors.gaussians import apply_masks

EYE = [0.3, -2.0, 1.1]


def setting(distance=False, count=70, features=6, offsets=3, dtype=torch.float32):
    generator = torch.Generator().manual_seed(3)
    decoders = ColorDecoders(features, offsets, distance=distance, generator=generator).to(dtype)
    anchors = torch.rand((count, 3), generator=generator, dtype=dtype) - 0.5
    values = (
        torch.randn((count, features), generator=generator, dtype=dtype),
        0.02 + 0.1 * torch.rand((count, 6), generator=generator, dtype=dtype),
        torch.randn((count, offsets, 3), generator=generator, dtype=dtype),
    )
    return decoders, anchors, values


def by_hand(decoders, anchors, values):
    """slot → mean, quaternion, scale, opacity, color; one Gaussian at a time."""
    weights = {name: one.detach().numpy() for name, one in decoders.named_parameters()}
    features, scalings, offsets = (one.numpy() for one in values)
    gaussians = {}
    for n, anchor in enumerate(anchors.numpy()):
        away = anchor - np.array(EYE)
        length = np.sqrt((away**2).sum())
        parts = [features[n], *([[length]] if decoders.distance else []), away / length]
        inputs = np.concatenate(parts)

        def network(name, inputs=inputs):
            first, first_bias, second, second_bias = (
                weights[f"{name}.{part}"]
                for part in ("first_weight", "first_bias", "second_weight", "second_bias")
            )
            return second @ np.maximum(first @ inputs + first_bias, 0.0) + second_bias

        opacity, covariance, color = (network(name) for name in ("opacity", "covariance", "color"))
        many = decoders.offsets
        for k in range(many):
            opaque = np.tanh(opacity[k])
            if opaque <= 0.0:
                continue
            quat = covariance[3 * many + k :: many]
            gaussians[n * many + k] = (
                anchor + offsets[n, k] * scalings[n, :3],
                quat / np.linalg.norm(quat),
                scalings[n, 3:] / (1.0 + np.exp(-covariance[k : 3 * many : many])),
                opaque,
                1.0 / (1.0 + np.exp(-color[k::many])),
            )
    return gaussians


@pytest.mark.parametrize("distance", [False, True])
def test_every_gaussian_is_that_of_the_formulas(distance):
    decoders, anchors, values = setting(distance, dtype=torch.float64)
    decoded = decode_colors(anchors, *values, decoders, EYE, backend="torch")
    expected = by_hand(decoders, anchors, values)
    assert decoded.slots.tolist() == sorted(expected)
    columns = (decoded.means, decoded.quats, decoded.scales, decoded.opacities, decoded.colors)
    for place, column in enumerate(columns):
        column_expected = np.array([expected[slot][place] for slot in sorted(expected)])
        np.testing.assert_allclose(column.detach().numpy(), column_expected, rtol=1e-10, atol=1e-12)


def gradients(backend, distance, opacity):
    decoders, anchors, values = setting(distance, count=130)
    leaves = [one.requires_grad_(True) for one in values]
    decoded = decode_colors(anchors, *leaves, decoders, EYE, opacity=opacity, backend=backend)
    columns = (decoded.means, decoded.quats, decoded.scales, decoded.opacities, decoded.colors)
    generator = torch.Generator().manual_seed(4)
    loss = sum((one * torch.randn(one.shape, generator=generator)).sum() for one in columns)
    loss.backward()
    gradients = [one.grad for one in (*leaves, *decoders.parameters())]
    return [*(one.detach() for one in columns), decoded.slots, decoded.raw_opacities, *gradients]


@pytest.mark.parametrize("distance", [False, True])
@pytest.mark.parametrize("opacity", [1.0, 0.4, 3.0])
def test_the_kernel_agrees_with_pytorch(distance, opacity):
    for ours, theirs in zip(
        gradients("native", distance, opacity), gradients("torch", distance, opacity), strict=True
    ):
        assert ours.shape == theirs.shape
        torch.testing.assert_close(ours, theirs, rtol=2e-4, atol=2e-5 * max(1.0, float(theirs.abs().max())))


def test_an_edit_multiplies_optical_depth():
    decoders, anchors, values = setting()
    plain = decode_colors(anchors, *values, decoders, EYE)
    edited = decode_colors(anchors, *values, decoders, EYE, opacity=0.25)
    torch.testing.assert_close((1.0 - edited.opacities) ** 4, 1.0 - plain.opacities)
    assert torch.equal(edited.means, plain.means)


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_no_anchors_no_opacity_and_what_is_not_finite(backend):
    decoders, anchors, values = setting()
    none = decode_colors(anchors[:0], *(one[:0] for one in values), decoders, EYE, backend=backend)
    assert len(none.slots) == 0
    assert len(decode_colors(anchors, *values, decoders, EYE, opacity=0.0, backend=backend).slots) == 0
    values[2][5, 1, 2] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        decode_colors(anchors, *values, decoders, EYE, backend=backend)
    with pytest.raises(ValueError, match="offsets has shape"):
        decode_colors(anchors, values[0], values[1], values[2][:3], decoders, EYE, backend=backend)
    with pytest.raises(ValueError, match="not possible"):
        ColorDecoders(0, 3, distance=False)


def test_masked_gaussians_are_gone_and_masks_learn_from_the_others():
    decoders, anchors, values = setting()
    whole = decode_colors(anchors, *values, decoders, EYE)
    soft = torch.full((70, 3), 0.7, requires_grad=True)
    hard = torch.ones(70, 3)
    hard[::2, 1] = 0.0
    some = apply_masks(whole, hard + (soft - soft.detach()))
    stay = hard.reshape(-1)[whole.slots] > 0
    assert 0 < int(stay.sum()) < len(stay)
    assert torch.equal(some.slots, whole.slots[stay])
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(some, name), getattr(whole, name)[stay]), name
    assert torch.equal(some.raw_opacities, whole.raw_opacities * hard)
    drawn = apply_masks(whole, hard > 0)
    for name in ("means", "quats", "scales", "opacities", "colors", "slots", "raw_opacities"):
        assert torch.equal(getattr(drawn, name), getattr(some, name)), name
    (some.opacities.sum() + some.scales.sum()).backward()
    expected = torch.zeros(210)
    expected[some.slots] = (some.opacities + some.scales.sum(1)).detach()
    torch.testing.assert_close(soft.grad.reshape(-1), expected)
