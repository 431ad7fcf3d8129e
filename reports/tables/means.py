"""Means of each dataset and method over its scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

_KEYS = ["dataset", "method", "variant", "rate", "preset", "split"]
_MEAN = ("psnr", "psnr_fg", "ssim", "lpips_vgg", "flip", "delta_e_uv", "fps")
_SUM = ("size_bytes", "train_seconds", "load_seconds", "primitives")
_MAX = ("peak_host_bytes", "peak_device_bytes")


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Per dataset and method: means over scenes of quality and FPS, sums of size and time, maximum of memory.

    Several seeds are averaged after that, and ``psnr_std`` is their spread. Composed rows do not take part.
    ``jobs`` names the rows' jobs. A set is complete if every scene that `results` knows of this dataset (at
    this preset and split) is "ok" for every seed of the method; all numbers of an incomplete set are missing,
    and ``note`` says why.
    """
    import pandas as pd

    basic = results[results["kind"] == "basic"]
    rows: list[dict[str, Any]] = []
    for keys, group in basic.groupby(_KEYS, dropna=False, sort=False):
        row: dict[str, Any] = dict(zip(_KEYS, keys, strict=True))
        same = (basic["dataset"] == row["dataset"]) & (basic["preset"] == row["preset"])
        wanted = set(basic.loc[same & (basic["split"] == row["split"]), "scene"])
        good = group[group["status"] == "ok"]
        seeds = sorted(set(group["seed"].dropna()))
        lacking = [
            (s, seed) for seed in seeds for s in sorted(wanted - set(good.loc[good["seed"] == seed, "scene"]))
        ]
        row["scenes"] = f"{len(wanted) - len({s for s, _ in lacking})} of {len(wanted)}"
        row["seeds"], row["complete"] = len(seeds), not lacking
        row["stale"] = bool(group["stale"].fillna(False).any())
        row["note"] = _note(group, lacking)
        row["jobs"] = tuple(str(job) for job in good["job"].dropna()) if not lacking else ()
        per_seed = [good[good["seed"] == seed] for seed in seeds] if not lacking else []
        for names, how in ((_MEAN, "mean"), (_SUM, "sum"), (_MAX, "max")):
            for name in names:
                values = [_reduce(part[name], how) for part in per_seed]
                known = values and all(value is not None for value in values)
                row[name] = (
                    sum(value for value in values if value is not None) / len(values) if known else None
                )
        psnr = [_reduce(part["psnr"], "mean") for part in per_seed]
        row["psnr_std"] = float(pd.Series(psnr).std()) if len(psnr) > 1 and None not in psnr else None
        rows.append(row)
    columns = [
        *_KEYS,
        "scenes",
        "seeds",
        "complete",
        *_MEAN,
        "psnr_std",
        *_SUM,
        *_MAX,
        "stale",
        "note",
        "jobs",
    ]
    table = pd.DataFrame(rows, columns=columns)
    numbers = [*_MEAN, "psnr_std", *_SUM, *_MAX]
    table[numbers] = table[numbers].astype("Float64")
    return table


def _reduce(values: pd.Series, how: str) -> float | None:
    """Of one set; None if any is missing."""
    if values.empty or values.isna().any():
        return None
    return float(values.astype(float).agg(how))


def _note(group: pd.DataFrame, lacking: list[tuple[Any, Any]]) -> str:
    told = []
    for scene in dict.fromkeys(scene for scene, _ in lacking):
        status = group.loc[(group["scene"] == scene) & (group["status"] != "ok"), "status"]
        told.append(f"{scene}: {status.iloc[0] if len(status) else 'not run'}")
    return "incomplete, no average: " + "; ".join(told) if told else ""
