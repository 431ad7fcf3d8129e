"""Plenoxels: spec and options."""

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

DEFLATE = "deflate"
PUBLISHED: dict[str, OptionValue] = {
    "start": "box",
    "background": "white",
    "density_lr": 30.0,
    "sh_lr": 1e-2,
    "tv_density": 1e-5,
    "tv_sh": 1e-3,
    "tv_stage": "coarse",
    "alpha_weight": 0.0,
}


@dataclass(frozen=True)
class PlenoxelsOptions:
    """Options of Plenoxels."""

    resolution: int = option(
        128,
        "vertices along the longest side of the final grid; the first has half as many",
        minimum=8,
        maximum=1024,
    )
    start: Literal["hull", "box"] = option(
        "hull", "first voxels: where no training view is empty, or everywhere in the box of that"
    )
    background: Literal["scene", "white"] = option("scene", "what training views are composited on")
    rays: int = option(5_000, "rays per iteration", minimum=1, maximum=1_000_000)
    density_lr: float = option(
        5.0, "first learning rate of densities; the published one is too coarse for faint matter", minimum=0.0
    )
    sh_lr: float = option(
        3e-2,
        "first learning rate of SH coefficients; the published one is too slow for short schedules",
        minimum=0.0,
    )
    tv_density: float = option(1e-4, "weight of the total variation of densities", minimum=0.0)
    tv_sh: float = option(1e-2, "weight of the total variation of SH coefficients", minimum=0.0)
    tv_stage: Literal["coarse", "both"] = option("both", "stages in which total variation counts")
    prune_weight: float = option(
        0.256,
        "voxels that never have more than this, / vertices along the longest side, in a pixel are pruned",
        minimum=0.0,
    )
    alpha_weight: float = option(
        0.2, "weight of the mean squared error of alpha, where training views are transparent", minimum=0.0
    )


SPEC = MethodSpec(
    name="plenoxels",
    title="Plenoxels",
    reference=(
        "S. Fridovich-Keil, A. Yu, M. Tancik, Q. Chen, B. Recht, A. Kanazawa: Plenoxels: Radiance Fields "
        "without Neural Networks. CVPR 2022"
    ),
    version="1",
    implementation="econgs_bench.methods.plenoxels.method:Plenoxels",
    source=built_in("plenoxels"),
    composable=True,
    point_sampled=True,
    edits=frozenset({"opacity"}),
    uses_alpha="it bounds the first voxels; views are composited on the background; alpha is a target too",
    options=PlenoxelsOptions,
    presets={"quick": {"resolution": 96}, "standard": {}, "paper": {"resolution": 512}},
    iterations={"quick": 1_200, "standard": 6_000, "paper": 128_000},
    rate_knobs=(RateKnob(DEFLATE, (0.0, 9.0), refit=False),),
    configurations={"fair": Configuration(), "paper": Configuration(PUBLISHED)},
    tunable=(
        "resolution",
        "density_lr",
        "sh_lr",
        "tv_density",
        "tv_sh",
        "tv_stage",
        "prune_weight",
        "alpha_weight",
    ),
)
