"""Methods that draw what is at the centre of a pixel, drawn as means over pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from bench import api
from bench.plan import Planner
from bench.selection import Selection
from bench.suites import load_suite
from bench.supersampling import Supersampled, drawn_as
from datasets.errors import DataError
from methods.options import resolve
from methods.registry import Registry


def jobs(method, variants):
    chosen = replace(load_suite("quick"), variants=tuple(variants))
    return Planner(Selection(chosen, scenes=("cores",), methods=(method,))).jobs(None)


def keys(jobs, kind):
    return {job.key for job in jobs if job.kind == kind}


def test_one_fit_and_one_model_serve_both_drawings():
    both = jobs("plenoxels", [{}, {"plenoxels": {"samples": 16}}])
    alone = jobs("plenoxels", [{}])
    assert keys(both, "fit") == keys(alone, "fit")
    assert keys(both, "encode") == keys(alone, "encode")
    assert keys(alone, "measure") < keys(both, "measure")
    drawn = {job.variant: job for job in both if job.kind == "measure"}
    assert set(drawn) == {"", "samples=16"}
    assert drawn["samples=16"].options == drawn[""].options
    assert drawn["samples=16"].overrides == {"samples": 16}
    assert {job.variant for job in both if job.kind in ("fit", "encode")} == {""}


def test_one_sample_is_the_drawing_as_published():
    assert keys(jobs("plenoxels", [{"plenoxels": {"samples": 1}}]), "measure") == keys(
        jobs("plenoxels", [{}]), "measure"
    )


def test_another_drawing_has_its_own_size_alone():
    chosen = replace(load_suite("quick"), variants=({}, {"plenoxels": {"samples": 16}}), rates="all")
    planned = Planner(Selection(chosen, scenes=("cores",), methods=("plenoxels",))).jobs(None)
    measured = [job for job in planned if job.kind == "measure"]
    assert len({job.rate for job in measured if job.variant == ""}) > 1
    assert {job.rate for job in measured if job.variant} == {None}


@pytest.mark.parametrize(("samples", "near"), [(3, "1 or 4"), (17, "16 or 25")])
def test_only_squares_are_drawn(samples, near):
    with pytest.raises(DataError, match=near):
        resolve(Registry().spec("sz3"), "quick", {"samples": samples})


def test_methods_that_integrate_have_no_such_setting():
    with pytest.raises(DataError, match="samples"):
        resolve(Registry().spec("3dgs"), "quick", {"samples": 16})


@dataclass
class Ramp:
    """Draws the column and the row of a pixel's centre, in the camera's own pixels."""

    scenes: tuple[str, ...] = ("s",)

    def render(self, camera, scenes=None, edit=None, background=None):
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rgb = np.stack([column / camera.width, (row / camera.height) ** 2, column % 2], axis=-1)
        return rgb.astype(np.float32), (row / camera.height).astype(np.float32)

    def timings(self, camera, scenes=None):
        return {"rasterise": float(camera.width)}


def test_a_pixel_is_the_mean_over_a_larger_picture():
    from datasets.camera import Camera

    camera = Camera.with_fov(np.eye(4), 0.5, 6, 4)
    model = Supersampled(Ramp(), 4)
    rgb, alpha = model.render(camera)
    larger, larger_alpha = Ramp().render(camera.resized(24, 16))
    np.testing.assert_allclose(rgb, larger.reshape(4, 4, 6, 4, 3).mean((1, 3)), atol=1e-6)
    np.testing.assert_allclose(alpha, larger_alpha.reshape(4, 4, 6, 4).mean((1, 3)), atol=1e-6)
    assert model.timings(camera) == {"rasterise": 24.0}
    assert model.scenes == ("s",)


def test_a_measurement_without_it_has_the_model_itself():
    model = Ramp()
    assert drawn_as(SimpleNamespace(overrides={}), model) is model


def test_a_volume_drawn_as_means_comes_near_the_truth(tmp_path):
    """One ray a pixel has what the truth of one ray has; 16 rays have the truth."""
    api.run(
        "quick",
        out=tmp_path / "runs",
        scenes=["cores"],
        methods=["sz3"],
        options={"sz3": {"error_bound": 1e-4}},
        quiet=True,
    )
    drawn = api.run(
        "quick",
        out=tmp_path / "runs",
        scenes=["cores"],
        methods=["sz3"],
        options={"sz3": {"error_bound": 1e-4, "samples": 16}},
        quiet=True,
    )
    rows = drawn.results.set_index("variant")["psnr"]
    assert len(rows) == 2
    one, means = rows["error_bound=0.0001"], rows["error_bound=0.0001,samples=16"]
    assert one < 35.0 < 45.0 < means
