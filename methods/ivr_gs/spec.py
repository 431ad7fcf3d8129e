"""iVR-GS: what it can do and how it is set."""

from dataclasses import replace

from methods.gaussian_splatting.spec import PUBLISHED as PLAIN_PUBLISHED
from methods.gaussian_splatting.spec import SPEC as PLAIN
from methods.interface import Configuration, Option, OptionValue, RateKnob

PUBLISHED: dict[str, OptionValue] = {**PLAIN_PUBLISHED, "background": "white", "shading_start": 0.0}
"""How the released code starts."""

SPEC = replace(
    PLAIN,
    name="ivr-gs",
    title="iVR-GS: inverse volume rendering by editable Gaussian splatting",
    reference=(
        "K. Tang, S. Yao, C. Wang: iVR-GS: Inverse Volume Rendering for Explorable Visualization via "
        "Editable 3D Gaussian Splatting. IEEE Transactions on Visualization and Computer Graphics 31(6), 2025"
    ),
    version="1",
    implementation="methods.ivr_gs.method:IvrGs",
    source=(
        "methods.ivr_gs",
        "methods.gaussian_splatting",
        "econgs.codebooks",
        "econgs.anchors.shading",
        *PLAIN.source[1:],
    ),
    edits=frozenset({"palette", "opacity", "light", "shading"}),
    uses_alpha=(
        "views are composited on the training background; alpha is also a target of its own, by SSIM; the "
        "palette color is the mean color weighted by alpha"
    ),
    options={
        **PLAIN.options,
        "dense_fraction": replace(PLAIN.options["dense_fraction"], default=0.001),
        "normal_gradient": Option(
            4e-6,
            "mean gradient of normals from which a Gaussian is cloned or split, first stage",
            minimum=0.0,
        ),
        "shaded_normal_gradient": Option(2e-4, "the same in the second stage", minimum=0.0),
        "shaded_growth": Option(True, "Gaussians also grow at the beginning of the second stage"),
        "shading_start": Option(
            0.5,
            "first value of the ambient and diffuse coefficients; 0 as published",
            minimum=0.0,
            maximum=1.0,
        ),
        "shading_lr": Option(0.01, "learning rate of all attributes of shading", minimum=0.0, maximum=1.0),
        # Losses
        "alpha_weight": Option(0.1, "weight of the alpha mask's loss", minimum=0.0),
        "normal_weight": Option(0.01, "weight of normals against those of the depth map", minimum=0.0),
        "offset_weight": Option(0.01, "weight of the mean square of offset colors", minimum=0.0),
        "smoothness_weight": Option(0.01, "weight of the smoothness of each coefficient", minimum=0.0),
        "opacity_weight": Option(0.001, "weight of the mean opacity of visible Gaussians", minimum=0.0),
        # Storage
        "codebook_size": Option(256, "words of each codebook", minimum=2, maximum=65536),
        "quantised": Option("all", "attributes with codebooks: all, none, or names joined by +"),
    },
    iterations={"quick": 1_600, "standard": 9_300, "paper": 40_000},
    rate_knobs=(RateKnob("codebook size", (4, 16, 64, 256, 1024), refit=False),),
    configurations={"fair": Configuration(), "paper": Configuration(PUBLISHED)},
)
