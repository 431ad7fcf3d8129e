"""No two modules import each other in a circle, over any number of others."""

from graphlib import TopologicalSorter
from pathlib import Path

import grimp

PACKAGES = ("datasets", "econgs", "methods", "bench", "reports")


def test_modules_import_each_other_in_no_circle() -> None:
    """Every import statement counts: inside functions and under ``TYPE_CHECKING`` too.

    ``importlib.import_module`` is not seen. It loads what a user or a record names: methods, commands, jobs.
    """
    graph = grimp.build_graph("econgs_bench", cache_dir=None)
    root = Path(__file__).parents[1]
    files = [path for package in PACKAGES for path in (root / package).rglob("*.py")]
    # The package's own __init__.py is bench/package.py. A folder without one would not be read.
    assert len(graph.modules) == len(files)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(imports).prepare()  # CycleError names the modules of a circle
