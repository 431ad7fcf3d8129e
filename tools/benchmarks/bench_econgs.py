"""An iteration of ECoNGS's training: what each part takes, and the native decoders against the torch twin.

    python -m tools.benchmarks.bench_econgs [--dataset NAME] [--scenes A,B] [--iterations N] [--steps N]

One fit is trained to the middle of its first and of its second stage; there steps with native and with torch
decoders are taken in turns (both train the same model), and medians are divided. ``--dataset vortex_views``
(needs BENCH_DATA) gives the figures of docs/results/speed.md.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any
from unittest.mock import patch

import torch

import econgs_bench.methods.econgs.training as training
from econgs_bench.bench.jobs.scenes import camera_extent
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.cloud import initial_cloud
from econgs_bench.datasets.render_views import views_of
from econgs_bench.datasets.views import ViewRequest
from econgs_bench.methods.econgs.spec import SPEC
from econgs_bench.methods.econgs.training import Trainer
from econgs_bench.methods.interface import SceneInput
from econgs_bench.methods.options import resolve

PARTS = ("decode", "rasterise", "loss", "context model", "backward", "optimiser")
decode = training.decode


def scenes(name: str, chosen: list[str]) -> list[SceneInput]:
    """Scenes of a dataset at 200 x 200, 42 training views."""
    dataset = open_dataset(name)
    found = []
    for scene in chosen or [scene.name for scene in dataset.scenes][:3]:
        views = {
            split: views_of(dataset, scene, ViewRequest(split, 42, 16, 200, 200))  # type: ignore[arg-type]
            for split in ("train", "val")
        }
        found.append(
            SceneInput(
                scene=dataset.scene(scene),
                train=views["train"],
                validation=views["val"],
                cloud=initial_cloud(dataset, scene, 10_000, 0),
                extent=camera_extent(views["train"].cameras),
            )
        )
    return found


@contextmanager
def clocked(trainer: Trainer, spent: dict[str, float]) -> Iterator[None]:
    """Adds up the seconds of each part of a step."""
    with ExitStack() as patches:

        def watch(owner: Any, name: str, part: str) -> None:
            before = getattr(owner, name)

            def timed(*given: Any, **named: Any) -> Any:
                start = time.perf_counter()
                try:
                    return before(*given, **named)
                finally:
                    spent[part] += time.perf_counter() - start

            patches.enter_context(patch.object(owner, name, timed))

        watch(training, "decode", "decode")
        watch(trainer, "splat", "rasterise")
        watch(trainer, "view_losses", "loss")
        watch(torch.Tensor, "backward", "backward")
        watch(trainer.optimiser, "step", "optimiser")
        if trainer.coding is not None:
            watch(trainer.coding, "apply", "context model")
        yield


def measure(trainer: Trainer, steps: int) -> dict[str, tuple[float, dict[str, float]]]:
    """Backend -> median seconds of a step, and of its parts, in turns."""
    times: dict[str, list[float]] = defaultdict(list)
    parts: dict[str, dict[str, list[float]]] = {name: defaultdict(list) for name in ("native", "torch")}
    for _ in range(steps):
        for name in ("native", "torch"):
            backend: Callable[..., Any] = decode if name == "native" else partial(decode, backend="torch")
            training.decode = backend  # type: ignore[assignment]
            spent: dict[str, float] = defaultdict(float)
            with clocked(trainer, spent):
                start = time.perf_counter()
                trainer.step()
                times[name].append(time.perf_counter() - start)
            for part, seconds in spent.items():
                parts[name][part].append(seconds)
    training.decode = decode
    return {
        name: (
            statistics.median(taken),
            {part: statistics.median(all_) for part, all_ in parts[name].items()},
        )
        for name, taken in times.items()
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dataset", default="vortices")
    parser.add_argument("--scenes", default="")
    parser.add_argument("--iterations", type=int, default=1_600)
    parser.add_argument("--steps", type=int, default=60)
    options = parser.parse_args()
    given = scenes(options.dataset, [name for name in options.scenes.split(",") if name])
    trainer = Trainer(given, resolve(SPEC, "standard", {}).options, options.iterations, 0, "cpu")
    print(f"{options.dataset}: {len(given)} scenes together, 200 x 200, {torch.get_num_threads()} threads")
    print(f"{'stage':<8}{'decoders':<10}{'anchors':>8}{'ms':>8}  parts [ms]")
    for stage, until in (("1", 0.45), ("2", 0.7)):
        while trainer.iteration < until * options.iterations:
            trainer.step()
        found = measure(trainer, options.steps)
        for name, (seconds, split) in found.items():
            told = ", ".join(f"{part} {1e3 * split[part]:.1f}" for part in PARTS if split.get(part))
            print(f"{stage:<8}{name:<10}{trainer.count:>8}{1e3 * seconds:>8.1f}  {told}")
        print(f"{'':<8}ratio {found['native'][0] / found['torch'][0]:.2f}", flush=True)


if __name__ == "__main__":
    main()
