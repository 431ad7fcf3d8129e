"""Reading volumes: time and memory of this installation against another one, by format.

python -m tools.benchmarks.bench_reading --against PYTHON [--samples 256] [--turns 5]

PYTHON is the interpreter of an environment with the other commit.

Each reading is a process of its own, and the two take turns. Its time is that of the second call,
as the first imports what it needs; its memory is the peak of the process.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.benchmarks.turns import heading, row

READ = """
import json, sys, time
try:
    from econgs_bench.datasets.memory import peak_host_bytes
    from econgs_bench.datasets.readers import read_volume
except ImportError:  # before packages had one name
    from datasets.memory import peak_host_bytes
    from datasets.readers import read_volume
read_volume(sys.argv[1])  # imports what it needs
start, cpu = time.perf_counter(), time.process_time()
volume = read_volume(sys.argv[1])
print(json.dumps([time.perf_counter() - start, time.process_time() - cpu]))
print(peak_host_bytes())
"""


def main() -> None:
    arguments = _parser().parse_args()
    samples = arguments.samples
    heading("Reading", "format", "time here [ms]", "there", "ratio", "processor time, ratio", "memory, ratio")
    with tempfile.TemporaryDirectory() as folder:
        for name, write in FORMATS.items():
            path = write(Path(folder), _values(samples))
            measured: dict[str, list[tuple[float, float, float]]] = {
                sys.executable: [],
                arguments.against: [],
            }
            for turn in range(arguments.turns + 1):
                for python, found in measured.items():
                    one = _read(python, path)
                    if turn:
                        found.append(one)
            here, there = (
                [statistics.median(column) for column in zip(*found, strict=True)]
                for found in measured.values()
            )
            ratios = [f"{a / b:.2f}" for a, b in zip(here, there, strict=True)]
            row(name, f"{1e3 * here[0]:.1f}", f"{1e3 * there[0]:.1f}", *ratios)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", required=True, help="the other interpreter")
    parser.add_argument("--samples", type=int, default=256, help="along each axis")
    parser.add_argument("--turns", type=int, default=5)
    return parser


def _values(samples: int) -> NDArray[np.float32]:
    """A smooth field with noise, so that no packing or search is at its best."""
    axis = np.linspace(-1.0, 1.0, samples, dtype=np.float32)
    field = np.sin(7.0 * axis)[:, None, None] * np.cos(5.0 * axis)[:, None] + axis
    noise = np.random.default_rng(0).normal(0.0, 0.01, field.shape)
    return np.asarray(field + noise, np.float32)


def _read(python: str, path: Path) -> tuple[float, float, float]:
    """Seconds, seconds of the processor and bytes of one reading."""
    found = subprocess.run(
        [python, "-P", "-c", READ, str(path)], capture_output=True, text=True, check=True, cwd="/"
    )
    times, memory = found.stdout.splitlines()
    wall, cpu = json.loads(times)
    return wall, cpu, float(memory)


def _raw(dtype: str) -> Callable[[Path, NDArray[np.float32]], Path]:
    def write(folder: Path, values: NDArray[np.float32]) -> Path:
        n = len(values)
        path = folder / f"v_{n}x{n}x{n}_{dtype}.raw"
        _as(dtype, values).tofile(path)
        return path

    return write


def _as(dtype: str, values: NDArray[np.float32]) -> NDArray[np.generic]:
    if dtype == "float32":
        return values
    scaled = (values - values.min()) / np.ptp(values) * np.iinfo(dtype).max
    return np.asarray(scaled, dtype)


def _npy(folder: Path, values: NDArray[np.float32]) -> Path:
    np.save(folder / "v.npy", values)
    return folder / "v.npy"


def _nifti(folder: Path, values: NDArray[np.float32]) -> Path:
    import nibabel

    nibabel.save(nibabel.Nifti1Image(_as("int16", values), np.diag([0.5, 0.5, 2.0, 1.0])), folder / "v.nii")
    return folder / "v.nii"


def _nrrd(folder: Path, values: NDArray[np.float32]) -> Path:
    import nrrd

    nrrd.write(str(folder / "v.nrrd"), values, {"encoding": "raw", "spacings": [1.0, 1.0, 2.0]})
    return folder / "v.nrrd"


def _hdf5(folder: Path, values: NDArray[np.float32]) -> Path:
    import h5py

    with h5py.File(folder / "v.h5", "w") as file:
        file["v"] = values
    return folder / "v.h5"


def _netcdf(folder: Path, values: NDArray[np.float32]) -> Path:
    import netCDF4

    with netCDF4.Dataset(folder / "v.nc", "w") as file:
        for name, size in zip("zyx", values.shape, strict=True):
            file.createDimension(name, size)
            file.createVariable(name, "f8", (name,))[:] = np.arange(size)
        file.createVariable("v", "f4", tuple("zyx"))[:] = values
    return folder / "v.nc"


def _tiff(folder: Path, values: NDArray[np.float32]) -> Path:
    import tifffile

    tifffile.imwrite(folder / "v.tif", _as("uint16", values), imagej=True, resolution=(2.0, 2.0))
    return folder / "v.tif"


def _vti(folder: Path, values: NDArray[np.float32]) -> Path:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    image, array = vtkImageData(), numpy_to_vtk(values.ravel())
    image.SetDimensions(*values.shape[::-1])
    array.SetName("v")
    image.GetPointData().SetScalars(array)
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(folder / "v.vti"))
    writer.SetInputData(image)
    writer.Write()
    return folder / "v.vti"


FORMATS: dict[str, Callable[[Path, NDArray[np.float32]], Path]] = {
    "raw, float32": _raw("float32"),
    "raw, uint16": _raw("uint16"),
    "raw, uint8": _raw("uint8"),
    "npy": _npy,
    "NIfTI, int16": _nifti,
    "NRRD": _nrrd,
    "HDF5": _hdf5,
    "NetCDF-4": _netcdf,
    "TIFF, uint16": _tiff,
    "VTI": _vti,
}

if __name__ == "__main__":
    main()
