"""Makes ``tools`` of the checkout importable, and none of the folders beside it."""

import importlib.util
import sys
from pathlib import Path

spec = importlib.util.spec_from_file_location("tools", Path(__file__).parents[2] / "tools" / "__init__.py")
assert spec is not None
sys.modules["tools"] = importlib.util.module_from_spec(spec)
