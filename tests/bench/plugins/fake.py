"""A method that takes no time and needs no torch: it learns one color per scene, and misbehaves on demand."""

from __future__ import annotations

import atexit
import copy
import json
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from econgs_bench.methods.interface import (
    Checkpoint,
    Diverged,
    MethodSpec,
    RateKnob,
    Refused,
    edits_by_scene,
    option,
)

Behaviour = Literal[
    "good", "refuse", "diverge", "nan", "raise", "abort", "exit", "hog", "sleep", "ledger", "no-checkpoint",
    "hold", "apart", "child", "child-abort", "thread", "hang", "mute", "escape", "parent", "busy",
]  # fmt: skip


@dataclass(frozen=True)
class Options:
    behaviour: Behaviour = option("good", "what it does wrong, in the fit")
    only: str = option("", "names of the only scenes on which it does wrong")
    pace: float = option(0.0, "seconds per iteration", minimum=0.0)
    group_budget: float = option(0.0, "power of the number of scenes that multiplies the iterations")
    file: str = option("", "if this file exists, all is well")


class Mute(Exception):
    """An exception whose text raises another."""

    def __str__(self) -> str:
        raise RuntimeError("no text")


def _spec(name: str, joint: bool, implementation: str = "") -> MethodSpec:
    return MethodSpec(
        name=name,
        title="A color",
        reference="none",
        version="1",
        implementation=implementation or f"fake:{'Joint' if joint else 'Single'}",
        source=(implementation.partition(":")[0] or "fake",),
        joint=joint,
        composable=not joint,
        edits=frozenset({"palette"}),
        uses_alpha="no",
        devices=("cpu",),
        options=Options,
        iterations={"quick": 20, "standard": 200, "paper": 2000},
        rate_knobs=(RateKnob("digits", (2.0, 6.0), refit=False),),
    )


SPEC = _spec("fake", joint=False)


@dataclass
class Color:
    colors: dict[str, list[float]]
    wrong_ledger: bool = False

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(self.colors)

    def primitives(self, scene: str | None = None) -> int:
        return 1 if scene else len(self.colors)

    def save(self, folder: Path, rate: float | None = None) -> dict[str, dict[str, int]]:
        ledger: dict[str, dict[str, int]] = {"": {}}
        for name, color in self.colors.items():
            text = json.dumps([round(c, int(rate)) if rate else c for c in color])
            (folder / f"{name}.json").write_text(text)
            ledger[name] = {"color": len(text)}
        (folder / "shared.txt").write_text("seven b")
        ledger[""]["shared"] = 7 + (1 if self.wrong_ledger else 0)
        return ledger

    def render(self, camera, scenes=None, edit=None, background=None):
        """The mean of the scenes' colors all over."""
        shape = (camera.height, camera.width)
        colors = {name: self.colors[name] for name in scenes or self.scenes}
        for name, wanted in edits_by_scene(edit, tuple(colors)).items():
            if refused := [k for k, v in vars(wanted).items() if v is not None and k != "palette"]:
                raise Refused(f"fake cannot edit {', '.join(refused)}")
            colors[name] = wanted.palette
        color = np.mean(list(colors.values()), axis=0, dtype=np.float32)
        return np.broadcast_to(color, (*shape, 3)).copy(), np.ones(shape, dtype=np.float32)

    def attributes(self, scene, count):
        return {"color": np.array([self.colors[scene]] * min(3, count), dtype=np.float32)}

    def timings(self, camera, scenes=None):
        return {"rasterise": 1e-4}


class Single:
    name = "fake"

    def partition(self, scenes, options):
        return [[scene] for scene in scenes]

    def fit(self, group, options, budget, seed, device, monitor, resume=None):
        targets = {s.name: _target(s.train.images) for s in group}
        colors = {name: [0.0, 0.0, 0.0] for name in targets}
        start = 0
        if resume is not None:
            start, colors = resume.iteration, {k: list(v) for k, v in resume.scalars["colors"].items()}
        behaviour = _behaviour(options, targets)
        if behaviour == "refuse":
            raise Refused("this scene is not to its taste")
        monitor.stage("colors")
        for iteration in range(start + 1, budget.iterations + 1):
            rng = np.random.default_rng([seed, iteration])
            for name, target in targets.items():
                noise = rng.normal(scale=0.01, size=3)
                colors[name] = [
                    float(c + 0.1 * (t - c) + n) for c, t, n in zip(colors[name], target, noise, strict=True)
                ]
            if options.pace:
                time.sleep(options.pace)
            loss = float(sum(np.abs(np.subtract(colors[n], targets[n])).mean() for n in targets))
            half = iteration == max(2, budget.iterations // 2)
            if half:
                loss = _misbehave(behaviour, loss)
            monitor.progress(iteration, {"loss": loss}, len(colors))
            state = Checkpoint(iteration, {}, {"colors": {k: list(v) for k, v in colors.items()}})
            if half and _behaviour(options, targets) == "hold":
                monitor.stage("held")
                while _behaviour(options, targets) == "hold" and not monitor.due(iteration):
                    time.sleep(0.01)
            if behaviour != "no-checkpoint" and monitor.due(iteration):
                monitor.pause(iteration, lambda: Color(colors), partial(copy.copy, state))
        return self.restore(state, options, device)

    def restore(self, checkpoint, options, device):
        colors = checkpoint.scalars["colors"]
        return Color(colors, wrong_ledger=_behaviour(options, colors) == "ledger")

    def load(self, folder, device):
        return Color({p.stem: json.loads(p.read_text()) for p in sorted(folder.glob("*.json"))})

    def compose(self, models):
        return Color({name: color for model in models for name, color in model.colors.items()})


class Joint(Single):
    def partition(self, scenes, options):
        """All but the last scene together."""
        if _behaviour(options, [scene.name for scene in scenes]) == "apart":
            raise RuntimeError("these scenes cannot be compared")
        return [list(scenes[:-1]), list(scenes[-1:])] if len(scenes) > 1 else [list(scenes)]


def _target(images: np.ndarray) -> np.ndarray:
    white = images[..., :3] + (1.0 - images[..., 3:])
    return white.reshape(-1, 3).mean(axis=0)


def _behaviour(options, scenes) -> str:
    if options.file and os.path.exists(options.file):
        return "good"
    if options.only and not set(options.only.split(",")) & set(scenes):
        return "good"
    return options.behaviour


def _misbehave(behaviour: str, loss: float) -> float:
    if behaviour == "diverge":
        raise Diverged("the color went away")
    if behaviour == "nan":
        return float("nan")
    if behaviour == "raise":
        raise ValueError("a bug in the method")
    if behaviour == "mute":
        raise Mute
    if behaviour == "escape":
        raise Refused("\x1b[2Jgone\x07 \u202eout of order")
    if behaviour == "abort":
        print("about to abort", flush=True)
        os.abort()
    if behaviour == "exit":
        os._exit(3)
    if behaviour == "busy":
        os._exit(76)  # as a worker whose job another process has
    if behaviour == "hog":
        hoard = []
        while True:
            hoard.append(np.ones(2**21))
            time.sleep(0.01)
    if behaviour == "sleep":
        time.sleep(600)
    if behaviour.startswith("child"):
        _leave_children()
    if behaviour == "child-abort":
        os.abort()
    if behaviour == "thread":
        threading.Thread(target=time.sleep, args=[600], daemon=False).start()
        atexit.register(time.sleep, 600)
    if behaviour == "parent":
        os.kill(os.getppid(), signal.SIGKILL)
        os._exit(3)
    if behaviour == "hang":
        sys.stdout.flush = lambda: time.sleep(600)
    return loss


def _leave_children() -> None:
    """A child, one in a session of its own, and one whose parent is gone; they hold every lock of the job."""
    for leaves, orphan in ((False, False), (True, False), (True, True)):
        if os.fork():
            continue
        if leaves:
            os.setsid()
        if orphan and os.fork():
            os._exit(0)
        print("left behind:", os.getpid(), flush=True)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(600)
        os._exit(0)
    time.sleep(0.5)  # all of them print
