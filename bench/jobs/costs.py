"""What models cost: bytes, seconds and memory of the jobs behind a measurement."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from econgs_bench.bench.jobs.encode import EncodeResult
from econgs_bench.bench.jobs.fit import FitResult
from econgs_bench.bench.jobs.partition import PartitionResult
from econgs_bench.bench.machine.timing import worst_of
from econgs_bench.bench.store.lineage import ModelRecords
from econgs_bench.bench.store.records import Record, Row


def memory(record: Record, fits: Iterable[Record] = ()) -> Row:
    """Peaks of a job and of the fits behind it; ``group_peak_host_bytes`` of the fits alone."""
    fits = list(fits)
    return {
        "peak_host_bytes": worst_of(one.peak_host_bytes for one in (record, *fits)),
        "peak_device_bytes": worst_of(one.peak_device_bytes for one in (record, *fits)),
        "group_peak_host_bytes": worst_of(fit.peak_host_bytes for fit in fits),
    }


def costs(rendered: Sequence[str], models: list[ModelRecords]) -> Row:
    """Bytes and seconds of all models together; what any model lacks, their sum lacks."""
    costs = [_cost(rendered, model) for model in models]
    names = set(costs[0]).intersection(*costs[1:]) if costs else ()
    partitions = {
        model.partition.job.id: model.partition.of(PartitionResult) for model in models if model.partition
    }
    seconds = [result.seconds for result in partitions.values() if result is not None]
    return {name: sum(cost[name] for cost in costs) for name in names} | {
        "partition_seconds": sum(seconds) if seconds else None
    }


def _cost(rendered: Sequence[str], model: ModelRecords) -> dict[str, float]:
    """Bytes and seconds of those scenes of a job that one model holds."""
    encode = model.encode.of(EncodeResult) if model.encode is not None else None
    if model.encode is None or encode is None:
        return {}
    group = model.encode.job.scenes
    scenes = [scene for scene in rendered if scene in group]
    cost: dict[str, float] = {"encode_seconds": encode.seconds, **_sizes(scenes, group, encode)}
    if model.fit is not None and (fit := model.fit.of(FitResult)) is not None:
        cost |= _times(len(scenes), len(group), encode, fit, model.partition)
    return cost


def _sizes(scenes: list[str], group: tuple[str, ...], encode: EncodeResult) -> dict[str, int]:
    """Own part + share of the shared part; they sum to the group's bytes over its scenes."""
    own = sum(sum(encode.ledger.get(scene, {}).values()) for scene in scenes)
    shared = sum(encode.ledger.get("", {}).values())
    return {
        "size_bytes": own + sum(share(shared, group, scene) for scene in scenes),
        "group_bytes": encode.total_bytes,
        "standalone_bytes": own + shared,
    }


def _times(
    scenes: int, group: int, encode: EncodeResult, fit: FitResult, partition: Record | None
) -> dict[str, float]:
    """Partition + fit + encode; partition time is shared by all scenes of the dataset."""
    seconds = fit.seconds + encode.seconds
    if partition is not None and (chosen := partition.of(PartitionResult)) is not None:
        seconds += chosen.seconds * group / len(partition.job.scenes)
    times = {"group_seconds": seconds, "train_seconds": seconds * scenes / group}
    if fit.cpu_seconds is not None:  # older records have none
        times["cpu_seconds"] = fit.cpu_seconds * scenes / group
    return times


def share(total: int, names: Iterable[str], name: str) -> int:
    """The part of ``total`` that falls to one of several; the parts sum to it exactly."""
    order = list(names)
    base, rest = divmod(total, len(order))
    return base + (1 if order.index(name) < rest else 0)


def fit_row(rendered: Sequence[str], fits: list[Record]) -> Row:
    """Columns of the table `results` about the fits behind a measurement."""
    results = [one for one in (fit.of(FitResult) for fit in fits) if one is not None]
    points = {name: count for one in results for name, count in one.cloud_points.items()}
    known = points.keys() >= set(rendered)
    return {
        "fit_reference_seconds": worst_of(one.reference_seconds for one in results),
        "fit_reference_worst": worst_of(one.reference_worst for one in results),
        "start_points": sum(points[scene] for scene in rendered) if known else None,
    }
