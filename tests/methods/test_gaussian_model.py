import json
import math

import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.splat.rasterise import rasterise
from econgs_bench.methods.gaussian_splatting.method import GaussianSplatting
from econgs_bench.methods.gaussian_splatting.model import GaussianModel, SceneGaussians
from econgs_bench.methods.interface import Edit, Refused, check_ledger

SH_C0 = 0.5 / math.sqrt(math.pi)


def model_of(known, name="tiny", rows=slice(None), background=(1.0, 1.0, 1.0), degree=0):
    """The known Gaussians in stored form; colors become DC coefficients."""
    picked = {key: value[rows] for key, value in known.items()}
    count = len(picked["means"])
    scene = SceneGaussians(
        name=name,
        background=background,
        sh_degree=degree,
        means=picked["means"],
        log_scales=picked["scales"].log(),
        quats=picked["quats"],
        logits=picked["opacities"].logit(),
        sh_dc=(picked["features"][:, None] - 0.5) / SH_C0,
        sh_rest=torch.zeros((count, 15, 3)),
    )
    return GaussianModel([scene])


@pytest.fixture
def camera(tiny):
    return tiny.look_at([2.0, 1.5, 1.0])


def expected(known, camera, background=(1.0, 1.0, 1.0), opacities=None):
    """The oracle in float64, composited here."""
    exact = {name: value.double() for name, value in known.items()}
    if opacities is not None:
        exact["opacities"] = opacities.double()
    splats = rasterise(**exact, camera=camera, backend="torch")
    return splats.features + (1.0 - splats.alpha[..., None]) * torch.tensor(background).double(), splats.alpha


def test_rendering_matches_the_oracle(tiny, camera):
    model = model_of(tiny.known())
    for background in ((1.0, 1.0, 1.0), (0.2, 0.4, 0.6)):
        rgb, alpha = model.render(camera, background=background)
        truth, truth_alpha = expected(tiny.known(), camera, background)
        assert rgb.shape == (32, 32, 3)
        torch.testing.assert_close(rgb.double(), truth.clamp(0, 1), atol=2e-5, rtol=0)
        torch.testing.assert_close(alpha.double(), truth_alpha, atol=2e-5, rtol=0)


def test_the_recorded_background_of_the_first_scene_is_the_default(tiny, camera):
    red = model_of(tiny.known(), background=(1.0, 0.0, 0.0))
    rgb, alpha = red.render(camera)
    assert alpha[0, 0] == 0
    assert rgb[0, 0].tolist() == [1.0, 0.0, 0.0]


def test_composition_is_one_sorted_set_of_gaussians(tiny, camera):
    known = tiny.known()
    halves = [model_of(known, "a", slice(0, 24, 2)), model_of(known, "b", slice(1, 24, 2))]
    whole = GaussianSplatting().compose(halves)
    assert whole.scenes == ("a", "b")
    assert (whole.primitives(), whole.primitives("a")) == (24, 12)
    truth, _ = expected(known, camera)
    torch.testing.assert_close(whole.render(camera)[0].double(), truth.clamp(0, 1), atol=2e-5, rtol=0)


def test_opacity_is_edited_per_scene_and_nothing_else(tiny, camera):
    known = tiny.known()
    model = GaussianSplatting().compose(
        [model_of(known, "a", slice(0, 12)), model_of(known, "b", slice(12, 24))]
    )
    edited, _ = model.render(camera, edit={"b": Edit(opacity=0.3)})
    factors = torch.cat([torch.ones(12), torch.full((12,), 0.3)])
    truth, _ = expected(known, camera, opacities=1 - (1 - known["opacities"]) ** factors)
    torch.testing.assert_close(edited.double(), truth.clamp(0, 1), atol=2e-5, rtol=0)
    strong, _ = model.render(camera, edit={"a": Edit(opacity=50.0)})
    factors = torch.cat([torch.full((12,), 50.0), torch.ones(12)])
    truth, _ = expected(known, camera, opacities=1 - (1 - known["opacities"]) ** factors)
    torch.testing.assert_close(strong.double(), truth.clamp(0, 1), atol=2e-5, rtol=0)
    assert torch.equal(model.render(camera, edit={"a": Edit()})[0], model.render(camera)[0])


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        ({"tiny": Edit(light="headlight", diffuse=2.0)}, "light, diffuse"),
        ({"tiny": Edit(opacity=0.5, shininess=2.0)}, "shininess"),
        ({"tiny": Edit(opacity=math.inf)}, "opacity factor"),
        ({"other": Edit(opacity=1.0)}, "other"),
    ],
)
def test_other_edits_are_refused_by_name(tiny, camera, edit, reason):
    with pytest.raises(Refused, match=reason):
        model_of(tiny.known()).render(camera, edit=edit)


@pytest.mark.parametrize("names", [("tiny",), ("a", "b c/ü.ply")])
@pytest.mark.parametrize("count", [0, 24])
def test_the_ledger_sums_to_the_files_and_loading_gives_the_same_pictures(
    tiny, camera, tmp_path, names, count
):
    models = [
        model_of(tiny.known(), name, slice(count), background=(0.5, 1.0, 0.25), degree=2) for name in names
    ]
    model = GaussianSplatting().compose(models)
    ledger = model.save(tmp_path)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(files) == 2 * len(names)
    check_ledger(ledger, sum(file.stat().st_size for file in files), names)
    parts = dict.fromkeys(("positions", "normals", "sh_dc", "scale"), 12)
    parts |= {"sh_rest": 180, "opacity": 4, "rotation": 16}
    for name in names:
        assert {part: ledger[name][part] for part in parts} == {k: v * count for k, v in parts.items()}
        assert set(ledger[name]) == {*parts, "header", "metadata"}
    again = GaussianSplatting().load(tmp_path, "cpu")
    assert set(again.scenes) == set(names)
    for name in names:
        for one, other in zip(model.render(camera, [name]), again.render(camera, [name]), strict=True):
            assert torch.equal(one, other)


def test_damaged_folders_are_named(tiny, tmp_path):
    load = GaussianSplatting().load
    model_of(tiny.known()).save(tmp_path)
    about = tmp_path / "tiny.json"
    good = json.loads(about.read_text())
    for change in ({"format": "other"}, {"background": [1.0]}, {"background": "white"}, {"sh_degree": 9}):
        about.write_text(json.dumps(good | change))
        with pytest.raises(DataError, match=r"tiny\.json"):
            load(tmp_path, "cpu")
    about.write_text(json.dumps(good))
    (tmp_path / "tiny.ply").unlink()
    with pytest.raises(DataError, match=r"tiny\.ply"):
        load(tmp_path, "cpu")


def test_timings_name_the_parts_of_a_frame(tiny, camera):
    times = model_of(tiny.known()).timings(camera)
    assert set(times) == {"decode", "shade", "rasterise"}
    assert times["shade"] > 0
    assert times["rasterise"] > 0
