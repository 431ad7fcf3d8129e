"""3dgs-coded: spec, and the codecs that are the points of its rate curve."""

from dataclasses import dataclass, replace
from typing import Literal

from econgs_bench.methods.gaussian_splatting.spec import SPEC as PLAIN
from econgs_bench.methods.interface import RateKnob, built_in


@dataclass(frozen=True)
class Codec:
    """A point of the rate curve.

    Attributes:
        name: of the codec and its quantisation, for people and for files.
        format: module of :mod:`.methods.formats`.
        settings: further arguments of its writer.
    """

    name: str
    format: Literal["zstd", "spz", "sog", "integer"]
    settings: tuple[tuple[str, object], ...] = ()


CODECS: dict[int, Codec] = {
    1: Codec("ply-zstd", "zstd"),
    2: Codec("spz-8bit-sh", "spz", (("bits", (8, 8, 8)),)),
    3: Codec("spz", "spz"),
    4: Codec("sog", "sog"),
    5: Codec("integer-half", "integer", (("factor", 0.5),)),
    6: Codec("integer", "integer"),
    7: Codec("integer-double", "integer", (("factor", 2.0),)),
    8: Codec("integer-fourfold", "integer", (("factor", 4.0),)),
}
"""Value of the rate knob -> codec."""
DEFAULT = 6

SPEC = replace(
    PLAIN,
    name="3dgs-coded",
    title="3D Gaussian splatting, saved by codecs",
    reference=(
        f"{PLAIN.reference}; saved as SPZ (Niantic), SOG (PlayCanvas), PLY in Zstandard, and by the integer "
        "coder of this project"
    ),
    version="3",
    implementation="econgs_bench.methods.coded.method:CodedSplatting",
    source=built_in("coded", "formats", "gaussian_splatting"),
    rate_knobs=(RateKnob("codec", tuple(CODECS), refit=False),),
)
