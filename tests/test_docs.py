"""The pages of docs/ and beside it: links lead somewhere, blocks are current, the whole stays small."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import pytest

from econgs_bench.reports.schema import TABLES, frame
from tests.reports.sections.ladders.test_table import table as rungs

ROOT = Path(__file__).parents[1]
DERIVED = ("command-line.md", "options.md", "procedural.md", "python.md", "tables.md")
"""Pages in docs/reference that are written when the site is built."""
DOCS = [
    page
    for ending in ("md", "ipynb")
    for page in sorted(ROOT.glob(f"docs/**/*.{ending}"))
    if page.name not in DERIVED
]
PAGES = [*sorted(ROOT.glob("*.md")), *DOCS, *ROOT.glob("reports/*/README.md")]
WITH_BLOCKS = [page for page in PAGES if re.search(r"^<!-- end -->$", page.read_text(encoding="utf-8"), re.M)]


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def _prose(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)


def _anchors(text: str) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    # GitHub keeps letters and digits; "²" is neither.
    kept = ("".join(c for c in one.lower() if c.isalpha() or c.isdecimal() or c in "_- ") for one in headings)
    return {one.replace(" ", "-") for one in kept}


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page: Path, derived: ModuleType) -> None:
    links = re.findall(r"\]\(([^)\s]+)\)|<img src=\"([^\"]+)\"", _prose(page))
    for link in (one or other for one, other in links):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if target.parent == ROOT / "docs" / "reference" and target.name in DERIVED:
            assert not anchor or anchor in _anchors(derived.PAGES[target.name]()), link
            continue
        assert target.exists(), link
        assert not anchor or anchor in _anchors(_prose(target)), link


def test_the_site_has_every_page_and_its_derived_ones(derived: ModuleType) -> None:
    assert set(derived.PAGES) == set(DERIVED)
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    linked = {(ROOT / "docs" / link).resolve() for link in re.findall(r"^- \[.*?\]\((.*?)\)", index, re.M)}
    assert linked == {page for page in DOCS if page.name != "index.md" or page.parent.name == "methods"}


def test_every_picture_is_on_a_page() -> None:
    shown = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [path.name for path in (ROOT / "docs" / "images").iterdir() if path.name not in shown] == []


def test_the_documentation_stays_small() -> None:
    assert len(DOCS) <= 30
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in DOCS) <= 40_000


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=_name)
def test_generated_blocks_are_current(generate: ModuleType, page: Path) -> None:
    """The blocks of ``docs/generate.py`` follow from the records."""
    assert page in generate.pages()
    assert not sorted(generate.outdated(page)), "run python docs/generate.py"


def test_the_first_breaks_on_ladders(generate, monkeypatch) -> None:
    rows = [
        {"method": name, "place": place, "psnr": 30.0, "rungs": 2, "purpose": "more noise"}
        for name in ("3dgs", "hac")
        for place in range(2)
    ]
    rows[1] |= {"psnr": 20.0}
    rows += [
        {"method": "econgs", "ladder": "x", "place": place, "rungs": 2, "purpose": "y"} for place in (0, 1)
    ]
    result = {"method": "3dgs", "kind": "basic", "variant": "", "preset": "quick", "width": 8, "height": 8,
              "train_views": 4, "seed": 0, "fit_processor": "P", "status": "ok"}  # fmt: skip
    tables = {name: frame(name) for name in TABLES}
    tables |= {"rungs": rungs(*rows), "results": frame("results", [result])}
    monkeypatch.setattr(generate, "tables", lambda bundles: tables)
    generate._report.cache_clear()
    lines = generate.verdict({"bundles": ["b"], "section": "ladders"}).splitlines()
    generate._report.cache_clear()
    assert "- HAC breaks on none of 1 ladder." in lines
    row = "| **noise**: more noise | `r1` quality, \N{MINUS SIGN}10.0 dB | holds | \N{EN DASH} |"
    assert row in lines
    assert lines[-1] == "*preset quick; 8²; training views 4; one seed, 0; P.*"


USUAL = {"kind": "basic", "variant": "", "rate": None, "preset": "quick", "width": 8, "height": 8,
         "train_views": 4, "fit_processor": "P", "dataset": "d", "scene": "s", "seed": 0,
         "psnr": 30.0}  # fmt: skip


def _table(generate, monkeypatch, measured, **keys) -> list[str]:
    results = frame("results", [USUAL | row for row in measured])
    monkeypatch.setattr(generate, "tables", lambda bundles: {"results": results})
    block = {"bundles": ["b"], "rows": "method", "columns": ["psnr"]} | keys
    return generate.table(block).splitlines()


def test_rows_of_fewer_seeds_than_others_are_marked(generate, monkeypatch) -> None:
    rows = [
        {"method": name, "seed": seed, "psnr": 30.0 + seed}
        for name, seeds in (("3dgs", (0, 1, 2)), ("hac", (0,)), ("ivr-gs", (0, 1)))
        for seed in seeds
    ]
    lines = _table(generate, monkeypatch, rows)
    assert lines[2:5] == ["| 3DGS | 31.00 |", "| HAC¹ | 30.00 |", "| iVR-GS² | 30.50 |"]
    line = "*preset quick; 8²; training views 4; seeds 0, 1, 2; P; ¹ one seed, ² two seeds."
    assert lines[-1].startswith(line)
    assert "seeds differ: 3DGS: 0, 1, 2; HAC: 0; iVR-GS: 0, 1" in lines[-1]
    assert "¹" not in "".join(_table(generate, monkeypatch, [row for row in rows if row["seed"] == 0]))


def test_means_over_different_scenes_are_no_table(generate, monkeypatch) -> None:
    scenes = {"3dgs": "ab", "hac": "a"}
    rows = [{"method": name, "scene": scene} for name, own in scenes.items() for scene in own]
    with pytest.raises(SystemExit, match="hac has no b of d"):
        _table(generate, monkeypatch, rows)
    assert _table(generate, monkeypatch, rows, rows=["method", "scene"])


def test_a_table_names_stale_rows_and_why(generate, monkeypatch) -> None:
    rows = [{"method": "3dgs"}, {"method": "hac", "stale": True, "changes": "version 0 (today 5)"}]
    assert _table(generate, monkeypatch, rows)[-1].endswith("; P; stale: HAC v0.*")


def test_variants_beside_the_default(generate, monkeypatch) -> None:
    rows = [{"method": "econgs", "size_bytes": 2**20}]
    rows += [{"method": "econgs", "variant": "rent=1", "psnr": 29.75, "size_bytes": 2**19}]
    lines = _table(generate, monkeypatch, rows, rows="variant", columns=["psnr", "mib"], change="psnr")
    assert lines[0] == "| variant | PSNR [dB] | change [dB] | size [MiB] |"
    assert lines[2] == "| **default** | 30.00 |  | 1.00 |"
    assert lines[3] == "| `rent=1` | 29.75 | \N{MINUS SIGN}0.25 | 0.50 |"


def test_a_programs_table_has_its_caption(generate, monkeypatch, tmp_path) -> None:
    (tmp_path / "a.csv").write_text('# `program`: a machine.\nwhat,time [s]\n"a, b",1|2\n', encoding="utf-8")
    monkeypatch.setattr(generate, "MEASURED", tmp_path)
    text = "| what | time [s] |\n| --- | --- |\n| a, b | 1\\|2 |\n"
    assert generate.from_csv({"file": "a.csv"}) == f"{text}\n*`program`: a machine.*\n"
    assert generate._narrow(text) == "|what|time [s]|\n|---|---|\n|a, b|1\\|2|\n"
