"""The catalogue: datasets by name, and any volume file or folder of views by path.

Each entry is a TOML file in this package. A search for the real files goes through the folders of
``BENCH_DATA`` (separated as in ``PATH``), then ``econgs-bench`` in the user's data folder.
"""

from __future__ import annotations

from econgs_bench.datasets.catalogue.entries import DatasetInfo, data_folders, list_datasets
from econgs_bench.datasets.catalogue.opening import open_dataset

__all__ = ["DatasetInfo", "data_folders", "list_datasets", "open_dataset"]
