"""Baking: what a plain viewer shows of a model comes near to what the model itself shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.splat import LINEAGE, LowPass
from econgs_bench.methods.baking.bake import VIEWERS, baked, enlarged, exact
from econgs_bench.methods.baking.distil import distilled
from econgs_bench.methods.contract.scene import away, cameras
from econgs_bench.methods.formats.gaussians import scene_of
from econgs_bench.methods.gaussian_splatting.model import GaussianModel
from econgs_bench.methods.shared.rendering import Rendering

CLOUD = LowPass(variance=0.03, compensated=True, ray_power=1.0)
"""How models are drawn by default here, and no viewer draws."""


def model(rendering=None, count=60, seed=2):
    """Sheets and needles of any direction with colors of degree 3."""
    rendering = rendering or Rendering()
    rng = np.random.default_rng(seed)
    values = {
        "means": rng.uniform(-0.3, 0.3, (count, 3)),
        "log_scales": np.log(0.08) - rng.uniform(0.0, 2.0, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "logits": rng.uniform(-2.0, 1.0, count),
        "sh_dc": rng.uniform(-0.8, 0.8, (count, 1, 3)),
        "sh_rest": rng.normal(0.0, 0.08, (count, 15, 3)),
    }
    scene = scene_of({name: one.astype(np.float32) for name, one in values.items()}, "a", (1.0, 1.0, 1.0), 3)
    if rendering.units != 1.0:
        scene = replace(
            scene,
            means=scene.means / rendering.units,
            log_scales=scene.log_scales - math.log(rendering.units),
        )
    made = GaussianModel([scene])
    made = made.drawn_by(rendering)
    return made


def error(one, other, views):
    """Root of the mean squared difference of pictures."""
    pairs = ((one.render(view)[0], other.render(view)[0]) for view in views)
    return math.sqrt(sum(float((a - b).square().mean()) for a, b in pairs) / len(views))


def test_plain_models_need_no_baking():
    plain = model()
    assert exact(plain, "a") is plain.scene("a")
    assert exact(model(Rendering(low_pass=CLOUD)), "a") is None


def test_a_plain_model_is_baked_to_itself():
    plain, views = model(), cameras(40)
    again = baked(plain, "a", views, (1.0, 1.0, 1.0), LINEAGE)
    assert len(again) == len(plain.scene("a"))
    torch.testing.assert_close(again.means, plain.scene("a").means, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(again.logits, plain.scene("a").logits, atol=1e-2, rtol=1e-2)
    torch.testing.assert_close(again.sh_dc, plain.scene("a").sh_dc, atol=2e-2, rtol=0.0)
    assert error(GaussianModel([again]), plain, views) < 2e-3


@pytest.mark.parametrize("points", [1, 2])
@pytest.mark.parametrize("viewer", VIEWERS.values(), ids=VIEWERS)
def test_clouds_look_more_alike_in_a_viewer_once_baked_and_distilled(points, viewer):
    views = cameras(16)
    cloud = model(Rendering(low_pass=replace(CLOUD, points=points)))
    shown = [enlarged(view, size) for view in views[:6] for size in (1, 2, 4)]

    def seen(scene):
        return error(GaussianModel([scene]).drawn_by(Rendering(low_pass=viewer)), cloud, shown)

    first = baked(cloud, "a", views, (1.0, 1.0, 1.0), viewer)
    assert seen(first) < seen(cloud.scene("a"))
    second = distilled(first, cloud, views, 60, viewer)
    assert seen(second) < seen(first)
    again = distilled(first, cloud, views, 60, viewer)
    assert torch.equal(again.means, second.means)
    assert torch.equal(again.sh_rest, second.sh_rest)


def test_a_bake_is_for_one_kind_of_viewer_at_all_sizes():
    """Without the depth along the ray nothing is left to average: viewers that compensate are right."""
    views = cameras(12)
    cloud = model(Rendering(low_pass=replace(CLOUD, ray_power=0.0)))
    found = {}
    for made, own in VIEWERS.items():
        scene = baked(cloud, "a", views, (1.0, 1.0, 1.0), own)
        torch.testing.assert_close(scene.log_scales, cloud.scene("a").log_scales, atol=1e-4, rtol=1e-4)
        for shown, viewer in VIEWERS.items():
            drawn = GaussianModel([scene]).drawn_by(Rendering(low_pass=viewer))
            found[made, shown] = [
                error(drawn, cloud, [enlarged(one, size) for one in views]) for size in (1, 2, 4)
            ]
    for size in range(3):
        assert found["antialiased", "antialiased"][size] < 0.7 * found["plain", "antialiased"][size]
    assert max(found["plain", "plain"]) < max(found["antialiased", "plain"])


def test_baked_gaussians_are_in_scene_units():
    views = cameras(12)
    one = baked(model(Rendering(low_pass=CLOUD)), "a", views, (1.0, 1.0, 1.0))
    other = baked(model(Rendering(units=4.0, low_pass=CLOUD)), "a", views, (1.0, 1.0, 1.0))
    for name in ("means", "log_scales", "logits"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=1e-4, rtol=1e-3)
    difference = GaussianModel([one]).render(views[0])[0] - GaussianModel([other]).render(views[0])[0]
    assert float(difference.abs().max()) < 1e-3


def test_what_no_view_sees_is_refused():
    with pytest.raises(DataError, match="no training view sees a Gaussian"):
        baked(model(), "a", [away(view) for view in cameras(3)], (1.0, 1.0, 1.0))
