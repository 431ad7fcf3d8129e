"""Random damage to the samples of a format: ``python -m tests.datasets.fuzz [FORMAT ...]``.

A mutation is refused with a DataError, or gives a volume. That volume is *garbage* if

- it differs between two readings whose new memory is filled with different bytes: values that no file held;
- its file was cut (all formats say how much they hold), and it differs from the original;
- it has more samples than the original, though no data were added. Stores of chunks (Zarr, HDF5) are excused:
  by their definition an absent chunk has the fill value.

Other changes of values have no trace in header or size, and nothing but a checksum could show them.
"""

from __future__ import annotations

import argparse
import math
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import list_variables, read_volume, sandbox
from econgs_bench.datasets.volume import Volume
from tests.datasets.damage import KINDS, Outcome, damage
from tests.datasets.forked import use_forks

CHUNKED = ("zarr", ".h5", "4.nc", "2.mnc", "hdf", ".xdmf", ".xmf")
_PATIENCE = 5.0
"""Seconds until a reading counts as hung; one of a sample takes less than a tenth."""
_MEMORY = 1 << 30


def fuzz(path: Path, mutations: int, folder: Path, patch: pytest.MonkeyPatch, seed: int = 0) -> Outcome:
    """Damage a sample, whose files fill a folder, many times; first each file is cut at 10, 50 and 90 %."""
    patch.setattr(sandbox, "PATIENCE", _PATIENCE)
    use_forks(patch, 0x55)
    files = [path] if path.is_file() else []
    files = sorted({*files, *(f for f in folder.rglob("*") if f.is_file() and f.stat().st_size)})
    files = [f for f in files if f.stat().st_size]
    variables = list_variables(path)
    variable = variables[0].name if variables else None
    resolution = 9 if variables and variables[0].dims is None else None
    original = read_volume(path, array=variable, resolution=resolution)
    original = replace(original, values=np.array(original.values))  # the file below it changes
    rng = np.random.default_rng(seed)
    outcome = Outcome()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    cuts = [(file, "cut", share, 0) for file in files for share in (0.1, 0.5, 0.9)]
    for number in range(mutations):
        if number < len(cuts):
            file, kind, at, value = cuts[number]
        else:
            file = files[rng.integers(len(files))]
            kind = KINDS[rng.integers(len(KINDS))]
            at, value = float(rng.uniform(0, 1 if rng.integers(2) else 0.3)), int(rng.integers(256))
        whole = file.read_bytes()
        damage(file, kind, min(at, 0.9999), value)
        start = time.monotonic()
        what = f"{file.name} {kind} at {at:.4f} with {value}"
        try:
            use_forks(patch, 0x55)
            volume = read_volume(path, array=variable, resolution=resolution)
            use_forks(patch, 0xAA)
            again = read_volume(path, array=variable, resolution=resolution)
            trouble = _trouble(path, kind, original, volume, again)
            same = volume.values.shape == original.values.shape and np.array_equal(
                volume.values, original.values
            )
            outcome.counts["same" if same else "other"] += 1
            if trouble:
                outcome.faults.append(f"{what}: {trouble}")
        except DataError as error:
            outcome.counts["refused"] += 1
            if "stood still" in error.reason:
                outcome.counts["hung"] += 1
            if "crashed" in error.reason:
                outcome.counts["crashed"] += 1
            if not error.remedy or (str(folder) not in error.what):
                outcome.faults.append(f"{what}: {error}")
        except Exception as error:
            outcome.faults.append(f"{what}: {error!r}")
        outcome.slowest = max(outcome.slowest, time.monotonic() - start)
        file.unlink()
        file.write_bytes(whole)  # a new file: the old one may be mapped
    used = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10
    if used > _MEMORY:
        outcome.faults.append(f"the reading process grew by {used >> 20} MiB")
    return outcome


def _trouble(path: Path, kind: str, original: Volume, volume: Volume, again: Volume) -> str:
    if volume.values.shape != again.values.shape or not np.array_equal(volume.values, again.values):
        return "differs from reading to reading"
    if not np.isfinite(volume.normalised()).all() or not np.isfinite(volume.extent).all():
        return "is not finite"
    larger = volume.values.size > original.values.size and volume.vertices is None
    if larger and not any(mark in path.name for mark in CHUNKED):
        larger = math.prod(list_variables(path)[0].dims or ()) > original.values.size  # not by uneven axes
    if larger and not any(mark in path.name for mark in CHUNKED):
        return f"has the dims {volume.dims}"
    if kind == "cut" and not (
        volume.values.shape == original.values.shape and np.allclose(volume.values, original.values)
    ):
        return "was cut, and is not the original"
    return ""


def main() -> int:
    """Fuzz the formats named on the command line, or all; print a line for each."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "formats",
        nargs="*",
    )
    parser.add_argument("--mutations", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    bad = 0
    write = [sys.executable, "-m", "tests.datasets.samples"]  # apart: a small process forks faster
    for name in options.formats or subprocess.check_output(write, encoding="utf-8").split():
        folder = Path(tempfile.mkdtemp())
        start = time.monotonic()
        subprocess.check_call([*write, name, str(folder)])
        with pytest.MonkeyPatch.context() as patch:
            outcome = fuzz(folder / name, options.mutations, folder, patch, options.seed)
        shutil.rmtree(folder)
        bad += bool(outcome.faults)
        wall = time.monotonic() - start
        print(f"{name}: {dict(outcome.counts)}, slowest {outcome.slowest:.1f} s, {wall:.0f} s", flush=True)
        for fault in outcome.faults[:10]:
            print(f"    {fault}", flush=True)
        if len(outcome.faults) > 10:
            print(f"    and {len(outcome.faults) - 10} more", flush=True)
    return bad


if __name__ == "__main__":
    sys.exit(main())
