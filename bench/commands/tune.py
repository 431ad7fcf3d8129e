"""``bench tune``."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from econgs_bench.bench.commands.arguments import (
    add_data,
    add_execution,
    add_settings,
    add_stored,
    count,
    repeatable,
)
from econgs_bench.bench.commands.results import print_grid
from econgs_bench.bench.commands.run import request
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.tune.objective import front, objective_of
from econgs_bench.bench.tune.study import Study, Trial, Trials, command, importances, means, smaller, studies
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.options import label, written
from econgs_bench.reports.tables.grid import Field

_STARTS = {"paper": "published settings", "fair": "its own defaults"}
"""Starting points, as :attr:`.bench.tune.study.Chosen.gains` names them -> for people."""


def tune_arguments(parser: ArgumentParser) -> None:
    """What ``bench tune`` takes."""
    add_stored(parser)
    parser.add_argument("method", metavar="METHOD", help="whose options are varied")
    parser.add_argument(
        "suite", nargs="?", default="quick",
        help="whose data, seeds and preset: a suite, or a TOML file (default: quick)",
    )  # fmt: skip
    parser.add_argument("--trials", type=count, default=24, metavar="N", help="in all (default: 24)")
    parser.add_argument(
        "--objective", default="front", metavar="SCORE",
        help="front[=DB,MIB]: area under PSNR over log2 of size, above DB and below MIB; point=DB,MIB: "
        "the same of the method's own rate alone; size=MIB: PSNR of a model of at most that size; psnr "
        "(default: front=20,64)",
    )  # fmt: skip
    repeatable(parser, "--option", metavar="NAME", help="vary this, instead of those that the method names")
    add_data(parser)
    add_settings(parser, "the same in all trials")
    add_execution(parser)
    parser.add_argument(
        "--show", action="store_true", help="show the method's studies in the run store, and run nothing"
    )


def tune(options: Namespace) -> int:
    """Run the trials of a study that have not ended yet, or show the studies of a store."""
    if find_spec("optuna") is None:
        raise DataError("bench tune", "needs the package optuna", "pip install 'econgs-bench[tune]'")
    return _show(options) if options.show else _run(options)


def _run(options: Namespace) -> int:
    from econgs_bench.bench.results.tables import build_tables
    from econgs_bench.bench.run.display import make_display
    from econgs_bench.bench.run.experiment import execute

    done = execute(
        request(options, methods=(options.method,), split="val", overrides={}),
        make_display(),
        plan=partial(
            Trials,
            objective=objective_of(options.objective),
            fixed=_fixed(options),
            names=tuple(options.option),
            budget=options.trials,
            show=_print,
            retry=options.retry == "failed",
        ),
    )
    assert isinstance(done.planner, Trials)
    study = done.planner.study
    build_tables(done.store, done.planner.registry.specs)
    if done.outcome.stopped:
        print("bench: stopped; run the same command again to resume", file=sys.stderr)
        return 130
    if len(study.trials) < study.budget:
        for name in done.outcome.unfinished:
            print(f"bench: {name} has no record", file=sys.stderr)
        return 1
    print("\n".join(["", *_summary(study, done.store)]))
    _print_tables(study)
    return 0 if study.chosen is not None else 1


def _print(study: Study, trial: Trial | None) -> None:
    """A study that begins, or one of its trials."""
    print("\n".join(_head(study)) if trial is None else _line(study, trial), flush=True)


def _show(options: Namespace) -> int:
    store = Store(Path(options.out))
    known = studies(store.root, options.method)
    if not known:
        have = sorted({study.method for study in studies(store.root)})
        remedy = f"It has studies of {', '.join(have)}" if have else "Run it without --show"
        raise DataError(store.root, f"no study of {options.method!r}", remedy)
    for study in known:
        lines = [*_head(study), *(_line(study, trial) for trial in study.trials), ""]
        print("\n".join([*lines, *_summary(study, store)]))
        _print_tables(study)
        print()
    return 0


def _fixed(options: Namespace) -> dict[str, bool | int | float | str]:
    """Options that every trial has."""
    from econgs_bench.datasets.names import unknown
    from econgs_bench.methods.options import parse_assignments

    given = parse_assignments(options.set)
    for name in given:
        if name != options.method:
            raise unknown("method", name, [options.method], of="this study (--set)")
    return given.get(options.method, {})


def _head(study: Study) -> list[str]:
    """What is tuned, on what, by which score."""
    under = study.conditions
    places = ", ".join(f"{dataset}/{scene}" for dataset, scene, _ in under.scenes)
    seeds = f"seed{'s' if len(under.seeds) > 1 else ''} {', '.join(map(str, under.seeds))}"
    lines = [
        f"study {study.name}: {study.method} (version {study.version}) on {places}, preset {under.preset}, "
        f"{seeds}, validation views; {study.budget} trials",
        f"score: {study.objective.title} [{study.objective.unit}], mean over scenes and seeds",
    ]
    if study.fixed:
        lines.append(f"in all trials: {label(study.fixed)}")
    return [*lines, *(f"  {name}: {one.text}" for name, one in study.space.items())]


def _line(study: Study, trial: Trial) -> str:
    """A trial, and the best one up to it."""
    text = f"{trial.status}: {trial.reason}"
    if trial.score is not None:
        models = means(trial)
        sizes, qualities = [mib for _, mib, _ in models], [psnr for *_, psnr in models]
        text = f"{trial.score:.3f}, {_span(qualities, '.2f')} dB at {_span(sizes, '.3g')} MiB"
    scores = [(one.score, -one.number) for one in study.trials[: trial.number + 1] if one.score is not None]
    best = f"best {max(scores)[0]:.3f} (trial {-max(scores)[1]})" if scores else "none yet"
    varied = label({name: value for name, value in trial.overrides.items() if name not in study.fixed})
    return f"trial {trial.number}: {text}; {best}; {varied or 'its own defaults'}"


def _span(values: list[float], form: str) -> str:
    low, high = (format(value, form) for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _summary(study: Study, store: Store) -> list[str]:
    """The chosen options, and what other methods of the store had under the same conditions."""
    failed = sum(trial.score is None for trial in study.trials)
    lines = [f"{len(study.trials)} of {study.budget} trials, {failed} failed"]
    for other in studies(store.root):
        if other.method != study.method and other.conditions == study.conditions:
            note = "" if other.budget == study.budget else " (another budget)"
            score = "nothing chosen" if other.chosen is None else f"score {other.chosen.score:.3f}"
            lines.append(f"under the same conditions: {other.method}, {score} of {other.budget} trials{note}")
    if study.chosen is None:
        if failed == len(study.trials):
            return [*lines, "no trial succeeded, so nothing is chosen"]
        point = f"{study.objective.psnr:g} dB and {study.objective.mib:g} MiB"
        remedy = f"name another one: --objective {study.objective.kind}=DB,MIB"
        return [*lines, f"no model is within the reference point of {point}, so nothing is chosen; {remedy}"]
    each = (f"{gain:+.3f} over {_STARTS[name]}" for name, gain in study.chosen.gains.items())
    gains = ", ".join(each)
    lines.append(f"chosen: trial {study.chosen.trial}, score {study.chosen.score:.3f} ({gains})")
    lines.append(command(study.method, study.chosen.overrides) or "the method's own defaults")
    return [*lines, *_as_good(study)]


def _as_good(study: Study) -> list[str]:
    """The trial that is as good as the defaults in fewer bytes, where the chosen one is another."""
    default = study.default
    found = smaller(study.trials, default) if default else None
    if default is None or found is None or (study.chosen and found.number == study.chosen.trial):
        return []
    (_, size, psnr), (_, size_before, psnr_before) = (means(one)[0] for one in (found, default))
    text = f"as good as its defaults in fewer bytes: trial {found.number}, {psnr:.2f} dB at {size:.3g} MiB "
    text += f"({psnr - psnr_before:+.2f} dB, {size / size_before:.0%} of the bytes)"
    return [text, command(study.method, found.overrides)]


def _print_tables(study: Study) -> None:
    """The front of all trials, and the importance of each option."""
    models = [(trial.number, *model) for trial in study.trials for model in means(trial)]
    if models:
        print("\nfront of all trials")
        rows = [models[place] for place in front([(mib, psnr) for *_, mib, psnr in models])]
        columns = zip(*(
            (str(number), "own" if rate is None else written(rate), f"{mib:.4g}", f"{psnr:.2f}")
            for number, rate, mib, psnr in rows
        ), strict=True)  # fmt: skip
        heads = ("Trial", "Rate", "MiB", "PSNR [dB]")
        print_grid([Field(head, list(cells), "number") for head, cells in zip(heads, columns, strict=True)])
    if shares := importances(study):
        print("\nimportance of options")
        ranges = [study.space[name].text for name in shares]
        parts = [f"{share:.0%}" for share in shares.values()]
        print_grid([Field("Option", list(shares)), Field("Range", ranges), Field("Share", parts, "number")])
