"""Speed of decoding anchors: the native kernels against the torch twin within one run.

    python tests/benchmarks/bench_decode.py [--repeats N] [--threads N] [--json FILE]

The two run in turns (A B A B …); medians and shortest times are divided. Other work on the machine hurts the
many steps of torch more, so the ratio of the shortest times is the one to trust when it is busy.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from econgs.anchors.decode import decode
from econgs.anchors.decoders import Decoders
from econgs.splat import native

ANCHORS = (4_500, 14_000)
EYE = (0.5, 0.25, -3.0)
OUTPUTS = ("means", "quats", "scales", "opacities", "colors")


def scene(count: int, opacity_bias: float) -> tuple[Decoders, dict[str, Tensor]]:
    """The paper's sizes: features and embedding of 50, ten Gaussians an anchor, 50 hidden units."""
    random = torch.Generator().manual_seed(0)
    decoders = Decoders(generator=random)
    decoders.network("opacity").second_bias.data += opacity_bias
    inputs = {
        "anchors": 0.3 * torch.randn(count, 3, generator=random),
        "features": 0.3 * torch.randn(count, 50, generator=random),
        "scalings": torch.exp(0.3 * torch.randn(count, 6, generator=random) - 4.0),
        "offsets": 0.5 * torch.randn(count, 10, 3, generator=random),
        "embedding": 0.1 * torch.randn(50, generator=random),
        "palette": torch.rand(3, generator=random),
    }
    return decoders, inputs


def decoding(
    decoders: Decoders, inputs: dict[str, Tensor], backend: str, backward: bool
) -> Callable[[], int]:
    """One view decoded, or that and the gradients of all that is trained; gives the number of Gaussians."""
    leaves = {name: one.clone().requires_grad_(name != "anchors") for name, one in inputs.items()}
    trained = [*(one for one in leaves.values() if one.requires_grad), *decoders.parameters()]
    outer: list[Tensor] = []

    def call() -> int:
        with torch.set_grad_enabled(backward):
            decoded = decode(**leaves, decoders=decoders, eye=EYE, backend=backend)
        if backward:
            outputs = [getattr(decoded, name) for name in OUTPUTS]
            if not outer:
                outer.extend(torch.randn_like(one) for one in outputs)
            torch.autograd.grad(outputs, trained, outer)
        return len(decoded.slots)

    return call


def measure(repeats: int) -> list[dict[str, Any]]:
    rows = []
    for count in ANCHORS:
        for bias, share in ((0.4, "nearly all drawn"), (0.0, "about a quarter drawn")):
            decoders, inputs = scene(count, bias)
            for what, backward in (("forward", False), ("forward + backward", True)):
                ways = {name: decoding(decoders, inputs, name, backward) for name in ("torch", "native")}
                drawn, _ = (call() for call in ways.values())  # also warms up
                times: dict[str, list[float]] = {name: [] for name in ways}
                for _ in range(repeats):
                    for name, call in ways.items():
                        start = time.perf_counter()
                        call()
                        times[name].append(1e3 * (time.perf_counter() - start))
                middle = {name: statistics.median(each) for name, each in times.items()}
                best = {name: min(each) for name, each in times.items()}
                rows.append(
                    {"anchors": count, "Gaussians": f"{drawn} ({share})", "what": what}
                    | {f"{name}, median": value for name, value in middle.items()}
                    | {f"{name}, shortest": value for name, value in best.items()}
                    | {"ratio": middle["torch"] / middle["native"]}
                    | {"ratio of shortest": best["torch"] / best["native"]}
                )
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    def text(name: str, value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        return f"{value:.1f}x" if name.startswith("ratio") else f"{value:.2f} ms"

    lines = ["| " + " | ".join(rows[0]) + " |", "|---" * len(rows[0]) + "|"]
    lines += ["| " + " | ".join(text(name, value) for name, value in row.items()) + " |" for row in rows]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15, help="turns (default 15)")
    parser.add_argument("--threads", type=int, help="threads of torch and of the native kernels")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
        native.set_threads(options.threads)
    machine = {"isa": native.isa(), "threads": native.threads(), "torch": torch.__version__}
    machine |= {"machine": platform.machine(), "date": time.strftime("%Y-%m-%d")}
    print(machine, "\n")
    rows = measure(options.repeats)
    print(markdown(rows), flush=True)
    if options.json:
        options.json.write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
