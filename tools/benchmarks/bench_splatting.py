"""Speed of the splatting core as ratios within one run.

    python -m tools.benchmarks.bench_splatting [--repeats N] [--threads N] [--only SECTION]

What is compared runs in turns (A B A B …) and medians are divided, so that a busy machine slows both alike.
Beside them stand the ratios of the shortest times: other work on the machine hurts the many small steps of
torch more than a kernel, so these are the ones to trust when it is busy.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from econgs_bench.bench.machine.provenance import cpu
from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.losses import photometric_loss, torch_ssim
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat import native, rasterise, spherical_harmonics
from tools.benchmarks.turns import Time, heading, interleaved, row

RATIOS = ("ratio", "ratio of shortest")
SCENES = {"10 k, 200²": (10_000, 200), "50 k, 400²": (50_000, 400)}


def scene(count: int, size: int) -> tuple[dict[str, Tensor], Camera]:
    """Random Gaussians that fill the image, 3 σ ≈ 7.7 px."""
    random = np.random.default_rng(7)
    pose = np.eye(4)
    pose[2, 3] = -3.0
    camera = Camera.with_fov(pose, 0.6, size, size)
    sigma = 7.7 / 3 * 3.0 / camera.fx
    arrays = {
        "means": random.uniform(-0.8, 0.8, (count, 3)),
        "quats": random.normal(size=(count, 4)),
        "scales": sigma * np.exp(0.3 * random.normal(size=(count, 3))),
        "opacities": random.uniform(0.1, 0.95, count),
        "features": random.uniform(size=(count, 3)),
    }
    return {name: torch.from_numpy(one.astype(np.float32)) for name, one in arrays.items()}, camera


def splatting(
    tensors: dict[str, Tensor], camera: Camera, backend: str, backward: bool
) -> Callable[[], Tensor]:
    """Draws a frame, which it returns, and its gradients from color and alpha to all five inputs if asked."""
    leaves = {name: one.clone().requires_grad_(backward) for name, one in tensors.items()}
    color, alpha = torch.rand(camera.height, camera.width, 3), torch.rand(camera.height, camera.width)

    def call() -> Tensor:
        out = rasterise(camera=camera, backend=backend, **leaves)
        if backward:
            torch.autograd.grad([out.features, out.alpha], list(leaves.values()), [color, alpha])
        return out.features

    return call


def against_the_oracle(repeats: int) -> None:
    heading("Native against the torch oracle", "scene", "what", "torch", "native", *RATIOS)
    for name, (count, size) in SCENES.items():
        tensors, camera = scene(count, size)
        for what, backward in (("forward", False), ("forward + backward", True)):
            ways = {one: splatting(tensors, camera, one, backward) for one in ("torch", "native")}
            slow, fast = interleaved(ways, repeats).values()
            row(name, what, slow, fast, *ratios(slow, fast))


def empty_pictures(repeats: int) -> None:
    """What a picture costs by its pixels alone: one Gaussian in it, against filling its four channels."""
    heading("One Gaussian against filling the picture with zeros", "size", "what", "splat", "fill", *RATIOS)
    for size in (200, 400, 800):
        tensors, camera = scene(1, size)
        tensors["means"].zero_()  # in the middle
        for what, backward in (("forward", False), ("forward + backward", True)):
            ways = {
                "splat": splatting(tensors, camera, "native", backward),
                "fill": lambda size=size: torch.zeros(size, size, 4),
            }
            slow, fast = interleaved(ways, 10 * repeats).values()
            row(f"{size}²", what, slow, fast, *ratios(slow, fast))


def ratios(slow: Time, fast: Time) -> tuple[str, str]:
    return f"{slow.median / fast.median:.1f} x", f"{slow.shortest / fast.shortest:.1f} x"


def blend_share(repeats: int) -> None:
    """The blend loop's lane evaluations per second over those of the same loop in L1, one thread each."""
    heading("Blend loop against its own rate in the L1 cache", "scene", "G/s", "in L1, G/s", "share")
    before = native.threads()
    native.set_threads(1)
    for name, (count, size) in SCENES.items():
        tensors, camera = scene(count, size)
        frame = splatting(tensors, camera, "native", True)
        rates, peaks = [], []
        for _ in range(3 * repeats):
            numbers = native.statistics(frame())
            rates.append(numbers["evaluations"] / numbers["blend"])
            peaks.append(native.bench_blend(3))
        rate, peak = statistics.median(rates), statistics.median(peaks)
        row(name, f"{rate / 1e9:.2f}", f"{peak / 1e9:.2f}", f"{rate / peak:.0%}")
    native.set_threads(before)


def usual_ssim(x: Tensor, y: Tensor) -> Tensor:
    """What 3DGS code does: an 11×11 depthwise convolution of five images."""
    offset = torch.arange(11.0) - 5
    taps = torch.exp(-(offset**2) / 4.5)
    channels = x.shape[2]
    window = (torch.outer(taps, taps) / taps.sum() ** 2).expand(channels, 1, 11, 11).contiguous()
    x, y = x.permute(2, 0, 1)[None], y.permute(2, 0, 1)[None]
    mx, my, xx, yy, xy = (
        functional.conv2d(one, window, padding=5, groups=channels) for one in (x, y, x * x, y * y, x * y)
    )
    numerator = (2 * mx * my + 1e-4) * (2 * (xy - mx * my) + 9e-4)
    return (numerator / ((mx * mx + my * my + 1e-4) * (xx - mx * mx + yy - my * my + 9e-4))).mean()


def ssim(repeats: int) -> None:
    heading("SSIM with gradient", "image", "11x11 convolution", "torch twin", "native", *RATIOS)
    for size in (200, 400, 800):
        rendered, target = torch.rand(size, size, 3, requires_grad=True), torch.rand(size, size, 3)

        def gradient(
            loss: Callable[[Tensor, Tensor], Tensor], x: Tensor = rendered, y: Tensor = target
        ) -> None:
            torch.autograd.grad(loss(x, y), x)

        losses = {"11x11 convolution": usual_ssim, "torch twin": torch_ssim, "native": native.ssim}
        ways = {name: partial(gradient, loss) for name, loss in losses.items()}
        slow, twin, fast = interleaved(ways, repeats).values()
        row(f"{size}²", slow, twin, fast, *ratios(slow, fast))


def instruction_sets(repeats: int) -> None:
    isas = native.available_isas()
    heading("Instruction sets, forward + backward", "scene", *isas)
    before = native.isa()
    for name, (count, size) in SCENES.items():
        tensors, camera = scene(count, size)
        frame = splatting(tensors, camera, "native", True)

        def under(isa: str, frame: Callable[[], Tensor] = frame) -> None:
            native.set_isa(isa)
            frame()

        row(name, *interleaved({isa: partial(under, isa) for isa in isas}, 3 * repeats).values())
    native.set_isa(before)


def optimiser_share(repeats: int) -> None:
    """A training iteration of 3DGS with all 59 floats per Gaussian, and the optimiser's part of it."""
    heading("Optimiser's share of a 3DGS iteration", "scene", "iteration, ms", "optimiser, ms", "share")
    rates = {"means": 1e-5, "dc": 1e-3, "rest": 1e-4, "opacities": 1e-3, "scales": 1e-4, "quats": 1e-4}
    for name, (count, size) in {**SCENES, "130 k, 800²": (130_000, 800)}.items():
        tensors, camera = scene(count, size)
        features = tensors.pop("features")
        raw = {
            "means": tensors["means"],
            "quats": tensors["quats"],
            "scales": tensors["scales"].log(),
            "opacities": tensors["opacities"].logit(),
            "dc": (features[:, None] - 0.5) / 0.2821,
            "rest": 0.01 * torch.randn(count, 15, 3),
        }
        optimiser = Adam(raw, rates)
        target = torch.rand(size, size, 3)
        position = torch.from_numpy(camera.position).float()
        whole, part = [], []
        for turn in range(3 * repeats + 2):
            start = time.perf_counter()
            optimiser.zero_grad()
            offset = torch.zeros(count, 2, requires_grad=True)
            out = rasterise(
                optimiser["means"],
                optimiser["quats"],
                optimiser["scales"].exp(),
                optimiser["opacities"].sigmoid(),
                spherical_harmonics(3, optimiser["means"], position, optimiser["dc"], optimiser["rest"]),
                camera,
                screen_offset=offset,
            )
            image = out.features + (1 - out.alpha[..., None])
            photometric_loss(image, target).backward()
            middle = time.perf_counter()
            optimiser.step()
            end = time.perf_counter()
            if turn >= 2:
                whole.append(1e3 * (end - start))
                part.append(1e3 * (end - middle))
        iteration, step = statistics.median(whole), statistics.median(part)
        row(name, f"{iteration:.2f}", f"{step:.2f}", f"{step / iteration:.0%}")


SECTIONS = {
    "oracle": against_the_oracle,
    "empty": empty_pictures,
    "blend": blend_share,
    "ssim": ssim,
    "isa": instruction_sets,
    "optimiser": optimiser_share,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5, help="repetitions of the slowest (default 5)")
    parser.add_argument("--threads", type=int, help="threads of torch and of the native kernels")
    parser.add_argument("--only", choices=SECTIONS, help="run only this section")
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
        native.set_threads(options.threads)
    torch.manual_seed(0)
    print(
        f"{native.threads()} threads, {cpu()}, {native.isa()}, torch {torch.__version__}, "
        f"{time.strftime('%Y-%m-%d')}; medians (shortest) in ms"
    )
    for name, section in SECTIONS.items():
        if options.only in (None, name):
            section(options.repeats)


if __name__ == "__main__":
    main()
