"""Decoding anchors: the torch twin against the paper's formulas written out, the kernels against the twin."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import UnknownName
from econgs_bench.econgs.anchors.decode import decode, decode_unshaded, visible_anchors
from econgs_bench.econgs.anchors.decoders import NETWORKS, Decoders
from econgs_bench.econgs.anchors.gaussians import ViewGaussians
from econgs_bench.econgs.anchors.shading import Factors, shade
from econgs_bench.econgs.splat import SplatImages, rasterise

from .conftest import ISAS, native_module, relative

native = native_module()
needs_native = pytest.mark.skipif(not ISAS, reason="econgs_bench.econgs._native is not compiled here")
EYE = (0.5, 0.25, -3.0)
SIDE = (0.6, 0.0, -0.8)
NAMES = ("means", "quats", "scales", "opacities", "colors")


@pytest.fixture(params=["torch", *(f"native-{isa}" for isa in ISAS)])
def backend(request: pytest.FixtureRequest, restored: None) -> str:
    name, _, isa = request.param.partition("-")
    if isa:
        native.set_isa(isa)
    return str(name)


@dataclass
class Case:
    """Anchors with their decoders; sizes, options, light and edits differ from case to case."""

    count: int = 200
    features: int = 50
    offsets: int = 10
    embedding: int = 50
    hidden: int = 50
    view_direction: bool = True
    offset_color: str = "tanh"
    light: tuple[float, float, float] | None = None
    factors: Factors | None = None
    seed: int = 0

    def make(self) -> tuple[Decoders, dict[str, Tensor]]:
        random = torch.Generator().manual_seed(self.seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(shape, generator=random)

        decoders = Decoders(
            self.features,
            self.offsets,
            self.embedding,
            hidden=self.hidden,
            view_direction=self.view_direction,
            offset_color=self.offset_color,  # type: ignore[arg-type]
            generator=random,
        )
        for name in NETWORKS:  # livelier than at the start of a training
            decoders.network(name).second_weight.data *= 2.0
        inputs = {
            "anchors": 0.3 * normal(self.count, 3),
            "features": 0.5 * normal(self.count, self.features),
            "scalings": torch.exp(0.3 * normal(self.count, 6) - 3.0),
            "offsets": 0.5 * normal(self.count, self.offsets, 3),
            "embedding": 0.3 * normal(self.embedding),
            "palette": torch.rand(3, generator=random),
        }
        return decoders, inputs


# Seeds without a normal of next to no length: its direction is rounding, which no float32 code can agree on.
CASES = {
    "paper": Case(),
    "edited": Case(offset_color="sigmoid", light=SIDE, factors=Factors(1.5, 0.5, 1.2, 0.8, 1.3), seed=1),
    "small": Case(features=32, offsets=5, embedding=16, hidden=32, view_direction=False, light=SIDE, seed=3),
    "large": Case(count=90, features=100, offsets=20, embedding=0, hidden=47, seed=4),
    "odd": Case(count=65, features=3, offsets=1, embedding=1, hidden=1, offset_color="sigmoid", seed=13),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


@dataclass
class Run:
    decoded: ViewGaussians
    outputs: dict[str, Tensor]
    gradients: dict[str, Tensor]


def run(case: Case, dtype: torch.dtype, backend: str, only: tuple[str, ...] = NAMES) -> Run:
    """One case decoded, with the gradients of a random linear function of its outputs."""
    decoders, inputs = case.make()
    decoders = decoders.to(dtype)
    leaves = {name: one.to(dtype).requires_grad_(True) for name, one in inputs.items()}
    decoded = decode(
        **leaves, decoders=decoders, eye=EYE, light=case.light, factors=case.factors, backend=backend
    )
    random = torch.Generator().manual_seed(77)
    outputs = {name: getattr(decoded, name) for name in NAMES}
    weights = {name: torch.randn(one.shape, generator=random).to(dtype) for name, one in outputs.items()}
    leaves |= dict(decoders.named_parameters())
    grads = torch.autograd.grad(
        [outputs[name] for name in only],
        list(leaves.values()),
        [weights[name] for name in only],
        allow_unused=True,
        materialize_grads=True,
    )
    return Run(decoded, outputs, dict(zip(leaves, grads, strict=True)))


def by_hand(case: Case) -> dict[str, Any]:
    """The paper's formulas, Gaussian by Gaussian, in float64 NumPy."""
    decoders, inputs = case.make()
    x = {name: one.double().numpy() for name, one in inputs.items()}
    factors = case.factors or Factors()
    eye = np.array(EYE)

    def network(name: str, anchor: int) -> Any:
        w1, b1, w2, b2 = (t.detach().double().numpy() for t in decoders.network(name).tensors())
        parts = [x["features"][anchor]]
        if case.view_direction:
            direction = x["anchors"][anchor] - eye
            parts.append(direction / np.sqrt((direction**2).sum()))
        hidden = w1 @ np.concatenate([*parts, x["embedding"]]) + b1
        return (w2 @ np.where(hidden > 0, hidden, 0) + b2).reshape(-1, case.offsets).T  # per Gaussian

    def sigmoid(value: Any) -> Any:
        return 1.0 / (1.0 + np.exp(-value))

    expected_values: dict[str, list[Any]] = {name: [] for name in (*NAMES, "slots", "raw")}
    for anchor in range(case.count):
        outputs = {name: network(name, anchor) for name in NETWORKS}
        scaling = x["scalings"][anchor]
        expected_values["raw"].append(np.tanh(outputs["opacity"][:, 0]))
        for k in range(case.offsets):
            opacity = math.tanh(outputs["opacity"][k, 0])
            if opacity <= 0:
                continue
            expected_values["slots"].append(anchor * case.offsets + k)
            expected_values["opacities"].append(1.0 - (1.0 - opacity) ** factors.opacity)
            mean = x["anchors"][anchor] + x["offsets"][anchor, k] * scaling[:3]
            expected_values["means"].append(mean)
            covariance = outputs["covariance"][k]
            expected_values["scales"].append(scaling[3:] * sigmoid(covariance[:3]))
            expected_values["quats"].append(covariance[3:] / np.linalg.norm(covariance[3:]))
            shading = outputs["shading"][k]
            activate = np.tanh if case.offset_color == "tanh" else sigmoid
            base = x["palette"] + activate(shading[:3])
            k_a, k_d = shading[3] * factors.ambient, shading[4] * factors.diffuse
            k_s, beta = (
                5 * sigmoid(shading[5]) * factors.specular,
                50 * sigmoid(shading[6]) * factors.shininess,
            )
            normal = outputs["normal"][k] / max(1e-3, np.linalg.norm(outputs["normal"][k]))
            view = (eye - mean) / np.linalg.norm(eye - mean)
            light = view if case.light is None else np.array(case.light)
            half = (view + light) / np.linalg.norm(view + light)
            color = base * k_a + base * k_d * abs(normal @ light) + k_s * abs(normal @ half) ** beta
            expected_values["colors"].append(np.clip(color, 0, 1))
    return {name: np.array(values) for name, values in expected_values.items()}


def test_formulas_of_the_paper(case: Case) -> None:
    truth = by_hand(case)
    assert 0 < len(truth["slots"]) < case.count * case.offsets
    assert ((truth["colors"] > 0) & (truth["colors"] < 1)).mean() > 0.02
    decoded = run(case, torch.float64, "torch").decoded
    assert decoded.slots.tolist() == truth["slots"].tolist()
    for name in NAMES:
        assert relative(getattr(decoded, name), torch.from_numpy(truth[name])) < 1e-12, name
    assert relative(decoded.raw_opacities, torch.from_numpy(truth["raw"])) < 1e-12


@pytest.mark.parametrize("light", [None, SIDE])
def test_gradients_of_the_twin_by_finite_differences(light: Any) -> None:
    case = Case(count=3, features=5, offsets=3, embedding=2, hidden=4, light=light, seed=5)
    decoders, inputs = case.make()
    decoders = decoders.double()
    leaves = [one.double().requires_grad_(True) for one in inputs.values()]
    weights = [one.detach().clone().requires_grad_(True) for one in decoders.parameters()]

    def outputs(*tensors: Tensor) -> tuple[Tensor, ...]:
        moved = copy.deepcopy(decoders)
        for name, module in moved.named_modules():
            if name:
                for key in list(module._parameters):
                    place = [n for n, _ in decoders.named_parameters()].index(f"{name}.{key}")
                    del module._parameters[key]
                    setattr(module, key, tensors[len(leaves) + place])
        decoded = decode(*tensors[:4], moved, *tensors[4:6], EYE, light=light, backend="torch")
        return tuple(getattr(decoded, name) for name in NAMES)

    assert len(outputs(*leaves, *weights)[0]) > 3
    assert torch.autograd.gradcheck(outputs, (*leaves, *weights), eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", [*CASES, "many blocks"])
def test_native_results_and_gradients_are_those_of_float64(name: str, isa: str) -> None:
    case = CASES.get(name, Case(count=1500, seed=11))
    mine, truth = run(case, torch.float32, "native"), run(case, torch.float64, "torch")
    assert torch.equal(mine.decoded.slots, truth.decoded.slots)
    for output in NAMES:
        assert relative(mine.outputs[output], truth.outputs[output]) < 2e-6, output
    assert relative(mine.decoded.raw_opacities, truth.decoded.raw_opacities) < 2e-6
    for leaf, gradient in truth.gradients.items():
        if gradient.numel():
            assert gradient.norm() > 0, leaf
        assert relative(mine.gradients[leaf], gradient) <= 1e-5, leaf


@needs_native
@pytest.mark.parametrize("only", NAMES)
def test_gradient_of_one_output_alone(only: str) -> None:
    """The others' gradients are None then, not zeros."""
    mine = run(CASES["paper"], torch.float32, "native", (only,))
    truth = run(CASES["paper"], torch.float64, "torch", (only,))
    for name, gradient in truth.gradients.items():
        assert relative(mine.gradients[name], gradient) <= 1e-5 or gradient.norm() == 0, name
        assert gradient.norm() > 0 or mine.gradients[name].norm() == 0, name


@pytest.mark.parametrize("count", [1, 63, 64, 65, 1300])
def test_bit_identical_for_any_number_of_threads(isa: str, count: int) -> None:
    results = []
    for threads in (1, 2, 3, 7):
        native.set_threads(threads)
        one = run(Case(count=count, light=SIDE), torch.float32, "native")
        results.append([*one.outputs.values(), one.decoded.slots, *one.gradients.values()])
    for other in results[1:]:
        for mine, theirs in zip(results[0], other, strict=True):
            assert torch.equal(mine, theirs)


@needs_native
def test_repeated_backward_and_no_grad_agree() -> None:
    decoders, inputs = CASES["paper"].make()
    features = inputs.pop("features").requires_grad_(True)
    decoded = decode(**inputs, features=features, decoders=decoders, eye=EYE, backend="native")
    total = decoded.colors.sum()
    (first,) = torch.autograd.grad(total, features, retain_graph=True)
    (second,) = torch.autograd.grad(total, features)
    assert torch.equal(first, second)
    with torch.no_grad():
        again = decode(**inputs, features=features, decoders=decoders, eye=EYE, backend="native")
    assert not again.colors.requires_grad
    assert not decoded.raw_opacities.requires_grad
    assert torch.equal(decoded.colors, again.colors)


def test_no_anchors(backend: str) -> None:
    one = run(Case(count=0), torch.float32, backend)
    assert one.decoded.slots.shape == (0,)
    assert one.decoded.raw_opacities.shape == (0, 10)
    assert [tuple(out.shape) for out in one.outputs.values()] == [(0, 3), (0, 4), (0, 3), (0,), (0, 3)]
    assert all((gradient == 0).all() for gradient in one.gradients.values())


@pytest.mark.parametrize("by", ["decoder", "edit"])
def test_no_gaussian_survives(backend: str, by: str) -> None:
    decoders, inputs = CASES["paper"].make()
    if by == "decoder":
        decoders.network("opacity").second_bias.data -= 100.0
    leaves = {name: one.requires_grad_(True) for name, one in inputs.items()}
    factors = Factors(opacity=0.0) if by == "edit" else None
    decoded = decode(**leaves, decoders=decoders, eye=EYE, factors=factors, backend=backend)
    assert len(decoded.means) == len(decoded.slots) == 0
    grads = torch.autograd.grad(
        sum(getattr(decoded, name).sum() for name in NAMES),
        [*leaves.values(), *decoders.parameters()],
        materialize_grads=True,
        allow_unused=True,
    )
    assert all((one == 0).all() for one in grads)


def test_degenerate_geometry_is_finite(backend: str) -> None:
    """The eye in an anchor and in its Gaussians, normals of no length, a light from behind, no rotation."""
    decoders, inputs = CASES["paper"].make()
    for name in ("normal", "covariance"):
        network = decoders.network(name)
        network.second_weight.data[:] = 0.0
        network.second_bias.data[:] = 0.0
    inputs["offsets"][:20] = 0.0
    inputs["anchors"][:20] = torch.tensor(EYE)
    inputs["anchors"][20:] = torch.tensor(EYE) + torch.tensor([0.0, 0.0, 2.0])
    inputs["offsets"][20:] = 0.0
    for light in (None, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)):
        leaves = {name: one.clone().requires_grad_(True) for name, one in inputs.items()}
        decoded = decode(**leaves, decoders=decoders, eye=EYE, light=light, backend=backend)
        assert len(decoded.slots) > 20
        assert (decoded.quats == torch.tensor([1.0, 0.0, 0.0, 0.0])).all()
        values = [getattr(decoded, name) for name in NAMES]
        assert all(torch.isfinite(one).all() for one in values)
        targets = [*leaves.values(), *decoders.parameters()]
        grads = torch.autograd.grad(sum(one.sum() for one in values), targets)
        assert all(torch.isfinite(one).all() for one in grads)


def test_normals_too_short_are_only_partly_normalised(backend: str) -> None:
    """A normal of length 5e-4 counts half: |n.l| = 0.5 where it points at the light."""
    decoders, inputs = Case(count=1, offsets=1).make()
    for name in ("normal", "shading", "opacity"):
        decoders.network(name).second_weight.data[:] = 0.0
    inputs["offsets"][:] = 0.0
    inputs["anchors"][:] = 0.0
    inputs["palette"] = torch.tensor([0.8, 0.4, 0.2])
    decoders.network("opacity").second_bias.data[:] = 1.0
    decoders.network("normal").second_bias.data[:] = torch.tensor([0.0, 0.0, 5e-4])
    decoders.network("shading").second_bias.data[:] = torch.tensor([0.0, 0.0, 0.0, 0.25, 0.5, -80.0, 0.0])
    decoded = decode(**inputs, decoders=decoders, eye=EYE, light=(0.0, 0.0, -1.0), backend=backend)
    torch.testing.assert_close(decoded.colors[0], 0.5 * inputs["palette"], rtol=1e-5, atol=1e-6)


def test_edits_do_what_they_say(backend: str) -> None:
    decoders, inputs = CASES["paper"].make()
    plain = decode(**inputs, decoders=decoders, eye=EYE, backend=backend)
    thin = decode(**inputs, decoders=decoders, eye=EYE, factors=Factors(opacity=0.25), backend=backend)
    torch.testing.assert_close(thin.opacities, 1.0 - (1.0 - plain.opacities) ** 0.25)
    thick = decode(**inputs, decoders=decoders, eye=EYE, factors=Factors(opacity=3.0), backend=backend)
    torch.testing.assert_close(1.0 - thick.opacities, (1.0 - plain.opacities) ** 3)
    dark = Factors(ambient=0.0, diffuse=0.0, specular=0.0)
    black = decode(**inputs, decoders=decoders, eye=EYE, factors=dark, backend=backend)
    assert (black.colors == 0).all()
    matte = Factors(specular=0.0)
    red = inputs | {"palette": torch.tensor([1.0, -2.0, -2.0])}
    colored = decode(**red, decoders=decoders, eye=EYE, factors=matte, backend=backend)
    assert colored.colors[:, 0].max() > 0.1
    for name in ("means", "quats", "scales", "opacities", "slots"):
        assert torch.equal(getattr(colored, name), getattr(plain, name))


def test_what_is_decoded_once_looks_the_same_from_everywhere(case: Case, backend: str) -> None:
    case = replace(case, view_direction=False)
    decoders, inputs = case.make()
    palette, factors = inputs.pop("palette"), case.factors or Factors()
    ready = decode_unshaded(**inputs, decoders=decoders)
    light = None if case.light is None else torch.tensor(case.light)
    for eye in (EYE, (2.0, -1.0, 0.5)):
        want = decode(
            **inputs, decoders=decoders, palette=palette, eye=eye, light=case.light, factors=case.factors
        )
        torch.testing.assert_close(ready.means, want.means, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(ready.quats, want.quats, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(ready.scales, want.scales, rtol=1e-5, atol=1e-7)
        assert torch.equal(ready.slots, want.slots)
        colors = ready.colors(palette, torch.tensor(eye), light, factors, backend)
        torch.testing.assert_close(colors, want.colors, rtol=1e-4, atol=1e-5)


def test_what_sees_the_direction_is_not_decoded_once() -> None:
    decoders, inputs = CASES["paper"].make()
    del inputs["palette"]
    with pytest.raises(ValueError, match="viewing direction"):
        decode_unshaded(**inputs, decoders=decoders)


@needs_native
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 4097])
def test_shading_rows_end_anywhere(count: int) -> None:
    random = torch.Generator().manual_seed(count)
    means, normals, base = (torch.randn((count, 3), generator=random) for _ in range(3))
    coefficients = torch.rand((count, 4), generator=random) * torch.tensor([1.0, 1.0, 5.0, 50.0])
    rows, eye = (means, normals, base, coefficients), torch.tensor(EYE)
    want = shade(*(one.double() for one in rows), eye.double(), None)
    torch.testing.assert_close(shade(*rows, eye, None, "native").double(), want, rtol=1e-4, atol=1e-5)


def test_shading_with_gradients_is_that_of_torch() -> None:
    means, normals, base = (torch.randn((9, 3)).requires_grad_(True) for _ in range(3))
    colors = shade(means, normals, base, torch.rand((9, 4)), torch.tensor(EYE), None)
    (gradient,) = torch.autograd.grad(colors.sum(), [base])
    assert gradient.abs().sum() > 0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["anchors", "features", "scalings", "offsets", "embedding", "palette"])
def test_not_finite_is_refused_by_name(backend: str, name: str, value: float) -> None:
    decoders, inputs = CASES["paper"].make()
    inputs[name].view(-1)[-1] = value
    with pytest.raises(ValueError, match=rf"^{name}\[.*finite"):
        decode(**inputs, decoders=decoders, eye=EYE, backend=backend)


def test_weights_that_are_not_finite_are_refused_by_name(backend: str) -> None:
    decoders, inputs = CASES["paper"].make()
    decoders.network("shading").second_weight.data[3, 4] = float("nan")
    with pytest.raises(ValueError, match=r"decoders\.shading\.second_weight\[3, 4\]"):
        decode(**inputs, decoders=decoders, eye=EYE, backend=backend)


def test_wrong_arguments_are_refused() -> None:
    decoders, inputs = CASES["paper"].make()
    with pytest.raises(ValueError, match=r"features has shape \(200, 49\)"):
        decode(**inputs | {"features": inputs["features"][:, 1:]}, decoders=decoders, eye=EYE)
    with pytest.raises(ValueError, match="embedding"):
        decode(**inputs | {"embedding": torch.zeros(3)}, decoders=decoders, eye=EYE)
    with pytest.raises(ValueError, match="float64"):
        decode(**inputs | {"palette": inputs["palette"].double()}, decoders=decoders, eye=EYE)
    with pytest.raises(ValueError, match="unit vector"):
        decode(**inputs, decoders=decoders, eye=EYE, light=(1.0, 1.0, 0.0))
    with pytest.raises(ValueError, match="eye"):
        decode(**inputs, decoders=decoders, eye=(0.0, float("nan"), 0.0))
    with pytest.raises(UnknownName):
        decode(**inputs, decoders=decoders, eye=EYE, backend="cuda")
    with pytest.raises(UnknownName, match="tanh"):
        Decoders(offset_color="tan")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="hidden"):
        Decoders(hidden=0)


def test_decoders_of_the_paper_have_its_size() -> None:
    assert sum(one.numel() for one in Decoders().parameters()) == 29_980
    first, second = (Decoders(generator=torch.Generator().manual_seed(5)).state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_decoders_may_start_blind_to_the_view_direction() -> None:
    usual, blind = (
        Decoders(generator=torch.Generator().manual_seed(3), direction_start=factor) for factor in (1.0, 0.0)
    )
    _, inputs = CASES["paper"].make()
    eyes = [(0.0, 0.0, -2.0), (2.0, 0.0, 0.0)]
    seen, same = (
        [decode(**inputs, decoders=decoders, eye=eye).raw_opacities for eye in eyes]
        for decoders in (usual, blind)
    )
    assert torch.equal(same[0], same[1])
    assert not torch.allclose(seen[0], seen[1], atol=1e-3)
    for name in NETWORKS:  # the same numbers else
        first, same_first = usual.network(name).first_weight, blind.network(name).first_weight
        assert torch.equal(first[:, :50], same_first[:, :50])
        assert torch.equal(first[:, 53:], same_first[:, 53:])


@pytest.mark.parametrize("offsets", [1, 4, 5])
def test_decoders_that_start_blind_show_half_of_the_gaussians_of_untrained_anchors(offsets: int) -> None:
    shares = []
    for seed in range(40):
        _, inputs = Case(count=3, offsets=offsets).make()
        inputs |= {"features": torch.zeros(3, 50), "embedding": torch.zeros(50)}
        decoders = Decoders(50, offsets, generator=torch.Generator().manual_seed(seed), direction_start=0.0)
        decoded = decode(**inputs, decoders=decoders, eye=EYE)
        shares.append(len(decoded.means) / (3 * offsets))
    assert min(shares) >= 0.5
    assert offsets == 1 or min(shares) < 1.0  # no more than it takes


@pytest.mark.parametrize("direction_start", [0.0, 1.0])
def test_all_gaussians_of_untrained_anchors_have_the_first_opacity_asked_for(direction_start: float) -> None:
    for seed in range(5):
        _, inputs = Case(count=3, offsets=4).make()
        inputs |= {"features": torch.zeros(3, 50), "embedding": torch.zeros(50)}
        generator = torch.Generator().manual_seed(seed)
        decoders = Decoders(50, 4, generator=generator, direction_start=direction_start, start_opacity=0.05)
        opacities = decode(**inputs, decoders=decoders, eye=EYE).raw_opacities
        assert opacities.shape == (3, 4)
        tolerance = 1e-6 if direction_start == 0.0 else 0.2  # the direction adds its part
        assert torch.allclose(opacities, torch.full_like(opacities, 0.05), atol=tolerance)


def camera_of(width: int, height: int) -> Camera:
    """A camera at z = -2 that looks along z."""
    pose = np.eye(4)
    pose[2, 3] = -2.0
    return Camera.with_fov(pose, 0.6, width, height)


def drawn(decoded: ViewGaussians, camera: Camera, backend: str) -> SplatImages:
    columns = (decoded.means, decoded.quats, decoded.scales, decoded.opacities, decoded.colors)
    return rasterise(*columns, camera, backend=backend)


def test_decoded_gaussians_can_be_drawn(backend: str) -> None:
    decoders, inputs = CASES["paper"].make()
    features = inputs.pop("features").requires_grad_(True)
    decoded = decode(**inputs, features=features, decoders=decoders, eye=(0.0, 0.0, -2.0), backend=backend)
    camera = camera_of(40, 30)
    image = drawn(decoded, camera, backend)
    assert image.alpha.max() > 0.3
    image.features.sum().backward()
    assert features.grad is not None
    assert features.grad.norm() > 0


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_visible_anchors_against_every_corner_of_the_frustum(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ECONGS_BACKEND", backend)
    camera = camera_of(80, 40)
    random = torch.Generator().manual_seed(1)
    anchors = 3.0 * (torch.rand(4000, 3, generator=random) - 0.5)
    scalings = torch.exp(torch.randn(4000, 6, generator=random) - 4.0)
    visible = visible_anchors(camera, anchors, scalings)
    for anchor, scaling, seen in zip(anchors.tolist(), scalings.tolist(), visible.tolist(), strict=True):
        depth = anchor[2] + 2.0
        reach = 3.0 * max(scaling[:3])
        inside = depth > 0.2
        if inside:
            radius = camera.fx * reach / depth
            u, v = camera.fx * anchor[0] / depth + 40, camera.fy * anchor[1] / depth + 20
            inside = -radius <= u <= 80 + radius and -radius <= v <= 40 + radius
        assert seen == inside
    assert 0.05 < visible.float().mean() < 0.95


def test_gaussians_of_what_is_not_visible_reach_no_pixel() -> None:
    """With offsets within three scalings, culling anchors changes no picture by more than faint tails."""
    decoders, inputs = Case(count=400, seed=2).make()
    inputs["anchors"] *= 5.0
    inputs["offsets"].clamp_(-1.0, 1.0)
    inputs["scalings"] *= 0.2
    camera = camera_of(40, 30)
    seen = visible_anchors(camera, inputs["anchors"], inputs["scalings"])
    assert 0.02 < seen.float().mean() < 0.9
    pictures = []
    for rows in (slice(None), seen):
        some = {name: one if name in ("embedding", "palette") else one[rows] for name, one in inputs.items()}
        decoded = decode(**some, decoders=decoders, eye=camera.position, backend="torch")
        pictures.append(drawn(decoded, camera, "torch").features)
    assert pictures[0].max() > 0.1
    torch.testing.assert_close(pictures[0], pictures[1], rtol=0, atol=0.02)
