"""The pages of docs/ and beside it: every link leads to a file, and to a heading where it names one."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import ModuleType

import pytest

from econgs_bench.bench.tune.study import Conditions, Point, Study, Trial
from econgs_bench.methods.econgs.spec import SPEC
from econgs_bench.methods.options import declared, resolve
from econgs_bench.reports.schema import TABLES, frame
from tests.reports.sections.ladders.test_table import table as rungs

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("reports/*/README.md")])


def _prose(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)


def _anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", _prose(page), re.M)
    # GitHub keeps letters and digits; "²" is neither.
    kept = ("".join(c for c in one.lower() if c.isalpha() or c.isdecimal() or c in "_- ") for one in headings)
    return {one.replace(" ", "-") for one in kept}


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
    assert lines[-1] == "*preset quick; 8²; training views 4; one seed, 0; P.*"


def test_rows_of_fewer_seeds_than_others_are_marked(generate, monkeypatch) -> None:
    usual = {"kind": "basic", "variant": "", "rate": None, "preset": "quick", "width": 8, "height": 8,
             "train_views": 4, "fit_processor": "P", "dataset": "d", "scene": "s"}  # fmt: skip
    rows = [
        usual | {"method": name, "seed": seed, "psnr": 30.0 + seed}
        for name, seeds in (("3dgs", (0, 1, 2)), ("hac", (0,)), ("ivr-gs", (0, 1)))
        for seed in seeds
    ]
    monkeypatch.setattr(generate, "tables", lambda bundles: {"results": frame("results", rows)})
    block = 'bundles = ["b"]\nrows = "method"\ncolumns = ["psnr"]\n'
    lines = generate.table(block).splitlines()
    assert lines[2:5] == ["| 3DGS | 31.00 |", "| HAC¹ | 30.00 |", "| iVR-GS² | 30.50 |"]
    line = "*preset quick; 8²; training views 4; seeds 0, 1, 2; P; ¹ one seed, ² two seeds."
    assert lines[-1].startswith(line)
    assert "seeds differ: 3DGS: 0, 1, 2; HAC: 0; iVR-GS: 0, 1" in lines[-1]
    rows[:] = [row for row in rows if row["seed"] == 0]
    assert "¹" not in generate.table(block)


def test_means_over_different_scenes_are_no_table(generate, monkeypatch) -> None:
    usual = {"kind": "basic", "variant": "", "rate": None, "preset": "quick", "width": 8, "height": 8,
             "train_views": 4, "fit_processor": "P", "dataset": "d", "seed": 0, "psnr": 30.0}  # fmt: skip
    scenes = {"3dgs": "ab", "hac": "a"}
    rows = [usual | {"method": name, "scene": scene} for name, own in scenes.items() for scene in own]
    monkeypatch.setattr(generate, "tables", lambda bundles: {"results": frame("results", rows)})
    with pytest.raises(SystemExit, match="hac has no b of d"):
        generate.table('bundles = ["b"]\nrows = "method"\ncolumns = ["psnr"]\n')
    assert generate.table('bundles = ["b"]\nrows = ["method", "scene"]\ncolumns = ["psnr"]\n')


def test_a_table_names_what_is_stale_and_why(generate, monkeypatch) -> None:
    usual = {"kind": "basic", "variant": "", "rate": None, "preset": "quick", "width": 8, "height": 8,
             "train_views": 4, "fit_processor": "P", "dataset": "d", "scene": "s", "seed": 0,
             "psnr": 30.0}  # fmt: skip
    rows = [
        usual | {"method": "3dgs"},
        usual | {"method": "hac", "stale": True, "changes": "version 0 (today 5)"},
    ]
    monkeypatch.setattr(generate, "tables", lambda bundles: {"results": frame("results", rows)})
    line = generate.table('bundles = ["b"]\nrows = "method"\ncolumns = ["psnr"]\n').splitlines()[-1]
    assert line.endswith("; P; stale: HAC version 0 (today 5).*")


def test_tuned_settings_are_named_where_they_lose_nothing(generate, monkeypatch, tmp_path) -> None:
    def trial(number, psnr, mib, **values):
        point = Point(dataset="d", scene="s", seed=0, rate=None, psnr=psnr, bytes=round(mib * 2**20))
        score = (psnr - 20) * math.log2(64 / mib)
        return Trial(number=number, overrides=values, values={}, status="ok", score=score, points=(point,))

    def study(method, *trials):
        conditions = Conditions(
            suite="tuning", preset="quick", scenes=(("d", "s", "h"),), protocol={}, seeds=(0,),
            objective="point=20,64", device="cpu",
        )  # fmt: skip
        written = Study(
            method=method,
            version="1",
            conditions=conditions,
            fixed={},
            space={},
            starts=2,
            budget=len(trials),
        )
        for one in trials:
            written = written.with_trial(one)
        (tmp_path / f"{method}.json").write_text(written.model_dump_json())

    study("3dgs", trial(0, 28, 4), trial(1, 30, 4), trial(2, 29.95, 2, rent=0.01), trial(3, 29, 0.01))
    study("hac", trial(0, 28, 1), trial(1, 30, 0.5), trial(2, 29, 0.5), trial(3, 40, 0.1))
    study("econgs", trial(0, 30, 1), trial(1, 35, 0.1), trial(2, 34, 0.1))  # the shortest: three count
    monkeypatch.setattr(generate, "STUDIES", tmp_path)
    text = generate.tuned_of("scenes = 1")
    assert text.startswith(
        "**Of 3 methods, after 3 trials each, 1 score better than with their defaults (3DGS); "
        "1 found a smaller model at most 0.1 dB below it, 0.3 on a scene (3DGS).**"
    )
    cells = {line.split(" | ")[0].strip("| "): line for line in text.splitlines() if line.startswith("| ")}
    assert cells["3DGS"].endswith("| 29.95 / 2 / 49.8 | 29.95 / 2 / 49.8 | `rent=0.01` |")
    assert cells["HAC"].endswith("| 30.00 / 0.5 / 70.0 | as default | \N{EN DASH} |  |")
    assert "`d` s; preset quick, validation views, seed 0" in text


BLOCK = 'method = "econgs"\npreset = "quick"\nsuite = "departures"\nbundles = ["b"]\n'


def _departures(generate, monkeypatch, *rows) -> list[str]:
    usual = {"method": "econgs", "kind": "basic", "variant": "", "preset": "quick", "width": 8, "height": 8,
             "train_views": 4, "seed": 0, "fit_processor": "P",
             "psnr": 30.0, "size_bytes": 2**20, "cpu_seconds": 100.0}  # fmt: skip
    results = frame("results", [usual | row for row in rows])
    monkeypatch.setattr(generate, "tables", lambda bundles: {"results": results})
    return generate.departures(BLOCK).splitlines()


def test_departures_join_options_with_what_was_measured(generate, monkeypatch) -> None:
    others = (
        {"method": "hac", "psnr": 1.0},
        {"kind": "edited", "psnr": 1.0},
        {"variant": "rent=1", "psnr": 1.0},
    )
    lines = _departures(
        generate,
        monkeypatch,
        {},
        {"variant": "start_spacing=0", "psnr": 31.0, "size_bytes": 3 * 2**20, "cpu_seconds": 150.0},
        {"variant": "growth_adapts=false,growth_gradient=0.0002", "psnr": 29.75},
        {"variant": "configuration=paper", "size_bytes": 2**19},
        *others,
    )
    cells = {
        line.split(" | ")[0].strip("| "): line.strip("| ").split(" | ") for line in lines[2:] if "|" in line
    }
    assert lines[2] == "| **default** |  |  |  | 30.00 | 1.00 MiB | 100 s |"
    doc = declared(SPEC.options)["start_spacing"].doc
    assert cells["`start_spacing`"] == [
        "`start_spacing`",
        "3",
        "0",
        doc,
        "+1.00",
        "\N{MULTIPLICATION SIGN}3.00",
        "\N{MULTIPLICATION SIGN}1.50",
    ]
    assert cells["`growth_gradient`"][1:3] == ["0.0003", "0.0002"]
    assert cells["`growth_gradient`"][4:] == ["\N{MINUS SIGN}0.25", *["\N{MULTIPLICATION SIGN}1.00"] * 2]
    assert cells["`growth_adapts`"][4] == "with `growth_gradient`"
    assert cells["`features`"][4:] == ["\N{EN DASH}"] * 3
    assert cells["`configuration=paper`"][4:] == [
        "0",
        "\N{MULTIPLICATION SIGN}0.50",
        "\N{MULTIPLICATION SIGN}1.00",
    ]
    ours, theirs = (resolve(SPEC, "quick", {"configuration": name}).values for name in ("fair", "paper"))
    names = [f"`{name}`" for name in ours if ours[name] != theirs[name]]
    assert list(cells) == ["**default**", "`iterations`", *names, "`configuration=paper`"]
    assert lines[-1] == "*preset quick; 8²; training views 4; one seed, 0; P.*"


def test_departures_say_what_is_stale_or_was_not_measured_at_all(generate, monkeypatch) -> None:
    lines = _departures(generate, monkeypatch, {"stale": True, "changes": "rent 0.02 (today 0.01)"})
    assert lines[-1].endswith("stale: ECoNGS-R rent 0.02 (today 0.01).*")
    none = generate.departures(BLOCK.replace('"b"', "")).splitlines()
    assert none[-1] == "*Not measured yet.*"
    assert none[2] == "| **default** |  |  |  | \N{EN DASH} | \N{EN DASH} | \N{EN DASH} |"


@pytest.mark.parametrize(
    ("asks", "line"),
    [
        (
            'show = "bytes"\nlevel = 35',
            "| `vortex/tf0` | 10.0 | \N{EN DASH} | 2.5 (0.25 \N{MULTIPLICATION SIGN}) |",
        ),
        ('show = "primitives"\nlevel = 30', "| `vortex/tf0` | 10.0 | \N{LESS-THAN OR EQUAL TO} 9 | 8 |"),
        ('show = "gains"', "| `vortex/tf0` | 10.0 | \N{EN DASH} | 2.7 |"),
        ('show = "prunable"\nlevel = 0.1', "| `vortex/tf0` | 10.0 | \N{EN DASH} | 12.5 |"),
    ],
)
def test_a_block_of_economy(generate, monkeypatch, asks, line) -> None:
    usual = {"dataset": "vortex", "scene": "tf0", "kind": "basic", "preset": "quick", "split": "test",
             "seed": 0, "status": "ok", "width": 8, "height": 8, "train_views": 4, "fit_processor": "P",
             "variant": "", "base": "", "stale": False}  # fmt: skip
    results = [
        usual | {"job": "a", "method": "3dgs", "psnr": 31.0, "size_bytes": 4096, "primitives": 9},
        usual | {"job": "b", "method": "hac", "psnr": 40.0, "size_bytes": 5120, "primitives": 8,
                 "gaussians": 16, "prunable_010": 0.125},
        usual | {"job": "c", "method": "hac", "variant": "rate_weight=1", "knob_value": 1.0, "psnr": 30.0,
                 "size_bytes": 1280, "primitives": 8},
    ]  # fmt: skip
    tables = {name: frame(name) for name in TABLES} | {
        "results": frame("results", results),
        "complexity": frame("complexity", [{"dataset": "vortex", "scene": "tf0", "lossless_bytes": 10240}]),
    }
    monkeypatch.setattr(generate, "tables", lambda bundles: tables)
    lines = generate.economy_of(f'bundles = ["b"]\n{asks}\n').splitlines()
    assert line in lines
    assert lines[-1] == "*preset quick; 8²; training views 4; one seed, 0; P.*"
