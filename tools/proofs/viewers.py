"""Does an exported file look right in a viewer? Draws it in Spark, in headless Chromium, beside the model.

python -m tools.proofs.viewers JOB FILE --runs DIR [--packages DIR] [--views 4] [--out DIR] [--option NAME=1]

FILE is what `bench export JOB` wrote (ply, spz, sog). The packages @sparkjsdev/spark and three come from npm,
once per folder. Prints, at 1, 2 and 4 times the size of the test views, the PSNR against the model's own
pictures, and the ink: how much darker than the background Spark's picture is, as a share of the model's.
Options are those of the class SparkRenderer, as blurAmount=0.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from econgs_bench.bench.saved import load, picture, truth_of
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.camera import Camera

PACKAGES = ("@sparkjsdev/spark@2.2.0", "three@0.187.0")
SIZES = (1, 2, 4)
PATIENCE = 600.0  # seconds until all pictures are there
_TURNS = {"ply": (0, 0, 0, 1), "sog": (0, 0, 0, 1), "spz": (1, 0, 0, 0)}
"""Half turn (x, y, z, w) from the axes of a format to the scene's."""
_CHROMIUM = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
_PAGE = """<!doctype html><script type="importmap">{"imports": {
"three": "/node_modules/three/build/three.module.js",
"three/addons/": "/node_modules/three/examples/jsm/",
"@sparkjsdev/spark": "/node_modules/@sparkjsdev/spark/dist/spark.module.js"}}</script><script type="module">
const tell = (path, body) => fetch(path, {method: "POST", body});
try {
  const THREE = await import("three");
  const {SparkRenderer, SplatMesh} = await import("@sparkjsdev/spark");
  const job = await (await fetch("/job")).json();
  const renderer = new THREE.WebGLRenderer({antialias: false, preserveDrawingBuffer: true});
  renderer.setPixelRatio(1);
  renderer.setClearColor(new THREE.Color().setRGB(...job.background, THREE.SRGBColorSpace), 1);
  const scene = new THREE.Scene();
  const spark = new SparkRenderer({renderer, ...job.options});
  scene.add(spark);
  const splats = new SplatMesh({url: "/file." + job.format});
  splats.quaternion.set(...job.turn);
  scene.add(splats);
  await splats.initialized;
  const gl = renderer.getContext();
  for (const [number, shot] of job.shots.entries()) {
    renderer.setSize(shot.width, shot.height);
    const angle = 2 * Math.atan(shot.height / (2 * shot.fy)) * 180 / Math.PI;
    const aspect = shot.width / shot.height * shot.fy / shot.fx;
    const camera = new THREE.PerspectiveCamera(angle, aspect, shot.near, 1000);
    camera.matrixAutoUpdate = false;
    camera.matrix.set(...shot.pose);
    camera.updateMatrixWorld(true);
    let pixels = null;
    for (let same = 0; same < 3;) {  // the order of Gaussians comes from a worker, some frames later
      await spark.update({scene, camera});
      renderer.render(scene, camera);
      const now = new Uint8Array(4 * shot.width * shot.height);
      gl.readPixels(0, 0, shot.width, shot.height, gl.RGBA, gl.UNSIGNED_BYTE, now);
      same = pixels && now.every((value, place) => value === pixels[place]) ? same + 1 : 0;
      pixels = now;
      await new Promise(resolve => setTimeout(resolve, 60));
    }
    await tell("/shot/" + number, pixels);
  }
  await tell("/done", "");
} catch (error) { await tell("/failed", String(error.stack || error)); }
</script>"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw, compare, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("job")
    parser.add_argument("file", type=Path)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--scene")
    parser.add_argument("--packages", type=Path, default=Path(tempfile.gettempdir(), "viewers"))
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--out", type=Path, help="folder for pictures: the model's beside Spark's")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE")
    options = parser.parse_args(arguments)
    store = Store(options.runs)
    _, scenes, _, model = load(store, options.job, {}, "cpu")
    scene = options.scene or scenes[0]
    _, truth = truth_of(store, options.job, scene)
    background = truth.scene().background
    tests = truth.cameras("test")
    chosen = tests[:: max(1, len(tests) // options.views)][: options.views]
    shots = [one.resized(size * one.width, size * one.height) for size in SIZES for one in chosen]
    values = {name: json.loads(value) for name, value in (one.split("=", 1) for one in options.option)}
    found = drawn(options.file, shots, background, _installed(options.packages), values)
    for start, size in zip(range(0, len(shots), len(chosen)), SIZES, strict=True):
        scores, inks = [], []
        for number in range(start, start + len(chosen)):
            own, _ = picture(model, shots[number], [scene], {}, background)
            scores.append(-10.0 * np.log10(np.square(own.clip(0.0, 1.0) - found[number]).mean()))
            inks.append(np.abs(found[number] - background).sum() / np.abs(own - background).sum())
            if options.out:
                options.out.mkdir(parents=True, exist_ok=True)
                both = np.concatenate([own.clip(0.0, 1.0), found[number]], axis=1)
                Image.fromarray(np.rint(255.0 * both).astype(np.uint8)).save(options.out / f"{number:02}.png")
        print(f"{options.file.name}, {size} x: {np.mean(scores):.2f} dB, ink {np.mean(inks):.3f}", flush=True)
    return 0


def _installed(folder: Path) -> Path:
    """The folder, with the packages in it."""
    if not (folder / "node_modules" / "@sparkjsdev" / "spark").is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        subprocess.run(["npm", "install", "--no-audit", "--prefix", str(folder), *PACKAGES], check=True)
    return folder


def drawn(
    file: Path, shots: Sequence[Camera], background: Sequence[float], packages: Path, options: dict[str, Any]
) -> list[NDArray[np.float32]]:
    """Spark's pictures (height, width, 3) of a file over a background, in [0, 1].

    Raises:
        RuntimeError: the page failed, or took too long.
    """
    pictures: dict[int, bytes] = {}
    problems: list[str] = []
    ended = threading.Event()
    turn = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV's camera to that of OpenGL
    form = file.suffix.lstrip(".")
    job = {
        "background": list(background), "format": form, "turn": _TURNS[form], "options": options,
        "shots": [
            {"width": one.width, "height": one.height, "fx": one.fx, "fy": one.fy, "near": one.near,
             "pose": (one.camera_to_world @ turn).reshape(-1).tolist()}
            for one in shots
        ],
    }  # fmt: skip
    replies = {"/": _PAGE.encode(), "/job": json.dumps(job).encode(), f"/file.{form}": file.read_bytes()}

    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments, directory=str(packages))

        def log_message(self, *_: Any) -> None:
            pass

        def do_GET(self) -> None:
            body = replies.get(self.path)
            if body is None:
                return super().do_GET()
            self.send_response(200)
            self.send_header("Content-Type", "text/html" if self.path == "/" else "application/octet-stream")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            if self.path.startswith("/shot/"):
                pictures[int(self.path.rpartition("/")[2])] = body
            else:
                problems.extend([body.decode()] if self.path == "/failed" else [])
                ended.set()
            self.send_response(204)
            self.end_headers()

    program = (
        os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome") or "chromium"
    )
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server, tempfile.TemporaryDirectory() as profile:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/"
        browser = subprocess.Popen(
            [program, *_CHROMIUM, f"--user-data-dir={profile}", address],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            if not ended.wait(PATIENCE) or problems:
                raise RuntimeError(f"{file}: {' '.join(problems) or 'the page did not end'}")
        finally:
            browser.terminate()
            browser.wait()
            server.shutdown()
    found = []
    for number, one in enumerate(shots):
        pixels = np.frombuffer(pictures[number], np.uint8).reshape(one.height, one.width, 4)
        found.append(pixels[::-1, :, :3].astype(np.float32) / 255.0)
    return found


if __name__ == "__main__":
    raise SystemExit(main())
