"""What the method can do and how it is set. Pure data: `bench list` imports this, so nothing heavy here."""

from dataclasses import dataclass

from econgs_bench.methods.interface import MethodSpec, option


@dataclass(frozen=True)
class Options:
    """Settings of the method; a user changes them with ``--set toy-blobs.size=0.02``."""

    # A field per setting: default, one line for people, range. `Literal["a", "b"]` as type lists choices.
    size: float = option(0.03, "standard deviation of a blob, scene units", minimum=1e-4, maximum=1.0)
    learning_rate: float = option(0.05, "learning rate", minimum=0.0, maximum=1.0)
    ssim_weight: float = option(0.2, "weight of D-SSIM in the loss", minimum=0.0, maximum=1.0)


SPEC = MethodSpec(
    name="toy-blobs",
    title="Round blobs at the points of the initial cloud",  # full name, for tables
    reference="unpublished",  # your paper
    version="1",  # raise it when the same options may come to other results: older rows are stale
    implementation="toy_blobs.method:Method",
    composable=True,  # models of several scenes render together (SceneModel does it)
    edits=frozenset({"opacity"}),  # of palette, opacity, light, shading; the model must refuse the others
    uses_alpha="views are composited on the scene's background",
    options=Options,
    iterations={"quick": 300, "standard": 2_000, "paper": 10_000},  # of one fit, per preset
)
