"""CCNeRF-CP: spec and options."""

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

GROUPS = 5
"""Published number of groups of color ranks."""
PUBLISHED: dict[str, OptionValue] = {
    "start": "box",
    "background": "white",
    "visible": 1e-4,
    "search": "twice",
    "first": 0.2,
    "factor_lr": 0.02,
    "harmonics_lr": 1e-3,
    "decay": "restarted",
    "alpha_weight": 0.0,
}


@dataclass(frozen=True)
class CpOptions:
    """Options of CCNeRF-CP."""

    density_ranks: int = option(96, "ranks of the density", minimum=1, maximum=1024)
    ranks: int = option(96, "color ranks of each group", minimum=1, maximum=1024)
    groups: int = option(GROUPS, "groups of color ranks; each refines those before", minimum=1, maximum=16)
    first_side: int = option(128, "first rows of a line, of a box that is a cube", minimum=4, maximum=1024)
    side: int = option(300, "final rows of a line, of a box that is a cube", minimum=4, maximum=1024)
    first: float = option(0.4, "standard deviation of the first factors", minimum=1e-3, maximum=10.0)
    start: Literal["cloud", "box"] = option("cloud", "first box: around the initial cloud, or a fixed cube")
    half_extent: float = option(
        1.5, "half side of a fixed first box, scene units", minimum=1e-3, maximum=100.0
    )
    background: Literal["scene", "white", "black", "random"] = option(
        "scene", "what training views are composited on: the scene's own, or another"
    )
    rays: int = option(4096, "rays of an iteration", minimum=1, maximum=1_000_000)
    step: float = option(0.5, "distance of samples, in cells", minimum=0.05, maximum=4.0)
    weight_threshold: float = option(
        1e-4, "weight in a pixel up to which a sample has no color", minimum=0.0, maximum=0.1
    )
    visible: float = option(
        3e-3, "opacity of a sample from which a cell is not empty", minimum=0.0, maximum=0.5
    )
    search: Literal["always", "twice"] = option(
        "always",
        "empty cells are looked for, and the box shrinks, whenever lines grow; or the first and third time, "
        "and it shrinks the first time alone (published)",
    )
    factor_lr: float = option(0.05, "first learning rate of factors", minimum=0.0, maximum=1.0)
    harmonics_lr: float = option(
        1e-2, "first learning rate of the SH coefficients of ranks", minimum=0.0, maximum=1.0
    )
    decay: Literal["through", "restarted"] = option(
        "through",
        "learning rates start again when lines grow, and fall to a tenth by the end, or at the pace at which "
        "they would over the whole budget (published)",
    )
    sparsity: float = option(1e-5, "weight of the mean magnitude of density factors", minimum=0.0)
    alpha_weight: float = option(
        0.05, "weight of the mean squared error of alpha, where training views are transparent", minimum=0.0
    )


SPEC = MethodSpec(
    name="ccnerf",
    title="CCNeRF-CP",
    reference=(
        "J. Tang, X. Chen, J. Wang, G. Zeng: Compressible-composable NeRF via Rank-residual Decomposition. "
        "NeurIPS 2022"
    ),
    version="1",
    implementation="econgs_bench.methods.ccnerf.method:CcNerf",
    source=built_in("ccnerf"),
    composable=True,
    point_sampled=True,
    edits=frozenset({"opacity"}),
    uses_alpha="views are composited on the training background; alpha is also a target of its own",
    options=CpOptions,
    presets={
        "quick": {"first_side": 64, "side": 128, "rays": 1024},
        "standard": {"first_side": 96, "side": 160, "rays": 2048},
    },
    iterations={"quick": 1_500, "standard": 7_500, "paper": 30_000},
    rate_knobs=(RateKnob("rank groups", tuple(float(k + 1) for k in range(GROUPS)), refit=False),),
    configurations={"fair": Configuration(), "paper": Configuration(PUBLISHED)},
    tunable=(
        "density_ranks",
        "ranks",
        "side",
        "first",
        "factor_lr",
        "harmonics_lr",
        "sparsity",
        "alpha_weight",
    ),
)
