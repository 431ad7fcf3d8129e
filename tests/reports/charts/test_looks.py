"""What colors, markers and legends stand for; charts of many variants and of several presets."""

import json
import re

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.distance import pdist
from skimage.color import rgb2lab

from econgs_bench.methods.registry import Registry
from econgs_bench.reports import markup, style
from econgs_bench.reports.charts import svg
from econgs_bench.reports.charts.labels import text_width
from econgs_bench.reports.charts.lines import Line, lines
from econgs_bench.reports.sections import order
from econgs_bench.reports.sections.anytime.table import anytime
from econgs_bench.reports.sections.losses.table import losses, steps
from econgs_bench.reports.sections.parts import chart as wholes
from econgs_bench.reports.sections.parts import families as parts
from econgs_bench.reports.sections.rates.conclusion import of_report
from econgs_bench.reports.sections.results import section as results_table
from econgs_bench.reports.sections.section import Page, legend
from econgs_bench.reports.style import (
    MOST_NAMED,
    OTHERS,
    OTHERS_NAME,
    Model,
    legend_entries,
    look,
    looks,
    named,
)
from tests.reports.sections.test_sections import (
    curve_table,
    sections,
    texts,
    tradeoff,
    tradeoff_data,
)

ECONGS, CLOUD, HAC = Model("econgs"), Model("3dgs", "start=cloud"), Model("hac")
MODELS = [ECONGS, *(Model("econgs", f"features={i}") for i in range(20)), CLOUD, HAC]


def many_variants(maker, **more):
    """ECoNGS in twelve variants of which three are on the front, and another method."""
    maker.run(method="econgs", psnr=33.0, size=3 << 20, views=0, **more)
    for i in range(11):
        psnr, size = (34.0 + i, (4 + i) << 20) if i < 2 else (30.0, (20 + i) << 20)
        maker.run(method="econgs", variant=f"features={i}", psnr=psnr, size=size, views=0, **more)
    maker.run(method="hac", psnr=20.0, size=90 << 20, views=0, **more)


def test_the_methods_of_this_project_have_looks_of_their_own():
    assert set(Registry().built_in()) == set(style.LOOKS) == set(style.TITLES)
    fixed = list(style.LOOKS.values())
    assert len({(each.color, each.dash) for each in fixed}) == len(fixed)
    assert len({(each.color, each.marker) for each in fixed}) == len(fixed)  # charts of points have no lines
    often = ["3dgs", "vq-3dgs", "3dgs-mcmc", "3dgs-coded", "scaffold-gs", "hac", "hac-plus", "ivr-gs",
             "plenoxels", "econgs"]  # fmt: skip
    assert {style.LOOKS[name].dash for name in often} == {"solid"}
    assert len({style.LOOKS[name].color for name in often}) == len(often) == len(style.PALETTE)


def test_the_color_blind_can_tell_the_colors_apart():
    """Distances in CIELAB as trichromats, and as simulated by Machado, Oliveira and Fernandes (2009)."""
    protan = [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ]
    deutan = [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ]
    display = np.array([[int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)] for color in style.PALETTE])
    linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    for vision in (np.eye(3), np.reshape(protan, (3, 3)), np.reshape(deutan, (3, 3))):
        seen = np.clip(linear @ vision.T, 0.0, 1.0)
        lab = rgb2lab(np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055))
        assert pdist(lab).min() > 15.0  # 2 or so are just noticeable


@pytest.mark.parametrize("method", style.LOOKS)
def test_a_method_looks_the_same_in_every_report(method):
    mine, others = Model(method), [Model(name) for name in style.LOOKS if name != method]
    variants = [Model(name, "x=1") for name in style.LOOKS]
    reports = ([mine], [*others, mine], [mine, *others[::-1]], [*variants, Model("foreign"), mine])
    assert {look(mine, report) for report in reports} == {style.LOOKS[method]}
    for report in reports:
        defaults = [look(each, report) for each in report if not each.options]
        assert len({each[::2] for each in defaults}) == len(defaults)
        assert len({look(each, report) for each in report}) == len(report)


def test_a_foreign_method_keeps_its_look_until_another_takes_it():
    names = [f"plugin {i}" for i in range(40)]
    alone = {name: look(Model(name), [Model(name)]) for name in names}
    builtin = {each[::2] for each in style.LOOKS.values()}
    assert not builtin & {each[::2] for each in alone.values()}
    for name in names:
        free = [Model(other) for other, each in style.LOOKS.items() if each.color != alone[name].color]
        assert look(Model(name), [*free, Model(name)]) == alone[name]
        taken = [Model(other) for other, each in style.LOOKS.items() if each.color == alone[name].color]
        assert look(Model(name), [Model(name), *taken]).color != alone[name].color
    apart = [Model(name) for name in names[:7]]
    report = [Model("3dgs"), Model("econgs"), Model("hac"), *apart]
    assert len({look(each, report).color for each in report}) == len(report) == 10


def test_a_method_has_one_color_and_its_variants_differ_in_marker_or_line():
    assert {look(each, MODELS).color for each in MODELS[:21]} == {style.LOOKS["econgs"].color}
    assert len({look(each, MODELS).color for each in (ECONGS, CLOUD, HAC)}) == 3
    assert len({look(each, MODELS) for each in MODELS}) == len(MODELS)
    assert len({look(each, MODELS[:8]).marker for each in MODELS[:8]}) == 8
    assert [look(each, MODELS[::-1]) for each in MODELS] == [look(each, MODELS) for each in MODELS]
    variant = MODELS[1]
    assert look(variant, [variant]) == look(variant, [HAC, CLOUD, variant, ECONGS])


def test_many_methods_stay_apart_where_the_colors_begin_again():
    methods = [Model(f"method {i}") for i in range(25)]
    styles = [look(each, methods) for each in methods]
    assert len({each[::2] for each in styles}) == 25
    assert len({each[:2] for each in styles}) == 25


def test_with_many_variants_only_the_defaults_are_told_apart():
    assert named(MODELS[:MOST_NAMED]) == set(MODELS[:MOST_NAMED])
    assert named(MODELS) == {ECONGS, CLOUD, HAC}
    styles = list(looks(MODELS, MODELS).values())
    assert styles.count(OTHERS) == 20
    assert OTHERS not in styles[20:]  # and drawn below
    assert list(legend_entries([MODELS], MODELS)) == ["ECoNGS-R", "3DGS [start=cloud]", "HAC", OTHERS_NAME]


def test_a_legend_shows_marker_and_dash(maker):
    names = [ECONGS, MODELS[1], Model("sz3")]
    entries = legend_entries([names], names)
    html = legend(entries)
    assert html.count("<svg") == 3
    assert html.count("stroke-dasharray") == sum(entry.dash != "solid" for entry in entries.values()) > 0
    assert len(set(re.findall(r'd="(M[^"]+z)"', html))) == 3
    many_variants(maker)
    assert tradeoff(maker).legend == {OTHERS_NAME: OTHERS}


def test_the_legend_of_lines_is_what_is_drawn():
    names = [Model("other"), Model("a"), Model("b"), Model("b", "x=1"), Model("c")]
    drawn = {
        "d": [
            Line(names[i], name, [1.0, 2.0], [30.0, 31.0 + i]) for i, name in ((1, "a"), (2, "b"), (4, "c"))
        ]
        * 3
    }
    chart = lines(drawn, "", "", names)
    assert set(chart.legend.values()) == {line.look for line in chart.panels[0].series}
    assert list(chart.legend) == ["a", "b", "c"]
    swatches = [svg.swatch(look(each, names)) for each in names]
    assert len(set(swatches)) == len(names)


@pytest.mark.parametrize(("count", "labels"), [(6, 6), (7, 0)])
def test_lines_are_named_at_their_ends_or_in_a_legend(count, labels):
    names = [Model(f"m{i}") for i in range(count)]
    curves = [Line(name, name.method, [1.0, 10.0], [30.0, 31.0 + i]) for i, name in enumerate(names)]
    chart = lines({"d": curves}, "", "", names)
    assert len(chart.panels[0].labels) == labels
    assert len(chart.legend) == (0 if labels else count)


def test_page_legends_name_only_what_is_drawn(maker):
    maker.run(method="3dgs")
    maker.run(method="hac")
    maker.run(method="econgs")
    tables = maker.tables()
    tables["curve"].loc[tables["curve"]["method"] == "hac", "psnr"] = None
    html = sections(tables)
    texts = re.findall(r"<text [^>]*>([^<]+)</text>", html["anytime"])
    assert {"3DGS", "ECoNGS-R"} <= set(texts)
    assert "HAC" not in texts


def test_the_page_names_the_lines_over_complexity(maker):
    for count in (1, 8, 64):
        maker.run(method="3dgs", dataset=f"blobs_{count}")
        maker.run(method="econgs", dataset=f"blobs_{count}")
    html = sections(maker.tables())["complexity"]
    names = re.findall(r"<text [^>]*>([^<]+)</text>", html)
    assert names.count("3DGS") == names.count("ECoNGS-R") == 3, "at the ends of the lines of each chart"


def test_the_front_is_named_among_many_variants_and_the_rest_is_gray(maker):
    many_variants(maker)
    (panel,) = tradeoff(maker).panels
    assert texts(panel) == {"ECoNGS-R", "HAC", "features=0", "features=1"}
    dots = [each for each in panel.series if each.title]
    assert [each.look.color == OTHERS.color for each in dots[:9]] == [True] * 9  # and drawn below
    assert sum(each.look.color == OTHERS.color for each in dots) == 9
    assert any("features=5" in each.title for each in dots)


def test_presets_and_splits_have_panels_of_their_own(maker):
    for preset, psnr in (("quick", 30.0), ("paper", 36.0)):
        maker.run(method="econgs", preset=preset, psnr=psnr, views=0)
        maker.run(method="3dgs", preset=preset, psnr=psnr - 2, size=9 << 20, views=0)
    maker.run(method="3dgs", split="val", psnr=20.0, views=0)
    panels = tradeoff_data(maker)
    titles = ["vortex · quick · test", "vortex · paper · test", "vortex · quick · val"]
    assert [panel.title for panel in panels] == titles
    assert [[y for _, y in panel.means] for panel in panels] == [[30.0, 28.0], [36.0, 34.0], [20.0]]
    assert {line.model for panel in panels for line in panel.lines} == {ECONGS, Model("3dgs")}


def test_rates_and_training_are_not_compared_across_presets(maker):
    for preset, gain in (("quick", 0.0), ("paper", 3.0)):
        for weight, psnr in ((1e-2, 33.0), (5e-3, 34.0), (1e-3, 35.0), (5e-4, 36.0)):
            variant = f"rate_weight={weight:g}"
            maker.run(method="hac", variant=variant, preset=preset, psnr=psnr + gain,
                      size=int(1 / weight) << 10, views=0)  # fmt: skip
    titles = ["vortex · quick", "vortex · paper"]
    assert of_report(maker.report()) == []
    assert [panel.title for panel in tradeoff_data(maker)] == titles
    rows = [("j", "s", "econgs", i, float(i), 30.0 + i, 9, '{"image": 0.1, "x": 0.1}') for i in (1, 2)]
    curve = pd.concat([curve_table(rows), curve_table(rows).assign(preset="paper", job="k")])
    assert list(anytime(curve, maker.tables()["results"])) == ["d · quick", "d · paper"]
    rows = steps({"curve": curve, "losses": curve[:0].assign(losses=[])})
    assert [panel.dataset for panel in losses(rows)] == ["d · quick", "d · paper"]


def test_every_row_of_the_page_has_a_key_of_its_own(maker):
    for preset in ("quick", "paper"):
        for seed in (0, 1):
            for scene in "ab":
                maker.run(scene=scene, preset=preset, seed=seed, views=0)
    maker.run(split="val", views=0)
    report = maker.report()
    page = Page(report, order.family(report), folder=maker.root)
    html = results_table.section(page).html
    details = json.loads(re.search(r'id="details">(.*?)</script>', html)[1])
    jobs = [row[0] for row in details["rows"] if isinstance(row[0], str)]
    keys = [*re.findall('data-key="([^"]*)"', html), *jobs]
    assert len(keys) == len(set(keys)) == 8 + 2 + 1 + 1
    lines = [line for panel in tradeoff_data(maker) for line in panel.lines]
    assert {key for line in lines for spot in (*line.means, *line.scenes) for key in spot.keys} <= set(keys)
    assert len(lines[0].scenes[0].keys) == 2  # seeds of one scene


# --------------------------------------------------------------------------- parts


def ledger(**methods):
    rows = [(method, part, count) for method, held in methods.items() for part, count in held.items()]
    return pd.DataFrame(rows, columns=["method", "part", "bytes"]).assign(
        job=[method for method, _, _ in rows], dataset="d", scene="s", variant="", rate=None,
        preset="quick", seed=0,
    )  # fmt: skip


def bars(table):
    return wholes.ledger_chart(*wholes.ledger(table))


def test_a_part_has_its_color_whatever_else_is_in_the_chart():
    first = bars(ledger(a={"positions": 50, "sh2": 50}))
    second = bars(ledger(a={"decoders": 70, "features": 20, "positions": 10}))
    colors = [{name: look.color for name, look in chart.legend.items()} for chart in (first, second)]
    assert colors[0]["positions"] == colors[1]["positions"]
    assert len({shade for each in colors for shade in each.values()}) == 4
    assert [bar.color for bar in first.panels[0].bars] == list(colors[0].values())


def test_all_families_look_different():
    others = dict.fromkeys(("opacity", "features", "codebooks", "new"), 9)
    table = ledger(a=dict.fromkeys(parts._FAMILIES, 100), b=others)
    shades = [look.color for look in bars(table).legend.values()]
    assert len(set(shades)) == len(shades) > 9


def test_parts_of_a_family_are_one_and_small_ones_are_the_rest():
    table = ledger(a={"sh_dc": 300, "sh_rest": 600, "positions": 95, "header": 5, "codebooks": 4})
    (bar,), families = wholes.ledger(table)
    assert families == ["positions", "color", "other"]
    assert bar.amounts == {"positions": 95, "color": 900, "other": 9}
    _, color, other = bars(table).panels[0].bars
    assert [line.partition(":")[0] for line in color.about.splitlines()[1:]] == ["color", "sh_dc", "sh_rest"]
    assert "codebooks: " in other.about


def test_titles_of_panels_are_broken_before_they_are_cut(maker):
    name = "a dataset of a name that is much longer than its panel is wide"
    maker.run(name, method="3dgs", views=0)
    maker.run(name, method="hac", psnr=30.0, views=0)
    chart = tradeoff(maker)
    (panel,) = chart.panels
    lines = re.findall(r'stroke-width="0.4">([^<]+)<', svg.file(chart))
    assert " ".join(lines) == panel.title == name
    assert len(lines) > 1
    assert max(map(text_width, lines)) < panel.width


def test_the_page_lifts_the_colors_that_would_drown_on_dark():
    rules = svg.theme()
    for light, dark in style.DARK.items():
        assert rules.count(f"light-dark({light},{dark})") == 4 / 2 + 1


def test_dots_of_methods_in_tables_have_their_markers():
    """Methods that share a color differ in the shape of their dots, on dark as well."""
    rules = svg.theme()
    dots = {method: markup.dot(entry) for method, entry in style.LOOKS.items()}
    assert len(set(dots.values())) == len(dots)
    shapes = {marker: re.findall(rf"\.dot\.{marker} {{.*polygon\((.*?)\)", rules) for marker in style.MARKERS}
    assert shapes.pop("circle") == []  # the usual one
    assert len({shape for (shape,) in shapes.values()}) == len(shapes)
    assert shapes["square"] == ["0% 0%,100% 0%,100% 100%,0% 100%"]
    row = {"method": "plenoxels", "variant": "", "rate": None}
    black = style.LOOKS["plenoxels"]
    assert markup.method(row, [Model("plenoxels")]).startswith(markup.dot(black))
    place = style.PALETTE.index(black.color)
    assert f".dot.c{place} {{ background: light-dark({black.color},{style.DARK[black.color]})" in rules
    assert f" c{place}" in markup.dot(black)
