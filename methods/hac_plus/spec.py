"""HAC++: spec and options."""

from dataclasses import dataclass, replace

from econgs_bench.methods.hac.spec import PUBLISHED, HacOptions
from econgs_bench.methods.hac.spec import SPEC as PLAIN
from econgs_bench.methods.interface import Configuration, built_in, option, with_default
from econgs_bench.methods.shared import splatting


@dataclass(frozen=True)
class HacPlusOptions(HacOptions):
    """Options of HAC, and those of contexts within an anchor."""

    mask_weight: float = option(
        0.0,
        "weight of the mean mask of the offsets, beside the rate (published: none)",
        minimum=0.0,
        maximum=1.0,
    )
    # A narrow model loses 0.7 dB on one scene of the search.
    context_hidden: int = with_default(HacOptions, "context_hidden", 100)
    chunk: int = option(
        10, "channels of a chunk of features, predicted from all chunks before it", minimum=1, maximum=256
    )


SPEC = replace(
    PLAIN,
    name="hac-plus",
    title="HAC++",
    reference=(
        "Y. Chen, Q. Wu, W. Lin, M. Harandi, J. Cai: HAC++: Towards 100X Compression of 3D Gaussian "
        "Splatting. IEEE Transactions on Pattern Analysis and Machine Intelligence, 2025"
    ),
    version="4",
    implementation="econgs_bench.methods.hac_plus.method:HacPlus",
    source=built_in("hac_plus", "hac", "scaffold_gs", "gaussian_splatting"),
    options=HacPlusOptions,
    presets={**PLAIN.presets, "quick": {**PLAIN.presets["quick"], "offsets": 5}},
    configurations={
        "fair": Configuration(),
        "paper": Configuration({**PUBLISHED, "rate_weight": 1e-3}),
    },
    tunable=(
        *splatting.TUNABLE,
        "features",
        "offsets",
        "growth_gradient",
        "mask_lr",
        "feature_step",
    ),
)
