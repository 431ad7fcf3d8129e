"""Scaffold-GS: spec and options."""

from dataclasses import dataclass
from typing import Literal

from econgs_bench.methods.interface import Configuration, MethodSpec, OptionValue, built_in, option
from econgs_bench.methods.shared import splatting


@dataclass(frozen=True)
class AnchorOptions(splatting.SplattingOptions):
    """Options that Scaffold-GS, HAC and HAC++ have in common."""

    # Start
    start: Literal["cloud", "random"] = option("cloud", "where the first anchors come from")
    random_points: int = option(10_000, "number of points of a random start", minimum=1, maximum=10_000_000)
    random_half_extent: float = option(
        1.3, "half side of the cube of a random start, scene units", minimum=1e-3, maximum=100.0
    )
    background: Literal["scene", "white", "black", "random"] = option(
        "scene", "what training views are composited on: the scene's own, or another"
    )
    # Representation
    features: int = option(32, "values of an anchor's feature", minimum=4, maximum=256)
    hidden: int = option(
        0,
        "hidden units of each decoder; 0 = as many as `features` (published)",
        minimum=0,
        maximum=256,
        search=(0, 64),
    )
    offsets: int = option(10, "Gaussians of an anchor (K)", minimum=1, maximum=64)
    start_opacity: float = option(
        0.0,
        "first opacity of all Gaussians of an anchor; 0 = as the network draws it, some hidden (published)",
        minimum=0.0,
        maximum=0.9,
    )
    voxel: float = option(
        0.001,
        "lattice of anchors, scene units; 0 = median distance to the nearest point",
        minimum=0.0,
        maximum=0.1,
    )
    init_factor: int = option(16, "coarsest growth cell, in lattice cells", minimum=1, maximum=4096)
    growth_levels: int = option(
        3, "number of growth cell sizes, each a quarter of the one before", minimum=1, maximum=3
    )
    growth_gradient: float = option(
        2e-4, "mean screen-space gradient (NDC) from which an offset grows an anchor", minimum=0.0
    )
    max_anchors: int = option(200_000, "growth stops at this number; 0 = no limit", minimum=0)
    # Learning rates
    feature_lr: float = option(
        7.5e-3, "first learning rate of features (published: 0.0075)", minimum=0.0, maximum=1.0
    )
    last_lr_share: float = option(
        1.0,
        "last learning rate of features, scalings and the covariance decoder as a share of the first; "
        "1 = constant (published)",
        minimum=1e-4,
        maximum=1.0,
        search=(0.01, 1.0),
    )
    # Losses
    ssim_weight: float = option(0.2, "weight of 1 - SSIM against L1", minimum=0.0, maximum=1.0)
    scale_weight: float = option(0.01, "weight of the mean product of scales of drawn Gaussians", minimum=0.0)


@dataclass(frozen=True)
class ScaffoldOptions(AnchorOptions):
    """Options of Scaffold-GS."""

    storage: Literal["read", "released"] = option(
        "read", "columns of the stored file: those that a reader needs; all that the released code writes"
    )


PUBLISHED: dict[str, OptionValue] = {
    **splatting.PUBLISHED,
    "start": "random",
    "background": "white",
    "max_anchors": 0,
    "hidden": 0,
    "offsets": 10,
    "start_opacity": 0.0,
    "growth_gradient": 2e-4,
    "feature_lr": 7.5e-3,
    "last_lr_share": 1.0,
    "scale_weight": 0.01,
}
"""How the released code starts on scenes without a cloud of their own, and its settings at every preset."""
TUNED: dict[str, OptionValue] = {
    "start_spacing": 3.0,
    "alpha_weight": 0.35,
    "prune_loss_db": 0.1,
    "offsets": 3,
    "growth_gradient": 5e-4,
    "scale_weight": 0.035,
}
"""What `bench tune` found for the preset quick (docs/results/parts.md)."""

SPEC = MethodSpec(
    name="scaffold-gs",
    title="Scaffold-GS",
    reference=(
        "T. Lu, M. Yu, L. Xu, Y. Xiangli, L. Wang, D. Lin, B. Dai: Scaffold-GS: Structured 3D Gaussians for "
        "View-Adaptive Rendering. CVPR 2024"
    ),
    version="7",
    implementation="econgs_bench.methods.scaffold_gs.method:ScaffoldGS",
    source=built_in("scaffold_gs", "gaussian_splatting"),
    composable=True,
    edits=frozenset({"opacity"}),
    uses_alpha="views are composited on the training background; alpha is also a target of its own",
    options=ScaffoldOptions,
    presets={"quick": {**splatting.QUICK, **TUNED, "start_opacity": 0.05}},
    iterations={"quick": 1_600, "standard": 8_000, "paper": 30_000},
    configurations={"fair": Configuration(), "paper": Configuration({**PUBLISHED, "storage": "released"})},
    tunable=(
        *splatting.TUNABLE,
        "features",
        "offsets",
        "growth_gradient",
        "ssim_weight",
        "scale_weight",
    ),
)
