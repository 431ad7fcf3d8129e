"""A method that learns one color per scene, and does a wrong thing in one of its stages.

What it does wrong in ``load`` and later is written into the model, for a loaded model knows no options.
"""

from __future__ import annotations

import atexit
import ctypes
import json
import os
import shutil
import signal
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import fake
import numpy as np

from econgs_bench.methods.interface import Diverged, Refused, option


@dataclass(frozen=True)
class Options(fake.Options):
    stage: str = option("", "where it does wrong: partition, fit, save, restore, load, render, ...")
    fault: str = option("", "what it does wrong")


SPEC = replace(
    fake._spec("faulty", joint=False, implementation="faulty:Faulty"), options=Options, rate_knobs=()
)
_FILE = "fault.json"


def _memory():
    hoard = []
    while True:
        hoard.append(np.ones(2**22))


def _thread():
    threading.Thread(target=time.sleep, args=[600], daemon=False).start()
    atexit.register(time.sleep, 600)


def _handles():
    held = []
    while True:
        held.append(open(os.devnull))  # noqa: SIM115


def _deep(level=0):
    return _deep(level + 1) + 1


def _flood():
    for _ in range(200):
        print("x" * 99_999)


def _close():
    os.closerange(0, 256)


def _away():
    gone = Path(f"gone-{os.getpid()}").resolve()
    gone.mkdir()
    os.chdir(gone)
    gone.rmdir()


def _raise(error):
    raise error


DEEDS = {
    "exit": lambda: os._exit(3),
    "exit-0": lambda: os._exit(0),
    "leave": lambda: sys.exit(0),
    "busy": lambda: os._exit(76),
    "stopped": lambda: os._exit(75),
    "abort": os.abort,
    "crash": lambda: ctypes.string_at(0),
    "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "term": lambda: os.kill(os.getpid(), signal.SIGTERM),
    "stop": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "raise": lambda: _raise(ValueError("a bug")),
    "mute": lambda: _raise(fake.Mute()),
    "interrupt": lambda: _raise(KeyboardInterrupt()),
    "refuse": lambda: _raise(Refused("not to its taste")),
    "diverge": lambda: _raise(Diverged("it went away")),
    "hang": lambda: time.sleep(600),
    "spin": lambda: all(item == 0 for item in iter(int, 1)),
    "memory": _memory,
    "thread": _thread,
    "child": fake._leave_children,
    "handles": _handles,
    "deep": _deep,
    "flood": _flood,
    "close": _close,
    "away": _away,
}
"""Deeds that any stage can do before its own."""


_done: set[str] = set()


def _do(found: tuple[str, str], stage: str, folder: Path) -> None:
    """Once in a process: a picture is rendered many times."""
    if found[0] == stage and stage not in _done:
        _done.add(stage)
        if found[1] == "delete":
            shutil.rmtree(folder)
        elif found[1] in DEEDS:
            DEEDS[found[1]]()


LEDGERS = {
    "more": {"": {"part": 10_000}},
    "less": {"": {"part": 1}},
    "negative": {"": {"part": 10_000, "other": -9_000}},
    "foreign": {"nobody": {"part": 1}},
    "text": {"": {"part": "many"}},
    "nan": {"": {"part": float("nan")}},
    "flat": {"part": 1},
    "none": None,
    "list": [1, 2],
}


class Faulty(fake.Single):
    name = "faulty"

    def fit(self, group, options, budget, seed, device, monitor, resume=None):
        found = options.stage, options.fault
        _do(found, "fit", monitor._folder.parent)
        if found == ("fit", "early"):
            return self.restore(None, options, device)
        model = super().fit(group, options, budget, seed, device, monitor, resume)
        return {"none": None, "text": "model"}.get(found[1], model) if found[0] == "fit" else model

    def restore(self, checkpoint, options, device):
        found = options.stage, options.fault
        _do(found, "restore", Path())
        if found[0] == "restore" and found[1] in ("none", "text"):
            return {"none": None, "text": "model"}[found[1]]
        colors = checkpoint.scalars["colors"] if checkpoint else {"a": [0.0, 0.0, 0.0]}
        return Model(colors, found)

    def load(self, folder, device):
        found = tuple(json.loads((folder / _FILE).read_text()))
        _do(found, "load", folder)
        colors = {p.stem: json.loads(p.read_text()) for p in folder.glob("*.json") if p.name != _FILE}
        if found[0] == "load" and found[1] in ("none", "text", "nobody"):
            return {"none": None, "text": "model", "nobody": Model({}, found)}[found[1]]
        return Model(colors, found)

    def compose(self, models):
        found = models[0].found
        _do(found, "compose", Path())
        if found[0] == "compose" and found[1] in ("none", "text", "first"):
            return {"none": None, "text": "model", "first": models[0]}[found[1]]
        return Model({name: color for model in models for name, color in model.colors.items()}, found)


class Model(fake.Color):
    def __init__(self, colors, found):
        super().__init__(colors)
        self.found = found

    def primitives(self, scene=None):
        if self.found[0] == "primitives":
            _do(self.found, "primitives", Path())
            return {"nan": float("nan"), "negative": -1, "text": "many", "none": None}[self.found[1]]
        return super().primitives(scene)

    def save(self, folder, rate=None):
        _do(self.found, "save", folder)
        ledger = super().save(folder, None)
        ledger[""]["fault"] = (folder / _FILE).write_text(json.dumps(self.found))
        if self.found[0] == "save":
            if self.found[1] == "more files":
                (folder / "more").write_text("not in the ledger")
            if self.found[1] == "link":
                (folder / "link").symlink_to("/etc/hostname")
            return LEDGERS.get(self.found[1], ledger)
        return ledger

    def render(self, camera, scenes=None, edit=None, background=None):
        rgb, alpha = super().render(camera, scenes, edit, background)
        if self.found[0] != "render":
            return rgb, alpha
        _do(self.found, "render", Path())
        h, w = alpha.shape
        return {
            "nan": (rgb * np.nan, alpha),
            "infinite": (rgb, alpha + np.inf),
            "none": None,
            "text": ("a picture", "of a scene"),
            "one": (rgb,),
            "shape": (rgb[:-1], alpha),
            "small": (rgb[:1, :1], alpha),
            "small alpha": (rgb, alpha[:1, :1]),
            "deep alpha": (rgb, alpha[..., None]),
            "planes": (np.moveaxis(rgb, 2, 0), alpha),
            "four": (np.concatenate([rgb, alpha[..., None]], axis=2), alpha),
            "gray": (rgb[..., :1], alpha),
            "flat": (rgb.reshape(h * w, 3), alpha.reshape(h * w)),
            "bytes": ((255 * rgb).astype(np.uint8), (255 * alpha).astype(np.uint8)),
            "complex": (rgb * 1j, alpha),
            "objects": (rgb.astype(object), alpha),
        }.get(self.found[1], (rgb, alpha))

    def timings(self, camera, scenes=None):
        if self.found[0] != "timings":
            return super().timings(camera, scenes)
        _do(self.found, "timings", Path())
        return {"nan": {"a": float("nan")}, "text": {"a": "long"}, "none": None, "nothing": {}}[self.found[1]]

    def attributes(self, scene, count):
        if self.found[0] != "attributes":
            return super().attributes(scene, count)
        _do(self.found, "attributes", Path())
        values = super().attributes(scene, count)["color"]
        return {"nan": {"a": values * np.nan}, "text": {"a": "red"}, "none": None, "flat": {"a": values[0]}}[
            self.found[1]
        ]
