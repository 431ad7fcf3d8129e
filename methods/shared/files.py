"""The folder of a saved model: its files, and those of them that are streams of the integer coder."""

from __future__ import annotations

from pathlib import Path

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.codec.group import GroupAttributes
from econgs_bench.econgs.codec.stream import decode_group


class NotSaved(DataError):
    """A folder holds no files of a method's models."""


def saved_files(folder: Path, suffix: str, method: str) -> list[Path]:
    """The files of one suffix, in order.

    Raises:
        NotSaved: there is none.
    """
    files = sorted(folder.glob(f"*{suffix}")) if folder.is_dir() else []
    if not files:
        raise NotSaved(folder, f"no saved {method} model in it", "Give the folder that Model.save wrote")
    return files


def plain_name(text: object) -> str:
    """The name of a file beside the one that names it.

    Raises:
        ValueError: it is none, but a path.
    """
    if not isinstance(text, str) or text in ("", ".", "..") or not {*"/\\\0"}.isdisjoint(text):
        raise ValueError(f"{text!r} is no name of a file")
    return text


def read_streams(folder: Path, suffix: str, method: str) -> list[tuple[str, GroupAttributes]]:
    """The file names and decoded groups of a folder that a method saved.

    Raises:
        DataError: no stream is there, or one cannot be read or decoded.
    """
    groups = []
    for file in saved_files(folder, suffix, method):
        try:
            data = file.read_bytes()
        except OSError as error:
            raise DataError(
                file, f"cannot be read ({error})", "Check the file and its permissions"
            ) from error
        groups.append((str(file), decode_group(data, str(file))))
    return groups
