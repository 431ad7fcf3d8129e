"""What the method can do and how it is set. Pure data: nothing heavy is imported here."""

from dataclasses import dataclass

from methods.interface import MethodSpec, option


@dataclass(frozen=True)
class ToyOptions:
    """Options of toy-blobs."""

    size: float = option(0.03, "standard deviation of a blob, scene units", minimum=1e-4, maximum=1.0)
    rate: float = option(0.05, "learning rate", minimum=0.0, maximum=1.0)


SPEC = MethodSpec(
    name="toy-blobs",
    title="Round blobs at the points of the cloud",
    reference="docs/guide/add-a-method.md",
    version="1",
    implementation="toy_blobs.method:ToyBlobs",
    composable=True,
    edits=frozenset({"opacity"}),
    uses_alpha="views are composited on the scene's background",
    options=ToyOptions,
    iterations={"quick": 300, "standard": 2_000, "paper": 10_000},
)
