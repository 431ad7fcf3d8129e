"""ECoNGS: spec and options."""

from dataclasses import dataclass
from typing import Literal

from econgs_bench.methods.interface import (
    Configuration,
    MethodSpec,
    RateKnob,
    built_in,
    option,
    with_default,
)
from econgs_bench.methods.shared import splatting


@dataclass(frozen=True)
class EcongsOptions(splatting.SplattingOptions):
    """Options of ECoNGS."""

    # Start
    start: Literal["cloud", "positions", "random"] = option(
        "cloud",
        "first anchors: the cloud, palette its mean color; its positions, palette gray; random points",
    )
    cloud_points: int = option(0, "points drawn from the initial cloud; 0 = all", minimum=0)
    random_points: int = option(10_000, "number of points of a random start", minimum=1, maximum=10_000_000)
    start_spacing: float = with_default(splatting.SplattingOptions, "start_spacing", 3.0)
    random_half_extent: float = option(
        0.5, "half side of the cube of a random start, scene units", minimum=1e-3, maximum=100.0
    )
    # Joint learning
    joint: bool = option(True, "learn similar scenes of a dataset together")
    threshold: float = option(0.01, "Chamfer distance up to which clusters of scenes merge", minimum=0.0)
    linkage: Literal["average", "single", "complete"] = option("average", "linkage of the clustering")
    chamfer: Literal["mean", "sum"] = option("mean", "how the two directions of the Chamfer distance combine")
    chamfer_points: int = option(
        512, "points of each cloud that look for their nearest in the others", minimum=1, maximum=10_000_000
    )
    group_budget: float = option(
        1.0,
        "a group of n scenes has n to this power times the iterations of one scene",
        minimum=0.0,
        maximum=1.0,
    )
    minibatch: Literal["view", "scenes"] = option(
        "view", "what a step of the optimiser sees: one view of one scene, or one of every scene of the group"
    )
    group_memory_mb: int = option(
        0, "groups estimated to need more host memory are split (MiB); 0 = what is free", minimum=0
    )
    # Representation
    features: int = option(32, "values of an anchor's feature", minimum=4, maximum=256)
    offsets: int = option(10, "Gaussians of an anchor (K)", minimum=1, maximum=64)
    embedding: int = option(50, "values of a scene's TF embedding", minimum=0, maximum=256)
    hidden: int = option(
        0, "hidden units of each decoder; 0: one per 50 first anchors, 25 to 50", minimum=0, maximum=256
    )
    view_direction: bool = option(False, "decoders see the viewing direction")
    direction_start: float = option(
        0.0,
        "factor on the direction's first weights: 0 starts from colors that are the same from everywhere",
        minimum=0.0,
        maximum=1.0,
    )
    start_opacity: float = option(
        0.0,
        "first opacity of all Gaussians of an anchor; 0 = as the network draws it, some culled",
        minimum=0.0,
        maximum=0.9,
    )
    storage: Literal["hybrid", "implicit", "partial", "explicit"] = option(
        "hybrid",
        "what anchors store: offsets; nothing but the feature; also normals; also all of the shading",
    )
    offset_color: Literal["sigmoid", "tanh"] = option("tanh", "activation of offset colors")
    shading_bias: float = option(
        0.5, "first value of the ambient and diffuse coefficients", minimum=0.0, maximum=1.0
    )
    specular_start: float = option(
        0.5, "first value of the specular coefficient, of 0 to 5", minimum=1e-3, maximum=4.999
    )
    scaling_activation: Literal["exp", "sigmoid"] = option("exp", "activation of an anchor's scalings")
    voxel: float = option(0.001, "lattice of anchors, scene units", minimum=1e-5, maximum=0.1)
    init_factor: int = option(16, "coarsest growth cell, in lattice cells", minimum=16, maximum=4096)
    growth_gradient: float = option(
        3e-4, "mean screen-space gradient (NDC) from which an offset grows an anchor", minimum=0.0
    )
    growth_adapts: bool = option(
        True,
        "that is for views 200 pixels wide and 3,000 iterations a scene; inversely proportional to the "
        "width, and to the root of the iterations",
    )
    growth_stop: float = option(
        0.5, "share of the budget after which nothing grows", minimum=0.0, maximum=1.0
    )
    growth_pauses: bool = option(True, "nothing grows while the quantisation noise is new, as in HAC")
    max_anchors: int = option(200_000, "growth of a scene stops at this number; 0 = no limit", minimum=0)
    # Losses
    ssim_weight: float = option(0.2, "weight of 1 - SSIM against L1", minimum=0.0, maximum=1.0)
    scale_loss: Literal["mean", "sum"] = option(
        "mean", "regulariser of the product of scales over drawn Gaussians"
    )
    scale_weight: float = option(0.01, "its weight (the paper's 0.001 belongs to the sum)", minimum=0.0)
    color_weight: float = option(
        0.01, "weight of offset colors squared, ten times as much beyond black and white", minimum=0.0
    )
    feature_lr: float = option(
        1e-2, "first learning rate of features; the last is a hundredth", minimum=0.0, maximum=1.0
    )
    decoder_rates: Literal["lineage", "stated"] = option(
        "lineage",
        "learning rates of the decoders of opacity and covariance: as in Scaffold-GS; 0.01, as the paper "
        "states for opacity, scaling and rotation",
    )
    last_lr_share: float = option(
        0.01,
        "last learning rate of the covariance decoder as a share of the first, with the rates `lineage`; "
        "1 = constant, as in Scaffold-GS",
        minimum=1e-4,
        maximum=1.0,
        before=1.0,
    )
    palette_lr: float = option(1e-4, "learning rate of palette colors", minimum=0.0, maximum=1.0)
    # Context model
    context: bool = option(True, "second stage with the context model")
    context_start: float = option(0.7, "share of the budget after which it begins", minimum=0.05, maximum=0.9)
    rate_weight: float = option(3e-4, "weight of the estimated bits (lambda_e)", minimum=0.0, maximum=1.0)
    rate_sample: float = option(
        0.05, "share of the visible anchors whose bits count in an iteration", minimum=0.001, maximum=1.0
    )
    rounding: float = option(
        0.05,
        "share of the budget, at its end, that trains on attributes rounded as the coder rounds them, "
        "without noise",
        minimum=0.0,
        maximum=0.5,
    )
    grid: Literal["small", "hac"] = option("small", "size of the binary hash grids")
    context_hidden: int = option(
        0, "hidden units of the context model; 0: one per 100 first anchors, 4 to 50", minimum=0, maximum=256
    )
    feature_step: float = option(0.1, "quantisation step Q of features", minimum=1e-6)
    scaling_step: float = option(0.001, "quantisation step Q of scalings", minimum=1e-8)
    offset_step: float = option(0.2, "quantisation step Q of offsets", minimum=1e-6)
    positions: Literal["coded", "float32"] = option("coded", "stored form of anchor positions")
    decoder_precision: Literal["float32", "float16", "int8"] = option(
        "int8", "precision of stored decoder weights"
    )
    # No more than the scene needs
    fold_embeddings: bool = option(True, "store TF embeddings as biases where a group has few scenes")
    target_bytes: int = option(
        0, "size per scene that lambda_e is steered to, shared parts included; 0 = none", minimum=0
    )
    target_psnr: float = option(
        0.0,
        "PSNR (dB) on validation (else training) views that lambda_e is steered to; 0 = none",
        minimum=0.0,
    )


SPEC = MethodSpec(
    name="econgs",
    title="ECoNGS: efficient compressive neural Gaussian splats",
    reference=(
        "K. Tang, C. Wang: ECoNGS: Efficient Compressive Neural Gaussian Splats for Volume Visualization"
    ),
    version="7",
    implementation="econgs_bench.methods.econgs.method:Econgs",
    source=built_in("econgs"),
    joint=True,
    composable=True,
    edits=frozenset({"palette", "opacity", "light", "shading"}),
    uses_alpha="views are composited on the scene's background; alpha is also a target of its own",
    options=EcongsOptions,
    presets={
        "quick": {**splatting.QUICK, "feature_lr": 2e-2, "start_points": 2_000, "start_opacity": 0.05},
        "paper": {"growth_gradient": 5.5e-4},  # growth_adapts makes it 3e-4 again
    },
    iterations={"quick": 510, "standard": 2_500, "paper": 10_000},
    configurations={
        "fair": Configuration(),
        # What the paper states and what its code base implies where it is silent (docs/results/parts.md).
        "paper": Configuration(
            {
                **splatting.PUBLISHED,
                "feature_step": 1.0,
                "scale_loss": "sum",
                "scale_weight": 0.001,
                "offset_color": "sigmoid",
                "decoder_precision": "float32",
                "features": 50,
                "growth_gradient": 2e-4,
                "growth_adapts": False,
                "view_direction": True,
                "direction_start": 1.0,
                "start_opacity": 0.0,
                "specular_start": 2.5,
                "shading_bias": 0.0,
                "grid": "hac",
                "max_anchors": 0,
                "color_weight": 0.0,
                "fold_embeddings": False,
                "hidden": 50,
                "context_hidden": 50,
                "group_budget": 0.0,
                "chamfer_points": 10_000,
                "scaling_activation": "sigmoid",
                "growth_pauses": False,
                "decoder_rates": "stated",
                "last_lr_share": 1.0,
                "rate_sample": 1.0,
                "rounding": 0.0,
                "positions": "float32",
                "context_start": 0.5,
                "rate_weight": 1e-4,
                "feature_lr": 1e-2,
            },
            {"quick": 1_600, "standard": 8_000, "paper": 20_000},
        ),
    },
    rate_knobs=(RateKnob("rate_weight", (1e-4, 5e-4, 1e-3, 5e-3, 1e-2), refit=True),),
    tunable=(
        *splatting.TUNABLE,
        "features",
        "offsets",
        "growth_gradient",
        "feature_lr",
        "feature_step",
    ),
)
