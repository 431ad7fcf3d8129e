"""3D Gaussian splatting: spec and options."""

from dataclasses import dataclass
from typing import Literal

from econgs_bench.methods.interface import Configuration, MethodSpec, OptionValue, built_in, option
from econgs_bench.methods.shared import splatting

PUBLISHED: dict[str, OptionValue] = {
    **splatting.PUBLISHED,
    "start": "random",
    "start_opacity": 0.1,
    "position_lr": 1.6e-4,
    "opacity_lr": 5e-2,
    "sh_rest_lr": 1.25e-4,
    "last_lr_share": 1.0,
}
"""How the released code starts on scenes without a cloud of their own, and its rates at every preset."""
QUICK: dict[str, OptionValue] = {**splatting.QUICK, "sh_rest_lr": 1e-3}
"""In so short a schedule; methods with options of 3DGS begin with these."""
TUNED: dict[str, OptionValue] = {
    "start_spacing": 0.2,
    "alpha_weight": 0.36,
    "position_lr": 3e-4,
    "opacity_lr": 0.04,
    "sh_rest_lr": 8.5e-4,
    "growth_gradient": 3e-4,
}
"""What `bench tune` found for the preset quick (docs/results/parts.md)."""


@dataclass(frozen=True)
class HarmonicsOptions(splatting.SplattingOptions):
    """Options of Gaussians with spherical harmonics, whatever decides on their number."""

    start: Literal["cloud", "random"] = option("cloud", "where the first Gaussians come from")
    random_points: int = option(100_000, "number of points of a random start", minimum=1, maximum=10_000_000)
    random_half_extent: float = option(
        1.3, "half side of the cube of a random start, scene units", minimum=1e-3, maximum=100.0
    )
    start_opacity: float = option(0.1, "first opacity of Gaussians", minimum=0.005, maximum=0.999)
    background: Literal["scene", "white", "black", "random"] = option(
        "scene", "what training views are composited on: the scene's own, or another"
    )
    sh_degree: int = option(3, "final degree of the spherical harmonics", minimum=0, maximum=3)
    ssim_weight: float = option(0.2, "weight of 1 - SSIM against L1 in the loss", minimum=0.0, maximum=1.0)
    position_lr: float = option(
        1.6e-4, "first learning rate of positions, x extent", minimum=0.0, maximum=1.0
    )
    opacity_lr: float = option(5e-2, "learning rate of opacity logits", minimum=0.0, maximum=1.0)
    sh_rest_lr: float = option(
        1.25e-4,
        "learning rate of SH coefficients above DC; the published one is too slow for short schedules",
        minimum=0.0,
        maximum=1.0,
    )
    last_lr_share: float = option(
        1.0,
        "last learning rate of all but positions as a share of the first, from the end of growth on; "
        "1 = constant (published)",
        minimum=1e-4,
        maximum=1.0,
        search=(0.01, 1.0),
    )


@dataclass(frozen=True)
class GaussianOptions(HarmonicsOptions):
    """Options of 3DGS, and the first of the methods that begin like it."""

    growth_gradient: float = option(
        2e-4, "mean screen-space gradient (NDC) from which a Gaussian is cloned or split", minimum=0.0
    )
    dense_fraction: float = option(
        0.01, "largest scale, as a fraction of the extent, that is cloned and not split", minimum=0.0
    )
    prune_opacity: float = option(0.005, "opacity under which a Gaussian is pruned", minimum=0.0, maximum=1.0)
    opacity_reset: bool = option(True, "reset opacities to 0.01 periodically while growing")
    reset_interval: int = option(
        0,
        "least iterations before the first reset and between two; 0 = a share of the budget (published)",
        minimum=0,
        search=(0, 1_000),
    )
    max_gaussians: int = option(
        0, "growth stops at this number (reported as a stage); 0 = no limit", minimum=0
    )


SPEC = MethodSpec(
    name="3dgs",
    title="3D Gaussian splatting",
    reference=(
        "B. Kerbl, G. Kopanas, T. Leimkühler, G. Drettakis: 3D Gaussian Splatting for Real-Time Radiance "
        "Field Rendering. ACM Transactions on Graphics 42(4), 2023"
    ),
    version="7",
    implementation="econgs_bench.methods.gaussian_splatting.method:GaussianSplatting",
    source=built_in("gaussian_splatting"),
    composable=True,
    edits=frozenset({"opacity"}),
    uses_alpha="views are composited on the training background; alpha is also a target of its own",
    options=GaussianOptions,
    presets={"quick": {**QUICK, **TUNED}, "standard": {"sh_rest_lr": 5e-4}},
    iterations={"quick": 1_200, "standard": 7_000, "paper": 30_000},
    configurations={
        "fair": Configuration(),
        "paper": Configuration({**PUBLISHED, "growth_gradient": 2e-4, "reset_interval": 0}),
    },
    tunable=(
        *splatting.TUNABLE,
        "sh_degree",
        "position_lr",
        "opacity_lr",
        "sh_rest_lr",
        "growth_gradient",
    ),
)
