"""The compiled module; econgs.splat.native is its typed face."""

from typing import Any

def __getattr__(name: str) -> Any: ...
