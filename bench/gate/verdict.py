"""The gate's verdict: which results are worse than the baseline by more than repetitions differ.

Each quantity of each cell, each method's mean over scenes, and each view are tested by Student's t. The
variance of a seed is that of the cell's own seeds, moderated by all cells (:mod:`.bench.gate.spread`). Holm's
correction keeps the probability of any false alarm under :data:`LEVEL`. Where the files of a model are those
of the baseline, nothing random is left: its results must be equal.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from econgs_bench.bench.gate.baseline import VIEW_ROUNDING, Baseline, BaselineCell, differences, rounding
from econgs_bench.bench.gate.cells import VIEW_METRIC, Cell, Key, Values
from econgs_bench.bench.gate.identity import CONTENTS, RENDERER, TRUTH, Identity
from econgs_bench.bench.gate.identity import differences as reasons
from econgs_bench.bench.gate.quantities import QUANTITIES, Quantity
from econgs_bench.bench.gate.spread import Prior, prior, quantile, tail, variance_of, without_rounding
from econgs_bench.reports.clocks import BUSY

LEVEL = 0.01
"""Probability of any false alarm in a comparison, in either direction."""
_EQUAL = 1e-3
"""Difference of scores that is never a finding: 0.001 dB, or 0.1 %."""
_ALL = "all scenes"
_LEAST_VIEWS = 3

Scope = Literal["a scene", "a method's mean", "a view"]
Kind = Literal["worse", "better", "not measured", "note"]


@dataclass(frozen=True)
class Finding:
    """A line of the verdict.

    Attributes:
        cell: title of the cell.
        text: what differs, for people.
    """

    kind: Kind
    cell: str
    text: str


@dataclass
class Verdict:
    """The outcome.

    Attributes:
        findings: the worst first.
        cells: titles of all cells of the baseline.
        tests: number of comparisons.
        same: number of models whose files equal the baseline's.
        differ: number of models whose files do not.
        unknown: number of models without files, or with none in the baseline.
        unidentified: number of cells whose truth is not named on both sides.
        elsewhere: processors and threads of baseline and run where models differ on unlike ones; else "".
    """

    findings: list[Finding] = field(default_factory=list)
    cells: list[str] = field(default_factory=list)
    tests: int = 0
    same: int = 0
    differ: int = 0
    unknown: int = 0
    unidentified: int = 0
    elsewhere: str = ""

    def add(self, findings: Iterable[Finding]) -> None:
        """Add findings and put the worst first."""
        order = ("worse", "not measured", "better", "note")
        self.findings = sorted([*self.findings, *findings], key=lambda finding: order.index(finding.kind))

    def of(self, *kinds: Kind) -> list[Finding]:
        return [finding for finding in self.findings if finding.kind in kinds]

    @property
    def word(self) -> str:
        """The worst of "worse", "not measured" and "pass"."""
        return next((kind for kind in ("worse", "not measured") if self.of(kind)), "pass")  # type: ignore[arg-type]

    @property
    def code(self) -> int:
        """Exit code: 0 pass, 1 worse, 2 not measured."""
        return {"pass": 0, "worse": 1, "not measured": 2}[self.word]


@dataclass(frozen=True)
class _Sample:
    """A quantity of a cell, or of a method over its scenes, before and after.

    Attributes:
        before, after: scores of each seed; ``after`` is empty if nothing is to be compared.
        values: the means before and after, for people.
        rounding: how far the mean score before may be off, as the file has few digits.
        cause: what explains a difference, beside the code; else "".
    """

    scope: Scope
    cell: str
    title: str
    quantity: Quantity
    before: list[float]
    after: list[float]
    values: tuple[float, float]
    rounding: float
    cause: str

    @property
    def variance(self) -> float:
        return variance_of(self.before)

    @property
    def freedom(self) -> int:
        return len(self.before) - 1

    def test(self, base: Prior) -> _Test:
        variance, freedom = base.moderated(self.variance, self.freedom)
        error = math.sqrt(variance * (1.0 / len(self.before) + 1.0 / len(self.after)))
        difference = _mean(self.after) - _mean(self.before)
        return _Test(
            self.scope,
            self.cell,
            self.title,
            self.quantity,
            *self.values,
            difference,
            error,
            freedom,
            self.rounding,
            self.cause,
        )


@dataclass(frozen=True)
class _Test:
    """One comparison; a positive ``difference`` of scores is better.

    Attributes:
        error: standard deviation of the difference by seeds.
        rounding: how much of the difference the digits of the file may make.
        cause: as in :class:`_Sample`; a difference with a cause is no loss and no gain.
    """

    scope: Scope
    cell: str
    title: str
    quantity: Quantity
    before: float
    after: float
    difference: float
    error: float
    freedom: float
    rounding: float
    cause: str

    @property
    def statistic(self) -> float:
        """Student's t of what seeds have to explain; 0 within equality."""
        excess = abs(self.difference) - self.rounding
        if abs(self.difference) <= _EQUAL or excess <= 0.0:
            return 0.0
        return math.copysign(excess / self.error if self.error > 0.0 else math.inf, self.difference)

    def tolerance(self, level: float) -> float:
        """The largest difference of scores that is no finding at a level of significance."""
        return max(quantile(level, self.freedom) * self.error + self.rounding, _EQUAL)

    def finding(self, kind: Kind, level: float) -> Finding:
        q = self.quantity
        tolerance = q.change(self.tolerance(level)).lstrip("+-") if self.error > 0.0 else "nothing"
        unit = " dB" if q.scale == "linear" else ""
        what = "1 - SSIM: " if q.name == "ssim" else ""
        text = (
            f"{self.title} {q.text(self.before)} → {q.text(self.after)} "
            f"({what}{q.change(self.difference)}{unit}; seeds explain {tolerance}{unit})"
        )
        if self.cause:
            return Finding("not measured", self.cell, f"{text}: {self.cause}")
        return Finding(kind, self.cell, text)


def compare(baseline: Baseline, cells: Mapping[Key, Cell], *, times: bool = True) -> Verdict:
    """Compare a run with a baseline.

    Args:
        baseline: the file.
        cells: of the run.
        times: whether times are asked for.
    """
    verdict = Verdict()
    pairs = [
        _Pair(old, cells.get(old.key) or Cell(old.key, old.version, ""), times) for old in baseline.cells
    ]
    for pair in pairs:
        verdict.cells.append(pair.title)
        verdict.add(pair.findings())
        verdict.same += len(pair.equal)
        verdict.differ += pair.differ
        verdict.unknown += pair.unknown
        verdict.unidentified += pair.unidentified
        verdict.elsewhere = verdict.elsewhere or pair.elsewhere
    tests = _all_tests(pairs)
    verdict.tests = len(tests)
    verdict.add(_significant(tests))
    return verdict


def tolerances(
    baseline: Baseline, seeds: int, *, times: bool = True
) -> Iterator[tuple[Scope, Quantity, float]]:
    """The largest loss of each comparison that a run may have without a finding.

    The run has all results of the baseline, from other files of models and on the same quiet processor; one
    comparison alone differs.

    Args:
        baseline: the file.
        seeds: number of seeds of the run.
        times: whether times are asked for.

    Yields:
        What is compared, the quantity, and the loss as a difference of scores.
    """
    tests = _all_tests([_Pair(old, _repeated(old, seeds), times) for old in baseline.cells])
    for test in tests:
        yield test.scope, test.quantity, test.tolerance(LEVEL / len(tests))


def _repeated(old: BaselineCell, seeds: int) -> Cell:
    """Each seed has the means of the baseline."""
    means = {name: _mean(v for v in values if v is not None) for name, values in old.values.items()}
    values = {name: mean for name, mean in means.items() if not math.isnan(mean)}
    every = range(seeds)
    return Cell(
        old.key, old.version, old.processor, dict.fromkeys(every, values), dict.fromkeys(every, old.views)
    )


def _all_tests(pairs: Sequence[_Pair]) -> list[_Test]:
    return [
        *_tests([sample for pair in pairs for sample in pair.samples()]),
        *_tests(list(_of_methods(pairs))),
        *_of_views(pairs),
    ]


class _Pair:
    """A cell before and after.

    Attributes:
        reasons: kind -> why something does not compare (:func:`.bench.gate.identity.differences`).
        values: seed -> values of the run that are of the baseline's truth.
        equal: seeds whose models have the files of the baseline.
        free: seeds of the run whose results have a chance to differ.
        cause: what explains differences beside the code; else "".
    """

    def __init__(self, old: BaselineCell, new: Cell, times: bool) -> None:
        self.old, self.new, self.title = old, new, old.key.title
        by_seed = {seed: reasons(old.identity, new.identities.get(seed, Identity())) for seed in new.values}
        self.reasons = {kind: text for found in by_seed.values() for kind, text in found.items()}
        self.values: dict[int, Values] = {
            seed: row for seed, row in new.values.items() if not {CONTENTS, TRUTH} & by_seed[seed].keys()
        }
        self.cause = self.reasons.get(RENDERER, "")
        truths = [old.identity.truth, *(new.identities.get(seed, Identity()).truth for seed in self.values)]
        self.unidentified = bool(self.values) and None in truths
        digests = dict(zip(old.seeds, old.models, strict=True))
        known = {seed for seed in self.values if digests.get(seed) and new.models.get(seed)}
        self.equal = {seed for seed in known if new.models[seed] == digests[seed]}
        self.differ, self.unknown = len(known - self.equal), len(self.values) - len(known)
        self.free = set(self.values) - self.equal
        self._times = times and old.kernel is not None
        self._pace = _pace(old, new) if self._times and self.values else ""

    def findings(self) -> Iterator[Finding]:
        """What needs no statistics."""
        for seed, reason in self.new.failures.items():
            yield Finding("worse", self.title, f"seed {seed} {reason}")
        for kind in (CONTENTS, TRUTH):
            if kind in self.reasons:
                yield Finding("not measured", self.title, self.reasons[kind])
        if not self.new.values and not self.new.failures:
            yield Finding("not measured", self.title, "the run has no such result")
        yield from self._of_lacking_views()
        if not self.values:
            return
        other_version = self.new.version != self.old.version
        if other_version:
            yield Finding("note", self.title, f"method version {self.old.version} → {self.new.version}")
        yield from self._of_options("note" if other_version else "worse")
        if self._pace:
            yield Finding("not measured", self.title, f"times: {self._pace}")
        for name, quantity in QUANTITIES.items():
            if name in self.reasons and self._asks(quantity):
                yield Finding("not measured", self.title, f"{quantity.title}: {self.reasons[name]}")
            rows = self.values if self._compares(quantity) else {}
            lacking = sum(name not in row for row in rows.values())
            if self.old.values.get(name) and lacking and (lacking == len(rows) or quantity.kind == "quality"):
                which = "" if lacking == len(rows) else f" of {lacking} of {len(rows)} seeds"
                yield Finding("not measured", self.title, f"{quantity.title}: no value{which} in the run")
        yield from self._of_equal()

    def _of_lacking_views(self) -> Iterator[Finding]:
        """Views of the same content that the run does not have: fewer views are a truth of their own."""
        paths = [] if CONTENTS in self.reasons else list(self.new.views.values())
        lacking = [view for view in self.old.views if any(view not in path for path in paths)]
        if lacking:
            text = f"{len(lacking)} of {len(self.old.views)} views were not measured ({lacking[0]}, ...)"
            yield Finding("worse", self.title, text)

    def _of_options(self, kind: Kind) -> Iterator[Finding]:
        """Options with other values; those of one side alone are new or gone, and results tell what they do.

        Args:
            kind: "worse" for the same version, which means the same results: such an option is a mistake.
        """
        old = self.old.options
        found: list[tuple[Kind, str]] = []
        for own in self.new.options.values():
            shared, alone = old.keys() & own.keys(), old.keys() ^ own.keys()
            found += [(kind, differences(old, own, shared)), ("note", differences(old, own, alone))]
        for weight, text in dict.fromkeys(found):
            if text:
                yield Finding(weight, self.title, f"options differ: {text}")

    @property
    def elsewhere(self) -> str:
        """Processors and threads, where models differ on unlike ones; else ""."""
        if not self.differ or self.new.processor == self.old.processor:
            return ""
        return f"the baseline's are of {self.old.processor}, these of {self.new.processor}"

    def _asks(self, quantity: Quantity) -> bool:
        return quantity.kind != "time" or (self._times and not self._pace)

    def _compares(self, quantity: Quantity) -> bool:
        return self._asks(quantity) and quantity.name not in self.reasons

    def _of_equal(self) -> Iterator[Finding]:
        """Equal files must measure alike: a gain, too, is one of measurement."""
        for seed in sorted(self.equal):
            for name, quantity in QUANTITIES.items():
                before, after = self.before(name).get(seed), self.values[seed].get(name)
                if quantity.kind == "time" or before is None or after is None or not self._compares(quantity):
                    continue
                difference = quantity.score(after) - quantity.score(before)
                if abs(difference) > _EQUAL + quantity.error(before, rounding(before)):
                    text = (
                        f"{quantity.title} {quantity.text(before)} → {quantity.text(after)} from the same "
                        f"files of the model (seed {seed}): {self.cause or 'rendering or metric has changed'}"
                    )
                    yield Finding("not measured" if self.cause else "worse", self.title, text)

    def before(self, name: str) -> dict[int, float]:
        """Seed -> value of the baseline."""
        values = zip(self.old.seeds, self.old.values.get(name, []), strict=False)
        return {seed: value for seed, value in values if value is not None}

    def after(self, name: str) -> dict[int, float]:
        """Seed -> value of the run, where chance has a part in it."""
        quantity = QUANTITIES[name]
        seeds = self.values if quantity.kind == "time" else self.free
        rows = {seed: self.values[seed] for seed in seeds} if self._compares(quantity) else {}
        return {seed: row[name] for seed, row in rows.items() if name in row}

    def samples(self) -> Iterator[_Sample]:
        """All quantities, also those that only tell how much seeds spread."""
        for name, quantity in QUANTITIES.items():
            before, after = list(self.before(name).values()), list(self.after(name).values())
            if len(before) > 1:
                scores = (
                    [quantity.score(value) for value in before],
                    [quantity.score(value) for value in after],
                )
                values = _mean(before), _mean(after)
                cause = "" if quantity.kind == "time" else self.cause
                yield _Sample(
                    "a scene",
                    self.title,
                    quantity.title,
                    quantity,
                    *scores,
                    values,
                    self.rounding(name),
                    cause,
                )

    def rounding(self, name: str) -> float:
        """How far the mean score of the baseline may be off by its digits."""
        return _mean(QUANTITIES[name].error(value, rounding(value)) for value in self.before(name).values())


def _pace(old: BaselineCell, new: Cell) -> str:
    """Why the times of a run do not compare; "" if they do."""
    if new.processor != old.processor:
        return f"the baseline's are of {old.processor}, these of {new.processor}"
    slow = bool(new.kernels and old.kernel) and float(np.median(new.kernels)) > BUSY * (old.kernel or 0.0)
    busy = "the machine was busy, as the reference kernel beside them shows; --without-times leaves times out"
    return busy if new.busy or slow else ""


def _tests(samples: Sequence[_Sample]) -> Iterator[_Test]:
    """A test of each sample that has results; the spread of a quantity is learned from all samples."""
    for quantity in QUANTITIES.values():
        own = [sample for sample in samples if sample.quantity is quantity]
        base = prior([sample.variance for sample in own], [sample.freedom for sample in own])
        yield from (sample.test(base) for sample in own if sample.after)


def _of_methods(pairs: Sequence[_Pair]) -> Iterator[_Sample]:
    """Means of each method over its scenes: what is small in each scene may be significant in all."""
    groups: dict[Key, list[_Pair]] = defaultdict(list)
    for pair in pairs:
        groups[pair.old.key._replace(dataset="", scene=_ALL)].append(pair)
    for key, group in groups.items():
        for name, quantity in QUANTITIES.items():
            before, after = (
                [side(name) for side in sides]
                for sides in zip(*((p.before, p.after) for p in group), strict=True)
            )
            scores = _over_scenes(quantity, before), _over_scenes(quantity, after)
            if len(group) > 1 and len(scores[0]) > 1 and quantity.kind != "time":
                values = tuple(_mean(_mean(scene.values()) for scene in scenes) for scenes in (before, after))
                title = f"{quantity.title} over {len(group)} scenes"
                cause = next((pair.cause for pair in group if pair.cause), "")
                digits = _mean(pair.rounding(name) for pair in group)
                name = key.title.lstrip("/")
                yield _Sample("a method's mean", name, title, quantity, *scores, values, digits, cause)  # type: ignore[arg-type]


def _over_scenes(quantity: Quantity, scenes: Sequence[Mapping[int, float]]) -> list[float]:
    """Mean score of each seed that all scenes have."""
    seeds = sorted(set.intersection(*(set(scene) for scene in scenes)))
    return [_mean(quantity.score(scene[seed]) for scene in scenes) for seed in seeds]


def _of_views(pairs: Sequence[_Pair]) -> Iterator[_Test]:
    """Views that lose or gain more than their scene does."""
    quantity = QUANTITIES[VIEW_METRIC]
    known = [pair.old for pair in pairs if pair.old.views]
    base = prior([_view_variance(old) for old in known], [_view_freedom(old) for old in known])
    for pair in pairs:
        old = pair.old
        paths = [pair.new.views[seed] for seed in sorted(pair.free) if pair.new.views.get(seed)]
        if (
            len(old.views) < _LEAST_VIEWS
            or VIEW_METRIC in pair.reasons
            or not paths
            or any(not set(old.views) <= set(path) for path in paths)
        ):
            continue
        before = np.array(list(old.views.values()))
        after = np.mean([[path[view] for view in old.views] for path in paths], axis=0)
        variance, freedom = base.moderated(_view_variance(old), _view_freedom(old))
        error = math.sqrt(variance * (1.0 / len(old.seeds) + 1.0 / len(paths)))
        excess = (after - before) - float(np.mean(after - before))
        before, after = before - before.mean(), after - after.mean()
        for view, one, other, more in zip(old.views, before, after, excess, strict=True):
            title = f"{quantity.title} of view {view} above the mean"
            digits = 2.0 * VIEW_ROUNDING  # the view's and the mean's
            yield _Test(
                "a view",
                pair.title,
                title,
                quantity,
                one,
                other,
                float(more),
                error,
                freedom,
                digits,
                pair.cause,
            )


def _view_variance(cell: BaselineCell) -> float:
    return without_rounding(cell.view_spread**2, _mean(cell.views.values()))


def _view_freedom(cell: BaselineCell) -> int:
    return (len(cell.seeds) - 1) * (len(cell.views) - 1)


def _mean(values: Iterable[float]) -> float:
    numbers = list(values)
    return float(np.mean(numbers)) if numbers else math.nan


# --------------------------------------------------------------------------- correction


def _significant(tests: Sequence[_Test]) -> Iterator[Finding]:
    """Holm's step-down correction, for losses and for gains."""
    for kind, sign in (("worse", -1.0), ("better", 1.0)):
        chances = [tail(sign * test.statistic, test.freedom) for test in tests]
        ranked = sorted(range(len(tests)), key=chances.__getitem__)
        for position, place in enumerate(ranked):
            level = LEVEL / (len(tests) - position)
            if chances[place] > level:
                break
            test = tests[place]
            yield test.finding(kind, level)  # type: ignore[arg-type]
