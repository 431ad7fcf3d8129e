"""The baseline file: results of a known good state, small and readable in a diff."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from econgs_bench.bench.gate.cells import AND, Cell, Key, Options
from econgs_bench.bench.gate.identity import Identity
from econgs_bench.bench.gate.identity import differences as reasons
from econgs_bench.bench.gate.quantities import QUANTITIES
from econgs_bench.bench.store.store import write_text
from econgs_bench.datasets.errors import DataError

FORMAT = 1
LEAST_SEEDS = 3
"""Seeds from which a spread is known."""
_DIGITS = 6
_VIEW_DECIMALS = 4
_REMEDY = "Write a new one with `bench baseline`"


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid")


class BaselineCell(_Model):
    """A cell's results.

    Attributes:
        version: of the method.
        processor: hardware and threads, for times.
        options: the method's options as they were resolved, and the iterations.
        seeds: in the order of all lists.
        values: quantity -> value of each seed; null where it could not be measured.
        views: view -> mean PSNR over seeds.
        view_spread: standard deviation of a view's PSNR over seeds, beyond what all views of a seed share.
        models: SHA-256 of the model's files of each seed, "" where they were not there.
        kernel: median seconds of the reference kernel; null if no time was measured.
        identity: what all seeds were measured on and by; empty in older files.
    """

    dataset: str
    scene: str
    method: str
    variant: str
    rate: float | None
    preset: str
    split: str
    requested_views: int
    version: str
    processor: str
    options: Options
    seeds: Annotated[list[int], Field(min_length=LEAST_SEEDS)]
    values: dict[str, list[float | None]]
    views: dict[str, float]
    view_spread: float
    models: list[str]
    kernel: float | None
    identity: Identity = Identity()

    @property
    def key(self) -> Key:
        return Key(*(getattr(self, name) for name in Key._fields))


class Change(_Model):
    """Why a baseline was written."""

    date: str
    reason: str
    version: str
    commit: str | None


class Baseline(_Model):
    """The file.

    Attributes:
        changes: the first one writes it, the others update it.
        environment: software that results depend on.
        cells: sorted by key.
    """

    format: int
    changes: list[Change]
    environment: dict[str, str]
    cells: list[BaselineCell]


def cell_of(cell: Cell) -> BaselineCell:
    """A cell for the file.

    Raises:
        DataError: it has failures, too few seeds, or seeds that differ in version, options or identity.
    """
    seeds = sorted(cell.values)
    if cell.failures:
        seed, reason = next(iter(cell.failures.items()))
        remedy = "A baseline holds finished runs: mend it, or run without it"
        raise DataError(cell.key.title, f"seed {seed} is {reason}", remedy)
    if len(seeds) < LEAST_SEEDS:
        raise DataError(
            cell.key.title,
            f"{len(seeds)} seeds show no spread",
            f"Run at least {LEAST_SEEDS}: --seed 0 --seed 1 --seed 2",
        )
    remedy = "Repeat the run in a new store"
    if AND in cell.version:
        raise DataError(cell.key.title, f"its seeds are of versions {cell.version} of the method", remedy)
    first = cell.identities.get(seeds[0], Identity())
    for seed in seeds[1:]:
        if changes := differences(cell.options[seeds[0]], cell.options[seed]):
            text = f"seeds {seeds[0]} and {seed} differ in options: {changes}"
            raise DataError(cell.key.title, text, remedy)
        if several := reasons(first, cell.identities.get(seed, Identity())):
            text = f"seeds {seeds[0]} and {seed} do not compare: {'; '.join(several.values())}"
            raise DataError(cell.key.title, text, remedy)
    views, spread = _views(cell, seeds)
    return BaselineCell(
        **cell.key._asdict(),
        version=cell.version,
        processor=cell.processor,
        options=cell.options[seeds[0]],
        seeds=seeds,
        values={
            name: [_short(cell.values[seed].get(name)) for seed in seeds]
            for name in QUANTITIES
            if any(name in cell.values[seed] for seed in seeds)
        },
        views=views,
        view_spread=spread,
        models=[cell.models.get(seed, "") for seed in seeds],
        kernel=_short(float(np.median(cell.kernels))) if cell.kernels else None,
        identity=first,
    )


def differences(
    before: Mapping[str, object], after: Mapping[str, object], names: Collection[str] | None = None
) -> str:
    """Options or versions that differ, as "ssim_weight 0.2 → 0.3"; "" if none does.

    Args:
        before: name -> value.
        after: as ``before``.
        names: those to compare; None: all.
    """
    changed = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    return ", ".join(
        f"{name} {before.get(name, 'absent')} → {after.get(name, 'absent')}"
        for name in changed
        if names is None or name in names
    )


def _views(cell: Cell, seeds: list[int]) -> tuple[dict[str, float], float]:
    """Mean of each view, and the standard deviation of what is neither the view's nor the seed's."""
    names = list(cell.views[seeds[0]])
    if not names or any(list(cell.views[seed]) != names for seed in seeds):
        return {}, 0.0
    table = np.array([[cell.views[seed][name] for name in names] for seed in seeds])
    means = table.mean(axis=0)
    rest = table - means - (table - means).mean(axis=1, keepdims=True)
    freedom = max((len(seeds) - 1) * (len(names) - 1), 1)
    spread = float(np.sqrt((rest**2).sum() / freedom))
    rounded = (round(float(mean), _VIEW_DECIMALS) for mean in means)
    return dict(zip(names, rounded, strict=True)), _short(spread) or 0.0


def _short(value: float | None) -> float | None:
    """Six digits; whole numbers as they are, as bytes must be equal."""
    return value if value is None or value.is_integer() else float(f"{value:.{_DIGITS}g}")


def rounding(value: float) -> float:
    """Largest difference between a value of the file and what was measured."""
    if value.is_integer():
        return 0.0
    return 0.5 * 10.0 ** (math.floor(math.log10(abs(value))) + 1 - _DIGITS)


VIEW_ROUNDING = 0.5 * 10.0**-_VIEW_DECIMALS
"""That of a view's PSNR in dB."""


def write(path: Path, baseline: Baseline) -> None:
    """Write the file whole or not at all; a list of numbers, options or views is one line."""
    text = json.dumps(baseline.model_dump(), indent=1, ensure_ascii=False)
    lists = re.compile(r"\[\s+([^\[\]{}]*?)\s+\]")
    text = lists.sub(lambda m: "[" + re.sub(r"\s*\n\s*", " ", m[1]) + "]", text)
    text = re.sub(r"(?<=\d)\.0(?=[,\]])", "", text)
    tables = re.compile(r'("(?:options|views|contents|metric_versions)": )\{\s+([^{}]*?)\s+\}')
    text = tables.sub(lambda m: m[1] + "{" + re.sub(r"\s*\n\s*", " ", m[2]) + "}", text)
    write_text(path, text + "\n")


def read(path: Path) -> Baseline:
    """Read the file.

    Raises:
        DataError: it cannot be read or is no baseline; the reason names the place.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise DataError(path, f"cannot be read ({reason})", _REMEDY) from error
    try:
        baseline = Baseline.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise DataError(path, f"is no baseline ({place}: {first['msg']})", _REMEDY) from error
    if baseline.format != FORMAT:
        raise DataError(path, f"has format {baseline.format}, this program reads {FORMAT}", _REMEDY)
    for cell in baseline.cells:
        counts = {len(cell.seeds), len(cell.models), *map(len, cell.values.values())}
        if len(counts) > 1 or not set(cell.values) <= set(QUANTITIES):
            raise DataError(
                path, f"{cell.key.title}: lists differ in length, or quantities are unknown", _REMEDY
            )
    return baseline


def sorted_cells(cells: Iterable[BaselineCell]) -> list[BaselineCell]:
    """In the order of their keys, so that files differ where results do."""
    return sorted(cells, key=lambda cell: tuple(map(str, cell.key)))
