"""zfp: spec and options."""

from dataclasses import dataclass, replace
from typing import Literal

from econgs_bench.methods.interface import Configuration, RateKnob, built_in, option
from econgs_bench.methods.sz3.spec import SPEC as SZ3
from econgs_bench.methods.sz3.spec import VolumeOptions


@dataclass(frozen=True)
class ZfpOptions(VolumeOptions):
    """Options of SZ3, and the mode of zfp."""

    error_bound: float = option(
        0.125,
        "greatest error of a value where no rate is asked for, share of the value range; most stay far below",
        minimum=1e-6,
    )
    mode: Literal["accuracy", "rate"] = option(
        "accuracy", "accuracy keeps the error bound; rate gives every block of values as many bits"
    )


SPEC = replace(
    SZ3,
    name="zfp",
    title="The volume, compressed by zfp, ray-marched",
    reference=(
        "P. Lindstrom: Fixed-Rate Compressed Floating-Point Arrays. IEEE Transactions on Visualization and "
        "Computer Graphics 20(12), 2014"
    ),
    implementation="econgs_bench.methods.volume.method:ZfpMethod",
    source=("econgs_bench.datasets", *built_in("volume", "zfp", "sz3")),
    options=ZfpOptions,
    rate_knobs=(RateKnob("error bound", (8.0, 1.0, 0.125, 0.015625, 1e-4), refit=False),),
    configurations={"fair": Configuration(), "paper": Configuration({"mode": "rate"})},
    tunable=("error_bound", "mode"),
)
