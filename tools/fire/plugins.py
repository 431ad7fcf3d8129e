"""Plugins that misbehave, in every stage, at import and in the spec: ``python -m tools.fire.plugins``.

Each fault must become a row of the right status whose reason says what happened, or an error in one line, and
the run must go on.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

import psutil

from econgs_bench.bench.store.store import Store
from tests.bench.conftest import PLUGINS, PRESET, Bench, suite_file, write_dataset
from tools.fire.attack import Tally, bench_in, leftovers, work_folder

FOLDER = Path(__file__).parent / "plugins"
LIMITS = ("--time-limit", "8", "--memory-limit", "1G")
OF_MEMORY = ("--time-limit", "180", "--memory-limit", "600M")
"""On a busy machine memory takes its time to fill."""
DEEDS = {
    "exit": ("failed", "exit code 3"),
    "exit-0": ("failed", "exit code 0"),
    "leave": ("failed", "exit"),
    "busy": ("failed", "exit code 76"),
    "stopped": ("unfinished", ""),
    "abort": ("failed", "SIGABRT"),
    "crash": ("failed", "SIGSEGV"),
    "kill": ("failed", "SIGKILL"),
    "term": ("unfinished", ""),
    "stop": ("timeout", "time limit"),
    "raise": ("failed", "ValueError: a bug"),
    "mute": ("failed", "Mute"),
    "interrupt": ("failed", ""),
    "refuse": ("refused", "not to its taste"),
    "diverge": ("diverged", "it went away"),
    "hang": ("timeout", "time limit"),
    "spin": ("timeout", "time limit"),
    "memory": ("oom", "memory limit"),
    "thread": ("ok", ""),
    "child": ("ok", ""),
    "handles": ("failed", "Too many open files"),
    "deep": ("failed", "RecursionError"),
    "flood": ("ok", ""),
    "close": ("failed|ok", ""),
    "away": ("ok", ""),
}
"""Deeds that any stage can do -> the status of the job, and words of its reason."""
STAGES = {"fit": "fit", "restore": "encode", "save": "encode", "load": "measure", "render": "measure"}
"""Stage -> the kind of its job."""
OWN = {
    ("fit", "early"): ("failed", "without a checkpoint"),
    ("fit", "none"): ("failed", ""),
    ("fit", "text"): ("failed", ""),
    ("fit", "delete"): ("failed|ok", ""),
    ("restore", "none"): ("failed", ""),
    ("restore", "text"): ("failed", ""),
    ("primitives", "nan"): ("failed", "primitives"),
    ("primitives", "negative"): ("failed", "primitives"),
    ("primitives", "text"): ("failed", "primitives"),
    ("primitives", "none"): ("failed", "primitives"),
    ("save", "more"): ("failed", "byte ledger sums to"),
    ("save", "less"): ("failed", "byte ledger sums to"),
    ("save", "negative"): ("failed", "negative entries"),
    ("save", "foreign"): ("failed", "not in the group"),
    ("save", "text"): ("failed", "byte ledger"),
    ("save", "nan"): ("failed", "byte ledger"),
    ("save", "flat"): ("failed", "byte ledger"),
    ("save", "none"): ("failed", "byte ledger"),
    ("save", "list"): ("failed", "byte ledger"),
    ("save", "more files"): ("failed", "byte ledger sums to"),
    ("save", "link"): ("failed", "byte ledger sums to"),
    ("save", "delete"): ("failed", "No such file"),
    ("load", "none"): ("failed", ""),
    ("load", "text"): ("failed", ""),
    ("load", "nobody"): ("failed", "the loaded model holds []"),
    ("load", "delete"): ("failed", "No such file|loaded model holds"),
    ("render", "nan"): ("failed", "not finite"),
    ("render", "infinite"): ("failed", "not finite"),
    **{
        ("render", name): ("failed", "renders")
        for name in (
            "none", "text", "one", "shape", "small", "small alpha", "deep alpha", "planes", "four", "gray",
            "flat", "bytes", "complex", "objects",
        )
    },
    **{("timings", name): ("failed", "timings") for name in ("nan", "text", "none")},
    ("timings", "nothing"): ("ok", ""),
    **{("attributes", name): ("failed", "attributes") for name in ("nan", "text", "none", "flat")},
    ("compose", "none"): ("failed", ""),
    ("compose", "text"): ("failed", ""),
    ("compose", "first"): ("failed", "the loaded model holds"),
}  # fmt: skip
"""Stage and deed of its own -> status and words, of which | separates alternatives."""
COMPOSE = ("exit", "crash", "raise", "refuse", "hang", "thread")
IMPORTS = {
    "exit": ("import os\nos._exit(3)", "exit code 3"),
    "leave": ("import sys\nsys.exit(3)", "exit"),
    "raise": ("raise ValueError('a bug')", "ValueError: a bug"),
    "abort": ("import os\nos.abort()", "SIGABRT"),
    "hang": ("import time\ntime.sleep(600)", "time limit"),
    "syntax": ("def (", "SyntaxError"),
    "lacking": ("import no_such_library", "No module named 'no_such_library'"),
    "empty": ("", "has no attribute 'Method'"),
    "encoding": ("# \udcff", "SyntaxError|has no attribute"),
    "no class": ("Method = 3", ""),
}
"""What the module of an implementation does -> words of the row of its fit."""
SPEC = """from econgs_bench.methods.interface import MethodSpec
SPEC = MethodSpec(
    name={name!r}, title="t", reference="r", version="1", implementation="{module}.method:Method",
    uses_alpha="no", iterations={{"quick": 1, "standard": 1, "paper": 1}}, devices=("cpu",),{more}
)
"""
SPECS = {
    "raise": "raise ValueError('a bug')\nSPEC = 1",
    "leave": "import sys\nsys.exit(0)\nSPEC = 1",
    "mute": "class Mute(Exception):\n    def __str__(self):\n        raise self\nraise Mute\nSPEC = 1",
    "syntax": "SPEC = (",
    "none": "SPEC = None",
    "class": "from econgs_bench.methods.interface import MethodSpec\nSPEC = MethodSpec",
    "lacking": "import no_such_library\nSPEC = 1",
    "deep": "def deep():\n    return deep()\nSPEC = deep()",
    **{
        f"{field} {value}": SPEC.format(name="x", module="x", more="").replace(old, f"{field}={value}")
        for field, old, values in (
            ("name", "name='x'", ("3", "''", "'a b'", "'../x'", "None", "'3dgs'")),
            ("version", 'version="1"', ("1", "None")),
            ("title", 'title="t"', ("None", "3")),
            ("implementation", 'implementation="x.method:Method"', ("'x'", "None", "'::'")),
            (
                "iterations",
                'iterations={"quick": 1, "standard": 1, "paper": 1}',
                ("{}", "None", '{"quick": 0, "standard": 1, "paper": 1}',
                 '{"quick": "1", "standard": 1, "paper": 1}'),
            ),
            ("devices", 'devices=("cpu",)', ("()", "('tpu',)", "None", "'cpu'")),
            ("options", 'devices=("cpu",)', ("3", "dict")),
            ("presets", 'devices=("cpu",)', ("{'quick': {'no': 1}}", "3")),
            ("rate_knobs", 'devices=("cpu",)', ("3", "(3,)")),
            ("edits", 'devices=("cpu",)', ("{'no'}", "3")),
        )
        for value in values
    },
}  # fmt: skip
"""A plugin's spec that cannot be used -> the module."""


def variants(faults: Iterable[tuple[str, str]]) -> str:
    """Line of a suite that runs the method faulty with each fault, and once without."""
    tables = [f'{{ faulty = {{ stage = "{stage}", fault = "{fault}" }} }}' for stage, fault in faults]
    return f"variants = [{', '.join(['{}', *tables])}]\nthreads = 1"


def rows(bench: Bench) -> dict[tuple[str, str], tuple[str, str]]:
    """Stage and fault -> status and reason of the job that failed, "ok" if none did."""
    found: dict[tuple[str, str], tuple[str, str]] = {}
    for record in Store(bench.store).records():
        if record.job.axes()["method"] == "faulty" and (not record.ok or record.job.kind == "measure"):
            key = str(record.job.options["stage"]), str(record.job.options["fault"])
            if record.cause is None and found.get(key, ("ok",))[0] == "ok":
                found[key] = record.status, record.reason or ""
    return found


def judge(tally: Tally, name: str, found: tuple[str, str] | None, expected: tuple[str, str]) -> None:
    """Count a fault: its row against the status and words that are due."""
    status, reason = found or ("unfinished", "")
    fits = status in expected[0].split("|") and any(word in reason for word in expected[1].split("|"))
    tally.add(name.split(":")[0], "" if fits else f"{name}: {status}: {reason}, not {expected}")


def children() -> set[int]:
    """Descendants of this process, which adopts none."""
    return {child.pid for child in psutil.Process().children(recursive=True)}


def attack_stages(
    bench: Bench,
    faults: dict[tuple[str, str], tuple[str, str]],
    tally: Tally,
    limits: tuple[str, ...] = LIMITS,
) -> None:
    """Run all faults in one run, beside the usual model."""
    names = (
        '"argon_bubble_like@32" = []' if "compose" in {s for s, _ in faults} else f'"{bench.dataset}" = ["a"]'
    )
    more = variants(faults) + ('\ncompositions = "all"' if "argon" in names else "")
    suite = suite_file(bench.store.parent, names, more + PRESET)
    done = bench(
        "run", suite, "--method", "faulty", "--plugins", PLUGINS, "--plugins", bench.plugins,
        "--out", bench.store, "--no-report", *limits, code=None,
    )  # fmt: skip
    found = rows(bench)
    for (stage, fault), expected in faults.items():
        judge(tally, f"{stage}: {fault}", found.get((stage, fault)), expected)
    judge(tally, "without a fault", found.get(("", "")), ("ok", ""))
    if done.returncode != 1 or "Traceback" in done.stderr:
        tally.add("the run goes on", f"exit code {done.returncode}: {done.stderr[-500:]}")
    else:
        tally.add("the run goes on")
    unfinished = any(expected[0] == "unfinished" for expected in faults.values())
    tally.add("nothing left behind", "" if unfinished else leftovers(bench.store))


def write_plugin(folder: Path, name: str, spec: str, method: str = "") -> Path:
    """A plugin of two modules; the folder to give."""
    (folder / name).mkdir(parents=True)
    (folder / name / "__init__.py").write_text("")
    (folder / name / "spec.py").write_bytes(spec.encode(errors="surrogateescape"))
    (folder / name / "method.py").write_bytes(method.encode(errors="surrogateescape"))
    return folder


def attack_imports(bench: Bench, names: Iterable[str], tally: Tally) -> None:
    """Run methods whose implementations cannot be imported, and a good one after them."""
    folder = bench.store.parent / "imports"
    words = {f"x-{name.replace(' ', '-')}": name for name in names}
    for method, name in words.items():
        module = method.replace("-", "_")
        write_plugin(folder, module, SPEC.format(name=method, module=module, more=""), IMPORTS[name][0])
    arguments = [part for method in [*words, "fake"] for part in ("--method", method)]
    done = bench(
        "run", "quick", "--dataset", bench.dataset, "--scene", "a", *arguments, "--no-report",
                      "--plugins", PLUGINS, "--plugins", folder, "--out", bench.store, *LIMITS, code=None,
    )  # fmt: skip
    found = {
        r.job.method: (r.status, r.reason or "") for r in Store(bench.store).records() if r.job.kind == "fit"
    }
    for method, name in words.items():
        expected = "timeout" if name == "hang" else "failed"
        judge(tally, f"import: {name}", found.get(method), (expected, IMPORTS[name][1]))
    judge(tally, "import: none", found.get("fake"), ("ok", ""))
    tally.add("the run goes on", "" if "Traceback" not in done.stderr else done.stderr[-500:])


def attack_specs(bench: Bench, names: Iterable[str], tally: Tally) -> None:
    """List methods with a spec that cannot be used: one line that names the plugin, and exit code 2."""
    for number, name in enumerate(names):
        folder = write_plugin(bench.store.parent / f"spec-{number}", "x", SPECS[name])
        done = bench("list", "methods", "--plugins", folder, code=None)
        lines = done.stderr.strip().splitlines()
        fits = done.returncode == 2 and len(lines) == 1 and lines[0].startswith("bench: ")
        named = fits and (str(folder) in lines[0] or " of x: " in lines[0])
        tally.add("spec", "" if named else f"{name}: exit code {done.returncode}: {done.stderr[-300:]}")


def attack_own_folder(bench: Bench, tally: Tally) -> None:
    """A plugin whose code is deleted between two runs, or by itself: its jobs are errors, no others."""
    folder = bench.store.parent / "mine"
    method = (
        "import shutil, sys\nfrom pathlib import Path\nfrom fake import Single\n"
        "class Method(Single):\n    def fit(self, *arguments):\n"
        "        shutil.rmtree(Path(__file__).parent)\n        return super().fit(*arguments)\n"
    )
    spec = "import fake\n" + SPEC.format(name="mine", module="mine", more=" options=fake.Options,")
    write_plugin(folder, "mine", spec, method)
    done = bench(
        "run", "quick", "--dataset", bench.dataset, "--scene", "a", "--method", "mine",
                      "--method", "fake", "--no-report", "--plugins", PLUGINS, "--plugins", folder,
                      "--out", bench.store, code=None,
    )  # fmt: skip
    found = {
        (r.job.axes()["method"], r.job.kind): (r.status, r.reason or "") for r in Store(bench.store).records()
    }
    judge(tally, "own folder: its encode", found.get(("mine", "encode")), ("failed", "mine|no method in it"))
    judge(tally, "own folder: others", found.get(("fake", "measure")), ("ok", "|no method in it"))
    tally.add("the run goes on", "" if "Traceback" not in done.stderr else done.stderr[-500:])
    done = bench("results", "--runs", bench.store, code=None)
    tally.add("results without the plugin", "" if done.returncode == 0 else done.stderr[-300:])
    shutil.rmtree(folder, ignore_errors=True)


def all_faults() -> dict[tuple[str, str], tuple[str, str]]:
    """Every deed in every stage."""
    return {(stage, deed): due for stage in STAGES for deed, due in DEEDS.items()} | {
        key: due for key, due in OWN.items() if key[0] != "compose"
    }


def composing() -> dict[tuple[str, str], tuple[str, str]]:
    """Deeds of joining models, each of which takes seven jobs."""
    return {("compose", deed): DEEDS[deed] for deed in COMPOSE} | {
        key: due for key, due in OWN.items() if key[0] == "compose"
    }


def main(arguments: list[str] | None = None) -> int:
    """Attack with every fault, and print what held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only", nargs="+", default=["stages", "memory", "compose", "imports", "specs", "own"]
    )
    options = parser.parse_args(arguments)
    tally = Tally()
    os.environ.pop("BENCH_DATA", None)
    with work_folder() as folder:
        dataset = write_dataset(folder / "tiny")
        before = children()
        for name in options.only:
            bench = bench_in(folder / name, dataset)
            bench.plugins, bench.patience = FOLDER, 3600.0
            if name == "stages":
                faults = {key: due for key, due in all_faults().items() if key[1] != "memory"}
                attack_stages(bench, faults, tally)
            elif name == "memory":
                faults = {(stage, "memory"): DEEDS["memory"] for stage in STAGES}
                attack_stages(bench, faults, tally, OF_MEMORY)
            elif name == "compose":
                attack_stages(bench, composing(), tally)
            elif name == "imports":
                attack_imports(bench, IMPORTS, tally)
            elif name == "specs":
                attack_specs(bench, SPECS, tally)
            else:
                attack_own_folder(bench, tally)
        left = children() - before
        tally.add("no process left", f"{left}" if left else "")
    return tally.finish()


if __name__ == "__main__":
    sys.exit(main())
