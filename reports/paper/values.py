"""What the paper's tables are made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from reports.style import MIB

NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Quantity:
    """A column: its header, where its published value stands and what brings measured values to its unit.

    Attributes:
        better: 1: more is better, -1: less is.
        across: how one number comes of a dataset's scenes.
        clock: whether it depends on the machine.
    """

    title: str
    published: str
    digits: int
    better: int = 0
    scale: float = 1.0
    across: str = "mean"
    clock: bool = False


QUANTITIES = {
    "psnr": Quantity("PSNR [dB]", "psnr", 2, 1),
    "lpips_vgg": Quantity("LPIPS", "lpips_vgg", 3, -1),
    "fps": Quantity("FPS", "fps", 2, 1, clock=True),
    "train_seconds": Quantity("Training [min]", "train_min", 2, -1, 1.0 / 60.0, "sum", clock=True),
    "size_bytes": Quantity("Size [MiB]", "size_mib", 2, -1, 1.0 / MIB, "sum"),
    "primitives": Quantity("Anchors", "anchors", 0, -1, across="sum"),
    "groups": Quantity("Groups", "groups_derived", 0),
    "partition_seconds": Quantity("Clustering [s]", "clustering_s", 2, clock=True),
    "decode_ms": Quantity("Decoding [ms]", "mlp_ms", 2, -1, clock=True),
    "rasterise_ms": Quantity("Rasterising [ms]", "raster_ms", 2, -1, clock=True),
    "frame_ms": Quantity("Frame [ms]", "total_ms", 2, -1, clock=True),
    "peak_host_bytes": Quantity("Host memory [GiB]", "", 2, -1, 1.0 / 2.0**30, "max"),
}


@dataclass(frozen=True)
class Value:
    """One cell.

    Attributes:
        mean: over seeds, in the column's unit; None if it is missing.
        published: the paper's value; None if it has none.
        seeds: what the mean is of.
    """

    mean: float | None
    published: float | None = None
    seeds: tuple[float, ...] = ()

    @property
    def spread(self) -> float | None:
        """Standard deviation over seeds; None for a single one."""
        n = len(self.seeds)
        if n < 2 or self.mean is None:
            return None
        return float((sum((value - self.mean) ** 2 for value in self.seeds) / (n - 1)) ** 0.5)


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Attributes:
        note: why its cells, or some seed's, are missing.
        jobs: what its means were measured by: those of complete seeds.
        hosts: where: machine, device and threads.
        sources: by which versions of the method's source.
        missing: column -> why it is missing although the row was measured.
    """

    label: str
    values: Mapping[str, Value]
    note: str = ""
    jobs: Sequence[str] = ()
    hosts: frozenset[tuple[str, ...]] = frozenset()
    sources: frozenset[str] = frozenset()
    missing: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Block:
    """The rows of one dataset under one protocol.

    Attributes:
        dataset: its name here.
        published: name in the paper of the dataset that the published values belong to; "": none.
        same: whether that is this very dataset. Differences are given only then.
        scenes: how many of the dataset's scenes were measured, and how, for people.
        marks: (row, column) -> 1 for the best, 2 for the second best measured value, or
            :data:`reports.tables.ranks.UNDECIDED` where they cannot be told apart.
        remarks: what to know of marks and of missing values.
        protocol: preset, number of views and split, in a few words.
    """

    dataset: str
    published: str
    same: bool
    scenes: str
    rows: Sequence[Row]
    marks: Mapping[tuple[int, str], int]
    remarks: Sequence[str] = ()
    protocol: str = ""


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables with as many blocks as datasets were measured; ``head`` names its rows."""

    name: str
    title: str
    head: str
    columns: Sequence[str]
    blocks: Sequence[Block] = field(default_factory=list)
