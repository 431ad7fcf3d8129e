"""Lines for people about a file, each once however often it is read."""

from __future__ import annotations

import logging
from functools import cache

_log = logging.getLogger(__name__)


@cache
def notice(text: str) -> None:
    """Log a line once for all readings and variables of a file."""
    _log.warning("%s", text)
