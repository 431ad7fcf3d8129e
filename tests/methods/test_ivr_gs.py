"""What iVR-GS adds to the contract (test_contract.py): its schedule, losses, shading and storage."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import Light
from econgs_bench.methods.interface import Edit, Refused
from econgs_bench.methods.ivr_gs.losses import depth_normals, normal_loss, smoothness_loss
from econgs_bench.methods.ivr_gs.model import (
    FORMAT,
    WIDTHS,
    IvrModel,
    Stored,
    attributes_with_codebooks,
    ready,
)
from econgs_bench.methods.ivr_gs.schedule import IvrSchedule
from econgs_bench.methods.ivr_gs.training import IvrTrainer
from econgs_bench.methods.shared.training import SceneLabel
from tests.methods.conftest import Fits

fit = Fits("ivr-gs", max_gaussians=500)


@pytest.fixture(scope="module")
def fitted(tiny, scene):
    recorder = tiny.Recorder()
    return fit(scene, recorder, 400), recorder


def saved(model, folder, rate=None):
    folder.mkdir()
    ledger = model.save(folder, rate)["tiny"]
    return fit.method.load(folder, "cpu"), ledger


def test_a_fit_approaches_views_that_it_never_saw(tiny, scene, fitted):
    model, recorder = fitted
    assert tiny.psnr(model, scene.validation) > 22.0
    assert recorder.stages[0] == "growth, stopped at 500 Gaussians" or recorder.stages[0] == "growth"
    assert recorder.stages[-1] == "shading"


def test_the_schedule_is_the_published_one_at_its_budget():
    schedule = IvrSchedule(40_000, early_reset=True)
    first = [i for i in range(1, 30_001) if schedule.grows(i)]
    again = [i for i in range(30_001, 40_001) if schedule.grows(i)]
    assert (first[0], first[-1], first[1] - first[0]) == (1_000, 9_500, 500)
    assert (again[0], again[-1], again[1] - again[0]) == (30_100, 31_900, 100)
    assert not schedule.shaded(30_000)
    assert schedule.shaded(30_001)
    resets = [i for i in range(1, 40_001) if schedule.resets_opacity(i)]
    assert resets == [500, 3_000, 6_000, 9_000]
    assert schedule.decayed(30_000, 1.0, 0.01) == pytest.approx(0.01)
    assert schedule.decayed(40_000, 1.0, 0.01) == pytest.approx(0.01)
    assert schedule.decayed(15_000, 1.0, 0.01) == pytest.approx(0.1)
    assert sum(IvrSchedule(400).grows(i) for i in range(1, 401)) >= 10
    assert not any(IvrSchedule(400, grows_shaded=False).grows(i) for i in range(301, 401))


def test_24_bytes_per_gaussian_and_ten_codebooks_of_256(tmp_path):
    count, generator = 5_000, torch.Generator().manual_seed(0)
    raw = {name: torch.randn((count, width), generator=generator) for name, width in WIDTHS.items()}
    positions = torch.rand((count, 3), generator=generator)
    label = SceneLabel("tiny", (1.0, 1.0, 1.0), None)
    stored = Stored.of(label, (0.5, 0.5, 0.5), positions, raw, fit.options(positions="float16"))
    _, ledger = saved(IvrModel([ready(stored.coded, "cpu")], [stored]), tmp_path / "a")
    ids = sum(ledger[name] for name in WIDTHS)
    assert ledger["positions"] + ids == 24 * count
    assert ledger["codebooks"] == 5_120


def test_values_are_activated_once(tiny, scene, tmp_path):
    """What is loaded shows what training saw, as far as half precision goes.

    The published code activates specular coefficients and shininess a second time.
    """
    trainer = IvrTrainer(scene, fit.options(supersampling=1), 400, 0, "cpu")
    trainer.run(tiny.Recorder())
    with torch.no_grad():
        trainer.optimiser["specular"].add_(1.0)  # highlights that a second sigmoid would change
    camera = scene.validation.cameras[0]
    model = trainer.model()
    with torch.no_grad():
        shown = IvrModel([trainer._shaded()], None)
        shown = shown.drawn_by(model.rendering)
        learned = shown.render(camera)[0]
    many, _ = saved(model, tmp_path / "many", 65536.0)
    torch.testing.assert_close(many.render(camera)[0], learned, atol=0.02, rtol=0)
    sizes = [saved(model, tmp_path / str(size), size)[0] for size in (4.0, 32.0, 256.0)]
    far = [float((one.render(camera)[0] - learned).norm()) for one in sizes]
    assert far == sorted(far, reverse=True)
    with pytest.raises(Refused, match="at the codebook size that it has"):
        saved(many, tmp_path / "again", 1024.0)


def test_parts_of_the_loss_carry_their_weights(tiny, scene):
    """Each part is its weight times what it was: twice the weight is twice the part."""
    names = {"alpha": "alpha", "mask": "mask", "normal": "normals", "offset": "offset colors",
             "smoothness": "smoothness", "opacity": "opacity"}  # fmt: skip
    trainer = IvrTrainer(scene, fit.options(), 40, 0, "cpu")
    while not trainer.shading:
        trainer.step()
    camera, back = scene.train.cameras[0], scene.train.background
    for option, name in names.items():
        values = []
        for weight in (1.0, 2.0):  # a smaller weight of alpha grows while the scene vanishes
            trainer.options = replace(trainer.options, **{f"{option}_weight": weight})
            found = trainer.drawn(camera, trainer.images[0], back).losses
            values.append(float(found[name].detach()))
        assert values[1] == pytest.approx(2.0 * values[0])
        assert values[1] > 0.0
    trainer.options = replace(trainer.options, alpha_weight=0.0, mask_weight=0.0, normal_weight=0.0)
    found = trainer.drawn(camera, trainer.images[0], back).losses
    assert set(found) == {"image", "offset colors", "smoothness", "opacity"}


@pytest.mark.parametrize(
    ("weights", "asks"),
    [((0.0, 0.1), True), ((0.1, 0.0), True), ((0.0, 0.0), False)],
)
def test_pruning_by_contribution_minds_alpha_where_a_loss_does(scene, weights, asks):
    alpha, mask = weights
    trainer = IvrTrainer(scene, fit.options(alpha_weight=alpha, mask_weight=mask), 40, 0, "cpu")
    (prunable,) = trainer.prunable()
    assert prunable.scenes[0].asks_alpha is asks


def test_rates_fall_in_the_second_stage_once_nothing_grows(scene):
    trainer = IvrTrainer(
        scene, fit.options(last_lr_share=0.1, decay="linear", prune_loss_db=0.0), 400, 0, "cpu"
    )
    assert [trainer.schedule.settled(i, 0.1) for i in (1, 300, 320)] == [1.0, 1.0, 1.0]
    trainer.iteration = 300
    while trainer.iteration < 360:
        trainer.step()
    assert trainer.optimiser.learning_rates["diffuse"] == pytest.approx(0.55 * trainer.options.shading_lr)
    assert trainer.optimiser.learning_rates["logits"] == pytest.approx(0.55 * trainer.options.opacity_lr)
    still = IvrSchedule(400, grows_shaded=False, decay="linear")
    assert still.settled(350, 0.1) == pytest.approx(0.55)


def test_shading_begins_as_chosen(scene):
    options = fit.options(shading_start=0.3, specular_start=0.7, shading_lr=1e-6)
    trainer = IvrTrainer(scene, options, 40, 0, "cpu")
    while not trainer.shading:
        trainer.step()
    shown = trainer._shaded().coefficients.detach()
    expected = torch.tensor([0.3, 0.3, 0.7]).expand(len(shown), 3)
    torch.testing.assert_close(shown[:, :3], expected, atol=1e-4, rtol=0.0)


def test_offset_colors_by_tanh_also_darken_and_come_back(tiny, scene, tmp_path):
    """A file that names no activation has sigmoid, as those of earlier versions."""
    trainer = IvrTrainer(scene, fit.options(offset_color="tanh"), 40, 0, "cpu")
    while not trainer.shading:
        trainer.step()
    assert not trainer._shaded().offsets.detach().abs().max() > 0.1  # begins at the palette color
    with torch.no_grad():
        trainer.optimiser["offset_color"].fill_(-1.0)
    trainer.iteration = 40
    model = trainer.model()
    again, _ = saved(model, tmp_path / "a")
    for one in (model, again):
        expected = torch.tensor(-1.0).half().float().tanh().expand(model.primitives(), 3)
        torch.testing.assert_close(one.scene("tiny").offsets, expected)
    bright = fit(scene, tiny.Recorder(), 40)
    assert bright.stored[0].coded.about.keys() == {"light", "palette"}
    assert saved(bright, tmp_path / "b")[0].scene("tiny").offsets.min() > 0.0
    about = {**model.stored[0].coded.about, "offset color": "relu"}
    unknown = replace(model.stored[0].coded, about=about)
    (tmp_path / "c").mkdir()
    unknown.write(tmp_path / "c", FORMAT)
    with pytest.raises(DataError, match="tiny"):
        fit.method.load(tmp_path / "c", "cpu")


def test_attributes_chosen_have_codebooks_and_the_others_none(tiny, scene, tmp_path):
    model = fit(scene, tiny.Recorder(), 20, quantised="scale + rotation_imaginary", codebook_size=16)
    again, ledger = saved(model, tmp_path / "a")
    count = model.primitives()
    assert ledger["scale"] == ledger["rotation imaginary"] == math.ceil(3 * count * 4 / 8)
    assert ledger["normal"] == 6 * count
    assert ledger["codebooks"] == 2 * 16 * 2
    camera = scene.validation.cameras[0]
    assert torch.equal(again.render(camera)[0], model.render(camera)[0])
    assert attributes_with_codebooks("none") == frozenset()
    assert attributes_with_codebooks("all") == frozenset(WIDTHS)
    with pytest.raises(Refused, match="'colour' is none of"):
        fit(scene, tiny.Recorder(), 5, quantised="colour")


def test_coded_positions_take_fewer_bytes_and_every_row_stays_together(tiny, scene, tmp_path):
    trainer = IvrTrainer(scene, fit.options(), 40, 0, "cpu")
    trainer.run(tiny.Recorder())
    models = {}
    for form in ("float16", "coded"):
        trainer.options = replace(trainer.options, positions=form)
        models[form] = trainer.model()
    again, ledger = saved(models["coded"], tmp_path / "coded")
    assert ledger["positions"] < saved(models["float16"], tmp_path / "float16")[1]["positions"]
    plain, coded = (one.stored[0].coded for one in models.values())
    cell = coded.grid.cell[0]
    assert cell == pytest.approx(0.08 * float(plain.column("scale", 3).mean(1).median().exp()), rel=0.01)
    tables = [torch.cat([one.column(*column) for column in WIDTHS.items()], dim=1) for one in (plain, coded)]
    same = (tables[0][:, None] == tables[1]).all(2)
    rows = torch.where(same, torch.cdist(plain.positions, coded.positions), torch.inf).argmin(1)
    assert len(rows.unique()) == len(plain.positions)
    assert (plain.positions - coded.positions[rows]).abs().max() < 0.5 * cell + 1e-3
    camera = scene.validation.cameras[0]
    assert torch.equal(again.render(camera)[0], models["coded"].render(camera)[0])
    torch.testing.assert_close(
        again.render(camera)[0], models["float16"].render(camera)[0], atol=0.01, rtol=0
    )


def test_normals_of_depth_maps(tiny):
    """A plane z = 0.2 x + 0.1 y seen from above: one normal everywhere, towards the camera."""
    camera = tiny.look_at([0.3, -0.2, 3.0])
    normal = np.array([-0.2, -0.1, 1.0]) / math.sqrt(1.05)
    origin, rays = camera.rays()
    distance = -(origin @ normal) / (rays @ normal)
    depth = distance * (rays @ camera.camera_to_world[:3, 2])
    alpha = torch.full((32, 32), 0.5)
    alpha[:, :4] = 0.0
    found, mask = depth_normals(torch.from_numpy(depth).float() * alpha, alpha, camera)
    assert mask[1:-1, 5:-1].all()
    assert not mask[:, :5].any()
    assert not mask[0].any()
    expected = torch.from_numpy(normal).float().expand_as(found)
    torch.testing.assert_close(found[mask], expected[mask], atol=1e-3, rtol=0)
    assert not found[~mask].any()
    right = expected * alpha[..., None]
    assert normal_loss(right, torch.from_numpy(depth).float() * alpha, alpha, camera) < 1e-6
    assert normal_loss(-right, torch.from_numpy(depth).float() * alpha, alpha, camera) > 0.1


def test_smoothness_cares_less_about_edges():
    step = torch.zeros(8, 8, 1)
    step[:, 4:] = 1.0
    flat = torch.zeros(8, 8, 3)
    assert smoothness_loss(torch.ones(8, 8, 1), flat) == 0.0
    assert smoothness_loss(step, flat) == pytest.approx(8 / 56)
    assert smoothness_loss(step, step.expand(8, 8, 3)) == pytest.approx(math.exp(-1) * 8 / 56)


def test_the_palette_is_the_mean_color_and_moves_every_color(scene, fitted):
    model, _ = fitted
    images = torch.from_numpy(scene.train.images)
    mean = images[..., :3].sum((0, 1, 2)) / images[..., 3].sum()
    torch.testing.assert_close(model.scene("tiny").palette, mean, atol=1e-5, rtol=0)
    camera = scene.validation.cameras[0]
    lifted = {"tiny": Edit(palette=(1.0, float(mean[1]), float(mean[2])))}
    plain, red = (model.render(camera, edit=edit)[0] for edit in (None, lifted))
    assert (red[..., 0] > plain[..., 0] + 0.01).any()
    torch.testing.assert_close(red[..., 1:], plain[..., 1:], atol=1e-4, rtol=0)


def test_light_of_the_scene_and_of_edits(scene, tiny, tmp_path):
    lit = replace(scene, scene=replace(scene.scene, light=Light(direction=(0.0, 0.0, 1.0))))
    model = fit(lit, tiny.Recorder(), 30)
    camera = scene.validation.cameras[0]
    plain = model.render(camera)[0]
    again, _ = saved(model, tmp_path / "a")
    assert again.scene("tiny").light == (0.0, 0.0, 1.0)
    assert torch.equal(again.render(camera)[0], plain)
    up = model.render(camera, edit={"tiny": Edit(light=(0.0, 0.0, 1.0))})[0]
    assert torch.equal(up, plain)
    assert not torch.equal(model.render(camera, edit={"tiny": Edit(light="headlight")})[0], plain)


def test_what_cannot_be_seen_goes(scene):
    trainer = IvrTrainer(scene, fit.options(), 40, 0, "cpu")
    with torch.no_grad():
        trainer.optimiser["logits"][:5] = -6.0
    before = trainer.count
    trainer.densification.prune_invisible()
    assert trainer.count == before - 5
    growth = trainer.densification
    assert len(growth.normal_gradients) == len(growth.statistics.visits) == trainer.count


def test_normals_alone_can_grow_gaussians(scene):
    changed = {"growth_gradient": 1e9, "opacity_reset": False}
    grown = IvrTrainer(scene, fit.options(**changed, normal_gradient=0.0), 100, 0, "cpu")
    still = IvrTrainer(scene, fit.options(**changed, normal_gradient=1e9), 100, 0, "cpu")
    for _ in range(25):
        grown.step()
        still.step()
    assert grown.count > 96 >= still.count
