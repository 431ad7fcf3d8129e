"""Draws the blobs of a PLY from the cameras of a folder; sees no true picture."""

import json
import sys
import time
from pathlib import Path

import numpy as np
from blobs import footprints, load, picture
from PIL import Image

points, sigma, depth, colors = load(sys.argv[1])
frames = json.loads((Path(sys.argv[2]) / "transforms_test.json").read_text())["frames"]
for frame in frames:
    start = time.perf_counter()
    total, mean = picture(depth, colors, *footprints(points, sigma, frame))
    pixels = np.concatenate([mean, -np.expm1(-total)[..., None]], axis=-1)
    print(f"frame {time.perf_counter() - start:.6f} s", flush=True)
    name = Path(frame["file_path"]).name + ".png"
    Image.fromarray(np.rint(255 * pixels.clip(0, 1)).astype(np.uint8)).save(Path(sys.argv[3]) / name)
