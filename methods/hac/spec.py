"""HAC: spec and options."""

from dataclasses import dataclass, replace
from typing import Literal

from methods.interface import Configuration, RateKnob, option
from methods.scaffold_gs.spec import PUBLISHED, ScaffoldOptions
from methods.scaffold_gs.spec import SPEC as PLAIN
from methods.shared import splatting


@dataclass(frozen=True)
class HacOptions(ScaffoldOptions):
    """Options of Scaffold-GS, and those of quantisation and coding."""

    features: int = option(
        50, "values of an anchor's feature, and hidden units of each decoder", minimum=4, maximum=256
    )
    rate_weight: float = option(1e-3, "weight of the estimated bits (lambda)", minimum=0.0, maximum=1.0)
    mask_weight: float = option(5e-4, "weight of the mean mask of the offsets", minimum=0.0, maximum=1.0)
    mask_lr: float = option(
        1e-2,
        "first learning rate of masks; the published one is too slow for short schedules",
        minimum=0.0,
        maximum=1.0,
    )
    grid: Literal["small", "hac"] = option("hac", "size of the binary hash grids")
    context_hidden: int = option(100, "hidden units of the context model", minimum=8, maximum=256)
    feature_step: float = option(0.4, "quantisation step Q of features (published: 1)", minimum=1e-6)
    scaling_step: float = option(0.001, "quantisation step Q of scalings", minimum=1e-8)
    offset_step: float = option(0.2, "quantisation step Q of offsets", minimum=1e-6)
    decoder_precision: Literal["float32", "float16", "int8"] = option(
        "int8", "precision of stored decoder weights"
    )


SPEC = replace(
    PLAIN,
    name="hac",
    title="HAC: hash-grid assisted context",
    reference=(
        "Y. Chen, Q. Wu, W. Lin, M. Harandi, J. Cai: HAC: Hash-grid Assisted Context for 3D Gaussian "
        "Splatting Compression. ECCV 2024"
    ),
    version="5",
    implementation="methods.hac.method:Hac",
    # Masks move as far as in 30,000 iterations.
    presets={"quick": {**PLAIN.presets["quick"], "mask_lr": 0.2}, "standard": {"mask_lr": 0.04}},
    options=HacOptions,
    rate_knobs=(RateKnob("rate_weight", (5e-4, 1e-3, 2e-3, 3e-3, 4e-3), refit=True),),
    configurations={
        "fair": Configuration(),
        "paper": Configuration(
            {
                **PUBLISHED,
                "rate_weight": 4e-3,
                "feature_step": 1.0,
                "mask_lr": 1e-2,
                "decoder_precision": "float32",
            },
        ),
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
