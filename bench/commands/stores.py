"""``bench merge``, ``bench compare``, ``bench bundle``, ``bench verify`` and ``bench cache``."""

from __future__ import annotations

import shutil
import sys
import uuid
from argparse import Namespace
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands.results import current
from bench.store import Store
from bench.tables import build_tables
from datasets.errors import DataError
from reports.schema import METRICS

if TYPE_CHECKING:
    import pandas as pd

PAIRING = ("dataset", "scene", "method", "variant", "rate", "preset", "split", "seed", "view")


def merge(options: Namespace) -> int:
    """Join stores and bundles: a job finished in one is finished in all; a success goes before a failure."""
    from bench.bundle import unpacked

    with ExitStack() as stack:
        paths = [Path(given) for given in options.stores]
        sources = [stack.enter_context(unpacked(path)) if path.is_file() else Store(path) for path in paths]
        return _merge(sources, options)


def _merge(sources: list[Store], options: Namespace) -> int:
    target = Store(Path(options.out), create=True)
    taken = kept = 0
    for source in sources:
        if source.root == target.root:
            raise DataError(source.root, "is the target itself", "Name the other stores only")
        for record in source.records():
            name = record.job.id
            with target.lock(name):
                there = target.record(name)
                if there is not None and (there.ok or not record.ok):
                    kept += 1
                    continue
                aside = target.partial / f"merge-{uuid.uuid4().hex}"
                try:
                    shutil.copytree(source.jobs / name, aside)
                    target.put_in_place(aside, name)
                finally:
                    shutil.rmtree(aside, ignore_errors=True)
                taken += 1
    build_tables(target, current(options))
    print(f"{target.root}: {taken} jobs taken, {kept} there already")
    return 0


def compare(options: Namespace) -> int:
    """Pair two stores view by view: mean of each metric in both, and how the views differ."""
    first, second = (build_tables(Store(Path(root)), write=False)["views"] for root in options.stores)
    table = paired(first, second)
    if table.empty:
        raise DataError(
            f"{options.stores[0]} and {options.stores[1]}",
            "have no view in common (same dataset, scene, method, variant, rate, preset, split and seed)",
            "Compare runs of the same selection",
        )
    if options.format:
        from bench.commands.results import print_as

        print_as(table, options.format)
    else:
        empty = [name for name in ("variant", "rate") if table[name].replace("", None).isna().all()]
        told = table.drop(columns=empty)
        print(told.to_string(index=False, float_format=lambda x: f"{x:.5g}", na_rep="-"))
        print("difference: second - first, mean over the paired views; least and greatest of any view")
    alone = (len(first) - table.attrs["views"], len(second) - table.attrs["views"])
    if any(alone):
        print(
            f"bench: not paired: {alone[0]} views of the first run, {alone[1]} of the second", file=sys.stderr
        )
    return 0


def paired(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    """One row per experiment and metric: both means, mean difference (second - first), its extremes.

    ``views`` is the number of paired views on which both have the metric. The frame's attribute
    "views" counts all pairs.
    """
    import pandas as pd

    keys = list(PAIRING)
    text = {key: "string" for key in keys if key not in ("rate", "seed")}
    left, right = (
        t[[*keys, *METRICS]].astype({**text}).assign(rate=t["rate"].fillna(-1.0)) for t in (first, second)
    )
    both = left.merge(right, on=keys, suffixes=("_1", "_2"))
    rows = []
    for experiment, group in both.groupby(keys[:-1], dropna=False):
        for metric in METRICS:
            a, b = group[f"{metric}_1"], group[f"{metric}_2"]
            known = a.notna() & b.notna()
            if known.any():
                a, b = a[known], b[known]
                difference = b - a
                rows.append(
                    {
                        **dict(zip(keys[:-1], experiment, strict=True)),
                        "metric": metric,
                        "views": int(known.sum()),
                        "first": a.mean(),
                        "second": b.mean(),
                        "difference": difference.mean(),
                        "least": difference.min(),
                        "greatest": difference.max(),
                    }
                )
    table = pd.DataFrame(rows)
    if len(table):
        table["rate"] = table["rate"].where(table["rate"] != -1.0)
    table.attrs["views"] = len(both)
    return table


def cache(options: Namespace) -> int:
    """Tell what the ground-truth cache takes, or shrink it."""
    from datasets.view_cache import ViewCache

    views = ViewCache()
    if options.action == "prune":
        freed = views.prune(options.max_size or views.max_bytes)
        print(f"freed {freed / 2**20:.1f} MiB")
    print(f"{views.folder}: {views.size() / 2**20:.1f} MiB of at most {views.max_bytes / 2**30:.0f} GiB")
    return 0


def bundle(options: Namespace) -> int:
    """Write a submission bundle of a store."""
    from bench.bundle import write_bundle

    out = Path(options.out)
    count = write_bundle(Store(Path(options.runs)), out, models=options.models)
    print(f"{out}: {count} records, {out.stat().st_size / 2**20:.1f} MiB")
    return 0


def verify(options: Namespace) -> int:
    """Check a bundle; 1 if anything in it does not hold."""
    from bench.bundle import verify_bundle

    problems = verify_bundle(Path(options.bundle))
    for problem in problems:
        print(f"bench: {problem}", file=sys.stderr)
    print(f"{options.bundle}: {f'{len(problems)} problems' if problems else 'all of it holds'}")
    return 1 if problems else 0
