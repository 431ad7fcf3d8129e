"""Means of each dataset and method over its scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from econgs_bench.reports.schema import METRICS, records
from econgs_bench.reports.style import absent

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

_KEYS = ("dataset", "method", "variant", "rate", "preset", "split")
_MEAN = (*METRICS, "floor", "one_ray", "fps")
_SUM = ("size_bytes", "train_seconds", "load_seconds", "primitives")
_MAX = ("peak_host_bytes", "peak_device_bytes")
_NUMBERS = (*_MEAN, *_SUM, *_MAX)


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """One row per dataset, method, variant, rate, preset and split.

    Quality and FPS are means over basic scenes, size and time are sums, memory is the maximum. These numbers
    are then averaged over the seeds that have them in all scenes; ``psnr_std`` is the standard deviation of
    PSNR over seeds. ``jobs`` are the jobs of the rows. ``scenes`` is as "3 of 4". A set is ``complete`` if
    every seed has a row "ok" of every scene that `results` has of this dataset, preset and split. An
    incomplete set has no numbers, and ``note`` gives the reason.
    """
    import pandas as pd

    basic = results[results["kind"] == "basic"]
    columns = [*_KEYS, "scene", "seed", "status", "changes", "job"]
    numbers = basic[list(_NUMBERS)].to_numpy(float, na_value=np.nan)
    sets: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    scenes: dict[tuple[Any, ...], set[str]] = {}
    for row, values in zip(records(basic[columns]), numbers, strict=True):
        row["numbers"] = values
        sets.setdefault(tuple(None if absent(row[key]) else row[key] for key in _KEYS), []).append(row)
        scenes.setdefault((row["dataset"], row["preset"], row["split"]), set()).add(row["scene"])
    rows = []
    for key, group in sets.items():
        axes = dict(zip(_KEYS, key, strict=True))
        rows.append(axes | _set(group, scenes[axes["dataset"], axes["preset"], axes["split"]]))
    counts = ["scenes", "seeds", "complete"]
    order = [*_KEYS, *counts, *_MEAN, "psnr_std", *_SUM, *_MAX, "changes", "note", "jobs"]
    table = pd.DataFrame(rows, columns=order)
    return table.astype(dict.fromkeys(("rate", "psnr_std", *_NUMBERS), "Float64"))


def _set(group: list[dict[str, Any]], scenes: set[str]) -> dict[str, Any]:
    """The columns of :func:`summary` for the rows of one key."""
    seeds: dict[Any, list[dict[str, Any]]] = {row["seed"]: [] for row in group if not absent(row["seed"])}
    for row in group:
        if row["status"] == "ok" and not absent(row["seed"]):
            seeds[row["seed"]].append(row)
    lacking = sorted(set().union(*(scenes - {row["scene"] for row in rows} for rows in seeds.values())))
    status = {row["scene"]: row["status"] for row in reversed(group) if row["status"] != "ok"}
    reasons = "; ".join(f"{scene}: {status.get(scene, 'not run')}" for scene in lacking)
    complete = not lacking
    per_seed = [_reduce(np.array([row["numbers"] for row in seeds[seed]])) for seed in sorted(seeds)]
    missing = np.full(len(_NUMBERS), np.nan)
    means = _over_seeds(np.array(per_seed)) if complete and per_seed else missing
    psnr = [values[0] for values in per_seed if not np.isnan(values[0])] if complete else []
    return {
        "scenes": f"{len(scenes) - len(lacking)} of {len(scenes)}",
        "seeds": len(seeds),
        "complete": complete,
        "psnr_std": float(np.std(psnr, ddof=1)) if len(psnr) > 1 else None,
        "changes": "; ".join(sorted({row["changes"] for row in group if not absent(row["changes"])} - {""})),
        "note": f"incomplete, no average: {reasons}" if lacking else "",
        "jobs": tuple(str(row["job"]) for row in group if row["status"] == "ok") if complete else (),
        **dict(zip(_NUMBERS, means, strict=True)),
    }


def _over_seeds(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(columns,) means of (seeds, columns) over the seeds that have a number; NaN where none has."""
    known = ~np.isnan(values)
    sums = np.array([column[has].sum() for column, has in zip(values.T, known.T, strict=True)])
    counts = known.sum(axis=0)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _reduce(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """(columns,) of (scenes, columns); NaN where a scene lacks the number, or without scenes."""
    if not len(numbers):
        return np.full(len(_NUMBERS), np.nan)
    sums = np.array([column.copy().sum() for column in numbers.T])
    means, maxima = sums / len(numbers), numbers.max(axis=0)
    kinds = [means if name in _MEAN else sums if name in _SUM else maxima for name in _NUMBERS]
    return np.array([kind[i] for i, kind in enumerate(kinds)])
