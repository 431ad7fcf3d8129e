"""Locks of a machine that several people share."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import textwrap

import pytest
from filelock import FileLock, Timeout

from econgs_bench.bench.machine.locks import check_locks, holder, lock_file, locked
from econgs_bench.datasets.errors import DataError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="users and permissions of POSIX")
OTHER = 65534
"""Number of another user, as whom only root can start a process; else the same user stands for it."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    place = tmp_path / "locks"
    place.mkdir()
    place.chmod(0o1777)
    for parent in (tmp_path, *tmp_path.parents):
        if parent.stat().st_uid == os.getuid() and parent != parent.parent:
            parent.chmod(parent.stat().st_mode | 0o711)
    monkeypatch.setenv("BENCH_LOCKS", str(place))
    return place


def as_other(code: str, folder) -> subprocess.Popen[str]:
    """A process of another user."""
    environment = {**os.environ, "BENCH_LOCKS": str(folder)}
    become = (  # after all imports: the interpreter may lie where others may not look
        "import os, econgs_bench.bench.machine.cores, econgs_bench.bench.machine.locks\n"
        f"if os.getuid() == 0: os.setgroups([]); os.setgid({OTHER}); os.setuid({OTHER})\n"
    )
    return subprocess.Popen(
        [sys.executable, "-P", "-B", "-c", become + textwrap.dedent(code)], env=environment, cwd="/",
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.PIPE, encoding="utf-8",
    )  # fmt: skip


def told(process) -> str:
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    return out.strip()


TAKE_ALL = """
from contextlib import ExitStack
from econgs_bench.bench.machine.cores import claim_cores
from econgs_bench.bench.machine.locks import check_locks, locked
check_locks()
with locked("timing"):
    pass
with locked("timing", shared=True), ExitStack() as stack:
    print(len(claim_cores(1, stack)))
"""


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_the_second_user_takes_locks_as_the_first_does(folder, umask) -> None:
    before = os.umask(umask)
    try:
        check_locks()
        with locked("timing"), locked("cores"), locked("core-0"):
            pass
    finally:
        os.umask(before)
    assert {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == {0o666}
    assert told(as_other(TAKE_ALL, folder)) == "1"


def test_locks_need_no_right_to_write(folder) -> None:
    for name in ("probe", "timing", "cores", *(f"core-{core}" for core in range(os.cpu_count() or 1))):
        lock_file(name).touch()
        lock_file(name).chmod(0o444)
    folder.chmod(0o555)
    assert told(as_other(TAKE_ALL, folder)) == "1"


def test_a_lock_that_its_owner_has_closed_names_him(folder) -> None:
    lock_file("timing").touch()
    lock_file("timing").chmod(0o000)
    code = """
    from econgs_bench.bench.machine.locks import check_locks
    from econgs_bench.datasets.errors import DataError
    try:
        check_locks()
    except DataError as error:
        print(error)
    """
    import pwd

    text = told(as_other(code, folder))
    assert "econgs-bench-timing.lock" in text
    assert pwd.getpwuid(os.getuid()).pw_name in text
    assert "Permission denied" in text


def test_who_holds_a_lock_is_named(folder) -> None:
    other = as_other(
        """
        import sys
        from econgs_bench.bench.machine.locks import locked
        with locked("timing"):
            print("held", flush=True)
            sys.stdin.read()
        """,
        folder,
    )
    assert other.stdout.readline() == "held\n"
    assert f"process {other.pid} of " in holder("timing")
    with pytest.raises(BlockingIOError), locked("timing", wait=False):
        pass
    with pytest.raises(BlockingIOError), locked("timing", shared=True, wait=False):
        pass
    told(other)
    assert holder("timing") == ""


def test_shared_holders_exclude_one_that_wants_it_alone(folder) -> None:
    with locked("timing", shared=True), locked("timing", shared=True, wait=False):
        with pytest.raises(BlockingIOError), locked("timing", wait=False):
            pass
        with pytest.raises(Timeout):  # what earlier versions take it by
            FileLock(lock_file("timing")).acquire(timeout=0)


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_what_another_user_has_put_in_place_of_a_lock_is_not_opened(folder, tmp_path, kind) -> None:
    path, target = lock_file("timing"), tmp_path / "letter"
    target.write_text("dear")
    target.chmod(0o600)
    if kind == "link":
        path.symlink_to(target)
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
    with pytest.raises(DataError, match="belongs to"):
        check_locks()
    assert stat.S_IMODE(target.stat().st_mode) == 0o600
    assert target.read_text() == "dear"


def test_a_folder_of_locks_is_made_for_all(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("BENCH_LOCKS", str(tmp_path / "new"))
    check_locks()
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o1777
