"""Histograms of what primitives carry, and the map of anchors by their features."""

import sys
from unittest.mock import Mock, patch

import numpy as np
import pandas as pd
import pytest
from scipy.signal import find_peaks

from econgs_bench.reports.sections.attributes.chart import map_chart
from econgs_bench.reports.sections.attributes.table import Missing, histograms, maps
from econgs_bench.reports.style import Model
from tests.reports.conftest import settings
from tests.reports.sections.test_sections import sections

ECONGS = Model("econgs")


def features_table(count=60):
    """Values of two attributes in two scenes."""
    rng = np.random.default_rng(0)
    rows = [
        (scene, name, list(rng.normal(size=count * width)), width)
        for scene in "ab"
        for name, width in (("opacity", 1), ("features", 4))
    ]
    table = pd.DataFrame(rows, columns=["scene", "name", "values", "width"])
    return table.assign(job="j", dataset="d", method="econgs", preset="quick", **settings(""))


def test_histograms_pool_scenes_and_components():
    panels = histograms(features_table(9000))
    assert [panel.attribute for panel in panels] == ["opacity", "features"]
    shares = panels[1].shares[ECONGS]
    values = np.concatenate(features_table(9000).query("name == 'features'")["values"].to_list())
    counted, _ = np.histogram(values, panels[1].edges)
    assert shares == pytest.approx(100 * counted / len(values))


def test_scalings_of_offsets_and_of_gaussians_have_histograms_of_their_own():
    rows = np.concatenate([np.full((500, 3), 0.2), np.full((500, 3), 5.0)], axis=1)
    table = features_table().iloc[:1].assign(name="scalings", values=[rows.ravel().tolist()], width=6)
    offsets, gaussians = histograms(table)
    assert [one.attribute for one in (offsets, gaussians)] == ["scalings of offsets", "scalings of Gaussians"]
    assert offsets.edges[0] < 0.2 < offsets.edges[-1] < 1.0
    assert 4.0 < gaussians.edges[0] < 5.0 < gaussians.edges[-1]
    (explicit,) = histograms(table.assign(width=3))
    assert explicit.attribute == "scalings", "another method's"


def test_attributes_are_of_the_default_rate():
    rates = pd.concat([features_table().assign(**settings(v)) for v in ("", "rate_weight=0.01", "offsets=5")])
    assert list(histograms(rates)[0].shares) == [ECONGS, Model("econgs", "offsets=5")]


def test_an_attribute_that_is_the_same_everywhere_has_a_histogram():
    table = features_table().assign(values=[[1.0] * 5] * 4)
    assert sum(histograms(table)[0].shares[ECONGS]) == pytest.approx(100.0)


def test_quantised_values_are_no_comb():
    values = np.random.default_rng(0).normal(0.0, 0.1, 20_000)
    table = features_table().head(1).assign(values=[np.round(values / 0.047) * 0.047])
    (panel,) = histograms(table)
    shares = np.array(panel.shares[ECONGS])
    assert len(find_peaks(np.pad(shares, 1), prominence=0.05 * shares.max())[0]) <= 3
    counted = np.histogram(values, panel.edges)[0] / 200
    assert np.abs(shares - counted).sum() < 12  # percent: what the values were before


def test_histograms_of_many_variants_show_the_default():
    variants = ["", *(f"features={i}" for i in range(12))]
    table = pd.concat([features_table().head(1).assign(**settings(variant)) for variant in variants])
    assert list(histograms(table)[0].shares) == [ECONGS]
    presets = pd.concat([table, table.assign(preset="paper")])
    assert [panel.dataset for panel in histograms(presets)] == ["d · quick", "d · paper"]


def test_without_umap_the_reason_is_told(maker):
    maker.run(method="econgs", views=0)
    tables = maker.tables() | {"features": features_table()}
    with patch.dict(sys.modules, {"umap": None}):
        html = sections(tables)["attributes"]
    assert "umap-learn is not installed" in html


def test_without_vectors_the_reason_is_told():
    with pytest.raises(Missing, match="no method of this report"):
        maps(features_table().query("name == 'opacity'"))


def test_of_few_anchors_there_is_no_map():
    with patch.dict(sys.modules, {"umap": Mock()}), pytest.raises(Missing, match="of 30 anchors"):
        maps(features_table(14))


def test_an_embedding_is_split_by_scene():
    umap = Mock()
    umap.UMAP.return_value.fit_transform = lambda values: values[:, :2]
    with patch.dict(sys.modules, {"umap": umap}):
        (anchors,) = maps(features_table())
    (panel,) = map_chart([anchors]).panels
    first = np.reshape(features_table()["values"].iloc[1], (-1, 4))[:, :2]
    assert np.array_equal(anchors.scenes["a"], first)
    assert [scene.title for scene in panel.series] == ["a", "b"]
    assert panel.series[0].x == first[:, 0].tolist()


def test_the_section_has_the_map_below_the_histograms(maker):
    maker.run(method="econgs", views=0)
    umap = Mock()
    umap.UMAP.return_value.fit_transform = lambda values: values[:, :2]
    with patch.dict(sys.modules, {"umap": umap}):
        html = sections(maker.tables() | {"features": features_table()})["attributes"]
    before, after = html.split("<h3>Anchors by their features</h3>")
    assert before.count("<figure") == 2
    assert after.count("<figure") == 1
