"""Files of models with a checksum: tables of numbers in safetensors, and facts in JSON.

Readers of these formats know nothing of the checksum and read the files all the same. Files without one, of
earlier versions, are read too.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save as to_safetensors
from torch import Tensor

from econgs_bench.datasets.bounded import json_of

_SUM = "crc32"
_FACTS = "model"


def write_tensors(file: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> dict[str, int]:
    """Write tensors of the CPU, and facts about them, as safetensors.

    Returns:
        Bytes of each tensor, and "metadata", which sum to the size of the file.
    """
    # In one text, with the sum before all else: safetensors writes several in any order.
    text = json.dumps({_SUM: _sum(tensors, facts), **facts})
    data = to_safetensors(dict(tensors), metadata={_FACTS: text})
    sizes = {name: tensor.numel() * tensor.element_size() for name, tensor in tensors.items()}
    total = file.write_bytes(data)
    return sizes | {"metadata": total - sum(sizes.values())}


def read_tensors(file: Path, kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Facts and tensors.

    Args:
        file: the file.
        kind: name and version of its format, which its facts have as "format".

    Raises:
        OSError, SafetensorError, ValueError, KeyError, TypeError: it is no such file, or it is damaged.
    """
    with safe_open(file, framework="pt") as opened:
        facts = _facts(json_of((opened.metadata() or {})[_FACTS]), kind)
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    _check(facts, tensors)
    return facts, tensors


def write_facts(file: Path, facts: Mapping[str, Any]) -> int:
    """Write facts as JSON; returns the bytes."""
    return file.write_bytes(json.dumps({_SUM: _sum({}, facts), **facts}, separators=(",", ":")).encode())


def read_facts(file: Path, kind: str) -> dict[str, Any]:
    """Facts; arguments and exceptions as those of :func:`read_tensors`."""
    facts = _facts(json_of(file.read_bytes()), kind)
    _check(facts, {})
    return facts


def _facts(content: Any, kind: str) -> dict[str, Any]:
    if not isinstance(content, dict) or content["format"] != kind:
        form = content["format"] if isinstance(content, dict) else None
        raise ValueError(f"format {form!r} instead of {kind!r}")
    return content


def _check(facts: dict[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """Compare the checksum of facts, which lose it, and tensors."""
    stored = facts.pop(_SUM, None)
    if stored not in (None, _sum(tensors, facts)):
        raise ValueError("its checksum differs: the file is damaged")


def _sum(tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> str:
    total = zlib.crc32(json.dumps(facts, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        total = zlib.crc32(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode(), total)
        total = zlib.crc32(tensor.numpy().tobytes(), total)
    return f"{total:08x}"
