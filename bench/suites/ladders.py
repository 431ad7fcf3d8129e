"""Ladders of a suite: rungs from harmless to fatal, which show where a method breaks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from econgs_bench.bench.suites.stress import part_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.methods.options import label


@dataclass(frozen=True)
class Rung:
    """One step of a ladder.

    Attributes:
        stress: of its runs (:mod:`.bench.suites.stress`); "" is none.
        scene: "dataset/scene" where the ladder's rungs are scenes; else "".
        options: method -> option -> value; other methods have no such rung.
    """

    stress: str = ""
    scene: str = ""
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def same_truth(self) -> bool:
        """Whether its test pictures are those of the first rung."""
        return not self.scene and not part_of(self.stress, "truth", "test")

    def title(self, method: str = "") -> str:
        """Its name for people."""
        chosen = self.options.get(method, {})
        return " ".join(filter(None, [self.scene, self.stress, label(chosen)])) or "as usual"


@dataclass(frozen=True)
class Ladder:
    """Rungs in order from harmless to fatal; the first one is the reference.

    Attributes:
        name: identifier.
        title: one line for people.
        rungs: two or more.
        datasets: names of the suite's datasets on which it is climbed; empty: all. Unused where rungs are
            scenes.
    """

    name: str
    title: str
    rungs: tuple[Rung, ...]
    datasets: tuple[str, ...] = ()

    @property
    def of_scenes(self) -> bool:
        """Whether its rungs are scenes."""
        return bool(self.rungs[0].scene)

    def options(self, method: str) -> set[str]:
        """Options of a method that some rung sets."""
        return {name for rung in self.rungs for name in rung.options.get(method, {})}

    def is_for(self, method: str) -> bool:
        """Whether a method has its rungs."""
        return not any(each.options for each in self.rungs[1:]) or bool(self.options(method))


def ladder_of(table: Mapping[str, Any], where: str) -> Ladder:
    """A ladder from a suite file's table.

    Args:
        table: with name, title and rungs; a rung is the text of a stress, or a table with stress, scene and
            options.
        where: the file, for messages.

    Raises:
        DataError, UnknownName: it is no ladder.
        KeyError, TypeError, ValueError, AttributeError: a part has another form.
    """
    for key in table:
        if key not in ("name", "title", "rungs", "datasets"):
            raise unknown("key", key, ("name", "title", "rungs", "datasets"), of=f"{where} (ladders)")
    rungs = tuple(_rung(rung, where) for rung in table["rungs"])
    datasets = tuple(map(str, table.get("datasets", ())))
    ladder = Ladder(str(table["name"]), str(table["title"]), rungs, datasets)
    what = f"{where} (ladder {ladder.name})"
    if len(rungs) < 2:
        raise DataError(what, f"has {len(rungs)} rungs", "Write two or more, the harmless one first")
    if len({bool(rung.scene) for rung in rungs}) > 1:
        raise DataError(what, "mixes rungs of scenes with others", "Name a scene on each rung, or on none")
    if not rungs[0].scene and (rungs[0].stress or rungs[0].options):
        raise DataError(what, "its first rung is not the usual run", 'Write rungs = ["", ...]')
    return ladder


def _rung(content: Any, where: str) -> Rung:
    if isinstance(content, str):
        return Rung(part_of(content))
    keys = ("stress", "scene", "options")
    for key in content:
        if key not in keys:
            raise unknown("key", key, keys, of=f"{where} (rungs)")
    options = {str(method): dict(chosen) for method, chosen in content.get("options", {}).items()}
    rung = Rung(part_of(str(content.get("stress", ""))), str(content.get("scene", "")), options)
    dataset, slash, scene = rung.scene.rpartition("/")
    if rung.scene and not (dataset and slash and scene):
        raise DataError(f"{where}: {rung.scene}", "is no scene of a dataset", 'Write "vortices/cores"')
    return rung
