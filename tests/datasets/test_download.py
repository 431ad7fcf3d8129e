"""Downloads from a local server, with everything that goes wrong on the way."""

from __future__ import annotations

import errno
import hashlib
import shutil
import socket
from collections import namedtuple
from pathlib import Path

import pytest

from econgs_bench.datasets import download
from econgs_bench.datasets.download import Remote, fetch
from econgs_bench.datasets.errors import DataError
from tests.datasets.http_server import CONTENT, serving

SIZE = len(CONTENT)
DIGEST = hashlib.sha512(CONTENT).hexdigest()


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr(download, "PAUSES", (0.0, 0.0))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with serving() as running:
        yield running


class Place:
    def __init__(self, server, folder: Path) -> None:
        self.server, self.target = server, folder / "sub" / "f.raw"
        self.part = self.target.with_name("f.raw.part")
        self.progress: list[tuple[int, int | None]] = []

    def fetch(self, digest: str = DIGEST, size: int | None = SIZE, algorithm: str = "sha512") -> None:
        remote = Remote(f"{self.server.url}/f.raw", algorithm, digest, size)
        fetch(remote, self.target, lambda *state: self.progress.append(state))

    def leave(self, content: bytes) -> None:
        self.part.parent.mkdir(exist_ok=True)
        self.part.write_bytes(content)

    def whole(self) -> bool:
        names = [path.name for path in self.target.parent.iterdir()]
        return names == ["f.raw"] and self.target.read_bytes() == CONTENT

    @property
    def ranges(self) -> list[str | None]:
        return [asked for _, asked in self.server.requests]


@pytest.fixture
def place(server, tmp_path):
    return Place(server, tmp_path)


def test_a_file_arrives_with_its_progress(place):
    place.server.faults = [("redirect", f"{place.server.url}/moved")]
    place.fetch()
    assert place.whole()
    assert [path for path, _ in place.server.requests] == ["/f.raw", "/moved"]
    assert place.progress[0] == (0, SIZE)
    assert place.progress[-1] == (SIZE, SIZE)
    assert len(place.progress) > 3


def test_a_file_of_unknown_length_arrives(place):
    place.server.faults = [("chunked",)]
    place.fetch(size=None)
    assert place.whole()
    assert place.progress[-1] == (SIZE, None)


@pytest.mark.parametrize(("algorithm", "digits"), [("sha512", 128), ("sha256", 8)])
def test_first_digits_of_a_hash_suffice(place, algorithm, digits):
    place.fetch(hashlib.new(algorithm, CONTENT).hexdigest()[:digits], None, algorithm)
    assert place.whole()


def test_a_cut_transfer_continues_where_it_ended(place):
    place.server.faults = [("cut", 100_000), ("code", 503), ("cut", 50_000)]
    with pytest.raises(DataError, match=r"3 attempts failed, .*; 150000 bytes are kept\. Run the .* resume"):
        place.fetch()
    assert not place.target.exists()
    assert place.part.read_bytes() == CONTENT[:150_000]
    place.fetch()
    assert place.whole()
    assert place.ranges == [None, "bytes=100000-", "bytes=100000-", "bytes=150000-"]


def test_it_starts_again_where_the_server_ignores_ranges(place):
    place.server.ranges = False
    place.server.faults = [("cut", 100_000)]
    place.fetch()
    assert place.whole()
    assert place.ranges == [None, "bytes=100000-"]


@pytest.mark.parametrize(
    ("left", "requests"),
    [
        (CONTENT, 1),  # all had arrived, and was not checked yet: 416
        (CONTENT + b"more", 2),  # 416, then all of it
        (b"an earlier file" * 1000, 2),  # continued, hashed, and fetched again
    ],
)
def test_what_an_earlier_call_left_is_checked_too(place, left, requests):
    place.leave(left)
    place.fetch()
    assert place.whole()
    assert len(place.ranges) == requests


def test_a_wrong_hash_keeps_nothing(place):
    place.server.content = CONTENT[::-1]
    with pytest.raises(DataError, match=r"its SHA512 is .* not .*: it is another file"):
        place.fetch()
    assert not list(place.target.parent.iterdir())


def test_a_wrong_size_is_refused_before_the_transfer(place):
    with pytest.raises(DataError, match=f"the server has {SIZE} bytes, the file has 99"):
        place.fetch(size=99)
    place.server.faults = [("chunked",)]
    with pytest.raises(DataError, match="the server sends more than 99 bytes"):
        place.fetch(size=99)
    assert not place.target.exists()
    assert not place.part.exists()


def test_bytes_beyond_the_promised_ones_are_not_taken(place):
    place.server.faults = [("more", 1000)]
    place.fetch()
    assert place.whole()


def test_a_file_that_is_not_there_is_not_asked_for_twice(place):
    place.server.faults = [("code", 404)]
    with pytest.raises(DataError, match=r"the server answers 404 \(Not Found\)"):
        place.fetch()
    assert len(place.ranges) == 1


def test_no_connection_is_named_at_once(place, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/f"
        for address in (url, "http://no-such-host.invalid/f"):
            with pytest.raises(DataError, match=r"cannot be reached \(no connection\)"):
                fetch(Remote(address, "sha512", DIGEST), tmp_path / "f", lambda *_: None)


def test_no_space_is_known_before_the_transfer(place, monkeypatch):
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(SIZE - 1))
    with pytest.raises(DataError, match=f"the disk is full .{SIZE} bytes are missing, {SIZE - 1} are free"):
        place.fetch()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(SIZE - 1000))
    place.leave(CONTENT[:1000])
    place.fetch()
    assert place.whole()


def test_a_disk_that_fills_up_meanwhile_keeps_what_arrived(place):
    def full(present: int, total: int | None) -> None:
        if present > 100_000:
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(DataError, match="the disk is full"):
        fetch(Remote(f"{place.server.url}/f.raw", "sha512", DIGEST), place.target, full)
    assert not place.target.exists()
    place.fetch()
    assert place.whole()
    assert place.ranges[1] is not None


def test_ctrl_c_keeps_what_arrived(place):
    def stop(present: int, total: int | None) -> None:
        if present > 100_000:
            raise KeyboardInterrupt

    remote = Remote(f"{place.server.url}/f.raw", "sha512", DIGEST, SIZE)
    with pytest.raises(KeyboardInterrupt):
        fetch(remote, place.target, stop)
    size = place.part.stat().st_size
    assert place.part.read_bytes() == CONTENT[:size]
    assert size > 100_000
    place.fetch()
    assert place.whole()
    assert place.ranges == [None, f"bytes={size}-"]


def test_two_calls_do_not_write_one_file(place):
    def second() -> None:
        with pytest.raises(DataError, match="by another process"):
            place.fetch()
        seen.append(True)

    seen: list[bool] = []
    place.server.faults = [("call", second)]
    place.fetch()
    assert seen
    assert place.whole()


def test_a_folder_that_cannot_be_is_named(place, tmp_path):
    (tmp_path / "sub").write_text("a file")
    with pytest.raises(DataError, match="cannot be written"):
        place.fetch()


@pytest.mark.parametrize("fault", ["drip", "headers"])
def test_a_server_of_single_bytes_counts_as_cut(place, monkeypatch, fault):
    monkeypatch.setattr(download, "WINDOW", 0.4)
    place.server.faults = [(fault, 0.05)] * 3
    place.server.ranges = False
    with pytest.raises(DataError, match=r"bytes within|no whole answer"):
        place.fetch()
    assert not place.target.exists()


@pytest.mark.parametrize("chunked", [True, False])
def test_a_file_of_unknown_size_has_a_limit(place, monkeypatch, chunked):
    remote = Remote(f"{place.server.url}/f.raw", "sha512", DIGEST, None, SIZE - 1)
    place.server.faults = [("chunked",)] if chunked else []
    with pytest.raises(DataError, match=r"more than|at most"):
        fetch(remote, place.target, lambda *_: None)
    assert not place.part.exists()
    place.server.faults = [("chunked",)] if chunked else []
    fetch(Remote(f"{place.server.url}/f.raw", "sha512", DIGEST, None, SIZE), place.target, lambda *_: None)
    assert place.whole()
