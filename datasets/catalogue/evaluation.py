"""Sets of the catalogue for evaluation alone: no option, default or rule of a method is chosen on them."""

from __future__ import annotations

import gzip
import hashlib
from functools import cache
from pathlib import Path

from econgs_bench.datasets.catalogue import entries
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import Dataset


def check_choice(dataset: Dataset) -> None:
    """Refuse a dataset for a run that chooses settings if its files are those of such a set, by any name.

    Raises:
        DataError: they are.
    """
    held = _held()
    seen: set[str] = set()
    for variable in dataset.volumes:
        if (source := dataset.volume(variable).source) in seen:
            continue
        seen.add(source)
        if (name := held.get(_digest(Path(source)))) is not None:
            raise DataError(
                dataset.name,
                f"is {name} of the catalogue, which is for evaluation alone: no choice is made on it",
                "Choose on other data (`bench list datasets`), and measure on this with `--split test`",
            )


@cache
def _held() -> dict[str, str]:
    """SHA-512 of a file of such a set -> the set."""
    tables = {name: entries.entry(name) for name in entries.built_in()}
    held = {name: table for name, table in tables.items() if table.get("evaluation")}
    return {file["sha512"]: name for name, table in held.items() for file in table["files"]}


def _digest(path: Path) -> str:
    """SHA-512 of a file's content as the catalogue has it; "" where there is no file."""
    if not path.is_file():
        return ""
    packed = path.suffix == ".gz" and path.with_suffix("").suffix == ".raw"
    with gzip.open(path) if packed else path.open("rb") as file:
        return hashlib.file_digest(file, "sha512").hexdigest()
