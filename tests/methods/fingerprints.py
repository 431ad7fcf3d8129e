"""Fingerprints of the methods: a tiny fit of each, recorded, so that no change of results passes unseen.

    python tests/methods/fingerprints.py            compare every method with tests/fingerprints.json
    python tests/methods/fingerprints.py --write    record new methods, new versions, and settings of presets
    python tests/methods/fingerprints.py --write --keep-version NAME
                                                    record changed results of the same version (say why)

The fits run on the tiny scene of the contract kit, each method in a process of its own: one thread; our
kernels, torch and MKL held to their baseline instruction set, so that every x86-64 machine does the same
arithmetic. Where the software behind it is the recorded one too (:func:`arithmetic`), results must be equal
byte for byte; elsewhere (another compiler, C library, release of torch or model of processor, by which
libraries choose their code) they must lie within ``TOLERANCE``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

FILE = Path(__file__).parents[1] / "fingerprints.json"
ITERATIONS = {"fair": 64}
"""Of the default configuration. Fits of others are shorter: published step sizes amplify rounding."""
SHORT = 24
ANCHORS = 1000
"""Of random starts of anchors, in place of the published 10,000.

Of more, HAC rounds some otherwise on another processor. Gaussians have as many as published, 100,000: of
fewer, each has a gradient near the threshold of growth, where the last bit decides who grows.
"""
VIEWS = 3
"""Of the loaded model, whose mean colors and alphas are recorded."""
TOLERANCE = {"losses": 2e-3, "pictures": 2e-3, "sizes": 0.02}
"""Relative differences that other software may cause; see :func:`differences`."""
BASELINE = {
    "ECONGS_ISA": "baseline",
    "ECONGS_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_CBWR": "COMPATIBLE",
    "ONEDNN_MAX_CPU_ISA": "SSE41",
    "CUDA_VISIBLE_DEVICES": "",
    "DRJIT_LIBLLVM_PATH": "none",  # volumes are drawn by the marcher in torch
}


def measure(name: str) -> dict[str, Any]:
    """The fingerprint of a method, by a process held to the baseline."""
    command = [sys.executable, "-P", __file__, "--measure", name]
    run = subprocess.run(
        command, env=os.environ | BASELINE, cwd=FILE.parents[1], capture_output=True, encoding="utf-8"
    )
    if run.returncode:
        raise RuntimeError(f"the fit of {name} failed:\n{run.stderr[-4000:]}")
    return dict(json.loads(run.stdout.splitlines()[-1]))


def fingerprint(name: str) -> dict[str, Any]:
    """Settings of every preset and configuration, and what fits with those of "quick" come to."""
    import torch

    from econgs_bench.methods.contract.checks import Subject
    from econgs_bench.methods.interface import PRESETS
    from econgs_bench.methods.options import CONFIGURATION, declared, resolve
    from econgs_bench.methods.registry import Registry, load_method

    torch.set_num_threads(1)
    spec = Registry().spec(name)
    configurations = list(spec.configurations) or [""]
    fewer = {"random_points": ANCHORS} if "max_anchors" in declared(spec.options) else {}
    settings, fits = {}, {}
    for one in configurations:
        overrides = {CONFIGURATION: one} if one else {}
        for preset in PRESETS:
            resolved = resolve(spec, preset, overrides)
            settings[f"{preset} {one}".strip()] = {"iterations": resolved.iterations, **resolved.values}
        with tempfile.TemporaryDirectory() as folder:
            count = ITERATIONS.get(one or "fair", SHORT)
            fits[one] = _fit(Subject(spec, load_method(spec), Path(folder), count, overrides | fewer))
    return {"version": spec.version, "arithmetic": arithmetic(), "settings": settings, "fits": fits}


def arithmetic() -> dict[str, str]:
    """Software and processor that decide the last bit of a result, and a digest of some numbers of theirs."""
    import numpy as np
    import torch

    from econgs_bench.econgs.splat import native

    module = Path(native._native.__file__).read_bytes()
    compiler = re.search(rb"GCC: \([^)]*\) [\d.]+|clang version [\d.]+", module)
    values = torch.linspace(-3.0, 3.0, 4096).reshape(64, 64)
    steps = (
        torch.exp(values),
        torch.sigmoid(values),
        torch.tanh(values),
        values @ values.exp(),
        values.sum(0),
    )
    digest = hashlib.sha256(b"".join(step.numpy().tobytes() for step in steps))
    digest.update(np.exp(values.numpy()).tobytes() + np.log(np.arange(1.0, 999.0)).tobytes())
    return {
        "torch": torch.__version__.partition("+")[0],
        "libc": " ".join(platform.libc_ver()),
        "compiler": compiler[0].decode() if compiler else "",
        "probe": digest.hexdigest()[:16],
        "processor": _processor(),
    }


def _processor() -> str:
    """Vendor, family and model, as "AuthenticAMD 25 17"; what Python says where Linux does not."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = (part.strip() for part in line.partition(":"))
        fields.setdefault(name, value)
    return " ".join(fields.get(name, "") for name in ("vendor_id", "cpu family", "model")).strip()


def _fit(subject: Any) -> dict[str, Any]:
    """Losses of every iteration, primitives, and the bytes and pictures of the saved model."""
    from econgs_bench.methods.contract.checks import Recorder, files_of
    from econgs_bench.methods.contract.scene import cameras

    recorder = Recorder()
    scenes = [subject.tiny("one"), subject.tiny("two", 0.15)] if subject.spec.joint else [subject.tiny("one")]
    model = subject.fit(scenes, recorder)
    folder, ledger = subject.saved(model, "model")
    files = files_of(folder)
    digest = hashlib.sha256()
    for name, content in sorted(files.items()):
        digest.update(name.encode() + b"\0" + content)
    loaded = subject.method.load(folder, "cpu")
    pictures = []
    for camera in cameras(VIEWS, phase=0.5):
        color, alpha = loaded.render(camera, scenes=[scenes[0].name])
        pictures.append([*(float(channel.mean()) for channel in color.unbind(-1)), float(alpha.mean())])
        pictures[-1] += [float(color.square().mean()), float((color[1:] - color[:-1]).abs().mean())]
    return {
        "losses": [float(f"{loss:.8g}") for loss in recorder.losses],
        "primitives": model.primitives(),
        "bytes": {
            f"{scene}/{part}": count for scene, parts in ledger.items() for part, count in parts.items()
        },
        "pictures": [[float(f"{value:.8g}") for value in row] for row in pictures],
        "sha256": digest.hexdigest(),
    }


def choices(now: dict[str, Any], recorded: dict[str, Any]) -> list[str]:
    """Settings of presets that are not as recorded, one line each: rows with the former ones turn stale."""
    lines = []
    for name in sorted(set(now["settings"]) | set(recorded["settings"])):
        one, other = now["settings"].get(name, {}), recorded["settings"].get(name, {})
        for option in sorted(set(one) | set(other)):
            if one.get(option) != other.get(option):
                lines.append(f"{name}: {option} is {one.get(option)!r}, recorded {other.get(option)!r}")
    return lines


def differences(now: dict[str, Any], recorded: dict[str, Any]) -> list[str]:
    """What of a method's results is not as recorded, one line each.

    Fits are compared exactly where the arithmetic is the recorded one, elsewhere within
    :data:`TOLERANCE` (bytes and primitives: at least 4).
    """
    exact = now["arithmetic"] == recorded["arithmetic"]
    lines = []
    for name in sorted(set(now["fits"]) | set(recorded["fits"])):
        one, other = now["fits"].get(name), recorded["fits"].get(name)
        label = f"fit {name}".strip()
        if one is None or other is None:
            lines.append(f"{label}: {'not recorded' if other is None else 'no longer there'}")
            continue
        if exact and one != other:
            lines.append(
                f"{label}: not byte for byte as recorded ({', '.join(k for k in one if one[k] != other[k])})"
            )
        lines += _unlike(label, one, other)
    return lines


def _unlike(label: str, one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    lines = []
    if len(one["losses"]) != len(other["losses"]):
        return [f"{label}: {len(one['losses'])} losses, recorded {len(other['losses'])}"]
    for i, (a, b) in enumerate(zip(one["losses"], other["losses"], strict=True), 1):
        if abs(a - b) > TOLERANCE["losses"] * abs(b):
            lines.append(f"{label}: loss {a:.8g} at iteration {i}, recorded {b:.8g}")
            break
    sizes, past_sizes = (
        {"primitives": fit["primitives"], **{f"bytes of {part}": n for part, n in fit["bytes"].items()}}
        for fit in (one, other)
    )
    for part in sorted(sizes | past_sizes):
        a, b = sizes.get(part, -100), past_sizes.get(part, -100)
        if abs(a - b) > max(TOLERANCE["sizes"] * abs(b), 4):
            lines.append(f"{label}: {part} {a}, recorded {b}")
    far = max(
        abs(a - b)
        for row, past in zip(one["pictures"], other["pictures"], strict=True)
        for a, b in zip(row, past, strict=True)
    )
    if far > TOLERANCE["pictures"]:
        lines.append(f"{label}: pictures of the loaded model differ by {far:.2g} in their means")
    return lines


def recorded() -> dict[str, Any]:
    """Method -> its fingerprint as recorded."""
    return dict(json.loads(FILE.read_text(encoding="utf-8"))) if FILE.is_file() else {}


def verdict(name: str, now: dict[str, Any], past: dict[str, Any] | None) -> str:
    """What is wrong with a method's results and what to do; "" if nothing."""
    remedy = f"python tests/methods/fingerprints.py --write {name}"
    if past is None:
        return f"{name} has no fingerprint: run {remedy}"
    lines = differences(now, past)
    if now["version"] != past["version"]:
        return f"{name} has version {now['version']}, its fingerprint {past['version']}: run {remedy}"
    if lines:
        chosen = choices(now, past)
        remedies = "raise its version or undo it"
        if chosen:
            remedies += f"; if it is by options of presets alone, run {remedy} --keep-version"
        return f"results of {name} changed: {remedies}\n  " + "\n  ".join([*lines, *chosen])
    if lines := choices(now, past):
        return f"options of {name} changed: undo it or run {remedy}\n  " + "\n  ".join(lines)
    return ""


def main() -> int:
    from econgs_bench.methods.registry import Registry

    parser = argparse.ArgumentParser(description="Compare or record the fingerprints of the methods.")
    parser.add_argument("methods", nargs="*", metavar="METHOD", help="default: all built-in ones")
    parser.add_argument("--write", action="store_true", help="record them in tests/fingerprints.json")
    parser.add_argument(
        "--keep-version", action="store_true", help="record changed results of the same version"
    )
    parser.add_argument("--measure", metavar="METHOD", help=argparse.SUPPRESS)  # inside the process of a fit
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(fingerprint(options.measure)))
        return 0
    past, wrong = recorded(), 0
    for name in options.methods or Registry().built_in():
        now = measure(name)
        problem = verdict(name, now, past.get(name))
        if options.write and (not problem.startswith("results of") or options.keep_version):
            past[name] = now
            problem = ""
        wrong += bool(problem)
        print(problem or f"{name}: {'recorded' if options.write else 'as recorded'}", flush=True)
    if options.write:
        FILE.write_text(_text(past), encoding="utf-8")
    return 1 if wrong else 0


def _text(prints: dict[str, Any]) -> str:
    """JSON with short lists on one line each, so that a change is a readable diff."""
    text = json.dumps(prints, indent=1, sort_keys=True)
    return re.sub(r"\[[^][{}]*\]", lambda match: re.sub(r"\s+", " ", match[0]), text) + "\n"


if __name__ == "__main__":
    sys.exit(main())
