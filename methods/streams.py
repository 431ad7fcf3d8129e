"""Models that are saved as self-contained streams of the integer coder: those of ECoNGS and HAC."""

from __future__ import annotations

from pathlib import Path

from datasets.errors import DataError
from econgs.context.stream import GroupAttributes, decode_group


def read_streams(folder: Path, suffix: str, method: str) -> list[tuple[str, GroupAttributes]]:
    """The file names and decoded groups of a folder that a method saved.

    Raises:
        DataError: no stream is there, or one cannot be read or decoded.
    """
    files = sorted(folder.glob(f"*{suffix}")) if folder.is_dir() else []
    if not files:
        raise DataError(folder, f"no saved {method} model in it", "Give the folder that Model.save wrote")
    groups = []
    for file in files:
        try:
            data = file.read_bytes()
        except OSError as error:
            raise DataError(
                file, f"cannot be read ({error})", "Check the file and its permissions"
            ) from error
        groups.append((str(file), decode_group(data, str(file))))
    return groups
