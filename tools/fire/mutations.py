"""Random damage to saved models of all methods: ``python -m tools.fire.mutations [METHOD ...]``.

Every second mutation has its checksums made again, so that the checks of the readers themselves are tried. A
damaged model must be refused with a DataError that names its folder or file, or render finite pictures. A
child process reads; it must not crash, hang or take 1 GiB more memory than before.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.interface import Method
from tests.datasets.damage import KINDS, Outcome, damage
from tools.fire.attack import Tally

PATIENCE = 30.0
"""Seconds that a reading may take; the slowest whole model takes 0.1 s."""
MEMORY = 1 << 30


# --------------------------------------------------------------------------- checksums made again


def repair(file: Path) -> bool:
    """Make the checksums of a damaged file again, as far as it can still be understood; whether it could."""
    again = _REPAIRS.get(file.suffix)
    try:
        data = again(file.read_bytes()) if again else None
        if file.suffix == ".drc":
            return _repair_mesh(file)
    except Exception:  # too damaged
        return False
    if data is None:
        return False
    file.write_bytes(data)
    return True


def _last_line(data: bytes, mark: bytes) -> bytes:
    text, found, _ = data.rpartition(mark)
    assert found
    return text + mark + str(zlib.crc32(text)).encode()


def _ply(data: bytes) -> bytes:
    head, _, body = data.partition(b"end_header\n")
    return re.sub(rb"crc32 [0-9a-f]{8}", b"crc32 %08x" % zlib.crc32(body), head) + b"end_header\n" + body


def _safetensors(data: bytes) -> bytes:
    """Sums of tensors and facts, in the header's text."""
    from safetensors.torch import load

    from econgs_bench.methods.shared.sealed import _sum

    length = int.from_bytes(data[:8], "little")
    facts = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["model"])
    stored = facts.pop("crc32")
    header = data[8 : 8 + length].replace(stored.encode(), _sum(load(data), facts).encode(), 1)
    return data[:8] + header + data[8 + length :]


def _json(data: bytes) -> bytes:
    """Of facts with the sum first, or of a scene of a volume with the sum last."""
    from econgs_bench.methods.shared.sealed import _sum

    facts = json.loads(data)
    stored = facts.pop("crc32")
    if isinstance(stored, str):
        text = json.dumps({"crc32": _sum({}, facts), **facts}, separators=(",", ":"))
    else:
        whole = zlib.crc32(json.dumps(facts, separators=(",", ":")).encode())
        text = json.dumps({**facts, "crc32": whole}, separators=(",", ":"))
    return text.encode()


def _container(data: bytes) -> bytes:
    from econgs_bench.econgs.codec.container import _CHECK, _ENTRY, _HEADER, MOST_SECTIONS, overhead

    magic, version, count, _ = _HEADER.unpack_from(data)
    assert count <= MOST_SECTIONS
    start = overhead(count)
    head = _HEADER.pack(magic, version, count, len(data))
    for index in range(count):
        kind, zero, scene, length, _ = _ENTRY.unpack_from(data, _HEADER.size + index * _ENTRY.size)
        if index == count - 1:
            length = len(data) - start
        head += _ENTRY.pack(kind, zero, scene, length, zlib.crc32(data[start : start + length]))
        start += length
    return head + _CHECK.pack(zlib.crc32(head)) + data[overhead(count) :]


def _zip(data: bytes) -> bytes:
    """The members as they stand in the damaged file, packed anew."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for member in old.infolist():
            with old.open(member) as stream:
                stream._expected_crc = None  # type: ignore[attr-defined]
                new.writestr(member.filename, stream.read())
    return out.getvalue()


def _repair_mesh(file: Path) -> bool:
    """Length and sum of a surface stand in the scene's file."""
    stem, number, _ = file.name.rsplit(".", 2)
    scene, data = file.with_name(f"{stem}.json"), file.read_bytes()
    about = json.loads(scene.read_bytes())
    about["surfaces"][int(number)] |= {"bytes": len(data), "crc32": zlib.crc32(data)}
    scene.write_text(json.dumps(about, separators=(",", ":")))
    return True


_REPAIRS: dict[str, Callable[[bytes], bytes]] = {
    ".toml": lambda data: _last_line(data, b"\ncrc32="),
    ".codec": lambda data: _last_line(data, b"\n"),
    ".ply": _ply,
    ".safetensors": _safetensors,
    ".json": _json,
    ".ints": lambda data: data[:8] + zlib.crc32(data[12:]).to_bytes(4, "little") + data[12:],
    ".volume": lambda data: data[:-4] + zlib.crc32(data[:-4]).to_bytes(4, "little"),
    ".econgs": _container,
    ".hac": _container,
    ".hacplus": _container,
    ".npz": _zip,
}
"""Suffix of a file -> the file with its checksums made again."""


# --------------------------------------------------------------------------- reading in a child


class Reader:
    """Reads a folder of a model as often as asked for, in children that are watched.

    Args:
        method: whose models they are.
        folder: of the model.
        camera: of the picture.
        picture: of the whole model.
    """

    def __init__(self, method: Method, folder: Path, camera: Any, picture: tuple[Any, Any]) -> None:
        self._method, self._folder, self._camera, self._picture = method, folder, camera, picture
        self._pid = 0

    def read(self) -> tuple[str, str]:
        """What became of a reading: refused, same, other or fault; and words."""
        if not self._pid:
            self._start()
        try:
            self._requests.write(b".")
            if not select.select([self._answers], [], [], PATIENCE)[0]:
                os.kill(self._pid, signal.SIGKILL)
                self._end()
                return "fault", f"took more than {PATIENCE:g} s"
            line = self._answers.readline()
        except BrokenPipeError:
            line = b""
        if not line:
            return "fault", f"the reading process ended: {self._end()}"
        kind, words = json.loads(line)
        return kind, words

    def close(self) -> None:
        if self._pid:
            os.kill(self._pid, signal.SIGKILL)
            self._end()

    def _end(self) -> str:
        _, status = os.waitpid(self._pid, 0)
        self._pid = 0
        self._requests.close()
        self._answers.close()
        return f"exit code {os.waitstatus_to_exitcode(status)}"

    def _start(self) -> None:
        requests, answers = os.pipe(), os.pipe()
        self._pid = os.fork()
        if self._pid:
            os.close(requests[0])
            os.close(answers[1])
            self._requests, self._answers = os.fdopen(requests[1], "wb", 0), os.fdopen(answers[0], "rb")
            return
        code = 70
        try:
            import torch

            torch.set_num_threads(1)
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            limit = pages * resource.getpagesize() + MEMORY
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            while os.read(requests[0], 1):
                os.write(answers[1], json.dumps(self._once()).encode() + b"\n")
            code = 0
        finally:
            os._exit(code)

    def _once(self) -> tuple[str, str]:
        try:
            model = self._method.load(self._folder, "cpu")
            scenes = model.scenes
            rgb, alpha = (part.numpy() for part in model.render(self._camera))
        except DataError as error:
            if str(self._folder) not in error.what or not error.remedy:
                return "fault", f"does not name its file: {error}"
            return "refused", ""
        except BaseException as error:
            return "fault", f"{type(error).__name__}: {error}"
        if not (np.isfinite(rgb).all() and np.isfinite(alpha).all()):
            return "fault", "renders values that are not finite"
        same = len(scenes) == 1 and all(
            np.array_equal(a, b) for a, b in zip((rgb, alpha), self._picture, strict=True)
        )
        return ("same" if same else "other"), ""


def prepared(name: str, folder: Path) -> tuple[Path, tuple[Any, ...]]:
    """A small saved model of a method, and the picture of one loaded from it.

    A child makes them: the native kernels start threads, which later children would lack.
    """
    saved, picture = folder / "model", folder / "picture.npz"
    pid = os.fork()
    if not pid:
        code = 70
        try:
            import torch

            from econgs_bench.methods.contract.checks import Subject
            from econgs_bench.methods.registry import Registry, load_method
            from tests.methods.test_contract import SMALL

            torch.set_num_threads(1)
            spec = Registry().spec(name)
            subject = Subject(spec, load_method(spec), folder, iterations=8, overrides=SMALL.get(name))
            subject.saved(subject.first()[0], "model")
            rgb, alpha = subject.method.load(saved, "cpu").render(subject.camera)
            np.savez(picture, rgb=rgb.numpy(), alpha=alpha.numpy())
            code = 0
        finally:
            traceback.print_exc() if code else None
            os._exit(code)
    if os.waitpid(pid, 0)[1]:
        raise RuntimeError(f"no model of {name} could be made")
    with np.load(picture) as parts:
        return saved, (parts["rgb"], parts["alpha"])


def fuzz(name: str, mutations: int, seed: int, folder: Path) -> Iterator[Outcome]:
    """Damage a small model of a method many times; yields the outcome of plain damage and of repaired."""
    from econgs_bench.methods.contract.scene import cameras
    from econgs_bench.methods.registry import Registry, load_method

    saved, picture = prepared(name, folder)
    method, camera = load_method(Registry().spec(name)), cameras(3, phase=1.0)[0]
    files = sorted(file for file in saved.rglob("*") if file.is_file())
    whole = {file: file.read_bytes() for file in files}
    rng = np.random.default_rng(seed)
    reader = Reader(method, saved, camera, picture)
    outcomes = Outcome(), Outcome()
    cuts = [(file, "cut", share) for file in files for share in (0.1, 0.5, 0.9)]
    try:
        for number in range(mutations):
            file, kind = files[rng.integers(len(files))], KINDS[rng.integers(len(KINDS))]
            at, value = float(rng.uniform(0, 1 if rng.integers(2) else 0.3)), int(rng.integers(256))
            repaired = bool(number % 2)
            if not repaired and number // 2 < len(cuts):
                file, kind, at = cuts[number // 2]
            damage(file, kind, min(at, 0.9999), value)
            outcome = outcomes[repaired and repair(file)]
            start = time.monotonic()
            found, words = reader.read()
            outcome.slowest = max(outcome.slowest, time.monotonic() - start)
            outcome.counts[found] += 1
            if found == "fault":
                again = ", repaired" if repaired else ""
                outcome.faults.append(f"{file.name} {kind} at {at:.4f} with {value}{again}: {words}")
            for other, data in whole.items():
                other.unlink(missing_ok=True)
                other.write_bytes(data)  # a new file: the old one may be mapped
    finally:
        reader.close()
    yield from outcomes


def main(arguments: list[str] | None = None) -> int:
    """Damage the methods named on the command line, or all; print a line for each."""
    from econgs_bench.methods.registry import Registry

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("methods", nargs="*")
    parser.add_argument("--mutations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    tally = Tally()
    for name in options.methods or Registry().built_in():
        folder, start = Path(tempfile.mkdtemp(prefix="fire-")), time.monotonic()
        for outcome, words in zip(
            fuzz(name, options.mutations, options.seed, folder), ("damaged", "repaired"), strict=True
        ):
            found = ", ".join(f"{count} {kind}" for kind, count in sorted(outcome.counts.items()))
            print(f"{name}, {words}: {found or 'none'}; slowest {outcome.slowest:.1f} s", flush=True)
            for fault in outcome.faults:
                tally.add(name, fault)
            for _ in range(sum(outcome.counts.values()) - len(outcome.faults)):
                tally.add(name)
        print(f"{name}: {time.monotonic() - start:.0f} s", flush=True)
        shutil.rmtree(folder)
    return tally.finish()


if __name__ == "__main__":
    sys.exit(main())
