"""What a GPU machine without a network needs beside the repository: wheels, in one folder.

python -m tools.gpu.prepare [--out .gpu] [--python 3.12]

The machine has a Python with torch for CUDA, CMake, a C++ compiler and nvcc. The folder and the repository go
there; the command that this prints runs there.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

PACKAGES = (
    "annotated-types", "bjontegaard", "constriction", "filelock", "flip-evaluator", "gsplat", "jaxtyping",
    "lpips", "nanobind", "nibabel", "platformdirs", "pydantic", "pydantic-core", "pynrrd", "rich",
    "scikit-build-core", "typing-extensions", "typing-inspection",
)  # fmt: skip
"""All that a run imports and that images with torch often lack. Mitsuba (60 MB) and VTK (134 MB) stay here:
truth is drawn there by the marcher in torch."""
COMMANDS = """\
install="python3 -m pip install -q --no-index --no-deps --no-compile --target /tmp/site"
$install {out}/*.whl && export PYTHONPATH=/tmp/site &&
$install --no-build-isolation . && PYTHONPATH=/tmp/site:$PWD python3 -P -m tools.gpu --out OUT"""
GLIBC = (17, 24, 27, 28, 31, 34)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(".gpu"), help="default: .gpu")
    parser.add_argument("--python", default="3.12", help="of that machine (default: 3.12)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for wheel in options.out.glob("*.whl"):  # pip installs no two versions of one
        wheel.unlink()
    pins = (Path(__file__).parents[2] / "constraints.txt").read_text(encoding="utf-8").split()
    pinned = {pin.partition("==")[0].lower().replace("_", "-"): pin for pin in pins}
    platforms = [f"--platform=manylinux_2_{n}_x86_64" for n in GLIBC] + ["--platform=manylinux2014_x86_64"]
    for name in PACKAGES:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
        command += [f"--python-version={options.python}", "--implementation=cp", *platforms]
        subprocess.run([*command, f"--dest={options.out}", pinned.get(name, name)], check=True)
    total = sum(file.stat().st_size for file in options.out.glob("*.whl"))
    print(f"{len(list(options.out.glob('*.whl')))} wheels, {total / 2**20:.0f} MiB, in {options.out}. There:")
    print(COMMANDS.format(out=options.out))


if __name__ == "__main__":
    main()
