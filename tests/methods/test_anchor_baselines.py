"""Scaffold-GS and HAC on a tiny scene of known Gaussians: what both promise to the harness."""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.anchors.direct import NETWORKS, ColorDecoders, decode_colors
from econgs_bench.methods.gaussian_splatting.ply import properties, read_ply, write_ply
from econgs_bench.methods.hac.training import Trainer as HacTrainer
from econgs_bench.methods.interface import EstimatesBytes, Refused
from econgs_bench.methods.scaffold_gs.model import parts_of
from econgs_bench.methods.scaffold_gs.schedule import Schedule
from econgs_bench.methods.scaffold_gs.training import Trainer as ScaffoldTrainer
from tests.methods.conftest import Fits

SMALL = {"features": 16, "offsets": 4, "voxel": 0.01}
BUDGET = 600

KINDS = {
    "scaffold-gs": SimpleNamespace(
        fit=Fits("scaffold-gs", **SMALL), trainer=ScaffoldTrainer, least=25.0,
        stages=["warm-up", "growth", "refinement"],
    ),
    "hac": SimpleNamespace(
        fit=Fits("hac", **SMALL, grid="small", context_hidden=24), trainer=HacTrainer, least=23.0,
        stages=["warm-up", "growth", "growth under noise", "growth with context model", "context model",
                "rounding"],
    ),
}  # fmt: skip


@pytest.fixture(scope="module", params=list(KINDS))
def kind(request):
    return KINDS[request.param]


@pytest.fixture(scope="module")
def fits(tiny, scene):
    """Name -> model and recorder of a whole fit, each made once."""

    @cache
    def of(name):
        recorder = tiny.Recorder(checkpoint_at=[1, BUDGET])
        return KINDS[name].fit(scene, recorder, BUDGET), recorder

    return of


@pytest.fixture
def fitted(kind, fits):
    return fits(kind.fit.spec.name)


def test_a_fit_approaches_views_that_it_never_saw(kind, tiny, scene, fitted):
    model, recorder = fitted
    assert tiny.psnr(model, scene.validation) > max(
        kind.least, tiny.psnr(recorder.models[0], scene.validation) + 6
    )
    assert recorder.stages == kind.stages
    assert len(recorder.losses) == BUDGET
    assert model.primitives() == model.primitives("tiny") > 0


def test_attributes_that_overflow_when_they_are_decoded_are_refused(tmp_path, tiny, scene):
    fit = KINDS["scaffold-gs"].fit
    fit(scene, tiny.Recorder(), 4).save(tmp_path)
    (file,), parts = tmp_path.glob("*.ply"), parts_of(SMALL["features"], SMALL["offsets"])
    rows = read_ply(file, parts)
    rows[0, properties(parts).index("f_anchor_feat_3")] = 1e30
    write_ply(file, rows, parts)
    with pytest.raises(DataError, match=r"tiny.ply: holds an attribute of more than 1e\+06"):
        fit.method.load(tmp_path, "cpu")


@pytest.mark.parametrize("storage", ["read", "released"])
def test_a_file_has_the_columns_that_are_asked_for_and_either_is_read(tmp_path, tiny, scene, storage):
    fit = KINDS["scaffold-gs"].fit
    model = fit(scene, tiny.Recorder(), 5, storage=storage)
    ledger = model.save(tmp_path)["tiny"]
    (file,), count = tmp_path.glob("*.ply"), model.primitives()
    columns = 3 + 3 * SMALL["offsets"] + SMALL["features"] + 6 + (8 if storage == "released" else 0)
    assert file.stat().st_size - ledger["header"] == 4 * columns * count
    assert sum(size for part, size in ledger.items() if part.startswith("unused")) == (
        32 * count if storage == "released" else 0
    )
    loaded, camera = fit.method.load(tmp_path, "cpu"), scene.validation.cameras[0]
    assert torch.equal(loaded.render(camera)[0], model.render(camera)[0])
    (tmp_path / "again").mkdir()
    assert loaded.save(tmp_path / "again")["tiny"] == ledger
    if storage == "released":
        unused = read_ply(file, {"unused": ("nx", "ny", "nz", "opacity", "rot_0", "rot_1", "rot_2", "rot_3")})
        assert (unused == np.float32([0, 0, 0, np.log(0.1 / 0.9), 1, 0, 0, 0])).all()


def test_decoders_have_the_width_that_is_asked_for_also_once_loaded(tmp_path, kind, tiny, scene):
    for hidden, width in ((0, SMALL["features"]), (7, 7)):
        model = kind.fit(scene, tiny.Recorder(), 5, hidden=hidden)
        (tmp_path / str(hidden)).mkdir()
        model.save(tmp_path / str(hidden))
        loaded, camera = kind.fit.method.load(tmp_path / str(hidden), "cpu"), scene.validation.cameras[0]
        decoders = loaded.scene("tiny").decoders
        assert {decoders.network(name).first_weight.shape[0] for name in NETWORKS} == {width}
        assert torch.equal(loaded.render(camera)[0], model.render(camera)[0])


def test_rates_are_constant_or_end_at_the_share_that_is_asked_for(kind, scene):
    def rates(**changed):
        trainer = kind.trainer(scene, kind.fit.options(**changed), 100, 0, "cpu")
        names = [*map(trainer.anchors.name, ("features", "log_scalings")), "covariance"]
        for trainer.iteration in (1, 100):
            yield [trainer.learning_rates()[one] for one in names]

    for decay in ("linear", "exponential"):
        assert list(rates(decay=decay)) == [[7.5e-3, 7e-3, 4e-3]] * 2
        first, last = rates(decay=decay, feature_lr=2e-2, last_lr_share=0.05)
        assert first == pytest.approx([2e-2, 7e-3, 4e-3], rel=0.05)
        assert last == pytest.approx([1e-3, 3.5e-4, 2e-4])


def test_the_first_opacity_is_that_of_all_gaussians_whatever_the_seed_draws(kind, scene):
    for seed in range(3):
        options = kind.fit.options(offsets=3, start_opacity=0.05)
        trainer = kind.trainer(scene, options, 100, seed, "cpu")
        values, positions = trainer.attributes(trainer.anchors), trainer.anchors.positions
        views = [
            decode_colors(positions, *values, trainer.decoders, camera.position).raw_opacities
            for camera in scene.train.cameras
        ]
        means = torch.stack(views).mean(dim=(0, 1))
        assert torch.allclose(means, torch.full((3,), 0.05), atol=5e-3)


@pytest.mark.parametrize("depth", [1.0, 30.0])
def test_gaussians_that_have_all_vanished_are_shown_again(depth, kind, scene):
    """As the rescue of the loss of alpha: without that loss, and of a scene without alpha, they stay away."""

    def drawn(scene=scene, **changed):
        trainer = kind.trainer(scene, kind.fit.options(offsets=3, **changed), 100, 0, "cpu")
        trainer.step()
        with torch.no_grad():
            trainer.decoders.network("opacity").second_bias -= depth
        for _ in range(8):
            trainer.step()
        values, positions = trainer.attributes(trainer.anchors), trainer.anchors.positions
        camera = scene.train.cameras[0]
        return len(decode_colors(positions, *values, trainer.decoders, camera.position).slots)

    train = replace(scene.train, images=scene.train.images * np.float32([1, 1, 1, 0]))
    assert drawn(alpha_weight=0.3) > 0
    assert drawn(alpha_weight=0.0) == 0
    assert drawn(replace(scene, train=train), alpha_weight=0.3) == 0


def test_networks_of_int8_take_a_quarter_and_are_drawn_as_they_are_stored(tmp_path, fits, scene):
    fit, (_, recorder) = KINDS["hac"].fit, fits("hac")
    pictures, networks = {}, {}
    for precision in ("float32", "int8"):
        options = fit.options(decoder_precision=precision)
        model = fit.method.restore(recorder.checkpoints[BUDGET], options, "cpu")
        (tmp_path / precision).mkdir()
        networks[precision] = model.save(tmp_path / precision)["tiny"]["decoders"]
        loaded = fit.method.load(tmp_path / precision, "cpu")
        pictures[precision] = model.render(scene.validation.cameras[0])[0]
        assert torch.equal(loaded.render(scene.validation.cameras[0])[0], pictures[precision])
    assert networks["int8"] < 0.4 * networks["float32"]  # with names and a scale a row
    assert 0 < (pictures["int8"] - pictures["float32"]).square().mean() < 1e-4


def test_a_model_of_another_method_is_refused(tmp_path, tiny, scene):
    models = [kind.fit(scene, tiny.Recorder(), 5) for kind in KINDS.values()]
    for kind, other in zip(KINDS.values(), reversed(models), strict=True):
        with pytest.raises(Refused, match="of its own only"):
            kind.fit.method.compose(models)
        folder = tmp_path / other.method
        folder.mkdir()
        other.save(folder)
        with pytest.raises(DataError, match="no saved"):
            kind.fit.method.load(folder, "cpu")


def test_bytes_are_estimated(tmp_path, fitted):
    model, _ = fitted
    model.save(tmp_path)
    assert isinstance(model, EstimatesBytes)
    assert 0 <= sum(file.stat().st_size for file in tmp_path.iterdir()) - model.bytes_estimate() < 4096


def test_a_fit_may_lose_every_anchor(kind, tiny, scene, tmp_path):
    trainer = kind.trainer(scene, kind.fit.options(), 40, 0, "cpu")
    trainer.anchors.keep(trainer.optimiser, torch.zeros(len(trainer.anchors), dtype=torch.bool))
    recorder = tiny.Recorder()
    trainer.run(recorder)
    bare = trainer.model()
    assert bare.primitives() == 0
    assert any("no anchors left" in stage for stage in recorder.stages)
    bare.save(tmp_path)
    camera = tiny.look_at([3.0, 0.0, 0.0])
    assert torch.equal(kind.fit.method.load(tmp_path, "cpu").render(camera)[0], torch.ones(32, 32, 3))


def test_what_cannot_be_fitted_is_refused(kind, tiny, scene):
    empty = tiny.with_cloud(scene, np.zeros((0, 3)))
    with pytest.raises(Refused, match="empty"):
        kind.fit(empty, tiny.Recorder(), 5)
    assert kind.fit(empty, tiny.Recorder(), 5, start="random", random_points=50).primitives() > 0
    with pytest.raises(Refused, match="more than max_anchors"):
        kind.fit(scene, tiny.Recorder(), 5, max_anchors=3)
    with pytest.raises(Refused, match="cells"):
        kind.fit(scene, tiny.Recorder(), 5, init_factor=4)


def test_a_start_that_shows_nothing_is_turned_and_no_other(kind, scene):
    """With one offset about half of all seeds make it invisible."""
    turned = 0
    for seed in range(12):
        trainer = kind.trainer(scene, kind.fit.options(offsets=1, start_opacity=0.0), 40, seed, "cpu")
        drawn = torch.Generator().manual_seed(seed)
        network = ColorDecoders(16, 1, distance=trainer.distance, generator=drawn).network("opacity")
        own = trainer.decoders.network("opacity")
        assert torch.equal(own.first_weight, network.first_weight)
        same = torch.equal(own.second_weight, network.second_weight)
        assert same or torch.equal(own.second_weight, -network.second_weight)
        turned += not same
        model = trainer.model()
        assert max(model.render(camera)[1].max() for camera in scene.train.cameras) > 0.0
        before = own.second_weight.clone()
        for _ in scene.train.cameras:  # each view once
            trainer.step()
        assert not torch.equal(before, trainer.decoders.network("opacity").second_weight)
    assert 0 < turned < 12


@pytest.mark.parametrize("fit", [kind.fit for kind in KINDS.values()] + [Fits("econgs", hidden=24, **SMALL)])
def test_growth_stops_at_the_limit(fit, tiny, scene):
    recorder = tiny.Recorder()
    limit = len(np.unique(np.round(scene.cloud.points / 0.01), axis=0)) + 5
    fit(scene, recorder, 300, max_anchors=limit, growth_gradient=0.0)
    assert max(recorder.counts) == limit
    assert any("stopped at" in stage for stage in recorder.stages)


def test_the_schedule_is_the_published_one_at_its_budget():
    plain, coding = Schedule(30_000), Schedule(30_000, coding=True)
    grown = [i for i in range(1, 30_001) if plain.grows(i)]
    assert (grown[0], grown[-1], len(grown)) == (1_600, 14_900, 134)
    assert (plain.visits(40.0), plain.visits(80.0)) == (40.0, 80.0)
    paused = set(grown) - {i for i in grown if coding.grows(i)}
    assert (min(paused), max(paused)) == (3_000, 3_900)
    assert next(i for i in range(1, 30_001) if coding.noisy(i)) == 3_001
    assert next(i for i in range(1, 30_001) if coding.coded(i)) == 10_001
    assert not any(plain.noisy(i) or plain.coded(i) or plain.exact(i) for i in (5_000, 20_000, 30_000))
    assert sum(Schedule(600, coding=True).grows(i) for i in range(601)) >= 10


def test_what_hangs_on_the_context_model_begins_with_it(tiny, scene):
    early, late = (Schedule(1_000, coding=True, context_share=share) for share in (0.1, 0.7))
    assert [next(i for i in range(1_001) if one.coded(i)) for one in (early, late)] == [101, 701]
    assert [next(i for i in range(1_001) if one.noisy(i)) for one in (early, late)] == [101, 101]
    assert [[i for i in range(1_001) if one.prunes_by_contribution(i)] for one in (early, late)] == [
        [501, 751],
        [701, 851],
    ]
    for iterations in range(1, 30_001, 7):
        published = max(1, round(10_000 * iterations / 30_000))
        assert Schedule(iterations, coding=True).context_start == published
    recorder = tiny.Recorder(checkpoint_at=[30, 40])
    KINDS["hac"].fit(scene, recorder, 50, context_start=0.7)
    contexts = [model.groups[0].context for model in recorder.models]
    assert [context is None for context in contexts] == [True, False]


def test_the_context_model_is_as_wide_as_the_first_anchors_ask_for(tmp_path, tiny, scene):
    cloud = np.random.default_rng(0).uniform(-0.5, 0.5, (900, 3))
    many, fit = tiny.with_cloud(scene, cloud), KINDS["hac"].fit
    sizes, widths = [], []
    for hidden in (0, 100):
        model = fit(many, tiny.Recorder(), 20, context_hidden=hidden, start_spacing=0.0)
        folder = tmp_path / str(hidden)
        folder.mkdir()
        sizes.append(model.save(folder)["tiny"]["context head"])
        loaded, camera = fit.method.load(folder, "cpu"), scene.validation.cameras[0]
        widths.append(loaded.groups[0].context.config.hidden)
        assert torch.equal(loaded.render(camera)[0], model.render(camera)[0])
    first = len(np.unique(np.round(cloud / SMALL["voxel"]), axis=0))
    assert widths == [first // 100, 100]
    assert sizes[0] < 0.2 * sizes[1]


def test_masks_learn_in_proportion_to_the_extent(scene):
    def rates(extent):
        options = KINDS["hac"].fit.options(configuration="paper", random_points=50)
        trainer = HacTrainer(replace(scene, extent=extent), options, 100, 0, "cpu")
        for trainer.iteration in (0, 100):
            yield trainer.learning_rates()[trainer.anchors.name("masks")]

    assert list(rates(1.0)) == pytest.approx([1e-2, 1e-4])
    assert list(rates(4.4)) == pytest.approx([4.4e-2, 4.4e-4])


def test_anchors_without_an_offset_are_pruned_while_growth_lasts_and_cost_no_bits(scene):
    options = KINDS["hac"].fit.options(growth_gradient=1e3, prune_loss_db=0.0)
    trainer = HacTrainer(scene, options, 400, 0, "cpu")
    masks, count = trainer.optimiser[trainer.anchors.name("masks")], len(trainer.anchors)
    places = trainer.anchors.positions[:5].clone()
    with torch.no_grad():
        masks[:5] = -20.0
    trainer.iteration = trainer.schedule.context_start
    for _ in range(4):
        trainer.step()
        assert len(trainer.anchors) == count
        gradient = trainer.optimiser[trainer.anchors.name("features")].grad
        assert gradient.any()
        assert not gradient[:5].any()
    assert int((trainer.anchors.statistics.visits[:5] > 0).sum()) > 0
    assert float(trainer.anchors.statistics.opacities[:5].sum()) == 0.0
    while trainer.iteration < trainer.schedule.growth_stop:
        trainer.step()
    assert len(trainer.anchors) <= count - 5
    assert not (trainer.anchors.positions[:, None] == places).all(-1).any()


def test_hac_pays_for_the_share_of_anchors_that_are_there(scene):
    """Anchors without an offset are not coded: their bits must not weigh in the loss."""

    def rate(gone):
        trainer = HacTrainer(scene, KINDS["hac"].fit.options(rate_weight=1.0), 100, 0, "cpu")
        masks = trainer.optimiser[trainer.anchors.name("masks")]
        with torch.no_grad():
            masks[:gone] = -20.0
        trainer.iteration = trainer.schedule.context_start + 1
        rows = torch.arange(gone, len(masks))  # the visible ones are the same in both
        values = trainer.attributes(trainer.anchors)
        trainer.begin_coding()
        trainer.generator.manual_seed(0)
        whole = trainer.prepare(values.of(rows), rows).losses["rate"]
        trainer.generator.manual_seed(0)
        all_there = partial(torch.ones(len(rows), 4).index_select, 0)
        bits = trainer.coding.apply(
            trainer.anchors, values.of(rows), rows, len(masks), trainer.iteration, all_there
        )[1]
        return float((whole - bits.grid).detach()), float(bits.attributes.detach()), len(masks)

    whole, bits, count = rate(0)
    assert whole == pytest.approx(bits, rel=1e-4)
    whole, bits, count = rate(count // 2)
    assert whole == pytest.approx(bits * (count - count // 2) / count, rel=1e-4)


def test_the_context_model_begins_with_the_attributes_of_its_anchors(scene):
    trainer = HacTrainer(scene, KINDS["hac"].fit.options(), 100, 0, "cpu")
    values = trainer.attributes(trainer.anchors)
    for trainer.iteration in range(1, 60):
        trainer.begin_coding()
    mean, _ = trainer.coding.model.distribution(torch.zeros(1, 24))
    torch.testing.assert_close(mean[0], values.flat.mean(0), rtol=1e-4, atol=1e-5)


def test_hac_pays_for_bits_and_masks(tiny, scene):
    """A larger lambda makes smaller streams; a larger weight of masks pushes them down."""
    kind = KINDS["hac"]
    sizes = [kind.fit(scene, tiny.Recorder(), 200, rate_weight=w).bytes_estimate() for w in (0.0, 0.05)]
    assert sizes[1] < 0.5 * sizes[0]
    masks = []
    for weight in (0.0, 0.1):
        trainer = HacTrainer(scene, kind.fit.options(mask_weight=weight), 200, 0, "cpu")
        trainer.run(tiny.Recorder())
        masks.append(float(trainer.optimiser[trainer.anchors.name("masks")].detach().mean()))
    assert masks[1] < masks[0] - 1.0
