"""What may be compared: the one rule that all tables, charts, sentences and gates ask.

A number has an identity: what it was measured *on* (content of the scene, split, the very pictures), *by*
(metric and ruler with their versions, version of the method) and, for times alone, *where* (processor,
threads, device, load).

- **Pictures.** :func:`set_apart` gives jobs with other content, device, size or pictures a dataset of their
  own, so that all rows of one dataset, preset, split and scene have one truth.
- **Versions, metrics and clocks.** :func:`judged` writes into the column `differences` of each row which of
  its values are not compared with those of the other rows of its dataset, and why. :func:`compared` leaves
  these out; :func:`remarks` counts them.

Bytes are compared wherever the truth is the same: they depend on neither machine nor metric.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from econgs_bench.reports.clocks import CLOCKS, Clocks
from econgs_bench.reports.schema import COVERAGE, METRICS, by_name, frame, records
from econgs_bench.reports.style import absent, counted, enumeration, label

if TYPE_CHECKING:
    import pandas as pd


Current = Callable[[str, str], Collection[str]]
"""Dataset and scene -> content hashes that it has today; none where that is not known."""

ROW = "row"
"""Key of `differences` for all values of a row."""
DATASET = "dataset"
"""Key of `differences` for a row that stands in a dataset of its own."""
DISTURBED = "disturbed"
"""Kind of the reason why a time does not count."""
UNKNOWN = "truth unknown"
"""End of the names of datasets whose rows are not ranked: what they were measured on is not known."""
_STRATUM = ("dataset", "preset", "split", "requested_views")
_PICTURES = (*METRICS, *COVERAGE)
_WORDS = re.compile(r" \[|, ")
"""What stands before the words that name a version of a dataset."""
PARTS = "parts"
"""Key of `differences` for the times of the parts of a frame."""
_CLOCKED = {
    "fps": (
        "fps",
        "fps_p05",
        "fps_p95",
        "fps_decoding",
        "load_seconds",
        "frame_ms",
        "decode_ms",
        "rasterise_ms",
    ),
    PARTS: ("decode_ms", "rasterise_ms"),
    "train_seconds": ("train_seconds", "group_seconds", "partition_seconds", "encode_seconds"),
}
"""Clock -> columns that it measured."""
_RULERS = {"fps": "ruler", PARTS: "parts_ruler"}
_SOURCES = {"fps": "fps", PARTS: "fps", "train_seconds": "train_seconds"}
"""Clock -> the one that the machine's load and processor beside it are recorded for."""


# --------------------------------------------------------------------------- datasets by what they show


def set_apart(jobs: pd.DataFrame, current: Current | None = None) -> pd.DataFrame:
    """The table `jobs` with a dataset for each content, device, size and truth.

    A dataset's name is a label. Where a store has several contents of a scene, that of today keeps the name,
    and the others are named by a hash, as "my [3f2a]". The column `differences` has the reason.

    Args:
        jobs: the table, with a row per job.
        current: content that scenes have today; it is asked only where there are several.
    """
    if jobs.empty:
        return jobs
    rows = records(jobs)
    for row in rows:
        row["differences"] = {}
    _by_content(rows, current or (lambda dataset, scene: ()))
    _by_axis(rows, ("device",), lambda row: str(row["device"]).partition(":")[0], "fitted on {}")
    _by_axis(
        rows,
        ("width", "height"),
        lambda row: f"{row['width']} \N{MULTIPLICATION SIGN} {row['height']}",
        "views of {}",
    )
    _by_axis(rows, ("samples",), lambda row: rays_a_pixel(int(row["samples"])), "truth with {}")
    _by_truth(rows)
    return jobs.assign(
        dataset=_column(jobs, "dataset", [row["dataset"] for row in rows]),
        differences=_column(jobs, "dataset", [_text(row["differences"]) for row in rows]),
    )


def root(name: str) -> str:
    """The name that a dataset had before :func:`set_apart`, or training views, made another of it."""
    return _WORDS.split(name, maxsplit=1)[0]


def rays_a_pixel(samples: int) -> str:
    """How the pixels of rendered views were sampled."""
    return (
        "rays as needed" if samples == 0 else "one ray a pixel" if samples == 1 else f"{samples} rays a pixel"
    )


def fixed_rays(rows: Iterable[Mapping[str, Any]]) -> str:
    """As "one ray a pixel" where the truth of rows has a fixed number of rays; else "".

    Datasets are named where others that are rendered here have other numbers, but for those whose names have
    the number.

    Args:
        rows: with the columns `dataset` and `samples`.
    """
    numbers: dict[str, int | None] = {}
    for row in rows:
        dataset, samples = str(row["dataset"]), row.get("samples")
        numbers[dataset] = numbers.get(dataset) if absent(samples) else int(samples)  # type: ignore[arg-type]
    sets: dict[str, list[str]] = defaultdict(list)
    for dataset, number in numbers.items():
        if number is not None:
            sets[rays_a_pixel(number)].append(dataset)
    fixed = {words: names for words, names in sets.items() if words != rays_a_pixel(0)}
    if len(sets) == 1:
        where = " where rendered here" if None in numbers.values() else ""
        return "".join(f"{words}{where}" for words in fixed)
    unnamed = {words: [name for name in names if words not in name] for words, names in fixed.items()}
    return "; ".join(f"{words} ({', '.join(names)})" for words, names in unnamed.items() if names)


def _column(like: pd.DataFrame, name: str, values: Sequence[Any]) -> pd.Series:
    import pandas as pd

    return pd.Series(values, like.index, dtype=like[name].dtype)


def _text(differences: Mapping[str, str]) -> str:
    return json.dumps(differences) if differences else ""


def _by_content(rows: Sequence[dict[str, Any]], current: Current) -> None:
    """Names of datasets by content: the contents of a scene are numbered in the order of their first job."""
    first: dict[tuple[str, str], dict[str, str]] = defaultdict(dict)
    for row in rows:
        row["contents"] = {} if absent(row["contents"]) else json.loads(row["contents"])
        for scene, content in row["contents"].items():
            times = first[row["dataset"], scene]
            times[content] = min(times.get(content, "~"), str(row["finished"]))
    places: dict[tuple[str, str, str], int] = {}
    reasons: dict[tuple[str, str], str] = {}
    members: dict[tuple[str, int], list[str]] = defaultdict(list)
    for (dataset, scene), times in first.items():
        if len(times) < 2:
            continue
        today = set(current(dataset, scene))
        plain = today & times.keys()
        if len(plain) != 1:
            plain = set()
        reasons[dataset, scene] = (
            "today it has the other" if plain
            else "today it has neither" if today and len(times) == 2
            else "today it has none of them" if today
            else "which one it has today is not known"
        )  # fmt: skip
        for place, content in enumerate(sorted(times.keys() - plain, key=lambda one: (times[one], one))):
            places[dataset, scene, content] = place
            members[dataset, place].append(f"{scene} {content}")
    names = {
        key: hashlib.sha256(" ".join(sorted(own)).encode()).hexdigest()[:4] for key, own in members.items()
    }
    several = {key: len(times) for key, times in first.items()}
    for row in rows:
        dataset, own = row["dataset"], row["contents"]
        scenes = sorted(own, key=lambda scene: (scene != row["scene"], scene))
        odd = [scene for scene in scenes if (dataset, scene, own[scene]) in places]
        if odd:
            place = places[dataset, odd[0], own[odd[0]]]
            row["dataset"] = f"{dataset} [{names[dataset, place]}]"
            when = first[dataset, odd[0]][own[odd[0]]][:16].replace("T", " ")
            row["differences"][DATASET] = (
                f"another content: {odd[0]} of {dataset} was measured with "
                f"{several[dataset, odd[0]]} contents, here with that of {when}; {reasons[dataset, odd[0]]}"
            )


def _by_axis(
    rows: Sequence[dict[str, Any]], columns: Sequence[str], value: Callable[[Any], str], words: str
) -> None:
    """Names of datasets by the value of some columns, where jobs with a method have several."""
    found: dict[tuple[Any, ...], set[str]] = defaultdict(set)
    known = [row for row in rows if not any(absent(row[name]) for name in (*columns, "method"))]
    for row in known:
        found[_protocol(row)].add(value(row))
    for row in known:
        if len(found[_protocol(row)]) > 1:
            row["differences"].setdefault(DATASET, f"another setting: {words.format(value(row))}")
            row["dataset"] = f"{row['dataset']}, {value(row)}"


def _protocol(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return row["dataset"], row["preset"], row["split"]


def _by_truth(rows: Sequence[dict[str, Any]]) -> None:
    """Names of datasets by the pictures: those of the most rows of a scene keep the name."""
    measured = [row for row in rows if not absent(row["test_views"])]
    truths: dict[tuple[Any, ...], Counter[str]] = defaultdict(Counter)
    example: dict[str, dict[str, Any]] = {}
    for row in measured:
        if not absent(row["truth"]):
            truths[_of_scene(row)][row["truth"]] += 1
            example.setdefault(row["truth"], row)
    names = _names_of_others(measured, truths)
    for row in measured:
        if absent(row["truth"]):
            row["differences"].setdefault(DATASET, "truth unknown: the record does not say what it is of")
            row["dataset"] = f"{row['dataset']}, {UNKNOWN}"
            continue
        usual = truths[_of_scene(row)].most_common(1)[0][0]
        if row["truth"] == usual:
            continue
        one = example[usual]
        if row["test_views"] != one["test_views"]:
            what, other = f"{row['test_views']} test views", f"{one['test_views']}"
        elif str(row["renderer"]) != str(one["renderer"]):
            what, other = f"pictures of {row['renderer']}", str(one["renderer"])
        else:
            what, other = f"other pictures {names[(*_of_scene(row), row['truth'])]}", "those of most rows"
        row["differences"].setdefault(DATASET, f"another truth: {what} instead of {other}")
        row["dataset"] = f"{row['dataset']}, {what}"


def _names_of_others(
    rows: Sequence[Mapping[str, Any]], truths: Mapping[tuple[Any, ...], Counter[str]]
) -> dict[tuple[Any, ...], str]:
    """Scene and truth -> the hash of all scenes' truths of its place in the order of their first jobs."""
    first: dict[tuple[Any, ...], str] = {}
    for row in rows:
        key = (*_of_scene(row), row["truth"])
        first[key] = min(first.get(key, "~"), str(row["finished"]))
    members: dict[tuple[Any, ...], list[tuple[Any, ...]]] = defaultdict(list)
    for scene, counts in truths.items():
        others = sorted((first[(*scene, truth)], truth) for truth in counts)
        others = [one for one in others if one[1] != counts.most_common(1)[0][0]]
        for place, (_, truth) in enumerate(others):
            members[*scene[:4], place].append((*scene, truth))
    return {
        key: hashlib.sha256(" ".join(sorted(str(one[-1]) for one in own)).encode()).hexdigest()[:4]
        for own in members.values()
        for key in own
    }


def _of_scene(row: Mapping[str, Any]) -> tuple[Any, ...]:
    views = None if absent(row["requested_views"]) else row["requested_views"]
    return (*_protocol(row), views, row["scene"], row["kind"], row["stress"])


# --------------------------------------------------------------------------- values that are compared


def judged(
    results: pd.DataFrame, clocks: Clocks | None = None, strata: Sequence[str] = _STRATUM
) -> pd.DataFrame:
    """The table `results` with what is not compared in its column `differences`.

    - Rows of one method, options and scenes learned together have one version: today's where some have it,
      else that of the most rows.
    - A metric has one version in a dataset, preset and split: that of the most rows.
    - Times count if nothing disturbed them (:meth:`.reports.clocks.Clocks.disturbed`), on one
      place (processor, threads, device and ruler): :func:`usual_place`.

    Args:
        results: rows; of a part of a store, the part is judged by itself.
        clocks: of the whole store; default: of these rows.
        strata: columns within whose values rows are compared.
    """
    if results.empty:
        return results
    rows = records(results)
    for row in rows:
        before = _parsed(row.get("differences"))
        row["differences"] = {DATASET: before[DATASET]} if DATASET in before else {}
    for own in _groups(rows, (*_STRATUM, "method", "variant", "scenes_together")):
        _judge_versions(own)
    clocks = clocks or Clocks(results)
    everywhere = {clock: Counter(Place.of(row, clock) for row in rows) for clock in _CLOCKED}
    for own in _groups([row for row in rows if ROW not in row["differences"]], strata):
        _judge_metrics(own)
        for clock in _CLOCKED:
            _judge_clock(own, clock, clocks, everywhere[clock])
    texts = [_text(row["differences"]) for row in rows]
    return results.assign(differences=_column(results, "dataset", texts))


def _parsed(text: Any) -> dict[str, str]:
    return {} if absent(text) or not text else dict(json.loads(text))


def pair_differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, str]:
    """Kind -> why the values of two rows of one name, of two stores or of a baseline, are not compared.

    What is unknown on one side differs in nothing. `contents` and `truth` (other views of the same content)
    hold for all columns, `ruler` for FPS, the name of a metric for that metric. Renderers of one truth agree
    but for rounding, so `renderer` explains differences and forbids no comparison.

    Args:
        one: the columns of these names and `metric_versions`, as text or parsed.
        other: the same of the other row.
    """
    found = {}
    first, second = (_table(row.get("contents")) for row in (one, other))
    for scene in sorted(first.keys() & second.keys()):
        if changed := _changed(first[scene], second[scene]):
            found["contents"] = f"truth differs: content of {scene} {changed}"
    if "contents" not in found and (changed := _changed(*(_pictures(row) for row in (one, other)))):
        found["truth"] = f"truth differs: other views of the same content, {changed}"
    renderers = [_plain(row.get("renderer")) for row in (one, other)]
    if _changed(*renderers):
        found["renderer"] = f"the truth was rendered by {renderers[1]}, that of the other by {renderers[0]}"
    if changed := _changed(*(_plain(row.get("ruler")) for row in (one, other))):
        found["ruler"] = f"timing protocol {changed}"
    first, second = (_table(row.get("metric_versions")) for row in (one, other))
    for name in sorted(first.keys() & second.keys()):
        if changed := _changed(first[name], second[name]):
            found[name] = f"version of the metric {changed}"
    return found


def _table(value: Any) -> dict[str, Any]:
    return dict(value) if isinstance(value, Mapping) else dict(_parsed(value))


def _changed(one: Any, other: Any) -> str:
    return (
        ""
        if one is None or other is None or str(one) == str(other)
        else f"{one} \N{RIGHTWARDS ARROW} {other}"
    )


def _pictures(row: Mapping[str, Any]) -> str | None:
    """The part of `truth` that does not depend on which of the views were measured."""
    truth = _plain(row.get("truth"))
    return None if truth is None else str(truth).partition("-")[0]


def reason(row: Mapping[str, Any], column: str) -> str:
    """Why a row's value of a column is not compared, in words; "" if it is."""
    found = _parsed(row.get("differences"))
    clock = next((clock for clock, columns in _CLOCKED.items() if column in columns), column)
    return found.get(column) or found.get(clock) or ("" if column == DATASET else found.get(ROW, ""))


def kind_of(row: Mapping[str, Any], column: str) -> str:
    """The kind of :func:`reason`, as "disturbed" or "elsewhere"; "" without one."""
    return reason(row, column).partition(":")[0]


def _groups(rows: Iterable[dict[str, Any]], keys: Sequence[str]) -> Iterable[list[dict[str, Any]]]:
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[tuple(_plain(row.get(key)) for key in keys)].append(row)
    return groups.values()


def _plain(value: Any) -> Any:
    return None if absent(value) else value


def _judge_versions(rows: Sequence[dict[str, Any]]) -> None:
    """Rows of other versions or options than those that a mean is of."""

    def version(row: Mapping[str, Any]) -> tuple[bool, str, str]:
        changes = "" if absent(row["changes"]) else str(row["changes"])
        return not bool(_plain(row["stale"])), str(_plain(row["method_version"])), changes

    counts = Counter(map(version, rows))
    usual = max(counts, key=lambda one: (one[0], counts[one], one[1]))
    for row in rows:
        if version(row) != usual:
            what = version(row)[2] or f"version {version(row)[1]}"
            row["differences"][ROW] = f"another version: {what}, beside rows of version {usual[1]}"


def _judge_metrics(rows: Sequence[dict[str, Any]]) -> None:
    versions = [(row, dict(_parsed(row.get("metric_versions")))) for row in rows]
    for metric in _PICTURES:
        counts = Counter(own[metric] for _, own in versions if metric in own)
        if len(counts) < 2:
            continue
        usual = max(counts, key=lambda one: (counts[one], one))
        for row, own in versions:
            if own.get(metric, usual) != usual and not absent(row.get(metric)):
                text = f"another metric: version {own[metric]}, beside rows of version {usual}"
                row["differences"][metric] = text


@dataclass(frozen=True)
class Place:
    """Where and by what a time was measured; what is not known is "" or None.

    Attributes:
        processor: name and cores.
        instructions: its instruction set; "" of a method without native kernels, which no set matters to.
        ruler: version of the timing.
    """

    processor: str
    instructions: str
    threads: int | None
    device: str
    ruler: int | None

    @classmethod
    def of(cls, row: Mapping[str, Any], clock: str) -> Place:
        """The place of a row's time."""
        processor = row.get(CLOCKS[_SOURCES[clock]][0])
        name = "" if absent(processor) else str(processor)
        parts = name.split(", ")
        instructions = parts.pop() if len(parts) > 2 and "core" not in parts[-1] else ""
        return cls(
            ", ".join(parts), instructions, _plain(row.get("threads")), str(_plain(row.get("device")) or ""),
            _plain(row.get(_RULERS[clock])) if clock in _RULERS else None,
        )  # fmt: skip

    def agrees(self, other: Place) -> bool:
        """Whether times of both are compared."""
        sets = {self.instructions, other.instructions} - {""}
        return len(sets) < 2 and replace(self, instructions="") == replace(other, instructions="")

    def difference(self, usual: Place) -> str:
        """How it differs from the place of most rows, in words."""
        if self.processor != usual.processor or self.instructions != usual.instructions:
            return f"elsewhere: timed on {self.text}, the others on {usual.text}"
        if self.threads != usual.threads:
            return f"other threads: timed with {self.threads} threads, the others with {usual.threads}"
        if self.device != usual.device:
            return f"elsewhere: timed on {self.device}, the others on {usual.device}"
        if 0 in (self.ruler, usual.ruler):
            own, others = (
                "its own program" if one == 0 else "the harness" for one in (self.ruler, usual.ruler)
            )
            return f"another clock: frames timed by {own}, the others by {others}"
        return f"another ruler: timed by version {self.ruler}, the others by version {usual.ruler}"

    @property
    def text(self) -> str:
        """Processor and threads, for people."""
        if not self.processor:
            return "an unknown processor"
        name = ", ".join(filter(None, (self.processor, self.instructions)))
        return name if self.threads is None else f"{name}, {counted(self.threads, 'thread')}"


def _judge_clock(
    rows: Sequence[dict[str, Any]], clock: str, clocks: Clocks, everywhere: Mapping[Place, int]
) -> None:
    source = _SOURCES[clock]
    timed = [row for row in rows if not absent(row.get(source))]
    if clock != source:  # what disturbed the frames disturbed their parts
        timed = [row for row in timed if source not in row["differences"]]
    quiet = []
    for row in timed:
        if reason := clocks.disturbed(row, source):
            row["differences"][clock] = f"{DISTURBED}: {reason}"
        else:
            quiet.append((row, Place.of(row, clock)))
    usual = usual_place(quiet, everywhere)
    for row, place in quiet:
        if usual is not None and not place.agrees(usual):
            row["differences"][clock] = place.difference(usual)


def usual_place(
    rows: Sequence[tuple[Mapping[str, Any], Place]], everywhere: Mapping[Place, int] = MappingProxyType({})
) -> Place | None:
    """The place where the most methods, then models, then seeds of models have all scenes; None without rows.

    A model's scenes are those that it has anywhere.

    Args:
        rows: each with its place.
        everywhere: place -> rows of a larger table, which decide between equals.
    """
    scenes: dict[tuple[Any, ...], set[str]] = defaultdict(set)
    for row, _ in rows:
        scenes[_model(row)].add(row["scene"])

    def weight(place: Place) -> tuple[int, int, int, int, int, str]:
        own: dict[tuple[Any, ...], dict[Any, set[str]]] = defaultdict(lambda: defaultdict(set))
        here = [row for row, other in rows if place.agrees(other)]
        for row in here:
            own[_model(row)][_plain(row.get("seed"))].add(row["scene"])
        whole = [model for model, seeds in own.items() for each in seeds.values() if each == scenes[model]]
        methods = {method for method, *_ in whole}
        found = len(methods), len(set(whole)), len(whole), len(here)
        return *found, everywhere.get(place, 0), str(place)

    places = {place for _, place in rows}
    known = [one for one in places if one.instructions or not any(_more(one, other) for other in places)]
    return max(known, key=weight, default=None)


def _more(one: Place, other: Place) -> bool:
    """Whether another place says more about the same processor."""
    return bool(other.instructions) and replace(other, instructions="") == one


def _model(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(_plain(row.get(name)) for name in ("method", "variant", "rate", "scenes_together"))


def compared(tables: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Tables with what is compared: `results` without the rows and values that have differences.

    Rows of `curve` and `timing` whose fit or drawing was not timed like the others' are left out as well, and
    the rungs of models that are left out.
    """
    import pandas as pd

    results = tables["results"]
    found = [_parsed(text) for text in results["differences"]] if "differences" in results else []
    if not any(each.keys() - {DATASET} for each in found):
        return dict(tables)
    out = dict(tables)

    def rows_with(*quantities: str) -> pd.DataFrame:
        at = [not each.keys().isdisjoint({ROW, *quantities}) for each in found]
        return results[pd.Series(at, results.index, dtype=bool)]

    if "rungs" in out:
        out["rungs"] = out["rungs"][~out["rungs"]["job"].isin(rows_with()["job"])]
    if "timing" in out:
        out["timing"] = out["timing"][~out["timing"]["job"].isin(rows_with("fps", PARTS)["job"])]
    if "curve" in out:  # of fits, whose measurements results hold
        left = set(_fits(rows_with("train_seconds")))
        kept = [fit not in left for fit in _fits(out["curve"])]
        out["curve"] = out["curve"][pd.Series(kept, out["curve"].index, dtype=bool)]
    values = results.copy()
    for column in {name for each in found for name in each} - {DATASET, ROW}:
        at = pd.Series([column in each for each in found], results.index)
        for name in _CLOCKED.get(column, (column,)):
            if name in values:
                values[name] = values[name].mask(at)
    whole = pd.Series([ROW not in each for each in found], results.index)
    out["results"] = values[whole]
    return out


_FIT = ("dataset", "scenes_together", "method", "variant", "preset", "requested_views", "seed", "scene")


def _fits(table: pd.DataFrame) -> list[tuple[Any, ...]]:
    """What each row's fit and scene are."""
    columns = (table[name].tolist() for name in _FIT)
    return [tuple(_plain(value) for value in key) for key in zip(*columns, strict=True)]


# --------------------------------------------------------------------------- what is left out, in words


def listing(results: pd.DataFrame, superseded: pd.DataFrame | None = None) -> pd.DataFrame:
    """The table `differences`: a line per row and quantity that is not compared, with the reason.

    Args:
        results: as :func:`judged` returns it.
        superseded: rows whose place a newer one takes.
    """
    lines = [
        row | {"quantity": quantity, "reason": why}
        for row in records(results)
        for quantity, why in _parsed(row.get("differences")).items()
    ]
    again = {"quantity": ROW, "reason": "measured again: a newer row takes its place"}
    lines += [row | again for row in (records(superseded) if superseded is not None else ())]
    return frame("differences", lines)


class Remark(NamedTuple):
    """A sentence on what is not compared.

    Attributes:
        dataset: its name in the table `results`.
        quantity: column that it is about; :data:`ROW` and :data:`DATASET` concern all.
        text: the sentence, without the dataset.
        kind: of the reason, as "disturbed"; "" of remarks that count no rows.
        rows: their number.
    """

    dataset: str
    quantity: str
    text: str
    kind: str = ""
    rows: int = 0


def remarks(results: pd.DataFrame, superseded: pd.DataFrame | None = None) -> list[Remark]:
    """What is not compared, counted by dataset and reason; unequal seeds and scenes.

    Args:
        results: as :func:`judged` returns it.
        superseded: rows whose place a newer one takes.
    """
    found = []
    for name, rows in _by_dataset(results).items():
        found += [*_counted(name, rows), *(Remark(name, ROW, text) for text in _of_sets(rows))]
    if superseded is not None:
        found += [
            Remark(str(name), ROW, replaced(rows)) for name, rows in superseded.groupby("dataset", sort=False)
        ]
    return found


def concerning(
    found: Iterable[Remark], titles: Iterable[str] | None = None, columns: Iterable[str] = ()
) -> list[Remark]:
    """The remarks on some datasets and columns.

    Args:
        found: of :func:`remarks`.
        titles: of panels; they begin with a dataset's name. Default: all datasets.
        columns: clocks and metrics that are shown; remarks on rows, seeds and scenes concern all.
    """
    starts = None if titles is None else list(titles)
    shown = {ROW, DATASET, *columns}
    return [
        one
        for one in found
        if one.quantity in shown and (starts is None or any(begins(title, one.dataset) for title in starts))
    ]


def begins(title: str, dataset: str) -> bool:
    """Whether the title of a panel begins with the name of a dataset."""
    rest = title.removeprefix(dataset)
    return rest != title and (not rest or not (rest[0].isalnum() or rest[0] in "_-[@"))


def sentences(found: Iterable[Remark]) -> list[str]:
    """The sentences; what holds of several datasets alike is one."""
    return _merged(((one.dataset, one.text) for one in found), "dataset")


def summary(found: Iterable[Remark]) -> str:
    """All remarks in a line: rows counted over datasets, without the details; "" without remarks."""
    counts: dict[tuple[str, str], int] = defaultdict(int)
    others = []
    for one in found:
        if one.rows:
            counts[one.kind, one.quantity] += one.rows
        else:
            others.append(one)
    kinds: dict[str, list[str]] = defaultdict(list)
    for (kind, quantity), count in counts.items():
        name = "all values" if quantity == ROW else by_name(quantity).title or quantity
        kinds[kind].append(f"{name} of {counted(count, 'row')}")
    parts = [f"{', '.join(what)} ({kind})" for kind, what in kinds.items()]
    return " ".join([*([f"Not compared: {'; '.join(parts)}."] if parts else []), *sentences(others)])


def replaced(superseded: pd.DataFrame | None) -> str:
    """Number of rows whose place newer rows of the same models take; "" without any."""
    count = 0 if superseded is None else len(superseded)
    return f"left out: {counted(count, 'row')} that newer ones of the same models replace." if count else ""


def left_out(results: pd.DataFrame) -> set[tuple[Any, str]]:
    """(row index, column) of the values that are not compared; empty for other tables."""
    if "differences" not in results:
        return set()
    found = set()
    for index, text in results["differences"].items():
        for quantity in _parsed(text).keys() - {DATASET}:
            names = tuple(results.columns) if quantity == ROW else _CLOCKED.get(quantity, (quantity,))
            found |= {(index, name) for name in names if by_name(name).better}
    return found


def notes(results: pd.DataFrame, superseded: pd.DataFrame | None = None) -> list[str]:
    """All :func:`remarks` as sentences; none for other tables than `results`."""
    if "differences" not in results:
        return []
    return sentences(remarks(results, superseded))


def _by_dataset(table: pd.DataFrame) -> dict[str, list[dict[str, Any]]]:
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in records(table):
        groups[str(row["dataset"])].append(row)
    return groups


def _counted(dataset: str, rows: Sequence[dict[str, Any]]) -> Iterable[Remark]:
    """Remarks that count rows by quantity and kind of reason, each with one of the reasons."""
    groups: dict[tuple[str, str], list[tuple[dict[str, Any], str]]] = defaultdict(list)
    for row in rows:
        for quantity, reason in _parsed(row.get("differences")).items():
            groups[quantity, reason.partition(":")[0]].append((row, reason))
    for (quantity, kind), own in groups.items():
        detail = own[0][1].partition(": ")[2]
        if quantity == DATASET:
            yield Remark(dataset, quantity, f"set apart, {kind}: {detail}.")
            continue
        who = enumeration(list(dict.fromkeys(label(row["method"]) for row, _ in own)))
        what = counted(len(own), "row")
        what = what if quantity == ROW else f"{by_name(quantity).title or quantity} of {what}"
        example = detail if len({text for _, text in own}) == 1 else f"as {detail}"
        text = f"not compared: {what} of {who} ({kind}: {example})."
        yield Remark(dataset, quantity, text, kind, len(own))


def _of_sets(rows: Sequence[dict[str, Any]]) -> Iterable[str]:
    """Sentences on models that have other presets, splits or seeds, or fewer scenes, than others."""
    basic = [row for row in rows if row["kind"] == "basic"]
    for axis in ("preset", "split"):
        values: dict[str, set[str]] = defaultdict(set)
        for row in basic:
            values[label(row["method"], row["variant"])].add(str(_plain(row[axis])))
        texts = {name: ", ".join(sorted(own)) for name, own in values.items()}
        if len(set(texts.values())) > 1:
            yield f"not compared across {axis}s, which differ: {_grouped(texts)}."
    for own in _groups(basic, ("preset", "split", "requested_views")):
        seeds: dict[str, set[Any]] = defaultdict(set)
        scenes: dict[str, set[str]] = defaultdict(set)
        for row in own:
            name = label(row["method"], row["variant"])
            seeds[name].add(_plain(row["seed"]))
            scenes[name].add(str(row["scene"]))
        numbers = {name: ", ".join(str(one) for one in sorted(own, key=str)) for name, own in seeds.items()}
        if len(set(numbers.values())) > 1:
            yield f"seeds differ: {_grouped(numbers)}."
        every = set().union(*scenes.values())
        fewer = {
            name: f"{len(own)} of {len(every)} ({', '.join(sorted(own))})"
            for name, own in scenes.items()
            if own != every
        }
        if fewer:
            yield f"scenes differ: {_grouped(fewer)}."


_MOST_NAMED = 4


def _grouped(texts: Mapping[str, str]) -> str:
    """As "A, B: text; C: other text"."""
    return "; ".join(_merged(texts.items(), "model"))


def _merged(pairs: Iterable[tuple[str, str]], noun: str) -> list[str]:
    """Names and texts as "A, B: text"; of many names with one text their number."""
    groups: dict[str, list[str]] = defaultdict(list)
    for name, text in pairs:
        groups[text].append(name)
    return [
        f"{', '.join(names) if len(names) <= _MOST_NAMED else counted(len(names), noun)}: {text}"
        for text, names in groups.items()
    ]
