"""Triangle meshes: spec and options."""

from dataclasses import dataclass
from typing import Literal

from econgs_bench.methods.interface import Configuration, MethodSpec, RateKnob, built_in, option

Coding = Literal["draco", "ply"]


@dataclass(frozen=True)
class MeshOptions:
    """Options of triangle meshes."""

    kept: float = option(
        0.5, "share of the triangles of an isosurface that decimation keeps", minimum=1e-4, maximum=1.0
    )
    step: float = option(0.0625, "step of the positions that Draco stores, voxels", minimum=1e-4, maximum=1.0)
    coding: Coding = option("draco", "how meshes are stored: by Draco, or as plain PLY of float32 positions")


SPEC = MethodSpec(
    name="mesh",
    title="Triangle mesh of isosurfaces",
    reference=(
        "W. Schroeder, R. Maynard, B. Geveci: Flying Edges: A High-Performance Scalable Isocontouring "
        "Algorithm. IEEE Symposium on Large Data Analysis and Visualization, 2015; M. Garland, "
        "P. S. Heckbert: Surface Simplification Using Quadric Error Metrics. SIGGRAPH, 1997"
    ),
    version="1",
    implementation="econgs_bench.methods.mesh.method:MeshMethod",
    source=built_in("mesh"),
    composable=True,
    point_sampled=True,
    edits=frozenset({"palette", "opacity", "light", "shading"}),
    needs_volume=True,
    volume_scenes=frozenset({"isosurfaces"}),
    uses_alpha="no views are used",
    options=MeshOptions,
    iterations={"quick": 1, "standard": 1, "paper": 1},
    rate_knobs=(RateKnob("share of triangles", (1.0, 0.5, 0.25, 0.1, 0.05, 0.02), refit=False),),
    configurations={"fair": Configuration(), "paper": Configuration({"kept": 1.0, "coding": "ply"})},
    tunable=("kept", "step", "coding"),
)
