"""Proof of the gate: planted regressions, each of which `bench gate` or a test must notice.

    python -m tools.proofs.planted                    every plant, and the same without one
    python -m tools.proofs.planted 3dgs-* sort-tiles  some of them (patterns)
    python -m tools.proofs.planted --full half-vector the gate's full form alone (three seeds, four scenes)
    python -m tools.proofs.planted --report           what earlier calls found, as Markdown (also with --full)

For each plant of plants.toml the script copies the checkout, replaces the plant's text, builds the native
module where C++ is touched, runs the named test, runs the suite `gate` with the named method, and compares it
with the project's baseline, as .ci/run does. Where the gate passes, the method's fingerprint is asked. The
control does all of that without a plant and must pass. ``--full`` asks the suite `gate-full` and its
baseline, as .ci/nightly does, and neither tests nor fingerprints. It needs a plain install of the project
(``pip install '.[test]'``).

Exit code 1: a plant's text is no longer in the source, nothing notices a plant, or the control does not pass.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLANTS = Path(__file__).with_name("plants.toml")
CONTROL = "control"
FINGERPRINT = "tests/methods/test_fingerprints.py::test_results_are_as_recorded_for_their_version[{}]"
_PACKAGES = ("bench", "datasets", "econgs", "methods", "reports")
_CHECKOUT = (*_PACKAGES, "native", "tests", "docs",
             "CMakeLists.txt", "pyproject.toml", "CHANGELOG.md", "README.md")  # fmt: skip


@dataclass(frozen=True)
class Plant:
    """A mistake that a developer could make.

    Attributes:
        name: short, of the list.
        breaks: what it breaks, for people.
        file: path from the root of the checkout.
        old: text that occurs once in it; new: what stands there instead.
        methods: with which the gate is run; none where pictures to learn from change, as the truth of models
            and measurement then changes alike.
        test: id of the test that is to notice it; "" where the gate alone does.
    """

    name: str
    breaks: str
    file: str
    old: str
    new: str
    methods: tuple[str, ...] = ()
    test: str = ""

    @property
    def missing(self) -> str:
        """Why it cannot be planted; "" if it can."""
        count = (ROOT / self.file).read_text(encoding="utf-8").count(self.old)
        return "" if count == 1 else f"its text occurs {count} times in {self.file}"


@dataclass
class Result:
    """What noticed a plant.

    Attributes:
        gate: method -> first finding of the gate; "" where it passed.
        test: the test's last line where it failed; "" where it passed.
        fingerprints: methods whose fingerprints differ, of those with which the gate passed.
        trouble: what kept the proof from being run.
    """

    name: str
    gate: dict[str, str]
    test: str
    fingerprints: list[str]
    trouble: str = ""

    @property
    def noticed(self) -> bool:
        return bool(self.test or self.fingerprints or any(self.gate.values()))


def plants() -> list[Plant]:
    """The list."""
    content = tomllib.loads(PLANTS.read_text(encoding="utf-8"))
    return [
        Plant(name, **{key: tuple(v) if key == "methods" else v for key, v in fields.items()})
        for name, fields in content.items()
    ]


class Proof:
    """Runs plants in a folder.

    Args:
        work: keeps builds, views and results between calls.
        suite: "gate" or "gate-full"; its baseline is in tests/.
    """

    def __init__(self, work: Path, suite: str) -> None:
        self.work, self.suite = work, suite
        self.baseline = ROOT / "tests" / f"{suite}-baseline.json"
        self.results = work / f"results-{suite}"
        for folder in (self.results, work / "copies", work / "runs"):
            folder.mkdir(parents=True, exist_ok=True)

    def prove(self, plant: Plant | None, methods: Sequence[str], tests: Sequence[str]) -> Result:
        """Plant a mistake (None: nothing) in a fresh copy; ask tests, the gate and the fingerprints."""
        name = plant.name if plant else CONTROL
        copy = self._copy(name)
        try:
            if not self.used(copy):
                raise RuntimeError("the installed package runs, not the copy: use a plain install, not -e")
            if plant:
                self._apply(plant, copy)
            failed = self._pytest(copy, *tests) if tests else ""
            gate = {method: self._gate(copy, name, method) for method in methods}
            missed = [method for method, finding in gate.items() if not finding]
            asked = missed if self.suite == "gate" else []
            prints = [method for method in asked if self._pytest(copy, FINGERPRINT.format(method))]
            result = Result(name, gate, failed, prints)
        except RuntimeError as error:
            result = Result(name, {}, "", [], str(error))
        finally:
            shutil.rmtree(copy)
        (self.results / f"{name}.json").write_text(json.dumps(asdict(result), indent=1), encoding="utf-8")
        return result

    def known(self, name: str) -> Result | None:
        """What an earlier call found."""
        path = self.results / f"{name}.json"
        return Result(**json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else None

    # ------------------------------------------------------------------ copies

    def _copy(self, name: str) -> Path:
        """The checkout, with the installed native module, in a folder of its own."""
        copy = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self.work / "copies"))
        for part in _CHECKOUT:
            if (ROOT / part).is_dir():
                ignored = shutil.ignore_patterns("__pycache__", "measured")
                shutil.copytree(ROOT / part, copy / part, ignore=ignored)
            else:
                shutil.copy2(ROOT / part, copy / part)
        module = importlib.util.find_spec("econgs_bench.econgs._native")
        assert module is not None
        assert module.origin is not None
        shutil.copy2(module.origin, copy / "econgs")
        package = copy / "econgs_bench"
        package.mkdir()
        for name in _PACKAGES:
            (package / name).symlink_to(copy / name)
        shutil.copy2(copy / "bench" / "package.py", package / "__init__.py")
        return copy

    def used(self, copy: Path) -> bool:
        """Whether commands on a copy run its code: an editable install comes before PYTHONPATH."""
        found = _check(
            self._in(copy, sys.executable, "-c", "import econgs_bench.econgs._native as m; print(m.__file__)")
        )
        return Path(found.stdout.strip()).is_relative_to(copy)

    def _apply(self, plant: Plant, copy: Path) -> None:
        path = copy / plant.file
        path.write_text(path.read_text(encoding="utf-8").replace(plant.old, plant.new), encoding="utf-8")
        if plant.file.startswith("native/"):
            self._build(copy)

    def _build(self, copy: Path) -> None:
        """Build the copy's native module; the build folder stays, so that only what differs is compiled."""
        tools, source, build = (self.work / name for name in ("tools", "native_source", "native_build"))
        if not tools.is_dir():
            _run([sys.executable, "-m", "pip", "install", "-q", "--target", str(tools), "nanobind"])
        code = f"import sys; sys.path.insert(0, {str(tools)!r}); import nanobind; print(nanobind.cmake_dir())"
        folder = _run([sys.executable, "-c", code]).stdout.strip()
        for path in [copy / "CMakeLists.txt", *(p for p in (copy / "native").rglob("*") if p.is_file())]:
            target = source / path.relative_to(copy)
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.is_file() or target.read_bytes() != path.read_bytes():
                shutil.copyfile(path, target)
        _run(["cmake", "-S", str(source), "-B", str(build), "-G", "Ninja", "-DCMAKE_BUILD_TYPE=Release",
              f"-DPython_EXECUTABLE={sys.executable}", f"-Dnanobind_DIR={folder}"])  # fmt: skip
        _run(["ninja", "-C", str(build)])
        (module,) = build.glob("_native*.so")
        shutil.copy2(module, copy / "econgs" / module.name)

    # ------------------------------------------------------------------ what is asked

    def _pytest(self, copy: Path, *tests: str) -> str:
        """The line that says why one of the tests failed; "" where they passed."""
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
        done = self._in(copy, *command)
        if done.returncode not in (0, 1):
            raise RuntimeError(f"{tests[0]} was not run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
        if done.returncode == 0:
            return ""
        lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return lines[0] if lines else "failed"

    def _gate(self, copy: Path, name: str, method: str) -> str:
        """The first loss that `bench gate` finds in a run of the copy; "" where it finds none.

        Other methods of the baseline are not measured (exit code 2), which counts nothing.
        """
        store = self.work / "runs" / f"{name} {method}"
        shutil.rmtree(store, ignore_errors=True)
        bench = [sys.executable, "-m", "econgs_bench.bench"]
        ran = self._in(copy, *bench, "run", self.suite, "--method", method, "--no-report", "--out", store)
        done = self._in(copy, *bench, "gate", store, "--without-times", "--baseline", self.baseline)
        text = done.stdout + done.stderr
        (self.results / f"{name} {method}.txt").write_text(text, encoding="utf-8")
        shutil.rmtree(store, ignore_errors=True)
        if done.returncode not in (1, 2):
            raise RuntimeError(f"bench gate: {text[-1500:]}\n{ran.stderr[-1500:]}")
        return " ".join(done.stdout.splitlines()[0].split()) if done.returncode == 1 else ""

    def _in(self, folder: Path, *command: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a command on a checkout; its views and locks are the proof's own."""
        own = {"PYTHONPATH": str(folder), "BENCH_CACHE": str(self.work / "cache"),
               "BENCH_LOCKS": str(self.work / "locks")}  # fmt: skip
        words = list(map(str, command))
        return subprocess.run(words, cwd=folder, env=os.environ | own, capture_output=True, encoding="utf-8")


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    return _check(subprocess.run(command, capture_output=True, encoding="utf-8"))


def _check(done: subprocess.CompletedProcess[str]) -> subprocess.CompletedProcess[str]:
    if done.returncode:
        raise RuntimeError(f"{' '.join(done.args[:6])} ...: {(done.stdout + done.stderr)[-2000:]}")
    return done


# --------------------------------------------------------------------------- report


def line(result: Result) -> str:
    """What noticed a plant, in one line for the terminal."""
    if result.trouble:
        return f"{result.name}: {result.trouble}"
    by = [f"gate with {method}: {finding}" for method, finding in result.gate.items() if finding]
    by += [result.test] if result.test else []
    by += [f"fingerprint of {method}" for method in result.fingerprints]
    return f"{result.name}: {'; '.join(by) or ('passes' if result.name == CONTROL else 'not noticed')}"


def markdown(listed: Sequence[Plant], proof: Proof) -> str:
    """Results of all plants as a table; of the full form, the gate's findings where it was asked."""
    full = proof.suite == "gate-full"
    rows = ["| Plant | What breaks | Noticed by | First finding of the gate |", "|---|---|---|---|"]
    if full:
        rows = ["| Plant | What breaks | First finding of the gate |", "|---|---|---|"]
    for plant in listed:
        result = proof.known(plant.name)
        if full and (result is None or result.trouble):
            continue
        if result is None or result.trouble:
            rows.append(f"| {plant.name} | {plant.breaks} | not run | |")
            continue
        by = [f"gate ({method})" for method, finding in result.gate.items() if finding]
        by += [f"`{plant.test.rpartition('::')[2]}`"] if result.test else []
        by += [f"fingerprint ({method})" for method in result.fingerprints]
        gate = [f"{method}: {_finding(text)}" for method, text in result.gate.items()]
        noticed = [] if full else [", ".join(by) or "**nothing**"]
        cells = [plant.name, plant.breaks, *noticed, "<br>".join(gate) or "not asked"]
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows)


def _finding(text: str) -> str:
    """A finding without its kind and without what all cells of a method share."""
    parts = re.match(r"(?:worse|not measured) (\S+) .*?views\): (.*)", text)
    return f"{parts[1]}: {parts[2]}" if parts else text or "passes"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("patterns", nargs="*", metavar="PLANT", help="default: all, and the control")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "proof", metavar="DIR")
    parser.add_argument("--new", action="store_true", help="only plants without a result")
    parser.add_argument("--full", action="store_true", help="ask the gate's full form alone")
    parser.add_argument("--report", action="store_true", help="print the results of earlier calls")
    options = parser.parse_args()
    listed = plants()
    if gone := [f"{plant.name}: {plant.missing}" for plant in listed if plant.missing]:
        print("\n".join(gone), file=sys.stderr)
        return 1
    proof = Proof(options.work.resolve(), "gate-full" if options.full else "gate")
    if options.report:
        print(markdown(listed, proof))
        return 0
    good = True
    chosen = options.patterns or ["*"]
    for plant in listed:
        if any(fnmatch(plant.name, one) for one in chosen) and not (options.new and proof.known(plant.name)):
            if options.full and not plant.methods:
                continue
            tests = [plant.test] if plant.test and not options.full else []
            result = proof.prove(plant, plant.methods, tests)
            print(line(result), flush=True)
            good &= result.noticed
    if any(fnmatch(CONTROL, one) for one in chosen):
        methods = sorted({method for plant in listed for method in plant.methods})
        tests = [] if options.full else sorted({plant.test for plant in listed if plant.test})
        result = proof.prove(None, methods, tests)
        print(line(result), flush=True)
        good &= not (result.noticed or result.trouble or result.fingerprints)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
