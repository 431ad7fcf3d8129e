"""Synthetic run stores: tables of the schema, and picture files."""

from __future__ import annotations

import io
import json
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import TABLES, frame

NO_LPIPS = "lpips_vgg: backbone weights missing: put vgg16-397923af.pth into ~/.cache/torch/hub/checkpoints"


def picture(path: Path, size: int, shift: float, noise: float, seed: int) -> None:
    """A shaded ball with straight alpha."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_ball(size, shift, noise, seed))


@cache
def _ball(size: int, shift: float, noise: float, seed: int) -> bytes:
    """Its PNG, made once."""
    y, x = np.mgrid[0:size, 0:size] / size * 2 - 1
    r = np.hypot(x - shift, y)
    rng = np.random.default_rng(seed)
    rgb = np.stack([0.9 - 0.4 * r, 0.5 + 0.3 * x, 0.3 + 0.4 * y], -1) + rng.normal(0, noise, (size, size, 3))
    alpha = np.clip((0.8 - r) * 8, 0, 1)[..., None]
    file = io.BytesIO()
    pixels = (np.clip(np.concatenate([rgb, alpha], -1), 0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def settings(variant: str, knob: str = "rate_weight") -> dict:
    """The axes of a row with these settings, of a method with this rate knob."""
    texts = [text for text in variant.split(",") if text]
    values = [float(text.removeprefix(f"{knob}=")) for text in texts if text.startswith(f"{knob}=")]
    base = ",".join(text for text in texts if not text.startswith(f"{knob}="))
    return {"variant": variant, "base": base, "knob_value": values[0] if values else None}


class Maker:
    """Builds the tables of a synthetic store under a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.rows: dict[str, list[dict]] = {name: [] for name in TABLES}

    def run(
        self, dataset="vortex", scene="tf0", method="3dgs", variant="", rate=None, psnr=33.98, size=4_000_000,
        fps=120.0, seconds=42.0, seed=0, status="ok", reason=NO_LPIPS, stale=False, lpips=None, side=96,
        views=5, **more,
    ) -> None:  # fmt: skip
        job = f"measure-{len(self.rows['results']):04d}"
        axes = {"dataset": dataset, "scene": scene, "method": method, **settings(variant), "rate": rate,
                "preset": "quick", "split": "test", "seed": seed, "job": job,
                "requested_views": more.pop("requested_views", 42)}  # fmt: skip
        row = {**axes, "kind": "basic", "edit": "", "status": status, "reason": reason, "stale": stale,
               "omissions": json.dumps(dict([reason.split(": ", 1)])) if reason == NO_LPIPS else None,
               "group": scene, "iterations": 700, "train_views": 38, "width": side, "height": side,
               "device": "cpu", "machine": "laptop", "threads": 2, "commit": "68a71d8fe012",
               "stage": None if status == "ok" else "densify"}  # fmt: skip
        if status != "ok":
            self.rows["results"].append(row | more)
            return
        quality = {"ssim": 1 - 2 / psnr, "flip": 1.2 / psnr, "delta_e_uv": 40 / psnr, "psnr_fg": psnr - 4}
        row |= {**quality, "psnr": psnr, "lpips_vgg": lpips, "size_bytes": size, "group_bytes": size,
                "standalone_bytes": size, "primitives": size // 236, "train_seconds": seconds,
                "group_seconds": seconds, "load_seconds": 0.04, "fps": fps, "peak_host_bytes": 700 << 20,
                "group_peak_host_bytes": 650 << 20, "fps_p05": fps * 0.8, "fps_p95": fps * 1.1,
                "encode_seconds": 0.1, "reference_seconds": 0.0123, "identical_views": 0}  # fmt: skip
        self.rows["results"].append(row | more)
        for i in range(views):
            truth = f"jobs/views-{dataset}-{scene}/truth/{i:04d}.png"
            render = f"jobs/{job}/renders/{i:04d}.png"
            if not (self.root / truth).exists():
                picture(self.root / truth, side, 0.1 * i - 0.2, 0.0, 0)
            picture(self.root / render, side, 0.1 * i - 0.2 + 0.01 * i, 0.02 + 0.02 * i, i)
            files = {"truth_file": truth, "render_file": render, "background": "#ffffff"}
            values = {"view": f"{i:04d}", "psnr": psnr + 2 - i, "identical": False}
            self.rows["views"].append(axes | quality | values | files)
        for step in range(8):
            point = {"iteration": step * 100, "train_seconds": seconds * step / 7, "loss": 0.1,
                     "psnr": psnr - 12 * 0.5**step, "primitives": 1000}  # fmt: skip
            self.rows["curve"].append(axes | {"job": f"fit-{job}"} | point)
        shares = {"positions": 0.05, "spherical harmonics": 0.76, "opacity, scale, rotation": 0.19}
        for part, portion in shares.items():
            size_of_part = {"job": f"encode-{job}", "part": part, "bytes": int(size * portion)}
            self.rows["ledger"].append(axes | size_of_part)

    def dvr(self, dataset="vortex", scene="tf0", ms=40.0, **more) -> None:
        """Cost of rendering a volume."""
        row = {"job": f"dvr-{len(self.rows['dvr']):04d}", "dataset": dataset, "scene": scene, "kind": "basic",
               "preset": "quick", "status": "ok", "nx": 600, "ny": 360, "nz": 240, "variables": "ACC",
               "dtype": "float32", "volume_bytes": 2**28, "ms_per_view": ms, "ms_p05": ms / 2,
               "ms_p95": ms * 2, "fps": 1e3 / ms, "setup_seconds": 1.5, "peak_host_bytes": 2**30,
               "width": 128, "height": 128, "renderer": "mitsuba", "backend": "llvm", "machine": "laptop",
               "threads": 2}  # fmt: skip
        self.rows["dvr"].append(row | more)

    def tables(self) -> dict[str, pd.DataFrame]:
        return {name: frame(name, rows) for name, rows in self.rows.items()}

    def report(self) -> Report:
        return Report(self.tables())


METHODS = {
    "econgs": (36.74, 480_000, 95.0, 130.0),
    "3dgs": (33.98, 33_000_000, 140.0, 154.0),
    "ivr-gs": (34.54, 2_900_000, 80.0, 690.0),
    "plenoxels": (31.37, 300_000_000, 12.0, 270.0),
    "ccnerf": (31.21, 2_600_000, 0.4, 1100.0),
    "scaffold-gs": (27.14, 12_000_000, 60.0, 220.0),
    "hac": (26.74, 1_270_000, 22.0, 540.0),
    "vq-3dgs": (33.1, 2_700_000, 150.0, 200.0),
}


def fill(maker: Maker, case: str) -> None:
    """Fill a store with a case of the report."""
    if case == "normal":
        maker.run(scene="tf0", psnr=34.2)
        maker.run(scene="tf1", psnr=31.7, size=5_100_000, seconds=51.0)
    elif case == "failures":
        maker.run(scene="tf0", stale=True)
        maker.run(scene="tf1", status="oom", reason="the fit passed its limit of 8 GiB")
        maker.run(scene="tf0", method="econgs", psnr=36.0, size=480_000)
        maker.run(scene="tf1", method="econgs", psnr=35.1, size=410_000)
        maker.run(scene="tf0", method="hac", status="refused", reason="<b>cannot</b> & will not")
        maker.run(scene="tf1", method="hac", status="timeout", reason="over 600 s")
    elif case == "many":
        for dataset, offset in (("vortex", 0.0), ("combustion", -1.5), ("ionization", 1.0)):
            for scene in range(3):
                for method, (psnr, size, fps, seconds) in METHODS.items():
                    knob = [(None, 1.0)] if method != "econgs" else [(0.5, 0.6), (1.0, 1.0), (2.0, 1.8)]
                    for rate, factor in knob:
                        maker.run(
                            dataset, f"tf{scene}", method, rate=rate, reason=None, lpips=3 / psnr,
                            psnr=psnr + offset + scene + 2 * (factor - 1), fps=fps / (1 + scene / 3),
                            size=int(size * factor * (1 + scene / 4)), seconds=seconds,
                        )  # fmt: skip
    elif case == "seeds":
        for seed, shift in enumerate((0.0, 0.3, -0.3)):
            for scene in ("tf0", "tf1"):
                maker.run(scene=scene, seed=seed, psnr=34.0 + shift)


@pytest.fixture
def maker(tmp_path: Path) -> Maker:
    return Maker(tmp_path)
