"""Decodes HAC's bitstreams and draws the test cameras of a folder; sees no true picture."""

import sys
import time
from argparse import ArgumentParser
from pathlib import Path

import torch
from arguments import ModelParams, PipelineParams
from gaussian_renderer import prefilter_voxel, render
from scene import GaussianModel, cameraList_from_camInfos, sceneLoadTypeCallbacks
from torchvision.utils import save_image
from utils.encodings_cuda import decoder


def load(folder: Path) -> GaussianModel:
    """The model of a folder of bitstreams."""
    state = torch.load(str(folder / "decoder.pth"))
    model = GaussianModel(**state["settings"])
    model.load_state_dict(state["networks"], strict=False)
    model.x_bound_min, model.x_bound_max = state["bounds"]
    # HAC decodes attributes in the context of the model's hash grids, so these come first.
    signs = decoder(model.get_encoding_params().numel(), str(folder / "hash.b")) * 2.0 - 1.0
    grids = model.encoding_xyz
    for grid in (grids.encoding_xyz, grids.encoding_xy, grids.encoding_xz, grids.encoding_yz):
        grid.params.data.copy_(signs[: grid.params.numel()].view_as(grid.params))
        signs = signs[grid.params.numel() :]
    # HAC replaces attributes by others of the same shape. It never changes rotations.
    anchors, batch = state["counts"]
    shapes: dict[str, tuple] = {"_anchor": (3,), "_scaling": (6,), "_anchor_feat": (model.feat_dim,)}
    shapes.update(_offset=(model.n_offsets, 3), _mask=(model.n_offsets, 1))
    for name, shape in shapes.items():
        setattr(model, name, torch.zeros(anchors, *shape, device="cuda"))
    model._rotation = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device="cuda").repeat(anchors, 1)
    model.conduct_decoding(pre_path_name=str(folder), patched_infos=[anchors, anchors, batch])
    model.eval()
    return model


@torch.no_grad()
def main(bitstreams: Path, cameras: str, pictures: Path) -> None:
    """Draw one picture for each test camera."""
    parser = ArgumentParser()
    groups = (ModelParams(parser), PipelineParams(parser))
    options = parser.parse_args(["-s", cameras, "--white_background"])
    scene, pipe = (group.extract(options) for group in groups)
    model, white = load(bitstreams), torch.ones(3, device="cuda")
    views = sceneLoadTypeCallbacks["Blender"](cameras, scene.white_background, scene.eval, ply_path=None)
    for view in cameraList_from_camInfos(views.test_cameras, 1.0, scene):
        torch.cuda.synchronize()
        start = time.perf_counter()
        visible = prefilter_voxel(view, model, pipe, white)
        image = render(view, model, pipe, white, visible_mask=visible)["render"]
        torch.cuda.synchronize()
        print(f"frame {time.perf_counter() - start:.6f} s", flush=True)
        save_image(image.clamp(0.0, 1.0), str(pictures / f"{view.image_name}.png"))


main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
