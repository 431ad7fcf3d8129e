"""3DGS-MCMC: spec and options."""

from dataclasses import dataclass, replace

from econgs_bench.methods.gaussian_splatting.spec import PUBLISHED as PLAIN_PUBLISHED
from econgs_bench.methods.gaussian_splatting.spec import QUICK, HarmonicsOptions
from econgs_bench.methods.gaussian_splatting.spec import SPEC as PLAIN
from econgs_bench.methods.gaussian_splatting.spec import TUNED as PLAIN_TUNED
from econgs_bench.methods.interface import (
    Configuration,
    OptionValue,
    RateKnob,
    built_in,
    option,
    with_default,
)
from econgs_bench.methods.shared import splatting

PUBLISHED: dict[str, OptionValue] = {**PLAIN_PUBLISHED, "start_opacity": 0.5, "cap": 300_000}
"""How the released code starts; its caps are what 3DGS ends with, 150,000 to 350,000 on synthetic scenes."""
TUNED = {name: PLAIN_TUNED[name] for name in ("alpha_weight", "position_lr", "opacity_lr", "sh_rest_lr")}
"""What suits it of the settings of 3DGS in the preset quick (docs/results/parts.md)."""


@dataclass(frozen=True)
class McmcOptions(HarmonicsOptions):
    """Options of Gaussians with spherical harmonics, and those of the chain."""

    start_scale: float = option(
        1.0, "first scales of Gaussians, x what is published", minimum=0.01, maximum=10.0
    )
    cap: int = option(60_000, "most Gaussians", minimum=1, maximum=100_000_000)
    start_opacity: float = with_default(HarmonicsOptions, "start_opacity", 0.5)
    dead_opacity: float = option(
        0.005,
        "opacity up to which a Gaussian is dead: it is moved, and noise moves it fully",
        minimum=1e-6,
        maximum=0.5,
    )
    opacity_weight: float = option(0.01, "weight of the mean opacity in the loss", minimum=0.0)
    scale_weight: float = option(
        0.01, "weight of the mean scale in the loss, in units of scenes of the published extent", minimum=0.0
    )
    noise_rate: float = option(
        5e5,
        "noise of positions, x their learning rate, in units of scenes of the published extent",
        minimum=0.0,
    )


SPEC = replace(
    PLAIN,
    name="3dgs-mcmc",
    title="3D Gaussian splatting as Markov chain Monte Carlo",
    reference=(
        "S. Kheradmand, D. Rebain, G. Sharma, W. Sun, J. Tseng, H. Isack, A. Kar, A. Tagliasacchi, K. M. Yi: "
        "3D Gaussian Splatting as Markov Chain Monte Carlo. NeurIPS 2024"
    ),
    version="3",
    implementation="econgs_bench.methods.gaussian_mcmc.method:GaussianMcmc",
    source=built_in("gaussian_mcmc", "gaussian_splatting"),
    options=McmcOptions,
    presets={
        "quick": {**QUICK, **TUNED, "cap": 20_000},
        "standard": {**PLAIN.presets["standard"], "cap": 40_000},
    },
    rate_knobs=(RateKnob("cap", (2_000, 5_000, 10_000, 20_000, 50_000), refit=True),),
    configurations={"fair": Configuration(), "paper": Configuration(PUBLISHED)},
    tunable=(
        *splatting.TUNABLE,
        "sh_degree",
        "position_lr",
        "sh_rest_lr",
        "opacity_weight",
        "scale_weight",
    ),
)
