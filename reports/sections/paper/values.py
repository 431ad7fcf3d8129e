"""Values, rows and blocks of the paper's tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.schema import COLUMNS

if TYPE_CHECKING:
    import pandas as pd

NOT_MEASURED = "not measured"
_GIB = 1.0 / 2.0**30

Parts = Mapping[tuple[str, str], float]
"""Scene and seed -> value, of a row's column."""


@dataclass(frozen=True)
class Quantity:
    """A column of the paper's tables.

    Attributes:
        title: header.
        published: column of the published table.
        digits: decimals.
        better: 1 if higher is better, -1 if lower is better, 0 if values are not ranked.
        scale: factor from the measured unit to the column's.
        across: how a dataset's scenes are combined: mean, sum or max.
        clock: whether the value depends on the machine.
    """

    title: str
    published: str
    digits: int
    better: int = 0
    scale: float = 1.0
    across: str = "mean"
    clock: bool = False


def _measured(name: str, published: str, digits: int, **more: Any) -> Quantity:
    """A quantity with title, unit and direction of the schema."""
    column = COLUMNS[name]
    return Quantity(column.header, published, digits, column.better, 1.0 / column.scale, **more)


QUANTITIES = {
    "psnr": _measured("psnr", "psnr", 2),
    "lpips_vgg": _measured("lpips_vgg", "lpips_vgg", 3),
    "fps": _measured("fps", "fps", 2, clock=True),
    "train_seconds": Quantity("Training [min]", "train_min", 2, -1, 1.0 / 60.0, "sum", clock=True),
    "size_bytes": _measured("size_bytes", "size_mib", 2, across="sum"),
    "primitives": Quantity("Anchors", "anchors", 0, -1, across="sum"),
    "groups": Quantity("Groups", "groups_derived", 0),
    "partition_seconds": Quantity("Clustering [s]", "clustering_s", 2, clock=True),
    "decode_ms": Quantity("Decoding [ms]", "mlp_ms", 2, -1, clock=True),
    "rasterise_ms": Quantity("Shading, rasterising [ms]", "raster_ms", 2, -1, clock=True),
    "frame_ms": Quantity("Frame [ms]", "total_ms", 2, -1, clock=True),
    "bd_psnr": Quantity("BD-PSNR [dB]", "", 2, 1),
    "scenes": Quantity("Scenes", "scenes", 0),
    "variables": Quantity("Variables", "variables", 0),
    "cloud_seconds": Quantity("Initial cloud [s]", "", 3, -1, across="max", clock=True),
    "drawn": Quantity("Gaussians drawn", "gaussians", 0, -1),
    "init_bytes": Quantity("Initial file [MiB]", "init_mib", 2, -1, 2.0**-20, "sum"),
    "triangles": Quantity("Triangles [million]", "triangles_million", 3, -1, 1e-6, "sum"),
    "peak_host_bytes": Quantity("Host memory [GiB]", "", 2, -1, _GIB, "max"),
    "peak_device_bytes": Quantity("Device memory [GiB]", "peak_gpu_gb", 2, -1, _GIB, "max"),
    "render_host_bytes": Quantity("Host memory [GiB]", "host_gib", 2, -1, _GIB, "max"),
    "render_device_bytes": Quantity("Device memory [GiB]", "gpu_gib", 2, -1, _GIB, "max"),
}


@dataclass(frozen=True)
class Value:
    """A cell.

    Attributes:
        mean: mean over seeds, in the column's unit; None if it is missing.
        published: the paper's value; None if the paper has none.
        seeds: the value of each seed.
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
class PaperRow:
    """A row of a table.

    Attributes:
        label: name of the row.
        values: column -> cell.
        note: why cells, or those of a seed, are missing.
        jobs: the measurements of the complete seeds.
        versions: versions of the method that fitted them.
        missing: column -> why a measured row lacks it.
        parts: column -> what its value is made of, at the seeds that have all scenes; in units of `results`.
        rivals: what rows are compared with each other: those with equal scenes and training views.
    """

    label: str
    values: Mapping[str, Value]
    note: str = ""
    jobs: Sequence[str] = ()
    versions: frozenset[str] = frozenset()
    missing: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[str, Parts] = field(default_factory=dict)
    rivals: tuple[Any, ...] = ()

    @property
    def has_published(self) -> bool:
        """Whether the paper has a value of this row."""
        return any(value.published is not None for value in self.values.values())


@dataclass(frozen=True)
class Block:
    """The rows of one dataset under one protocol.

    Attributes:
        dataset: name of the dataset.
        published: the paper's name of the dataset with the published values; "" if there are none.
        same: whether both are one dataset. Only then documents give differences.
        scenes: number of scenes and the protocol, for people.
        rows: the rows.
        marks: (row, column) -> 1 for the best, 2 for the second best measured value, or
            :data:`.reports.tables.table.UNDECIDED`.
        remarks: remarks on marks and on missing values.
        protocol: preset, number of views and split, as a short label.
        count: number of basic scenes.
    """

    dataset: str
    published: str
    same: bool
    scenes: str
    rows: Sequence[PaperRow]
    marks: Mapping[tuple[int, str], int]
    remarks: Sequence[str] = ()
    protocol: str = ""
    count: int = 0


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables: a block per dataset and protocol; ``head`` is the header of the labels."""

    name: str
    title: str
    head: str
    columns: Sequence[str]
    blocks: Sequence[Block] = field(default_factory=list)


def parts(seeds: Mapping[Any, pd.DataFrame], columns: Sequence[str]) -> dict[str, Parts]:
    """Column -> value of each scene and seed, of the seeds that have it of all scenes.

    Args:
        seeds: seed -> its rows, one per scene.
        columns: of :data:`QUANTITIES`; those that are no column of the rows are left out.
    """
    return {
        name: {
            (str(scene), str(seed)): float(value)
            for seed, rows in seeds.items()
            if rows[name].notna().all()
            for scene, value in zip(rows["scene"], rows[name], strict=True)
        }
        for name in columns
        if all(name in rows for rows in seeds.values())
    }


def counted_once(compositions: pd.DataFrame, basic: pd.DataFrame) -> pd.DataFrame:
    """Compositions with the bytes of the models that no earlier one has, so that their sum has each once.

    A single composition keeps its bytes. Of several, a model counts with its whole files.

    Args:
        compositions: rows of a method and seed; their groups are joined by commas.
        basic: rows of the scenes of the same models. The bytes are missing where a group's are.
    """
    import pandas as pd

    if len(compositions) < 2:
        return compositions
    files = dict(zip(basic["group"], basic["group_bytes"], strict=True))
    counted: set[str] = set()
    sizes = []
    for groups in compositions["group"]:
        new = [name for name in str(groups).split(",") if name not in counted]
        counted.update(new)
        sizes.append(sum(files[name] for name in new) if files.keys() >= set(new) else None)
    column = compositions["size_bytes"]
    return compositions.assign(size_bytes=pd.Series(sizes, column.index, dtype=column.dtype))
