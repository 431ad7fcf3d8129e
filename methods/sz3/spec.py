"""sz3: spec and options."""

from dataclasses import dataclass

from econgs_bench.methods.interface import Configuration, MethodSpec, RateKnob, built_in, option


@dataclass(frozen=True)
class VolumeOptions:
    """Options of the methods that store the volume itself."""

    error_bound: float = option(
        0.01, "greatest error of a value where no rate is asked for, share of the value range", minimum=1e-6
    )


SPEC = MethodSpec(
    name="sz3",
    title="The volume, compressed by SZ3, ray-marched",
    reference=(
        "X. Liang et al.: SZ3: A Modular Framework for Composing Prediction-Based Error-Bounded Lossy "
        "Compressors. IEEE Transactions on Big Data 9(2), 2023"
    ),
    version="1",
    implementation="econgs_bench.methods.volume.method:Sz3Method",
    source=("econgs_bench.datasets", *built_in("volume", "sz3")),
    joint=True,
    composable=True,
    point_sampled=True,
    edits=frozenset({"palette", "opacity", "light", "shading", "transfer"}),
    needs_volume=True,
    uses_alpha="not at all: nothing is learned from views",
    options=VolumeOptions,
    iterations={"quick": 1, "standard": 1, "paper": 1},
    rate_knobs=(RateKnob("error bound", (1e-1, 3e-2, 1e-2, 3e-3, 1e-4), refit=False),),
    configurations={"fair": Configuration(), "paper": Configuration({"error_bound": 1e-3})},
    tunable=("error_bound",),
)
