"""What VEG adds to the contract (test_contract.py): look-up, law of opacity, groups, files and edits."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from econgs_bench.datasets.cloud import PointCloud
from econgs_bench.datasets.edits import Edit, edited
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth.model import Layer
from econgs_bench.datasets.ground_truth.reference import ReferenceMarcher
from econgs_bench.datasets.scene import BasicScene, Light
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.units import camera_in_units, cloud_in_units, scene_in_units, views_in_units
from econgs_bench.datasets.volume import Volume
from econgs_bench.methods.contract.scene import tiny_scene
from econgs_bench.methods.interface import Diverged, Refused
from econgs_bench.methods.shared.rendering import Rendering
from econgs_bench.methods.veg.appearance import Appearance, scene_as_json, scene_from_json
from econgs_bench.methods.veg.field import gradients_at, values_at
from econgs_bench.methods.veg.model import (
    WIDTHS,
    Field,
    Group,
    ScalarGaussians,
    Stored,
    VegModel,
    mean_lengths,
    visible_rows,
)
from econgs_bench.methods.veg.schedule import VegSchedule
from econgs_bench.methods.veg.training import VegTrainer, greatest_opacities
from tests.methods.conftest import Fits

fit = Fits("veg", max_gaussians=2000)
LOW = Bump("low", 0.1, 0.2, 0.3, 0.5, (0.2, 0.5, 0.9), 0.2)
HIGH = Bump("high", 0.4, 0.6, 1.0, 1.0, (0.9, 0.4, 0.1), 0.7)


@pytest.fixture(scope="module")
def scenes():
    """One volume through each of two transfer functions; clouds of visible voxels, as in the harness."""
    pair = [tiny_scene("tiny", volume="transfer"), tiny_scene("other", volume="transfer", swapped=True)]
    volume = pair[0].volume()
    visible = np.argwhere(pair[0].scene.transfer.classify(volume.normalised())[..., 3] > 0.0)[:, ::-1]
    low, high = volume.box
    points = low + np.random.default_rng(0).permutation(visible)[:800] * (high - low) / (
        np.array(volume.dims) - 1
    )
    cloud = PointCloud(points.astype(np.float32), np.full(points.shape, 0.5, np.float32))
    return [replace(scene, cloud=cloud) for scene in pair]


@pytest.fixture(scope="module")
def fitted(tiny, scenes):
    recorder = tiny.Recorder()
    return fit(scenes, recorder, 300), recorder


def look(*bumps, entries=4096, length=0.05, light=None):
    scene = BasicScene("s", "v", TransferFunction("t", bumps, length), light=light)
    return Appearance.of(scene, entries, "cpu")


def gaussians(count, law="depth", seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.rand(shape, generator=generator, dtype=torch.float64).to(dtype)

    return ScalarGaussians(
        law,
        means=random(count, 3),
        scales=0.01 + 0.1 * random(count, 3),
        quats=torch.nn.functional.normalize(random(count, 4) - 0.5, dim=1),
        normals=random(count, 3) - 0.5,
        scalars=random(count),
        opacities=random(count),
        factors=torch.ones((count, 4), dtype=dtype),
    )


# --------------------------------------------------------------------------- field and look-up


def test_values_and_gradients_of_a_volume_are_those_of_scipy():
    generator = np.random.default_rng(0)
    values = generator.integers(0, 200, (7, 9, 11)).astype(np.uint8)
    volume = Volume("v", values, (1.0, 2.0, 0.5), (10.0, 180.0), "test")
    low, high = volume.box
    points = generator.uniform(1.2 * low, 1.2 * high, (300, 3))  # some of them outside
    scale = (np.array(volume.dims) - 1) / (high - low)

    def expected(points):
        index = np.clip((points - low) * scale, 0, np.array(volume.dims) - 1)[:, ::-1].T
        table = np.clip((values.astype(np.float64) - 10.0) / 170.0, 0.0, 1.0)
        return map_coordinates(table, index, order=1, mode="nearest")

    np.testing.assert_allclose(values_at(volume, points), expected(points), atol=1e-6)
    found = gradients_at(volume, points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1.0 / scale[axis]
        sides = expected(points + step) - expected(points - step)
        np.testing.assert_allclose(found[:, axis], sides / (2.0 * step[axis]), atol=1e-4)


def test_the_look_up_is_linear_between_the_entries_of_the_transfer_function():
    transfer = TransferFunction("t", (LOW, HIGH), 0.05)
    values = torch.rand(500, generator=torch.Generator().manual_seed(0))
    values[:2] = torch.tensor([0.0, 1.0])
    for entries in (100, 1024):
        found = look(LOW, HIGH, entries=entries).look_up(values)
        at = np.linspace(0.0, 1.0, entries)
        table = transfer.classify(at)
        expected = np.stack([np.interp(values.double(), at, column) for column in table.T], axis=1)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
        assert torch.equal(look(LOW, HIGH, entries=entries).extinctions(values), found[:, 3])


def test_gradients_of_what_is_seen_are_finite_differences():
    part = gaussians(4, dtype=torch.float64)
    light = Light(direction=(0.0, 0.6, 0.8))
    looks = [look(LOW, light=light), look(HIGH)]
    looks = [
        Appearance(*(one.double() if isinstance(one, torch.Tensor) else one for one in vars(each).values()))
        for each in looks
    ]
    eye = torch.tensor([0.3, 2.0, 1.0], dtype=torch.float64)
    scalars = torch.tensor([0.15, 0.45, 0.55, 0.25], dtype=torch.float64)
    learned = [part.means, part.scales, part.normals, scalars, part.opacities, part.factors]
    for law in ("depth", "product"):

        def seen(means, scales, normals, scalars, opacities, factors, law=law):
            own = ScalarGaussians(law, means, scales, part.quats, normals, scalars, opacities, factors)
            return own.seen(looks, eye)

        inputs = [one.detach().clone().requires_grad_() for one in learned]
        assert torch.autograd.gradcheck(seen, inputs, eps=1e-7, atol=1e-4)


def test_a_phong_highlight_becomes_a_like_one():
    """r·v of twice the angle, to the power 20, against n·h to four times the power."""
    light = Light(shininess=20.0, model="phong")
    power = float(look(LOW, light=light).coefficients[3])
    angle = np.linspace(0.0, 0.4, 50)
    np.testing.assert_allclose(np.cos(2.0 * angle) ** 20.0, np.cos(angle) ** power, atol=0.02)


# --------------------------------------------------------------------------- opacity


def test_the_mean_length_is_the_mass_over_the_area():
    """Sums over a fine grid of a Gaussian of peak 1, and of its projections along its axes."""
    scales = torch.tensor([[0.3, 0.2, 0.1], [0.2, 0.2, 0.2]], dtype=torch.float64)
    step = 0.05
    at = np.arange(-2.0, 2.0 + step / 2, step)
    for sigmas, found in zip(scales.numpy(), mean_lengths(scales), strict=True):
        bells = [np.exp(-0.5 * (at / sigma) ** 2).sum() * step for sigma in sigmas]
        areas = [bells[0] * bells[1], bells[0] * bells[2], bells[1] * bells[2]]
        assert float(found) == pytest.approx(
            math.prod(bells) / math.sqrt(np.mean(np.square(areas))), rel=1e-6
        )
    assert float(mean_lengths(scales)[1]) == pytest.approx(math.sqrt(2.0 * math.pi) * 0.2)


def test_optical_depth_follows_the_transfer_function_as_in_a_volume():
    """-ln(1 - opacity) of a Gaussian is proportional to that of the transfer function at its value."""
    part = gaussians(50)
    plateau = torch.full_like(part.scalars, 0.25)
    part = replace(part, scalars=plateau)
    eye = torch.tensor([0.0, 0.0, 3.0])
    depths = []
    for opacity in (0.1, 0.4):
        _, found = part.seen([look(replace(LOW, opacity=opacity))], eye)
        depths.append(-torch.log1p(-found.double()))
    expected = torch.full((50,), math.log(0.6) / math.log(0.9), dtype=torch.float64)
    torch.testing.assert_close(depths[1] / depths[0], expected, rtol=1e-3, atol=0.0)


def test_published_opacities_are_products():
    part = gaussians(50, law="product")
    part = replace(part, scalars=torch.full_like(part.scalars, 0.25))
    _, found = part.seen([look(LOW)], torch.tensor([0.0, 0.0, 3.0]))
    torch.testing.assert_close(found, 0.2 * part.opacities, rtol=1e-4, atol=0.0)


def test_scenes_shown_together_add_extinctions_and_mix_colors_by_them():
    """Against float64 sums, as the ground truth of a composition has them; each scene has its own light."""
    part = gaussians(200)
    looks = [look(LOW), look(HIGH, length=0.02), look(replace(LOW, color=(0.0, 1.0, 0.0)))]
    rows = visible_rows(part.scalars, looks)
    part = part.of(rows)
    colors, opacities = part.seen(looks, torch.tensor([0.0, 0.0, 3.0]))
    tables = [
        TransferFunction("t", (bump,), length).classify(part.scalars.double().numpy())
        for bump, length in ((LOW, 0.05), (HIGH, 0.02), (replace(LOW, color=(0.0, 1.0, 0.0)), 0.05))
    ]
    total = sum(table[:, 3] for table in tables)
    mixed = sum(table[:, 3:] * table[:, :3] for table in tables) / total[:, None]
    depth = total * part.opacities.double().numpy() * mean_lengths(part.scales.double()).numpy()
    np.testing.assert_allclose(colors, mixed, atol=2e-3)
    np.testing.assert_allclose(opacities, 1.0 - np.exp(-depth), atol=2e-3)


def test_a_gaussian_that_one_transfer_function_hides_is_kept_for_another():
    part = gaussians(3)
    part = replace(part, scalars=torch.tensor([0.25, 0.8, 0.05]), opacities=torch.ones(3))
    each = [greatest_opacities(part, [one]) for one in (look(LOW), look(HIGH))]
    both = greatest_opacities(part, [look(LOW), look(HIGH)])
    assert each[0][1] == each[1][0] == both[2] == 0.0
    assert both[0] == each[0][0] > 0.01
    assert both[1] == each[1][1] > 0.01


# --------------------------------------------------------------------------- fits


def marched(scene, edit, cameras):
    """Float64 pictures of an edited scene."""
    changed = edited(scene.scene, edit)
    volume = scene.volume()
    return ReferenceMarcher(volume).compose(cameras, (Layer.of(changed, volume),))


def test_a_fit_approaches_views_that_it_never_saw(tiny, scenes, fitted):
    model, recorder = fitted
    assert model.scenes == ("tiny", "other")
    for scene in scenes:
        assert tiny.psnr(model, scene.validation, scenes=[scene.name]) > 28.0
    assert recorder.stages[0] == "growth"
    assert recorder.stages[-1] == "shading"


def test_a_transfer_function_that_it_never_saw_shows_the_volume(tiny, scenes, fitted):
    """A shifted bump of another color, against the marcher; what was learned is far from it."""
    model, _ = fitted
    bumps = (replace(LOW, start=0.15, rise=0.25, fall=0.35, end=0.55, color=(0.1, 0.7, 0.2)),)
    edit = Edit(transfer=TransferFunction("new", bumps, 0.05))
    views = scenes[0].validation
    truth = replace(views, images=marched(scenes[0], edit, views.cameras))
    seen = tiny.psnr(model, truth, scenes=["tiny"], edit={"tiny": edit})
    assert seen > 24.0
    assert seen > tiny.psnr(model, truth, scenes=["tiny"]) + 6.0


def test_a_composition_is_one_look_at_shared_gaussians(tiny, scenes, fitted):
    """Both scenes together against the marcher's composition, and no Gaussian drawn twice."""
    model, _ = fitted
    volume = scenes[0].volume()
    layers = tuple(Layer.of(scene.scene, volume) for scene in scenes)
    views = scenes[0].validation
    truth = replace(views, images=ReferenceMarcher(volume).compose(views.cameras, layers))
    assert tiny.psnr(model, truth) > 27.0
    members = [model.scene(name) for name in model.scenes]
    (drawn,) = model.together(members, views.cameras[0], {})
    assert len(drawn.means) <= len(members[0].field.gaussians)
    assert len(drawn.numbers.unique()) == len(drawn.means)


def test_an_edit_shows_what_a_scene_so_defined_would(scenes, fitted):
    model, _ = fitted
    camera = scenes[0].validation.cameras[0]
    (group,) = model.groups
    for edit in (
        Edit(palette=(0.1, 0.8, 0.3), opacity=0.5),
        Edit(light=(0.0, 0.6, 0.8), ambient=0.5, shininess=2.0),
        Edit(transfer=TransferFunction("new", (LOW,), 0.03), opacity=2.0),
    ):
        defined = tuple(edited(scene, edit) for scene in group.scenes)
        other = VegModel([replace(group, scenes=defined)])
        other = other.drawn_by(model.rendering)
        expected = other.render(camera, ["tiny"])[0]
        assert torch.equal(model.render(camera, ["tiny"], {"tiny": edit})[0], expected)
        assert not torch.equal(model.render(camera, ["tiny"])[0], expected)


def test_a_fit_does_not_depend_on_scene_units(tiny, scenes, tmp_path):
    """Positions in other units, a volume that has none, and a new transfer function of the scene's units."""
    usual = fit(scenes[0], tiny.Recorder(), 24)
    transfer = TransferFunction("new", (replace(LOW, opacity=0.4),), 0.05)
    camera = scenes[0].validation.cameras[0]
    expected = usual.render(camera, edit={"tiny": Edit(transfer=transfer)})[0]
    for units in (1.0 / 1024.0, 1024.0):
        one = scenes[0]
        scaled = replace(
            one,
            scene=scene_in_units(one.scene, units),
            train=views_in_units(one.train, units),
            cloud=cloud_in_units(one.cloud, units),
            extent=units * one.extent,
            units=1.0 / units,
        )
        model = fit(scaled, tiny.Recorder(), 24)
        assert model.rendering.units == units
        edit = Edit(transfer=replace(transfer, reference_length=0.05 * units))
        found = model.render(camera_in_units(camera, units), edit={"tiny": edit})[0]
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0.0)


def test_the_published_configuration_fits_and_its_first_stage_has_no_light(tiny, scenes):
    changed = {"configuration": "paper", "random_points": 400, "max_gaussians": 2000}
    recorder = tiny.Recorder([30])
    model = fit(scenes, recorder, 60, **changed)
    assert model.groups[0].field.gaussians.law == "product"
    assert model.groups[0].field.table_size == 100
    (midway,) = recorder.models
    early = midway.groups[0].field.gaussians
    assert early.factors is None
    assert bool((early.opacities == 1.0).all())
    low, high = scenes[0].volume().box
    trainer = VegTrainer(scenes, fit.options(**changed), 60, 0, "cpu")
    start = trainer.optimiser["means"].detach().numpy()
    assert len(start) == 400
    assert (start >= low).all()
    assert (start <= high).all()
    expected = values_at(scenes[0].volume(), start)
    np.testing.assert_allclose(trainer.optimiser["scalars"].detach().sigmoid(), expected, atol=2e-4)


def test_the_schedule_is_the_published_one_at_its_budget():
    schedule = VegSchedule(40_000)
    first = [i for i in range(1, 30_001) if schedule.grows(i)]
    again = [i for i in range(30_001, 40_001) if schedule.grows(i)]
    assert (first[0], first[-1], first[1] - first[0]) == (1_000, 19_500, 500)
    assert (again[0], again[-1], again[1] - again[0]) == (30_100, 31_900, 100)
    assert not any(schedule.resets_opacity(i) for i in range(1, 40_001))


def test_another_seed_gives_another_model_and_views_that_are_not_finite_are_called_diverged(tiny, scenes):
    camera = scenes[0].validation.cameras[0]
    one, other = (fit(scenes[0], tiny.Recorder(), 8, seed=seed).render(camera)[0] for seed in (7, 8))
    assert not torch.equal(one, other)
    train = scenes[0].train
    broken = replace(scenes[0], train=replace(train, images=np.full_like(train.images, np.nan)))
    with pytest.raises(Diverged, match=r"image loss.*iteration 1"):
        fit(broken, tiny.Recorder(), 4)


def test_scenes_of_one_variable_are_one_group_and_others_are_refused_by_name(tiny, scenes):
    one, two = scenes
    else_ = replace(one, scene=replace(one.scene, name="else", variable="other"))
    surfaces = tiny_scene("surfaces", volume="isosurfaces")
    views = replace(tiny_scene("views"), volume=None)
    groups = fit.method.partition([one, else_, surfaces, two, views], fit.options())
    assert [[scene.name for scene in group] for group in groups] == [
        ["tiny", "other"], ["else"], ["surfaces"], ["views"],
    ]  # fmt: skip
    with pytest.raises(Refused, match="scene 'surfaces' shows isosurfaces"):
        fit(surfaces, tiny.Recorder(), 2)
    with pytest.raises(Refused, match="scene 'views' has only views"):
        fit(views, tiny.Recorder(), 2)
    with pytest.raises(Refused, match="scene 'tiny' has only views"):
        fit(replace(one, volume=None), tiny.Recorder(), 2)
    with pytest.raises(Refused, match="initial clouds of tiny are empty"):
        fit(tiny.with_cloud(one, []), tiny.Recorder(), 2)
    with pytest.raises(Refused, match="more than max_gaussians = 5"):
        fit(one, tiny.Recorder(), 2, max_gaussians=5)


# --------------------------------------------------------------------------- files


def test_24_bytes_per_gaussian_and_eight_codebooks_of_256(tmp_path):
    count, generator = 5_000, torch.Generator().manual_seed(0)
    raw = {name: torch.randn((count, width), generator=generator) for name, width in WIDTHS.items()}
    stored = Stored.of("depth", 1024, torch.rand((count, 3), generator=generator), raw, 256)
    scene = BasicScene("bone", "density", TransferFunction("t", (LOW,)))
    model = VegModel([Group((scene,), stored.field("cpu"), stored)])
    ledger = model.save(tmp_path)
    shared = ledger[""]
    assert shared["positions"] + sum(shared[name] for name in WIDTHS) == 24 * count
    assert shared["codebooks"] == 8 * 256 * 2
    assert ledger["bone"] == {"transfer function": (tmp_path / "bone.json").stat().st_size}
    again = fit.method.load(tmp_path, "cpu")
    assert again.rendering == Rendering()
    assert again.groups[0].scenes == (scene,)
    for name, values in vars(model.groups[0].field.gaussians).items():
        if isinstance(values, torch.Tensor):
            assert torch.equal(getattr(again.groups[0].field.gaussians, name), values)
    with pytest.raises(Refused, match="at the codebook size that it has"):
        again.save(tmp_path, 16.0)


@pytest.mark.parametrize(
    "light", [None, Light(), Light((0.0, 0.6, 0.8), 0.1, 0.2, 0.3, 7.0, "phong")], ids=["none", "head", "far"]
)
def test_definitions_of_scenes_are_kept_exactly(light):
    scene = BasicScene("s", "v", TransferFunction("t", (LOW, HIGH), 1.0 / 3.0), light, (0.1, 0.2, 0.3))
    assert scene_from_json(json.loads(json.dumps(scene_as_json(scene)))) == scene


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("transfer/bumps", []),
        ("transfer/bumps/0/color", [0.1, 0.2]),
        ("transfer/bumps/0/rise", None),
        ("transfer/reference_length", -1.0),
        ("transfer/reference_length", math.inf),
        ("light/model", "lambert"),
        ("light/ambient", math.nan),
        ("light", 3),
        ("background", "white"),
    ],
)
def test_definitions_that_are_none_are_named(tmp_path, path, value):
    raw = {name: torch.zeros((2, width)) for name, width in WIDTHS.items()} | {
        "rotation real": torch.ones(2, 1)
    }
    stored = Stored.of("depth", 16, torch.zeros((2, 3)), raw, 4)
    scene = BasicScene("bone", "density", TransferFunction("t", (LOW,)))
    VegModel([Group((scene,), stored.field("cpu"), stored)]).save(tmp_path)
    file = tmp_path / "bone.json"
    about = json.loads(file.read_text())
    *parents, last = path.split("/")
    place = about["scene"]
    for name in parents:
        place = place[int(name) if name.isdigit() else name]
    place[last] = value
    file.write_text(json.dumps(about))
    with pytest.raises(DataError, match=r"bone\.json"):
        VegModel.load(tmp_path, "cpu")


def test_a_field_without_gaussians_shows_nothing():
    raw = {name: torch.zeros((0, width)) for name, width in WIDTHS.items()}
    field = Stored.of("depth", 16, torch.zeros((0, 3)), raw, 4).field("cpu")
    assert isinstance(field, Field)
    scene = BasicScene("bone", "density", TransferFunction("t", (LOW,)))
    model = VegModel([Group((scene,), field, None)])
    _, alpha = model.render(tiny_scene("t").validation.cameras[0])
    assert float(alpha.max()) == 0.0
    with pytest.raises(Refused, match="quantised at the end of a fit"):
        model.save("nowhere")
