"""iVR-GS: spec and options."""

from dataclasses import dataclass, replace
from typing import Literal

from econgs_bench.methods.gaussian_splatting.spec import PUBLISHED as PLAIN_PUBLISHED
from econgs_bench.methods.gaussian_splatting.spec import QUICK, GaussianOptions
from econgs_bench.methods.gaussian_splatting.spec import SPEC as PLAIN
from econgs_bench.methods.gaussian_splatting.spec import TUNED as PLAIN_TUNED
from econgs_bench.methods.interface import Configuration, OptionValue, RateKnob, built_in, option
from econgs_bench.methods.shared import splatting
from econgs_bench.methods.shared.schedule import Decay

PUBLISHED: dict[str, OptionValue] = {
    **PLAIN_PUBLISHED,
    "background": "white",
    "offset_color": "sigmoid",
    "shading_start": 0.0,
    "specular_start": 2.5,
    "growth_gradient": 2e-4,
    "reset_interval": 0,
    "mask_weight": 0.1,
    "positions": "float16",
}
"""How the released code starts."""
TUNED = {name: PLAIN_TUNED[name] for name in ("start_spacing", "growth_gradient")}
"""What suits it of the settings of 3DGS in the preset quick (docs/results/parts.md)."""


@dataclass(frozen=True)
class IvrOptions(GaussianOptions):
    """Options of 3DGS, and those of shading and storage."""

    dense_fraction: float = option(
        0.001, "largest scale, as a fraction of the extent, that is cloned and not split", minimum=0.0
    )
    normal_gradient: float = option(
        4e-6, "mean gradient of normals from which a Gaussian is cloned or split, first stage", minimum=0.0
    )
    shaded_normal_gradient: float = option(2e-4, "the same in the second stage", minimum=0.0)
    shaded_growth: bool = option(True, "Gaussians also grow at the beginning of the second stage")
    offset_color: Literal["sigmoid", "tanh"] = option(
        "sigmoid", "activation of offset colors; sigmoid (published) only brightens the palette color"
    )
    shading_start: float = option(
        0.5, "first value of the ambient and diffuse coefficients; 0 as published", minimum=0.0, maximum=1.0
    )
    specular_start: float = option(
        0.5,
        "first value of the specular coefficient, of 0 to 5; 2.5 as published",
        minimum=1e-3,
        maximum=4.999,
    )
    decay: Decay = option(
        "exponential",
        "how learning rates with a last value go there from the first: that of positions in the first stage",
    )
    shading_lr: float = option(0.01, "learning rate of all attributes of shading", minimum=0.0, maximum=1.0)
    # Losses
    alpha_weight: float = option(
        0.0,
        "weight of the mean absolute error of alpha, where training views are transparent anywhere",
        minimum=0.0,
        search=(0.0, 0.8),
    )
    mask_weight: float = option(0.1, "weight of the published loss of alpha, 0.2 (1 - SSIM)", minimum=0.0)
    normal_weight: float = option(0.01, "weight of normals against those of the depth map", minimum=0.0)
    offset_weight: float = option(0.01, "weight of the mean square of offset colors", minimum=0.0)
    smoothness_weight: float = option(0.01, "weight of the smoothness of each coefficient", minimum=0.0)
    opacity_weight: float = option(0.001, "weight of the mean opacity of visible Gaussians", minimum=0.0)
    # Storage
    codebook_size: int = option(256, "words of each codebook", minimum=2, maximum=65536)
    quantised: str = option("all", "attributes with codebooks: all, none, or names joined by +")
    positions: Literal["float16", "coded"] = option(
        "coded", "stored form of positions: cells of a fine grid, as those of ECoNGS; float16 (published)"
    )


SPEC = replace(
    PLAIN,
    name="ivr-gs",
    title="iVR-GS: inverse volume rendering by editable Gaussian splatting",
    reference=(
        "K. Tang, S. Yao, C. Wang: iVR-GS: Inverse Volume Rendering for Explorable Visualization via "
        "Editable 3D Gaussian Splatting. IEEE Transactions on Visualization and Computer Graphics 31(6), 2025"
    ),
    version="9",
    implementation="econgs_bench.methods.ivr_gs.method:IvrGs",
    source=built_in("ivr_gs", "formats", "gaussian_splatting"),
    edits=frozenset({"palette", "opacity", "light", "shading"}),
    uses_alpha=(
        "views are composited on the training background; alpha is also a target of its own, as a mask; the "
        "palette color is the mean color weighted by alpha"
    ),
    options=IvrOptions,
    # The mask is its loss of alpha.
    presets={**PLAIN.presets, "quick": {**QUICK, **TUNED, "alpha_weight": 0.0}},
    iterations={"quick": 1_600, "standard": 9_300, "paper": 40_000},
    rate_knobs=(RateKnob("codebook size", (4, 16, 64, 256, 1024), refit=False),),
    configurations={"fair": Configuration(), "paper": Configuration(PUBLISHED)},
    tunable=(
        *splatting.TUNABLE,
        "position_lr",
        "opacity_lr",
        "growth_gradient",
        "shading_lr",
        "normal_weight",
    ),
)
