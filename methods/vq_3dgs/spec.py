"""vq-3dgs: what it can do and how it is set."""

from dataclasses import replace

from methods.gaussian_splatting.spec import SPEC as PLAIN
from methods.interface import Option, RateKnob

SIZES = (16, 64, 256, 1024)
"""Codebook sizes that one fit prepares."""

SPEC = replace(
    PLAIN,
    name="vq-3dgs",
    title="3D Gaussian splatting, vector-quantised",
    reference=(
        f"{PLAIN.reference}; quantised by products of residual codebooks with fine-tuning, as a line of work "
        "since K. Navaneet, K. Meibodi, S. Koohpayegani, H. Pirsiavash (Compact3D, ECCV 2024) does"
    ),
    version="1",
    implementation="methods.vq_3dgs.method:VectorQuantised",
    source=(
        "methods.vq_3dgs",
        "methods.gaussian_splatting",
        "econgs.codebooks",
        "econgs.context.coder",
        *PLAIN.source[1:],
    ),
    options={
        **PLAIN.options,
        "codebook_size": Option(256, "words of each codebook, where no rate is asked for", choices=SIZES),
        "stages": Option(2, "residual codebooks per group of attributes", minimum=1, maximum=8),
        "tuning": Option(
            0.2,
            "share of the budget that fine-tunes codebooks, all sizes in turn",
            minimum=0.0,
            maximum=0.9,
        ),
        "tuning_lr": Option(
            1.0, "learning rates of words, as a share of those of 3DGS", minimum=0.0, maximum=10.0
        ),
    },
    rate_knobs=(RateKnob("codebook size", SIZES, refit=False),),
)
