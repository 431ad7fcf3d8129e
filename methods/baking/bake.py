"""Plain Gaussians that look, in a viewer, as much as possible like those of a model.

Each Gaussian keeps its number and its place; scales, rotation, opacity and colors may depend on the view in a
model, and its filters may not be those of viewers. What is stored is the mean over the views that see it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.splat import LINEAGE, LowPass
from econgs_bench.econgs.splat.composite import MIN_ALPHA
from econgs_bench.econgs.splat.rays import MIN_THROUGH
from econgs_bench.econgs.splat.sh import harmonics
from econgs_bench.econgs.splat.splats import Splats
from econgs_bench.econgs.splat.torch_backend import MAX_ALPHA, Projected, project
from econgs_bench.methods.gaussian_splatting.model import SH_REST, SceneGaussians, SplatModel
from econgs_bench.methods.interface import HasGaussians
from econgs_bench.methods.shared.rendering import Rendering

VIEWERS = {"antialiased": LowPass(compensated=True), "plain": LINEAGE}
"""How viewers draw: they add 0.3 px² to Gaussians, and shrink opacities for that or do not."""
MOST_VIEWS = 64
"""Views that a fit of colors looks at, spread evenly over those given."""
_RIDGE = 1e-4  # share of a Gaussian's summed weights
_FAINTEST = 2e-4  # least opacity where depth along a ray may make a Gaussian darker
_AT_ONCE = 1 << 13  # Gaussians whose colors are solved for together
_OUTSIDE = 0.15  # share of the image's sides by which a middle may lie outside


def exact(model: Any, scene: str, viewer: LowPass = LINEAGE) -> SceneGaussians | None:
    """The Gaussians of a model that a viewer draws as the model does; None where it does not."""
    if isinstance(model, SplatModel) and model.rendering == Rendering(low_pass=viewer):
        return model.scene(scene)
    return None


def sizes(viewer: LowPass) -> tuple[int, ...]:
    """Multiples of the training size at which Gaussians are fitted for a viewer.

    One that does not compensate its filter draws Gaussians the darker, the larger their pixels: no file is
    right at all sizes, and what is stored is the mean over these.
    """
    return (1, 2) if viewer.compensated else (1, 2, 4)


def baked(
    model: HasGaussians,
    scene: str,
    cameras: Sequence[Camera],
    background: RGB,
    viewer: LowPass | None = VIEWERS["antialiased"],
    degree: int = 3,
) -> SceneGaussians:
    """Plain Gaussians of a scene, fitted to what cameras see of it, in scene units.

    - Scales: geometric mean, quaternions: mean after aligning signs, both weighted by opacity. The scene's
      own smoothing is added.
    - Opacity: of the mean optical depth, 1 - exp(mean ln(1 - o)) weighted by area, where o gives a Gaussian
      in the viewer the mass (opacity times area) that it has in the model's view.
    - Colors: weighted least squares of spherical harmonics; weights are opacities in the views, with a ridge
      above the constant coefficient.

    Args:
        model: any that tells its Gaussians apart.
        scene: name of its scene.
        cameras: of the training views.
        background: the scene's.
        viewer: how the Gaussians will be drawn; None: as the model draws them, so that opacities are its own.
        degree: of spherical harmonics.

    Raises:
        DataError: no camera sees any Gaussian.
    """
    return baked_rows(model, scene, cameras, background, viewer, degree)[0]


def baked_rows(
    model: HasGaussians,
    scene: str,
    cameras: Sequence[Camera],
    background: RGB,
    viewer: LowPass | None,
    degree: int = 3,
) -> tuple[SceneGaussians, Tensor]:
    """As :func:`baked`, and (N,) the numbers of its Gaussians in the model."""
    step = max(1, -(-len(cameras) // MOST_VIEWS))
    chosen = list(cameras)[::step]
    with torch.inference_mode():
        views = _Views(model, scene, chosen)
        shape = _mean_shapes(views)
        if shape is None:
            raise DataError(scene, "no training view sees a Gaussian of this model", "Export another scene")
        logits, coefficients, keep = _mean_looks(views, shape, viewer, degree)
        rows = keep.nonzero()[:, 0]
        full = torch.zeros((len(rows), 1 + SH_REST, 3))
        full[:, : coefficients.shape[1]] = coefficients[rows]
        values = {
            "means": shape.means[rows],
            "log_scales": shape.scales[rows].log(),
            "quats": shape.quats[rows],
            "logits": logits[rows],
            "sh_dc": full[:, :1].clone(),
            "sh_rest": full[:, 1:].clone(),
        }
    # Copies, because tensors of inference mode take part in no gradient.
    values = {name: one.clone() for name, one in values.items()}
    return SceneGaussians(scene, background, degree, **values), rows


@dataclass(frozen=True)
class _View:
    """What a camera sees: the rows of its Gaussians among all, what is splatted, and opacities as drawn.

    Attributes:
        units: scene units / units of the Gaussians.
        inside: (M,) before the camera, and about in the image.
    """

    camera: Camera
    numbers: Tensor
    splats: Splats
    units: float
    opacities: Tensor
    inside: Tensor

    def masses(self, factor: int) -> Tensor:
        """(M,) opacity times area in px² / 2π, where the picture is that many times as wide."""
        means, quats, scales, opacities, _, camera, _, low_pass = self.splats
        seen = project(means, quats, scales, enlarged(camera, factor), None, low_pass)
        drawn = seen.opacities(opacities).nan_to_num(0.0).clamp(max=MAX_ALPHA)
        return drawn * seen.det.clamp_min(0.0).sqrt()


class _Views:
    """The views of a scene, made anew in each pass: memory holds one."""

    def __init__(self, model: HasGaussians, scene: str, cameras: Sequence[Camera]) -> None:
        self._model, self._scene, self.cameras = model, scene, cameras

    def each(self, use: Callable[[_View], None]) -> None:
        """Pass all views that hold a Gaussian."""
        for camera in self.cameras:
            splats, numbers = self._model.splats(self._scene, camera)
            if not len(numbers):
                continue
            low_pass = splats.low_pass.at_one_point()
            scales = torch.hypot(splats.scales, splats.scales.new_tensor(low_pass.smoothing**0.5)).cpu()
            tensors = (splats.means.cpu(), splats.quats.cpu(), scales)
            opacities, colors = splats.opacities.cpu().clamp(min=0.0), splats.features.cpu()
            splats = Splats(*tensors, opacities, colors, splats.camera, None, low_pass)
            seen = project(*tensors, splats.camera, None, low_pass)
            drawn = seen.opacities(opacities).nan_to_num(0.0).clamp(max=MAX_ALPHA)
            inside = _inside(seen, splats.camera) & (opacities > 0.0)
            use(_View(camera, numbers.cpu(), splats, camera.near / splats.camera.near, drawn, inside))


def enlarged(camera: Camera, factor: int) -> Camera:
    """A camera whose picture is that many times as wide and high."""
    return camera.resized(factor * camera.width, factor * camera.height)


def _inside(seen: Projected, camera: Camera) -> Tensor:
    """(N,) whether Gaussians are before a camera and their middles about in its image."""
    inside = (seen.depth > camera.near) & torch.isfinite(seen.det)
    for places, side in ((seen.u, camera.width), (seen.v, camera.height)):
        inside &= (places > -_OUTSIDE * side) & (places < (1.0 + _OUTSIDE) * side)
    return inside


@dataclass(frozen=True)
class _Shapes:
    """Mean Gaussians in scene units: (N, 3) means, (N, 4) quats, (N, 3) scales; whether a view saw them."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    seen: Tensor


def _mean_shapes(views: _Views) -> _Shapes | None:
    totals: dict[str, Tensor] = {}
    widths = {"weight": 1, "means": 3, "logs": 3, "quats": 4}

    def add(view: _View) -> None:
        numbers = view.numbers
        count = max(int(numbers.max()) + 1, len(totals.get("weight", ())))
        for name, width in widths.items():
            old = totals.get(name, torch.zeros((0, width)))
            totals[name] = torch.cat([old, torch.zeros((count - len(old), width))])
        splats = view.splats
        weight = (view.opacities * view.inside)[:, None]
        signs = (totals["quats"][numbers] * splats.quats).sum(1, keepdim=True)
        quats = torch.where(signs < 0.0, -splats.quats, splats.quats)
        logs = (view.units * splats.scales).clamp_min(1e-12).log()
        parts = {"weight": torch.ones_like(weight), "means": view.units * splats.means, "logs": logs}
        parts["quats"] = quats
        for name, values in parts.items():
            totals[name].index_add_(0, numbers, weight * values)

    views.each(add)
    if not totals or not bool((totals["weight"] > 0.0).any()):
        return None
    weight = totals["weight"].clamp_min(1e-12)
    quats = totals["quats"] / totals["quats"].norm(dim=1, keepdim=True).clamp_min(1e-12)
    seen = (totals["weight"][:, 0] > 0.0) & (quats.square().sum(1) > 0.5)
    return _Shapes(totals["means"] / weight, quats, (totals["logs"] / weight).exp(), seen)


def _mean_looks(
    views: _Views, shape: _Shapes, viewer: LowPass | None, degree: int
) -> tuple[Tensor, Tensor, Tensor]:
    """(N,) logits, (N, K, 3) coefficients, and which Gaussians are dark enough to be drawn."""
    count = len(shape.means)
    depths, areas = torch.zeros(count), torch.zeros(count)
    weights, colors, eyes = [], [], []

    def add(view: _View) -> None:
        rows = (view.inside & shape.seen[view.numbers]).nonzero()[:, 0]
        numbers = view.numbers[rows]
        drawn_by = viewer or view.splats.low_pass
        # Where both compensate their filters, masses are in proportion at all sizes.
        constant = viewer is None or (viewer.compensated and view.splats.low_pass.compensated)
        for factor in (1,) if constant else sizes(drawn_by):
            camera = enlarged(view.camera, factor)
            plain = project(shape.means, shape.quats, shape.scales, camera, None, drawn_by)
            area = plain.det.clamp_min(1e-20).sqrt()
            if plain.share is not None:
                area = area * plain.share.clamp_min(1e-6)
            if viewer is None:
                opacity = view.splats.opacities[rows].clamp(max=1.0)
            else:
                opacity = (view.masses(factor)[rows] / area[numbers]).clamp(0.0, MAX_ALPHA)
            area = torch.where(_inside(plain, camera), area / factor**2, 0.0)
            areas.add_(area)  # a Gaussian that the model leaves out is not there
            depths[numbers] += area[numbers] * (1.0 - opacity).clamp_min(MIN_THROUGH).log()
        weight, color = torch.zeros(count), torch.zeros((count, 3))
        weight[numbers], color[numbers] = view.opacities[rows], view.splats.features[rows] - 0.5
        weights.append(weight)
        colors.append(color)
        eyes.append(torch.as_tensor(view.camera.position, dtype=torch.float32))

    views.each(add)
    opacities = 1.0 - (depths / areas.clamp_min(1e-20)).exp()
    keep = shape.seen & (opacities >= (_FAINTEST if viewer is None else MIN_ALPHA))
    coefficients = torch.zeros((count, (degree + 1) ** 2, 3))
    for rows in keep.nonzero()[:, 0].split(_AT_ONCE):
        weight = torch.stack([one[rows] for one in weights], 1)
        color = torch.stack([one[rows] for one in colors], 1)
        away = torch.nn.functional.normalize(shape.means[rows, None] - torch.stack(eyes), dim=2)
        coefficients[rows] = _least_squares(degree, away, weight, color)
    return opacities.clamp(1e-4, 1.0 - 1e-4).logit(), coefficients, keep


def _least_squares(degree: int, directions: Tensor, weights: Tensor, colors: Tensor) -> Tensor:
    """(n, K, 3) coefficients that give (n, V, 3) colors in (n, V, 3) directions at (n, V) weights."""
    basis = harmonics(degree, directions)
    weighted = (basis * weights[:, :, None]).transpose(1, 2)
    ridge = torch.full((basis.shape[2],), _RIDGE)
    ridge[0] = 0.0
    normal = weighted @ basis + torch.diag_embed((weights.sum(1)[:, None] * ridge).clamp_min(1e-9))
    solved: Tensor = torch.linalg.solve(normal.double(), (weighted @ colors).double()).float()
    return solved
