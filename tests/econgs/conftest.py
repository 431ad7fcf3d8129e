"""Scenes, an independent renderer and the backends that the tests of the splatting core share."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.splat import LINEAGE, LowPass, rasterise

NAMES = ("means", "quats", "scales", "opacities", "features", "screen_offset")
OUTPUTS = ("features", "alpha", "depth")


@dataclass
class Scene:
    """Float64 inputs that are exactly representable in float32, and the view."""

    tensors: dict[str, torch.Tensor]
    camera: Camera
    low_pass: LowPass = LINEAGE

    def render(self, dtype: torch.dtype, backend: str | None, device: str = "cpu") -> Any:
        moved = {name: one.to(dtype).to(device) for name, one in self.tensors.items()}
        return rasterise(camera=self.camera, low_pass=self.low_pass, backend=backend, **moved)

    def gradients(
        self, dtype: torch.dtype, backend: str | None, seeds: dict[str, torch.Tensor], device: str = "cpu"
    ) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """Outputs, and gradients of Σ outputs · seeds, in float64 on the CPU."""
        leaves = {
            name: one.to(device, dtype, copy=True).requires_grad_(True) for name, one in self.tensors.items()
        }
        out = rasterise(camera=self.camera, low_pass=self.low_pass, backend=backend, **leaves)
        loss = sum((getattr(out, name) * seeds[name].to(dtype).to(device)).sum() for name in OUTPUTS)
        assert isinstance(loss, torch.Tensor)
        loss.backward()
        outputs = {name: getattr(out, name).detach().double().cpu() for name in OUTPUTS}
        grads = {}
        for name, leaf in leaves.items():
            assert leaf.grad is not None, name
            grads[name] = leaf.grad.double().cpu()
        return outputs, grads


@dataclass
class Reference:
    """Images by the independent renderer, the pixels where rounding decides, and those with a held alpha."""

    features: NDArray[np.float64]
    alpha: NDArray[np.float64]
    depth: NDArray[np.float64]
    radii: NDArray[np.int64]
    doubtful: NDArray[np.bool_]
    clamped: NDArray[np.bool_]


def look_at(position: tuple[float, float, float], size: tuple[int, int], fov: float, shift: float) -> Camera:
    """A camera at a point, looking at the origin; ``shift`` moves the principal point (pixels)."""
    forward = -np.asarray(position) / np.linalg.norm(position)
    right = np.cross(forward, [0.1, 0.2, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    camera = Camera.with_fov(pose, fov, *size)
    return Camera(
        pose, camera.fx, 1.1 * camera.fy, camera.cx + shift, camera.cy - 0.6 * shift, *size, name="test"
    )


def make_scene(
    count: int = 200,
    size: tuple[int, int] = (61, 45),
    channels: int = 3,
    seed: int = 0,
    *,
    sigma: float = 0.05,
    stretch: float = 0.4,
    opacity: tuple[float, float] = (0.05, 0.95),
    shift: float = 0.0,
    position: tuple[float, float, float] = (1.2, -2.0, 0.7),
    fov: float = 0.7,
    offset: float = 1.0,
    low_pass: LowPass = LINEAGE,
) -> Scene:
    """A cloud of Gaussians around the origin; ``stretch`` is the spread of the log scales."""
    random = np.random.default_rng(seed)
    camera = look_at(position, size, fov, shift)
    means = random.uniform(-0.6, 0.6, (count, 3)).astype(np.float32)
    # Float32 and float64 must agree on the order: no two depths within a few units in the last place.
    depth = (means.astype(np.float64) - camera.position) @ camera.camera_to_world[:3, 2]
    order = np.argsort(depth)
    apart = np.diff(depth[order], prepend=-np.inf) > 4e-6
    means = means[np.sort(order[apart])]
    count = len(means)
    arrays = {
        "means": means,
        "quats": random.normal(size=(count, 4)) * random.uniform(0.3, 3.0, (count, 1)),
        "scales": sigma * np.exp(stretch * random.normal(size=(count, 3))),
        "opacities": random.uniform(*opacity, count),
        "features": random.normal(size=(count, channels)),
        "screen_offset": offset * random.normal(size=(count, 2)),
    }
    tensors = {name: torch.from_numpy(np.asarray(one, np.float32)).double() for name, one in arrays.items()}
    return Scene(tensors, camera, low_pass)


def brute_force(scene: Scene) -> Reference:
    """Every Gaussian at every pixel in numpy float64: no tiles, no extents, no shared code.

    A pixel is doubtful where an alpha lies within rounding of 1/255 or 0.99, or the transmittance within
    rounding of 1e-4: there float32 may decide otherwise than float64, rightly.
    """
    camera = scene.camera
    data = {name: one.numpy() for name, one in scene.tensors.items()}
    turn, shift = camera.camera_to_world[:3, :3].T, camera.camera_to_world[:3, 3]
    local = (data["means"] - shift) @ turn.T
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    shape = (camera.height, camera.width)
    features, depth = np.zeros((*shape, data["features"].shape[1])), np.zeros(shape)
    transmittance, running = np.ones(shape), np.ones(shape, bool)
    doubtful, clamped = np.zeros(shape, bool), np.zeros(shape, bool)
    radii = np.zeros(len(local), int)
    limits = 1.3 * camera.width / 2 / camera.fx, 1.3 * camera.height / 2 / camera.fy
    for one in np.argsort(local[:, 2], kind="stable"):
        px, py, pz = local[one]
        if pz <= scene.camera.near:
            continue
        w, *vector = data["quats"][one]
        axes = Rotation.from_quat([*vector, w]).as_matrix() * data["scales"][one]
        sx, sy = np.clip(px / pz, -limits[0], limits[0]), np.clip(py / pz, -limits[1], limits[1])
        jacobian = np.array([[camera.fx, 0, -camera.fx * sx], [0, camera.fy, -camera.fy * sy]]) / pz
        before = jacobian @ turn @ axes @ axes.T @ turn.T @ jacobian.T
        covariance = before + scene.low_pass.variance * np.eye(2)
        opacity = data["opacities"][one]
        if power := scene.low_pass.ray_power:
            # The part of the ray (clamped as the Jacobian) from the middle to the surface at one deviation,
            # over that of a mean direction: the mean of the inverse squares.
            ray = turn.T @ np.array([sx, sy, 1.0]) / np.sqrt(sx**2 + sy**2 + 1.0)
            length = 1.0 / np.linalg.norm(np.linalg.solve(axes, ray))
            relative = min(length * np.sqrt((data["scales"][one] ** -2.0).mean()), 50.0)
            opacity = 1.0 - max(1.0 - opacity, 1e-4) ** relative**power
        if scene.low_pass.compensated:
            opacity *= np.sqrt(max(np.linalg.det(before), 0.0) / np.linalg.det(covariance))
        centre = np.array([camera.fx * px / pz + camera.cx, camera.fy * py / pz + camera.cy])
        centre += data["screen_offset"][one]
        away = np.stack([x, y], axis=-1) - centre
        exponent = np.einsum("hwi,ij,hwj->hw", away, np.linalg.inv(covariance), away)
        alpha = opacity * np.exp(-0.5 * exponent)
        doubtful |= running & (abs(alpha * 255 - 1) < 1e-3)
        doubtful |= running & (abs(alpha / 0.99 - 1) < 1e-4)
        clamped |= alpha > 0.99
        alpha = np.minimum(alpha, 0.99)
        if (alpha >= 1 / 255).any():
            radii[one] = int(np.ceil(3 * np.sqrt(np.linalg.eigvalsh(covariance)[-1])))
        alpha[alpha < 1 / 255] = 0
        after = transmittance * (1 - alpha)
        doubtful |= running & (abs(after / 1e-4 - 1) < 1e-2)
        running &= after >= 1e-4
        weight = np.where(running, transmittance * alpha, 0)
        transmittance = np.where(running, after, transmittance)
        features += weight[..., None] * data["features"][one]
        depth += weight * pz
    return Reference(features, 1 - transmittance, depth, radii, doubtful, clamped)


def relative(actual: torch.Tensor, expected: torch.Tensor) -> float:
    """Relative L2 distance."""
    assert actual.shape == expected.shape
    return ((actual - expected).norm() / expected.norm().clamp(min=1e-30)).item()


def random_seeds(scene: Scene, keep: NDArray[np.bool_], seed: int = 5) -> dict[str, torch.Tensor]:
    """Gradients to feed into the outputs: random, zero outside ``keep``."""
    random = np.random.default_rng(seed)
    mask = torch.from_numpy(keep.astype(np.float32)).double()
    channels = scene.tensors["features"].shape[1]
    shape = mask.shape
    draw = {"features": (*shape, channels), "alpha": shape, "depth": shape}
    seeds = {
        name: torch.from_numpy(random.normal(size=size).astype(np.float32)).double()
        for name, size in draw.items()
    }
    return {name: one * (mask[..., None] if name == "features" else mask) for name, one in seeds.items()}


def native_module() -> Any:
    """The compiled kernels, or None where there are none."""
    if importlib.util.find_spec("econgs_bench.econgs._native") is None:
        return None
    from econgs_bench.econgs.splat import native

    return native


ISAS: list[str] = native_module().available_isas(testing=True) if native_module() else []


@pytest.fixture
def restored() -> Iterator[None]:
    """Leaves the kernels' instruction set and threads, and torch's threads, as they were."""
    native = native_module()
    before = (native.isa(), native.threads()) if native else None
    yield
    if before:
        native.set_isa(before[0])
        native.set_threads(before[1])
    torch.set_num_threads(1)


@pytest.fixture(params=ISAS)
def isa(request: pytest.FixtureRequest, restored: None) -> str:
    """Every instruction set of the kernels, in use."""
    native_module().set_isa(request.param)
    return str(request.param)


@pytest.fixture
def ways(restored: None, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Iterator[None]]:
    """Sets every backend, instruction set and number of threads in turn."""

    def each() -> Iterator[None]:
        monkeypatch.setenv("ECONGS_BACKEND", "torch")
        for threads in (1, 2):
            torch.set_num_threads(threads)
            yield
        monkeypatch.setenv("ECONGS_BACKEND", "native")
        for isa in ISAS:
            native_module().set_isa(isa)
            for threads in (1, 2, 3, 4):
                native_module().set_threads(threads)
                yield

    return each


def _backends() -> list[Any]:
    present = [pytest.param(("native", isa), id=f"native-{isa}") for isa in ISAS or ["missing"]]
    cuda = pytest.param(("gsplat", ""), id="gsplat", marks=pytest.mark.cuda)
    return [pytest.param(("torch", ""), id="torch"), *present, cuda]


@dataclass
class Backend:
    """A float32 backend under test, and how near to the float64 oracle it must come."""

    name: str
    device: str = "cpu"
    tolerance: float = 1e-5


@pytest.fixture(params=_backends())
def backend(request: pytest.FixtureRequest, restored: None) -> Backend:
    name, isa = request.param
    if name == "gsplat":
        if not torch.cuda.is_available() or importlib.util.find_spec("gsplat") is None:
            pytest.skip("no CUDA device with gsplat here")
        return Backend(name, "cuda", 1e-3)
    if name == "native":
        native = native_module()
        if native is None:
            pytest.skip("econgs_bench.econgs._native is not compiled here")
        native.set_isa(isa)
    return Backend(name)


@pytest.fixture(scope="session")
def splat() -> SimpleNamespace:
    """The helpers above, for test modules that cannot import this file."""
    helpers: dict[str, Callable[..., Any] | Any] = {
        "make_scene": make_scene,
        "brute_force": brute_force,
        "relative": relative,
        "random_seeds": random_seeds,
        "native": native_module(),
        "names": NAMES,
        "outputs": OUTPUTS,
    }
    return SimpleNamespace(**helpers)


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    """The tensors here are small: threads of torch only get in each other's way (the kernels keep theirs)."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
