"""What a stranger sends, and what another user of the machine does: ``python -m tools.fire.strangers``.

Stores, bundles, texts, pictures and models that lie; each is given to the commands that read it. A command
must end with an exit code and lines of its own, within memory and time. What is outside of its store, and of
what it was told to write, stays as it is and where it is.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.bench.results.bundle import MANIFEST, write_bundle
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.memory import peak_host_bytes
from econgs_bench.datasets.seals import sealed, unsealed
from tests.bench.conftest import Bench, write_dataset
from tests.bench.test_bundle import resigned
from tests.bench.test_strangers import BOMBS, COMMANDS, LEAD_OUT, LINKS, NUMBERS, deflated, files_of
from tools.fire.attack import Tally, bench_in, work_folder

SECRET = "a private key: 3f1c9b7e5d"
MEMORY = 1 << 30
"""Bytes of a command at most; one that reads a whole store of this size takes a third."""
SECONDS = 120.0
CODES = {0, 1, 2, 3, 141}
"""Exit codes of commands; a crash has another."""
LABELS = (
    "\x1b]0;title\x07\x1b[2J", "<script id=evil>x</script>", "<img id=evil src=x onerror=x>", "=1+1|cmd",
    "@SUM(A1)", "a|b\n# c", "]]><evil/>", "\x00\x0b\ufffe\u202e\x9b2J", "[a](javascript:x)",
    "\\input{/etc/passwd}", "../../evil", "'; touch evil; '", "-" * 5000,
)  # fmt: skip


@dataclass
class Watch:
    """Counts what must be none over all attacks.

    Attributes:
        home: folder of the reader, outside of every store: what is in it must stay as it is.
        crashes: commands that ended by a signal or a traceback.
        touched: attacks after which a file in ``home`` had changed, or lay in what was written.
        most: peak of the memory of any command, in bytes.
    """

    home: Path
    commands: int = 0
    crashes: int = 0
    touched: int = 0
    most: int = 0
    _before: dict[Path, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        (self.home / "old-photos").mkdir(parents=True)
        (self.home / "old-photos" / "sea.jpg").write_bytes(b"waves")
        (self.home / "victim").mkdir()
        (self.home / "victim" / "letter").write_text("dear")
        (self.home / "id_rsa").write_text(SECRET)
        (self.home / "id_rsa").chmod(0o600)
        self._before = files_of(self.home)

    def run(self, bench: Bench, *words: object, written: Path | None = None) -> str:
        """Run a command to its end; what must not be, "" for nothing.

        Args:
            written: folder in which nothing of ``home`` may lie afterwards.
        """
        self.commands += 1
        start, log = time.monotonic(), bench.store.parent / "log"
        remarks = log.with_suffix(".err")
        with log.open("wb") as output, remarks.open("wb") as said:
            process = subprocess.Popen(
                bench.command(*words), env=bench.environment, cwd=bench.store.parent,
                stdin=subprocess.DEVNULL, stdout=output, stderr=said,
            )  # fmt: skip
            resource.prlimit(process.pid, resource.RLIMIT_AS, (8 * MEMORY, 8 * MEMORY))
            peak = 0
            while process.poll() is None:
                peak = max(peak, peak_host_bytes(process.pid) or 0)
                if time.monotonic() - start > SECONDS:
                    process.kill()
                time.sleep(0.01)
        code = process.returncode
        text = "".join(path.read_text(encoding="utf-8", errors="replace") for path in (log, remarks))
        self.most = max(self.most, peak)
        faults = []
        if "Traceback" in text or code not in CODES:
            self.crashes += 1
            faults.append(f"exit code {code}: {text[-300:]}")
        if peak > MEMORY:
            faults.append(f"{peak >> 20} MiB")
        faults += self.look(written)
        return "; ".join([f"{words[0]}: {fault}" for fault in faults])

    def look(self, written: Path | None = None) -> list[str]:
        """Faults of what is outside of a store, which is put back."""
        faults = []
        if files_of(self.home) != self._before:
            faults.append("changed a file outside")
            shutil.rmtree(self.home)
            self.__post_init__()
        for path in written.rglob("*") if written is not None else ():
            if path.is_file() and not path.is_symlink() and _holds(path, SECRET.encode()):
                faults.append(f"copied a file of the reader to {path.name}")
        self.touched += bool(faults)
        return faults

    def finish(self) -> None:
        """Print the counts."""
        print(
            f"commands: {self.commands}, of which crashed: {self.crashes}, most memory {self.most >> 20} MiB"
        )
        print(f"attacks after which a file outside was touched: {self.touched}", flush=True)


def _holds(path: Path, words: bytes) -> bool:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            return any(words in archive.read(name) for name in archive.namelist())
    return words in path.read_bytes()


class Victim:
    """A finished store to be changed as a stranger would, and given to commands."""

    def __init__(self, folder: Path, finished: Bench, watch: Watch) -> None:
        self.folder, self.watch, self._finished = folder, watch, finished
        self._jobs = {
            kind: finished.of_kind(kind)[0].job.id for kind in ("views", "encode", "fit", "measure")
        }
        self.bench = bench_in(folder, finished.dataset)

    def renew(self) -> None:
        """The store as it was."""
        for name in ("runs", "out"):
            shutil.rmtree(self.folder / name, ignore_errors=True)
        shutil.copytree(self._finished.store, self.bench.store)
        (self.folder / "out").mkdir()

    def record(self, kind: str) -> Path:
        return self.bench.store / "jobs" / self._jobs[kind] / "record.json"

    def place(self, text: str) -> Path:
        return self.bench.store / text.format(**self._jobs)

    def run(self, name: str) -> str:
        """Give the store to a command of :data:`tests.bench.test_strangers.COMMANDS`."""
        names = {
            **self._jobs, "store": self.bench.store, "other": self._finished.store,
            "out": self.folder / "out", "dataset": self._finished.dataset,
        }  # fmt: skip
        words = [word.format(**names) for word in COMMANDS[name]]
        if words[0] == "run":
            words = self.bench.run_arguments("--no-report", "--retry")[3:]
        return self.watch.run(self.bench, *words, written=self.folder / "out")

    def bundle(self) -> dict[str, bytes]:
        """Name -> bytes of the files of a bundle."""
        path = self.folder / "whole.zip"
        write_bundle(Store(self._finished.store), path, models=True)
        with zipfile.ZipFile(path) as archive:
            return {name: archive.read(name) for name in archive.namelist()}


def changed(path: Path, change: Callable[[Any], Any]) -> None:
    """A record with other values, and a checksum that fits."""
    values = json.loads(unsealed(path.read_text(encoding="utf-8")))
    change(values)
    path.write_text(sealed(json.dumps(values)), encoding="utf-8")


# --------------------------------------------------------------------------- records, links, bombs


def attack_names(victim: Victim, keys: Iterable[str], commands: Iterable[str], tally: Tally) -> None:
    """Records that name a folder outside of the store, and that of another job."""
    for kind in ("views", "encode"):
        for key in (*keys, "0" * 16):
            for command in commands:
                victim.renew()
                lie = {"status": "failed", "cause": f"views-{'0' * 16}"}

                def change(record: Any, key: str = key, lie: Mapping[str, str] = lie) -> None:
                    record.update(lie)
                    record["job"]["key"] = key

                changed(victim.record(kind), change)
                (victim.bench.store / "partial" / f"{kind}-x").mkdir()
                tally.add("records that lead out of a store", victim.run(command))


def attack_links(victim: Victim, places: Iterable[str], commands: Iterable[str], tally: Tally) -> None:
    """Symbolic links in the place of parts of a store."""
    for place in places:
        for command in commands:
            victim.renew()
            path, target = victim.place(place), victim.watch.home / "id_rsa"
            if path.is_dir() or not path.suffix:
                target = victim.watch.home
            if path.is_dir():
                shutil.rmtree(path)
            path.unlink(missing_ok=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(target)
            tally.add("symbolic links", victim.run(command))


def attack_bombs(victim: Victim, tally: Tally) -> None:
    """Bundles that are small as files."""
    whole, path = victim.bundle(), victim.folder / "bomb.zip"
    for bomb in (*BOMBS, None):
        files = dict(whole)
        if bomb is not None:
            bomb(files)
            if not bomb.__name__.startswith("manifest"):
                resigned(files)
            deflated(files, path)
        else:  # a gigabyte in a kilobyte
            with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
                archive.writestr(MANIFEST, bytes(1 << 30))
        for words in (("verify", path), ("merge", path, "--out", victim.folder / "merged")):
            shutil.rmtree(victim.folder / "merged", ignore_errors=True)
            tally.add("bombs", victim.watch.run(victim.bench, *words))


def attack_numbers(victim: Victim, tally: Tally) -> None:
    """Numbers that no table holds."""
    for kind, key, number in NUMBERS:
        victim.renew()
        path = victim.record(kind)
        text = json.dumps(json.loads(unsealed(path.read_text())))
        path.write_text(sealed(re.sub(re.escape(key) + r"[-\d.e]+", key + number, text)))
        for command in ("results", "report", "bundle", "merge"):
            tally.add("numbers", victim.run(command))


def attack_pictures(victim: Victim, tally: Tally) -> None:
    """Files in the place of stored pictures."""
    from PIL import Image

    def eps(path: Path) -> None:
        Image.new("RGB", (8, 8)).save(path, "EPS")

    def bomb(path: Path) -> None:
        Image.new("1", (20_000, 20_000)).save(path, "PNG")

    def large(path: Path) -> None:
        Image.new("1", (13_000, 13_000)).save(path, "PNG")

    def cut(path: Path) -> None:
        path.write_bytes(path.read_bytes()[:-20])

    for fake in (eps, bomb, large, cut):
        for pattern in ("jobs/*/renders/*.png", "jobs/*/truth/*.png"):
            victim.renew()
            for path in victim.bench.store.glob(pattern):
                fake(path)
            for command in ("report", "render", "baseline"):
                tally.add("pictures", victim.run(command))


# --------------------------------------------------------------------------- texts


class _Evil(HTMLParser):
    """Whether a page has an element of a label."""

    found = False

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found |= ("id", "evil") in attributes


def attack_texts(victim: Victim, labels: Iterable[str], tally: Tally) -> None:
    """Labels that a terminal, a browser, a spreadsheet or a shell would take for commands."""
    for label in labels:
        victim.renew()
        for path in victim.bench.store.glob("jobs/*/record.json"):
            changed(path, lambda record, label=label: _relabel(record, label))
        runs, out = victim.bench.store, victim.folder / "out"
        for form in ("", "md", "csv", "tex", "json"):
            words = ("results", "--runs", runs, *(("--format", form) if form else ()))
            wrong = victim.watch.run(victim.bench, *words)
            # Remarks on standard error are for people: only what is printed must be of the form.
            text, said = (
                (victim.folder / name).read_bytes().decode("utf-8", "replace") for name in ("log", "log.err")
            )
            if not wrong and re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", text + said):
                wrong = "a control character"
            commands = {"md": r"<(script|img)", "csv": r'(^|,)"?[=@]'}.get(form)
            if not wrong and commands and re.search(commands, text, re.MULTILINE):
                wrong = f"a command in {form}"
            tally.add("texts", wrong and f"{label[:20]!r}: {wrong}")
        report = victim.watch.run(victim.bench, "report", "--runs", runs, "--out", out, written=out)
        wrong = report or _page(out)
        tally.add("texts", wrong and f"{label[:20]!r}: {wrong}")


def _relabel(record: Any, label: str) -> None:
    job = record["job"]
    job["dataset_name"] = job["dataset"] = job["group"] = label
    if record.get("provenance"):
        record["provenance"]["cpu"] = record["provenance"]["machine"] = label
    if record["job"]["kind"] == "measure":
        record["measure"]["renderer"] = label


def _page(out: Path) -> str:
    """What a label has done to the files of a report."""
    for path in out.rglob("*"):
        if path.suffix == ".svg":
            try:
                ElementTree.parse(path)
            except ElementTree.ParseError as error:
                return f"{path.name}: {error}"
        if path.suffix == ".html":
            parser = _Evil()
            parser.feed(path.read_text(encoding="utf-8"))
            if parser.found:
                return f"{path.name}: an element of a label"
        if path.suffix == ".md" and re.search(r"<(script|img)", path.read_text(encoding="utf-8")):
            return f"{path.name}: HTML"
    return "" if any(out.rglob("report.html")) else "no page"


# --------------------------------------------------------------------------- models


READER = """
import json, sys
from tools.fire.strangers import accepted
for line in sys.stdin:
    print(json.dumps(accepted(*json.loads(line))), flush=True)
"""


def accepted(method: str, folder: str) -> str:
    """Reads a model as a command does, which decodes in a process of its own: refused, read or a fault."""
    from econgs_bench.datasets.errors import DataError
    from econgs_bench.methods.contract.scene import cameras
    from econgs_bench.methods.registry import Registry, load_method

    try:
        model = load_method(Registry().spec(method)).load(Path(folder), "cpu")
        rgb, alpha = (part.numpy() for part in model.render(cameras(3, phase=1.0)[0]))
    except DataError as error:
        return "refused" if error.remedy else f"no remedy: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "read" if np.isfinite(rgb).all() and np.isfinite(alpha).all() else "values that are not finite"


STREAMS = {"zfp": (".volume", 24), "sz3": (".volume", 200), "mesh": (".drc", 40)}
"""Method -> suffix of a file with a stream, and bytes of it that are mutated."""


class Parent:
    """A process that reads models one after the other; its end would be that of a user's command."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self._start()

    def read(self, method: str, folder: Path) -> str:
        """What became of a model; "" if it was refused, or read with finite pictures."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([method, str(folder)]) + "\n")
        self._process.stdin.flush()
        if not (line := self._process.stdout.readline()):
            self._watch.crashes += 1
            code = self._process.wait()
            self._start()
            return f"the process that reads it ended with code {code}"
        self.outcome = json.loads(line)
        return "" if self.outcome in ("refused", "read") else self.outcome

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _start(self) -> None:
        self.outcome = ""
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", READER], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            encoding="utf-8", env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        )  # fmt: skip


def attack_streams(
    folder: Path, methods: Iterable[str], number: int, seed: int, watch: Watch, tally: Tally
) -> None:
    """Mutate the first bytes of streams within models, whose lengths and checksums fit."""
    from tools.fire.mutations import prepared, repair

    rng, parent = random.Random(seed), Parent(watch)
    for method in methods:
        suffix, first = STREAMS[method]
        saved, _ = prepared(method, folder / method)
        file = next(saved.rglob(f"*{suffix}"))
        whole = {path: path.read_bytes() for path in saved.rglob("*") if path.is_file()}
        start = 12 + int.from_bytes(whole[file][8:12], "little") if suffix == ".volume" else 0
        seen = {"refused": 0, "read": 0}
        for _ in range(number):
            data = bytearray(whole[file])
            for _ in range(2):
                data[start + rng.randrange(min(first, len(data) - start - 4))] = rng.randrange(256)
            file.write_bytes(data)
            repair(file)
            tally.add(f"mutated streams of {method}", parent.read(method, saved))
            if parent.outcome in seen:
                seen[parent.outcome] += 1
            for path, content in whole.items():
                path.write_bytes(content)
        print(f"    {method}: {seen['refused']} refused, {seen['read']} read", flush=True)
    parent.close()


def attack_files(folder: Path, methods: Iterable[str], watch: Watch, tally: Tally) -> None:
    """Other files in the place of those of models."""
    from tools.fire.mutations import prepared

    deep = b"[" * 100_000
    contents = {
        "deep JSON": b'{"format":' + deep, "deep TOML": b"a = " + deep, "an infinity": b'{"a": 1e999}',
        "nothing": b"", "zeros": bytes(1 << 20), "a pickle": b"\x80\x04cos\nsystem\n(S'touch evil'\ntR.",
    }  # fmt: skip
    parent = Parent(watch)
    for method in methods:
        saved, _ = prepared(method, folder / method)
        for path in sorted(path for path in saved.rglob("*") if path.is_file()):
            whole = path.read_bytes()
            sealed_by = {".toml": _with_sum, ".codec": _with_line}.get(path.suffix, lambda data: data)
            for data in contents.values():
                path.write_bytes(sealed_by(data))
                tally.add("files of models", parent.read(method, saved))
            with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
                for name in ("about.npy", "meta.json"):
                    archive.writestr(name, bytes(1 << 28))
            tally.add("files of models", parent.read(method, saved))
            path.unlink()
            path.symlink_to(watch.home / "id_rsa")
            tally.add("files of models", parent.read(method, saved))
            path.unlink()
            path.write_bytes(whole)
    parent.close()


def _with_sum(data: bytes) -> bytes:
    import zlib

    return data + b"\ncrc32=" + str(zlib.crc32(data)).encode()


def _with_line(data: bytes) -> bytes:
    import zlib

    return data + b"\n" + str(zlib.crc32(data + b"\n")).encode()


# --------------------------------------------------------------------------- other users of the machine


USERS = (1001, 1002)
_OPEN = """
user=$1 closed=$2 inner=$3 aside=$PWD/python
shift 3
IFS="
"
for folder in $inner; do
    mkdir -p "$aside$folder"
    mount --bind "$folder" "$aside$folder"
done
for folder in $closed; do mount -t tmpfs -o mode=755 tmpfs "$folder"; done
for folder in $inner; do
    mkdir -p "$folder"
    mount --bind "$aside$folder" "$folder"
done
exec setpriv --reuid "$user" --regid "$user" --clear-groups "$@"
"""
"""Runs a command as another user: user, closed folders, folders of Python within them, command."""
PROTECTED = Path("/proc/sys/fs/protected_regular")


@contextlib.contextmanager
def protected(value: int) -> Iterator[bool]:
    """Set what Linux refuses for files of others in a folder with the sticky bit; whether that worked."""
    before = PROTECTED.read_text() if PROTECTED.exists() else ""
    try:
        with contextlib.suppress(OSError):
            PROTECTED.write_text(str(value))
        yield PROTECTED.exists() and PROTECTED.read_text().strip() == str(value)
    finally:
        with contextlib.suppress(OSError):
            PROTECTED.write_text(before)


def attack_users(folder: Path, values: Iterable[int], tally: Tally) -> None:
    """Two users run at once with the locks of one folder; then one of them closes a lock to all."""
    for path in (folder, folder.parent):
        path.chmod(0o755)
    dataset = write_dataset(folder / "tiny")
    for value in values:
        with protected(value) as possible:
            if not possible:
                print(f"    fs.protected_regular cannot be {value} here", flush=True)
                continue
            locks = folder / f"locks-{value}"
            locks.mkdir()
            locks.chmod(0o1777)
            runs = [_as_user(user, folder / f"{value}-{user}", dataset, locks) for user in USERS]
            for user, run in zip(USERS, runs, strict=True):
                text, _ = run.communicate(timeout=600)
                tally.add(
                    "runs of two users at once", f"user {user}: {text[-300:]}" if run.returncode else ""
                )
            for lock in locks.iterdir():
                lock.chmod(0o600)
            owner = {os.stat(lock).st_uid for lock in locks.iterdir()}
            for user in set(USERS) - owner or USERS[1:]:
                run = _as_user(user, folder / f"{value}-{user}-closed", dataset, locks)
                text, _ = run.communicate(timeout=600)
                named = run.returncode == 2 and "belongs to" in text and "Traceback" not in text
                tally.add("locks that are closed name their owner", "" if named else text[-300:])


def _as_user(user: int, folder: Path, dataset: Path, locks: Path) -> subprocess.Popen[str]:
    """A run of another user in a folder of its own.

    Where Python or its packages lie in a folder that is closed to others, they see those alone of it.
    """
    folder.mkdir()
    os.chown(folder, user, user)
    bench = bench_in(folder, dataset)
    bench.environment |= {"BENCH_LOCKS": str(locks), "HOME": str(folder)}
    inner: dict[str, str] = {}
    for prefix in {sys.prefix, sys.base_prefix}:
        path = Path(prefix).resolve()
        closed = next((str(p) for p in reversed(path.parents) if not p.stat().st_mode & 0o001), None)
        if closed:
            inner[str(path)] = closed
    lists = ["\n".join(sorted(set(paths))) for paths in (inner.values(), inner)]
    words = ["sh", str(user), *lists, *bench.run_arguments("--no-report")]
    return subprocess.Popen(
        ["unshare", "--mount", "sh", "-ec", _OPEN, *words], env=bench.environment, cwd=folder,
        umask=0o022, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8",
    )  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Attack, and print what held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--streams", type=int, default=400, help="mutated streams of each method")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", help="attacks to run; default: all")
    options = parser.parse_args(arguments)
    tally = Tally()
    with work_folder() as folder:
        finished = bench_in(folder / "finished", write_dataset(folder / "tiny"))
        finished.run()
        watch = Watch(folder / "victim" / "home")
        victim = Victim(folder / "victim", finished, watch)
        from econgs_bench.methods.registry import Registry

        attacks: dict[str, Callable[[], None]] = {
            "names": lambda: attack_names(victim, LEAD_OUT, ("run", "merge", "repair", "bundle"), tally),
            "links": lambda: attack_links(victim, LINKS.values(), COMMANDS, tally),
            "bombs": lambda: attack_bombs(victim, tally),
            "numbers": lambda: attack_numbers(victim, tally),
            "pictures": lambda: attack_pictures(victim, tally),
            "texts": lambda: attack_texts(victim, LABELS, tally),
            "streams": lambda: attack_streams(
                folder / "streams", STREAMS, options.streams, options.seed, watch, tally
            ),
            "files": lambda: attack_files(folder / "files", Registry().built_in(), watch, tally),
        }
        if os.getuid() == 0:
            attacks["users"] = lambda: attack_users(folder / "users", (0, 1, 2), tally)
        for name in options.only or attacks:
            (folder / name).mkdir(exist_ok=True)
            start = time.monotonic()
            attacks[name]()
            print(f"{name}: {time.monotonic() - start:.0f} s", flush=True)
        watch.finish()
    return tally.finish() or int(bool(watch.crashes or watch.touched))


if __name__ == "__main__":
    sys.exit(main())
