"""vq-3dgs: spec and options."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

from econgs_bench.methods.gaussian_splatting.spec import SPEC as PLAIN
from econgs_bench.methods.gaussian_splatting.spec import GaussianOptions
from econgs_bench.methods.interface import Configuration, RateKnob, built_in, option
from econgs_bench.methods.shared import splatting

Size = Literal[16, 64, 256, 1024]
SIZES: tuple[int, ...] = get_args(Size)
"""Codebook sizes of the rate curve."""


@dataclass(frozen=True)
class VqOptions(GaussianOptions):
    """Options of 3DGS, and those of its codebooks."""

    codebook_size: Size = option(256, "words of each codebook")
    stages: int = option(2, "residual codebooks per group of attributes", minimum=1, maximum=8)
    tuning: float = option(0.2, "share of the budget that fine-tunes codebooks", minimum=0.0, maximum=0.9)
    tuning_lr: float = option(
        1.0, "learning rates of words, as a share of those of 3DGS", minimum=0.0, maximum=10.0
    )
    positions: Literal["float16", "coded"] = option(
        "coded", "stored form of positions: cells of a fine grid, as those of ECoNGS; float16 (published)"
    )


SPEC = replace(
    PLAIN,
    name="vq-3dgs",
    title="3D Gaussian splatting, vector-quantised",
    reference=(
        f"{PLAIN.reference}; quantised by products of residual codebooks with fine-tuning, as a line of work "
        "since K. Navaneet, K. Meibodi, S. Koohpayegani, H. Pirsiavash (Compact3D, ECCV 2024) does"
    ),
    version="7",
    implementation="econgs_bench.methods.vq_3dgs.method:VectorQuantised",
    source=built_in("vq_3dgs", "formats", "gaussian_splatting"),
    options=VqOptions,
    rate_knobs=(RateKnob("codebook_size", SIZES, refit=True),),
    configurations={
        "fair": Configuration(),
        "paper": Configuration({**PLAIN.configurations["paper"].options, "positions": "float16"}),
    },
    tunable=(
        *splatting.TUNABLE,
        "sh_degree",
        "position_lr",
        "sh_rest_lr",
        "growth_gradient",
        "stages",
    ),
)
