"""Draws a grid of svox2 from the test cameras of a folder; sees no true picture."""

import sys
import time
from argparse import ArgumentParser
from pathlib import Path

import imageio
import svox2
import torch
from util import config_util
from util.dataset import datasets


@torch.no_grad()
def main(checkpoint: str, cameras: str, pictures: Path, scene_scale: str) -> None:
    """Draw one picture for each test camera."""
    parser = ArgumentParser()
    config_util.define_common_args(parser)
    options = parser.parse_args([cameras, "--scene_scale", scene_scale])
    views = datasets[options.dataset_type](cameras, split="test", **config_util.build_data_options(options))
    grid = svox2.SparseGrid.load(checkpoint, device="cuda")
    config_util.setup_render_opts(grid.opt, options)
    for index in range(views.n_images):
        height, width = views.get_image_size(index)
        camera = svox2.Camera(
            views.c2w[index].to(device="cuda"),
            *(views.intrins.get(name, index) for name in ("fx", "fy", "cx", "cy")),
            width=width,
            height=height,
            ndc_coeffs=views.ndc_coeffs,
        )
        torch.cuda.synchronize()
        start = time.perf_counter()
        image = grid.volume_render_image(camera, use_kernel=True)
        torch.cuda.synchronize()
        print(f"frame {time.perf_counter() - start:.6f} s", flush=True)
        pixels = (255.0 * image.clamp(0.0, 1.0)).round().byte().cpu().numpy()
        imageio.imwrite(str(pictures / f"{index:04d}.png"), pixels)


main(sys.argv[1], sys.argv[2], Path(sys.argv[3]), sys.argv[4])
