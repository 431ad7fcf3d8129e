"""Configuration of Sphinx: the site of ``docs/`` with the pages that follow from the code.

pip install '.[docs]'
sphinx-build -W docs build/docs/site
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from derived import PAGES  # noqa: E402

project = "econgs-bench"
copyright = "the econgs-bench authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["images"]
html_theme = "furo"
html_title = "econgs-bench"
html_copy_source = False
html_show_sphinx = False
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # a test runs the cells; their outputs are in the file
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_mock_imports = ["torch"]
suppress_warnings = ["misc.highlighting_failure"]

_LINK = re.compile(r"\[([^\]]*)\]\(((?:\.\./)+(?!guide|concepts|reference|results|images)[^)#]+)(#[^)]*)?\)")


def write_reference(app: Sphinx) -> None:
    """Write the pages that follow from the code; git ignores them."""
    for name, page in PAGES.items():
        path, text = HERE / "reference" / name, page()
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def rewrite(app: Sphinx, page: str, source: list[str]) -> None:
    """Name files outside of docs/ instead of linking to them; the index gets its tables of contents."""
    if page.endswith("python") and source[0].lstrip().startswith("{"):
        return
    text = source[0]
    depth = page.count("/")

    def named(link: re.Match[str]) -> str:
        path = link[2]
        if path.count("../") <= depth:
            return link[0]
        return f"{link[1]} (`{path.replace('../', '')}`)"

    text = _LINK.sub(named, text)
    if page == "index":
        generated = "".join(f"- [x](reference/{name})\n" for name in PAGES)
        text = text.replace("\nThe built site adds", f"{generated}\nThe built site adds", 1)
        text += _contents(text)
        text = text.replace(generated, "", 1)
    source[0] = text


def _contents(text: str) -> str:
    """A hidden table of contents for each section of the index, of its links in their order."""
    parts = []
    for section in text.split("\n## ")[1:]:
        pages = re.findall(r"^- \[.*?\]\((.*?)\)", section, re.MULTILINE)
        names = "\n".join(re.sub(r"\.(md|ipynb)$", "", name) for name in pages)
        title = section.partition("\n")[0]
        parts.append(f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n{names}\n```\n")
    return "".join(parts)


def formula(self: Any, node: nodes.Element) -> None:
    """A formula as MathML, which browsers draw without a script."""
    block = isinstance(node, nodes.math_block)
    mathml = convert(node.astext(), display="block" if block else "inline")
    self.body.append(f'<div class="math">{mathml}</div>' if block else mathml)
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Connect the builder with the functions above."""
    app.connect("builder-inited", write_reference)
    app.connect("source-read", rewrite)
    app.add_node(nodes.math, override=True, html=(formula, None))
    app.add_node(nodes.math_block, override=True, html=(formula, None))
