"""The pages of docs/ and beside it: every link leads to a file, and to a heading where it names one."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from reports.schema import frame
from tests.reports.tables.test_ladders import table as rungs

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("reports/*/README.md")])


def _prose(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)


def _anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", _prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)|<img src=\"([^\"]+)\"", _prose(page))
    for link in (one or other for one, other in links):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in _anchors(target), link


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    """The script ``docs/generate.py``."""
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_generated_blocks_are_current(generate: ModuleType) -> None:
    """The blocks of ``docs/generate.py`` follow from bundles and parser."""
    assert not sorted(generate.outdated()), "run python docs/generate.py"


@pytest.mark.parametrize(
    ("show", "line"),
    [
        ("breaks", "| **noise**: more noise | `r1` quality, \N{MINUS SIGN}10.0 dB | holds | \N{EN DASH} |"),
        ("verdicts", "- HAC breaks on none of 1 ladder."),
        ("flicker", "| 3DGS | 2.50 |"),
        (
            'method"\nmethod = "3dgs',
            "| **noise**: more noise | 0 of 1 | `r1` on `vortices/cores` "
            "| quality, \N{MINUS SIGN}10.0 dB | 20.00 |",
        ),
    ],
)
def test_a_block_of_ladders(generate, monkeypatch, show, line) -> None:
    rows = [
        {"method": name, "place": place, "psnr": 30.0, "rungs": 2, "purpose": "more noise"}
        for name in ("3dgs", "hac")
        for place in range(2)
    ]
    rows[1] |= {"psnr": 20.0, "flicker": 2.5}
    rows += [
        {"method": "econgs", "ladder": "x", "place": place, "rungs": 2, "purpose": "y"} for place in (0, 1)
    ]
    result = {"method": "3dgs", "kind": "basic", "variant": "", "preset": "quick", "width": 8, "height": 8,
              "train_views": 4, "seed": 0, "fit_processor": "P"}  # fmt: skip
    tables = {"rungs": rungs(*rows), "results": frame("results", [result])}
    monkeypatch.setattr(generate, "tables", lambda bundles: tables)
    lines = generate.ladders_of(f'bundles = ["b"]\nshow = "{show}"\n').splitlines()
    assert line in lines
    assert lines[-1] == "*preset quick; 8²; training views 4; seed 0; P.*"
