"""HAC: spec and options."""

from dataclasses import dataclass, replace
from typing import Literal

from econgs_bench.methods.interface import (
    Configuration,
    OptionValue,
    RateKnob,
    built_in,
    option,
    with_default,
)
from econgs_bench.methods.scaffold_gs.spec import PUBLISHED as PLAIN_PUBLISHED
from econgs_bench.methods.scaffold_gs.spec import SPEC as PLAIN
from econgs_bench.methods.scaffold_gs.spec import AnchorOptions
from econgs_bench.methods.shared import splatting


@dataclass(frozen=True)
class HacOptions(AnchorOptions):
    """Options of Scaffold-GS, and those of quantisation and coding."""

    features: int = with_default(AnchorOptions, "features", 50)
    rate_weight: float = option(1e-3, "weight of the estimated bits (lambda)", minimum=0.0, maximum=1.0)
    mask_weight: float = option(5e-4, "weight of the mean mask of the offsets", minimum=0.0, maximum=1.0)
    mask_lr: float = option(
        2.3e-3,
        "first learning rate of masks, times the extent of the scene (published: 0.01)",
        minimum=0.0,
        maximum=1.0,
    )
    grid: Literal["small", "hac"] = option("hac", "size of the binary hash grids")
    context_start: float = option(
        1 / 3,
        "share of the budget after which the context model begins (published: a third)",
        minimum=0.1,
        maximum=0.9,
    )
    context_hidden: int = option(
        0,
        "hidden units of the context model (published: 100); 0: one per 100 first anchors, 4 to 50",
        minimum=0,
        maximum=256,
        search=(0, 100),
    )
    feature_step: float = option(0.4, "quantisation step Q of features (published: 1)", minimum=1e-6)
    scaling_step: float = option(0.001, "quantisation step Q of scalings", minimum=1e-8)
    offset_step: float = option(0.2, "quantisation step Q of offsets", minimum=1e-6)
    decoder_precision: Literal["float32", "float16", "int8"] = option(
        "int8", "precision of stored decoder weights"
    )


PUBLISHED: dict[str, OptionValue] = {
    **PLAIN_PUBLISHED,
    "mask_lr": 1e-2,
    "context_start": 1 / 3,
    "context_hidden": 100,
    "feature_step": 1.0,
    "decoder_precision": "float32",
}
"""As for Scaffold-GS, and the released settings of coding."""

SPEC = replace(
    PLAIN,
    name="hac",
    title="HAC: hash-grid assisted context",
    reference=(
        "Y. Chen, Q. Wu, W. Lin, M. Harandi, J. Cai: HAC: Hash-grid Assisted Context for 3D Gaussian "
        "Splatting Compression. ECCV 2024"
    ),
    version="7",
    implementation="econgs_bench.methods.hac.method:Hac",
    source=built_in("hac", "scaffold_gs", "gaussian_splatting"),
    # Masks move as far as in 30,000 iterations, and decide what shows.
    presets={
        "quick": {**PLAIN.presets["quick"], "start_opacity": 0.0, "mask_lr": 0.045},
        "standard": {"mask_lr": 9.1e-3},
    },
    options=HacOptions,
    rate_knobs=(RateKnob("rate_weight", (5e-4, 1e-3, 2e-3, 3e-3, 4e-3), refit=True),),
    configurations={
        "fair": Configuration(),
        "paper": Configuration({**PUBLISHED, "rate_weight": 4e-3}),
    },
    tunable=(
        *splatting.TUNABLE,
        "features",
        "offsets",
        "growth_gradient",
        "mask_weight",
        "feature_step",
    ),
)
