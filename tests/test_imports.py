"""No two modules import each other in a circle, over any number of others."""

import json
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGES = ("datasets", "econgs", "methods", "bench", "reports")
IMPORTS = """
import grimp, json
graph = grimp.build_graph("econgs_bench", cache_dir=None)
imports = {module: sorted(graph.find_modules_directly_imported_by(module)) for module in graph.modules}
print(json.dumps(imports))
"""


def test_modules_import_each_other_in_no_circle() -> None:
    """Every import statement counts: inside functions and under ``TYPE_CHECKING`` too.

    ``importlib.import_module`` is not seen. It loads what a user or a record names: methods, commands, jobs.
    """
    # In a process of its own, as pytest's import hook hides the folders of an editable installation.
    imports = json.loads(subprocess.check_output([sys.executable, "-c", IMPORTS], encoding="utf-8"))
    # Such an installation has the rest of the checkout below the package, too.
    modules = {name for name in imports if "." in name and name.split(".")[1] in PACKAGES}
    modules.discard("econgs_bench.bench.package")  # which is installed as the package's own __init__.py
    root = Path(__file__).parents[1]
    files = {path for package in PACKAGES for path in (root / package).rglob("*.py")}
    files.remove(root / "bench" / "package.py")
    assert len(modules) == len(files)  # a folder without __init__.py would not be read
    # CycleError names the modules of a circle.
    TopologicalSorter({module: imports[module] for module in modules | {"econgs_bench"}}).prepare()
