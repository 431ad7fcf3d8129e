"""VEG: spec and options."""

from dataclasses import dataclass
from typing import Literal

from econgs_bench.methods.interface import (
    Configuration,
    MethodSpec,
    OptionValue,
    RateKnob,
    built_in,
    option,
)
from econgs_bench.methods.shared import splatting

PUBLISHED: dict[str, OptionValue] = {
    **splatting.PUBLISHED,
    "start": "random",
    "start_normals": "random",
    "background": "white",
    "opacity_law": "product",
    "table_size": 100,
    "first_stage": "unshaded",
    "shading_start": 0.0,
    "opacity_lr": 0.025,
    "growth_gradient": 2e-4,
    "normal_gradient": 4e-6,
    "shaded_normal_gradient": 2e-3,
    "normal_weight": 0.01,
    "alpha_weight": 0.1,
    "group_budget": 0.0,
}
"""What the paper and its released code do."""


@dataclass(frozen=True)
class VegOptions(splatting.SplattingOptions):
    """Options of VEG."""

    group_budget: float = option(
        1.0,
        "a group of n scenes has n to this power times the iterations of one scene",
        minimum=0.0,
        maximum=1.0,
    )
    # Start
    start: Literal["cloud", "random"] = option(
        "cloud", "where the first Gaussians come from: the clouds of all scenes, or the volume's box"
    )
    random_points: int = option(100_000, "number of points of a random start", minimum=1, maximum=10_000_000)
    start_normals: Literal["volume", "random"] = option(
        "volume", "first normals: the volume's gradients, or random ones"
    )
    # Look-up
    opacity_law: Literal["depth", "product"] = option(
        "depth",
        "opacity from the look-up's extinction along a Gaussian, of which a learned share counts; or the "
        "published product of the look-up's opacity and a learned one",
    )
    table_size: int = option(1024, "entries of the look-up; 100 as published", minimum=2, maximum=65536)
    first_stage: Literal["light", "unshaded"] = option(
        "light", "first stage: shaded by each scene's own light, or the colors of the look-up"
    )
    background: Literal["scene", "white", "black", "random"] = option(
        "scene", "what training views are composited on: the scene's own, or another"
    )
    # Losses
    ssim_weight: float = option(0.2, "weight of 1 - SSIM against L1 in the loss", minimum=0.0, maximum=1.0)
    normal_weight: float = option(
        0.0, "weight of normals against those of the depth map; 0.01 as published", minimum=0.0
    )
    smoothness_weight: float = option(
        0.01, "weight of the smoothness of each coefficient, second stage", minimum=0.0
    )
    opacity_weight: float = option(
        0.001, "weight of the mean opacity of visible Gaussians, second stage", minimum=0.0
    )
    # Learning rates
    position_lr: float = option(
        1.6e-4, "first learning rate of positions, x extent", minimum=0.0, maximum=1.0
    )
    opacity_lr: float = option(5e-2, "learning rate of opacities (logits)", minimum=0.0, maximum=1.0)
    scalar_lr: float = option(2.5e-4, "learning rate of scalars (logits)", minimum=0.0, maximum=1.0)
    shading_start: float = option(
        1.0,
        "first factor on the light's ambient and diffuse coefficients, second stage; 0 as published",
        minimum=0.0,
        maximum=10.0,
    )
    shading_lr: float = option(0.01, "learning rate of all attributes of shading", minimum=0.0, maximum=1.0)
    # Growth
    growth_gradient: float = option(
        1e-3,
        "mean screen-space gradient (NDC) from which a Gaussian is cloned or split; 2e-4 as published",
        minimum=0.0,
    )
    normal_gradient: float = option(
        2e-4, "mean gradient of normals from which a Gaussian is cloned or split, first stage", minimum=0.0
    )
    shaded_normal_gradient: float = option(2e-4, "the same in the second stage", minimum=0.0)
    dense_fraction: float = option(
        0.001, "largest scale, as a fraction of the extent, that is cloned and not split", minimum=0.0
    )
    prune_opacity: float = option(
        0.005,
        "opacity under which a Gaussian is pruned: the learned one, or the greatest under the scenes' "
        "transfer functions",
        minimum=0.0,
        maximum=1.0,
    )
    max_gaussians: int = option(
        0, "growth stops at this number (reported as a stage); 0 = no limit", minimum=0
    )
    # Storage
    codebook_size: int = option(256, "words of each codebook", minimum=2, maximum=65536)


SPEC = MethodSpec(
    name="veg",
    title="VEG: volume encoding Gaussians, independent of the transfer function",
    reference=(
        "L. Dyken, A. Sewell, W. Usher, N. Debardeleben, S. Petruzza, S. Kumar: Volume Encoding Gaussians: "
        "Transfer Function-Agnostic 3D Gaussians for Volume Rendering. arXiv:2504.13339, 2025"
    ),
    version="3",
    implementation="econgs_bench.methods.veg.method:Veg",
    source=built_in("veg", "ivr_gs", "formats", "gaussian_splatting"),
    joint=True,
    composable=True,
    edits=frozenset({"palette", "opacity", "light", "shading", "transfer"}),
    needs_volume=True,
    volume_scenes=frozenset({"transfer"}),
    uses_alpha="views are composited on the training background; alpha is also a target of its own",
    options=VegOptions,
    presets={"quick": splatting.QUICK},
    iterations={"quick": 1_600, "standard": 9_300, "paper": 40_000},
    rate_knobs=(RateKnob("codebook size", (4, 16, 64, 256, 1024), refit=False),),
    configurations={"fair": Configuration(), "paper": Configuration(PUBLISHED)},
    tunable=(
        *splatting.TUNABLE,
        "position_lr",
        "opacity_lr",
        "scalar_lr",
        "shading_lr",
        "growth_gradient",
    ),
)
