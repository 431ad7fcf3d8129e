"""Rays through pixels: one by one as of a whole picture, and against the projection."""

from dataclasses import replace

import numpy as np
import torch

from econgs_bench.econgs.rays import PixelRays, camera_rays
from econgs_bench.methods.contract.scene import look_at


def test_rays_of_pixels_are_those_of_pictures_and_project_back():
    cameras = [replace(look_at(eye, 7), height=5, cy=2.4) for eye in ((0.5, -2.0, 1.0), (-1.0, 0.3, 2.5))]
    whole = [camera_rays(camera) for camera in cameras]
    pixels = torch.randperm(2 * 35)
    found = PixelRays(cameras)(pixels)
    for name in ("origins", "directions", "near"):
        expected = torch.cat([getattr(one, name) for one in whole])[pixels]
        torch.testing.assert_close(getattr(found, name), expected, rtol=1e-12, atol=1e-12)
    camera, rays = cameras[0], whole[0]
    points = (rays.origins + 2.0 * rays.near[:, None] * rays.directions).numpy()
    local = (points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    np.testing.assert_allclose(local[:, 2], 2.0 * camera.near)
    column = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    row = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    np.testing.assert_allclose(column, np.tile(np.arange(7) + 0.5, 5))
    np.testing.assert_allclose(row, np.repeat(np.arange(5) + 0.5, 7))
    assert camera_rays(camera, torch.float32).directions.dtype == torch.float32
