"""econgs-bench: compressed scene representations of volume visualisation, measured (:mod:`.bench.api`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from econgs_bench.bench.api import (
        DataError,
        Dataset,
        DatasetInfo,
        Drawing,
        Edit,
        Runs,
        SavedModel,
        ViewSet,
        list_datasets,
        open_dataset,
        render_views,
        run,
        score_views,
    )

__all__ = [
    "DataError", "Dataset", "DatasetInfo", "Drawing", "Edit", "Runs", "SavedModel", "ViewSet",
    "list_datasets", "open_dataset", "render_views", "run", "score_views",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import the interface when it is first used: the command line starts without it."""
    if name in __all__:
        from econgs_bench.bench import api

        return getattr(api, name)
    raise AttributeError(f"module 'econgs_bench' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
