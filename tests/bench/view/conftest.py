"""Sources to look at: shaded Gaussians with a truth, a picture without Gaussians, names that attack."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from econgs_bench.bench.view.server import Server, Viewer
from econgs_bench.bench.view.sources import Marched, Opened, Source
from econgs_bench.datasets.camera_paths import test_cameras as cameras_of
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.econgs.splat.low_pass import LowPass
from econgs_bench.methods.gaussian_splatting.model import GaussianModel, SceneGaussians
from econgs_bench.methods.ivr_gs.model import IvrModel, ShadedGaussians
from econgs_bench.methods.shared.rendering import Rendering

HOSTILE = "<img src=x onerror=\"document.title='hit'\">'\"${alert(1)}"
CAMERAS = cameras_of(4, 0.5 * math.sqrt(3.0), 64, 64)
EVERY = frozenset({"palette", "opacity", "light", "shading"})
ENTRY = """title = "a ball"
[[files]]
path = "data/ball_24x24x24_uint8.raw"
variable = "density"
[[scenes]]
name = "ball"
variable = "density"
light = { ambient = 0.5, direction = [0.0, 0.0, 1.0] }
[[scenes.bumps]]
name = "shell"
range = [0.3, 0.4, 0.5, 0.6]
color = [0.8, 0.2, 0.1]
opacity = 0.3
[[scenes]]
name = "core"
variable = "density"
[[scenes.bumps]]
name = "core"
range = [0.7, 0.8, 1.0, 1.0]
color = "#2040e0"
opacity = 0.6
[compositions]
both = ["ball", "core"]
"""


@pytest.fixture(scope="module")
def entry(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TOML file and its volume: values fall off from the middle, 0 to 200 of 255."""
    folder = tmp_path_factory.mktemp("entry")
    away = np.linalg.norm(np.stack(np.meshgrid(*[np.linspace(-1, 1, 24)] * 3)), axis=0)
    (folder / "data").mkdir()
    values = (200 * np.clip(1 - away, 0, 1)).astype(np.uint8)
    (folder / "data/ball_24x24x24_uint8.raw").write_bytes(values.tobytes())
    (folder / "ball.toml").write_text(ENTRY)
    return folder / "ball.toml"


def _common(count: int, seed: int) -> dict[str, torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    return {
        "means": torch.rand((count, 3), generator=random) - 0.5,
        "quats": torch.randn((count, 4), generator=random),
    }


def shaded(name: str, count: int = 400, seed: int = 1) -> IvrModel:
    """Sheets, needles and blobs, shaded, in units of their own, drawn with every filter."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=random)

    own = _common(count, seed)
    scene = ShadedGaussians(
        name=name, background=(1.0, 1.0, 1.0), light=(0.0, 0.6, 0.8), palette=torch.tensor([0.7, 0.3, 0.2]),
        means=2.0 * own["means"], quats=own["quats"], scales=0.08 * uniform(count, 3).square() + 1e-4,
        opacities=uniform(count), normals=torch.randn((count, 3), generator=random),
        offsets=0.3 * uniform(count, 3) - 0.15,
        coefficients=torch.tensor([0.4, 0.7, 0.3, 20.0]).repeat(count, 1),
    )  # fmt: skip
    filters = LowPass(0.03, True, smoothing=1e-5, ray_power=1.0, points=2)
    return IvrModel([scene], None).drawn_by(Rendering(0.5, filters))


def harmonic(name: str, count: int = 300) -> GaussianModel:
    """Gaussians of 3DGS with colors of degree 3, as published."""
    random = torch.Generator().manual_seed(3)
    return GaussianModel([
        SceneGaussians(
            name, (1.0, 1.0, 1.0), 3, log_scales=torch.randn((count, 3), generator=random) * 0.6 - 3.6,
            logits=3.0 * torch.randn(count, generator=random),
            sh_dc=torch.randn((count, 1, 3), generator=random),
            sh_rest=0.2 * torch.randn((count, 15, 3), generator=random), **_common(count, 2),
        )
    ])  # fmt: skip


class Flat:
    """A model without Gaussians: one color, half transparent."""

    scenes = ("cores",)

    def primitives(self, scene=None):
        return 1

    def render(self, camera, scenes=None, edit=None, background=None):
        alpha = torch.full((camera.height, camera.width), 0.5)
        color = torch.tensor([0.2, 0.4, 0.8]) * alpha[..., None]
        return color + (1 - alpha[..., None]) * torch.tensor(background), alpha


def source(label: str, model, *, truth: bool = False, edits: frozenset[str] = frozenset()) -> Source:
    dataset = open_dataset("vortices@32") if truth else None
    definitions = {scene.name: scene for scene in dataset.scenes} if dataset else {}
    drawer = Marched("vortices@32", dataset, 1) if truth else None
    background = (1.0, 1.0, 1.0)
    opened = Opened(model.scenes, background, CAMERAS, model, drawer, definitions, edits, size=1234)
    return Source(label, lambda: replace(opened))


@contextmanager
def serving(*sources: Source) -> Iterator[Server]:
    with Server(Viewer(sources)) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving(
        source("shaded", shaded("cores"), truth=True, edits=EVERY),
        source("harmonic", harmonic("other"), edits=frozenset({"opacity"})),
        source("flat", Flat()),
        source(HOSTILE, harmonic(HOSTILE), edits=frozenset({"opacity"})),
    ) as running:
        yield running
