"""ParaView's maps: their colors and opacities as VTK draws them, their range, and what is no map."""

import json

import numpy as np
import pytest
from skimage.color import lab2rgb, rgb2lab
from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.transfer_maps import read_map, transfer_of

POINTS = [-20.0, 0.1, 0.9, 0.2, 130.0, 0.2, 0.1, 0.9, 250.0, 0.9, 0.9, 0.1]
OPACITIES = [0.0, 0.0, 0.3, 0.0, 80.0, 0.7, 0.5, 0.4, 160.0, 0.1, 0.5, 1.0, 240.0, 1.0, 0.5, 0.0]
SPACES = {
    "RGB": "RGB", "HSV": "HSV", "Lab": "Lab", "CIELAB": "Lab", "Diverging": "Diverging", "Step": "Step",
    "Lab/CIEDE2000": "LabCIEDE2000",
}  # fmt: skip
RANGE = (-50.0, 300.0)
XML = """<?xml version="1.0"?><!-- exported --><ColorMaps><ColorMap name="x" space="{space}">
<Point x="-20" o="0" r="0.1" g="0.9" b="0.2"/><Point x="130" o="0.8" r="0.2" g="0.1" b="0.9"/>
<Point x="250" o="0.3" r="0.9" g="0.9" b="0.1"/><NaN r="1" g="0" b="0"/></ColorMap></ColorMaps>"""
ENTRY = """
[[files]]
path = "ramp.npy"

[[scenes]]
name = "a"
transfer = "{map}"
"""


def _preset(**changes):
    return {"Name": "mine", "ColorSpace": "RGB", "RGBPoints": POINTS, "Points": OPACITIES} | changes


def _written(folder, content, name="map.json"):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def _drawn(transfer, values, low, high):
    """Colors, and opacities of the reference length, at values of the data."""
    table = transfer.classify((np.asarray(values) - low) / (high - low))
    return table[:, :3], -np.expm1(-table[:, 3] * transfer.reference_length)


def _by_vtk(space, points, opacities, values, wrap=False):
    color, opacity = vtkColorTransferFunction(), vtkPiecewiseFunction()
    getattr(color, f"SetColorSpaceTo{space}")()
    color.SetHSVWrap(wrap)
    for point in np.reshape(points, (-1, 4)).tolist():
        color.AddRGBPoint(*point)
    for point in np.reshape(opacities, (-1, 4)).tolist():
        opacity.AddPoint(*point)
    return (
        np.array([color.GetColor(value) for value in values]),
        np.array([opacity.GetValue(value) for value in values]),
    )


def _agree(drawn, expected, most=0.003):
    (rgb, alpha), (colors, opacities) = drawn, expected
    assert np.quantile(np.abs(alpha - np.minimum(opacities, 0.9999)), 0.99) < 0.002
    seen = opacities > 0.02
    assert np.quantile(np.abs(rgb - colors)[seen], 0.99) < most


@pytest.mark.parametrize("space", SPACES)
def test_colors_and_opacities_are_those_of_vtk(tmp_path, space):
    """At values anywhere, beyond the ends too; with midpoints and sharpness."""
    chosen = read_map(_written(tmp_path, [_preset(ColorSpace=space)]))
    transfer = transfer_of(chosen, "t", RANGE)
    assert len(transfer.bumps) < 400
    values = np.random.default_rng(0).uniform(*RANGE, 40 if "2000" in space else 2000)
    most = 0.02 if "2000" in space else 0.003
    _agree(_drawn(transfer, values, *RANGE), _by_vtk(SPACES[space], POINTS, OPACITIES, values), most)


def test_lab_is_that_of_the_cie(tmp_path):
    """By another library than the one that reads maps."""
    points = [0.0, 0.9, 0.1, 0.1, 1.0, 0.1, 0.2, 0.8]
    chosen = read_map(
        _written(tmp_path, _preset(ColorSpace="Lab", RGBPoints=points, Points=[0, 1, 0.5, 0, 1, 1, 0.5, 0]))
    )
    values = np.linspace(0.0, 1.0, 101)
    rgb, _ = _drawn(transfer_of(chosen, "t", None), values, 0.0, 1.0)
    ends = rgb2lab(np.array([[[0.9, 0.1, 0.1], [0.1, 0.2, 0.8]]]))[0]
    mixed = ends[0] + values[:, None] * (ends[1] - ends[0])
    assert np.abs(rgb - lab2rgb(mixed[None])[0]).max() < 0.01


@pytest.mark.parametrize(
    ("space", "vtk"), [("RGB", "RGB"), ("Lab", "Lab"), ("Wrapped", "HSV"), ("HSV", "HSV")]
)
def test_xml_is_the_same_map(tmp_path, space, vtk):
    chosen = read_map(_written(tmp_path, XML.format(space=space), "map.xml"))
    values = np.random.default_rng(1).uniform(*RANGE, 500)
    opacities = [-20.0, 0.0, 0.5, 0.0, 130.0, 0.8, 0.5, 0.0, 250.0, 0.3, 0.5, 0.0]
    expected = _by_vtk(vtk, POINTS, opacities, values, wrap=space == "Wrapped")
    _agree(_drawn(transfer_of(chosen, "t", RANGE), values, *RANGE), expected)


def test_a_map_without_opacities_has_the_usual_ramp(tmp_path):
    preset = _preset()
    del preset["Points"]
    transfer = transfer_of(read_map(_written(tmp_path, preset)), "t", RANGE)
    _, alpha = _drawn(transfer, [-40.0, -20.0, 115.0, 250.0, 290.0], *RANGE)
    assert alpha == pytest.approx([0.0, 0.0, 0.5, 0.9999, 0.9999], abs=0.002)


def test_two_points_at_one_value_are_a_step(tmp_path):
    points = [0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0, 1.0]
    opacities = [0.0, 0.2, 0.5, 0.0, 1.0, 0.2, 0.5, 0.0, 1.0, 0.8, 0.5, 0.0, 2.0, 0.8, 0.5, 0.0]
    chosen = read_map(_written(tmp_path, _preset(RGBPoints=points, Points=opacities)))
    rgb, alpha = _drawn(transfer_of(chosen, "t", (0.0, 2.0)), [0.5, 0.9999, 1.0001, 1.5], 0.0, 2.0)
    assert alpha == pytest.approx([0.2, 0.2, 0.8, 0.8], abs=1e-3)
    assert rgb == pytest.approx(np.array([[1, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1]]), abs=1e-3)


def test_an_entry_names_a_map_in_values_of_the_data_or_stretched(tmp_path):
    np.save(tmp_path / "ramp.npy", np.linspace(-50, 300, 512, dtype=np.float32).reshape(8, 8, 8))
    _written(tmp_path, [_preset(Name="other"), _preset()])
    (tmp_path / "a.toml").write_text(
        ENTRY.format(map="map.json") + 'preset = "mine"\nreference_length = 0.02\n'
    )
    dataset = open_dataset(str(tmp_path / "a.toml"))
    transfer = dataset.scenes[0].transfer
    assert transfer.reference_length == 0.02
    values = np.linspace(*RANGE, 300)
    _agree(_drawn(transfer, values, *RANGE), _by_vtk("RGB", POINTS, OPACITIES, values))
    with (tmp_path / "a.toml").open("a") as file:
        file.write("rescale = true\n")
    transfer = open_dataset(str(tmp_path / "a.toml")).scenes[0].transfer
    colors, opacities = np.reshape(POINTS, (-1, 4)).copy(), np.reshape(OPACITIES, (-1, 4)).copy()
    for points in (colors, opacities):
        points[:, 0] = -50.0 + 350.0 * (points[:, 0] - points[0, 0]) / np.ptp(points[:, 0])
    _agree(_drawn(transfer, values, *RANGE), _by_vtk("RGB", colors, opacities, values))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('map = "map.json"', "unknown key"),
        ('preset = "gone"', "preset 'gone' of"),
        ('[[scenes.bumps]]\nname="b"\nrange=[0,0.1,0.2,0.3]\ncolor=[1,0,0]\nopacity=0.5', "beside bumps"),
    ],
)
def test_an_entry_with_a_map_has_no_bumps_and_a_preset_that_is_there(tmp_path, more, words):
    np.save(tmp_path / "ramp.npy", np.linspace(-50, 300, 512, dtype=np.float32).reshape(8, 8, 8))
    _written(tmp_path, [_preset(), _preset(Name="other")])
    (tmp_path / "a.toml").write_text(ENTRY.format(map="map.json") + more)
    with pytest.raises(DataError, match=words):
        open_dataset(str(tmp_path / "a.toml"))
    (tmp_path / "a.toml").write_text(ENTRY.format(map="none.json"))
    with pytest.raises(DataError, match=r"none\.json was not found"):
        open_dataset(str(tmp_path / "a.toml"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("no map", "is no JSON"),
        ("[]", "holds no color map"),
        ([{"Name": "c", "IndexedColors": [1, 0, 0]}], "map of categories"),
        ([_preset(), _preset(Name="b")], "holds 2 maps: mine, b. Choose one: preset"),
        (_preset(RGBPoints=[0.0, 1.0, 1.0, 1.0]), "RGBPoints are not two or more points of x, red"),
        (_preset(RGBPoints=POINTS[:-1]), "RGBPoints are not two or more points of x, red"),
        (_preset(RGBPoints="red"), "RGBPoints are not two or more points"),
        (_preset(RGBPoints=[0.0, 1, 1, 1, "1", 0, 0, 0]), "no finite number"),
        (_preset(RGBPoints=[0.0, 255, 0, 0, 1.0, 0, 0, 0]), "from 0 to 1; one is not"),
        (_preset(Points=[0.0, 1.5, 0.5, 0, 1.0, 0, 0.5, 0]), "Points are x, opacity, midpoint"),
        (_preset(Points=[0.0, 0.0, 0.5, 0, 1.0, 0, 0.5, 0]), "is transparent everywhere"),
        (_preset(RGBPoints=[3.0, 1, 1, 1, 3.0, 0, 0, 0]), "RGBPoints are all at 3"),
        (_preset(ColorSpace="CMYK"), "has the color space 'CMYK'. Choose RGB"),
        ('{"RGBPoints": [0, 1, 1, NaN, 1, 0, 0, 0]}', "is no JSON"),
        ("[" * 3000, "is no JSON"),
        ("<ColorMaps/>", "holds no color map"),
        ("<ColorMaps><ColorMap>", "is no XML"),
        (XML.format(space="RGB").replace('r="0.1"', 'r="red"'), "is no XML of color maps"),
        (XML.format(space="RGB").replace('x="-20"', ""), "has a point without 'x'"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><ColorMaps>&b;</ColorMaps>', "declares a document type"),
        (XML.format(space="RGB").replace('name="x"', 'name="x" indexedLookup="true"'), "map of categories"),
    ],
)  # fmt: skip
def test_what_is_no_map_is_one_line(tmp_path, content, words):
    path = _written(tmp_path, content)
    with pytest.raises(DataError) as error:
        transfer_of(read_map(path), "t", (-50.0, 300.0))
    assert str(error.value).startswith(str(path))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("points", "value_range"),
    [(POINTS, (300.0, 400.0)), (POINTS, (-1.0e6, -30.0)), ([0.0, 1, 0, 0, 1.0, 0, 0, 1], (0.0, 255.0))],
)
def test_a_map_of_other_values_than_the_volume_says_how_to_stretch_it(tmp_path, points, value_range):
    opacities = [points[0], 0.0, 0.5, 0.0, points[-4], 1.0, 0.5, 0.0]
    chosen = read_map(_written(tmp_path, _preset(RGBPoints=points, Points=opacities)))
    with pytest.raises(DataError, match=r"rescale = true"):
        transfer_of(chosen, "t", value_range)
    assert transfer_of(chosen, "t", None).bumps
