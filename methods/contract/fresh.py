"""Renders a saved model in a process of its own.

``python -m econgs_bench.methods.contract.fresh NAME DEVICE FOLDER ...`` is that process.

FOLDER holds ``model`` and ``view.npz``; it gets ``picture.npz`` or ``failure.json``. Plugin folders follow.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

from econgs_bench.datasets.camera import Camera
from econgs_bench.methods.failures import failure
from econgs_bench.methods.registry import Registry, load_method


def main(name: str, device: str, folder: str, *plugins: str) -> int:
    """Load and render; 1 if either failed."""
    spec = Registry(plugins).spec(name)
    try:
        with np.load(Path(folder, "view.npz")) as view:
            size = int(view["width"]), int(view["height"])
            near = float(view["near"])
            camera = Camera.with_fov(view["pose"], float(view["fov"]), *size, near=near)
        rgb, alpha = load_method(spec).load(Path(folder, "model"), device).render(camera)
        np.savez(Path(folder, "picture.npz"), rgb=rgb.cpu().numpy(), alpha=alpha.cpu().numpy())
    except Exception as error:
        facts = {"error": f"{type(error).__name__}: {error}", **asdict(failure(error, spec))}
        Path(folder, "failure.json").write_text(json.dumps(facts), encoding="utf-8")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
