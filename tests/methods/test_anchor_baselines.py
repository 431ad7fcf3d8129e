"""Scaffold-GS and HAC on a tiny scene of known Gaussians: what both promise to the harness."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from datasets.errors import DataError
from econgs.anchors.direct import ColorDecoders
from methods.gaussian_splatting.ply import properties, read_ply, write_ply
from methods.hac.training import Trainer as HacTrainer
from methods.interface import EstimatesBytes, Refused
from methods.scaffold_gs.model import parts_of
from methods.scaffold_gs.schedule import Schedule
from methods.scaffold_gs.training import Trainer as ScaffoldTrainer
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
def fitted(kind, tiny, scene):
    recorder = tiny.Recorder(checkpoint_at=[1])
    return kind.fit(scene, recorder, BUDGET), recorder


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


def test_networks_of_int8_take_a_quarter_and_are_drawn_as_they_are_stored(tmp_path, tiny, scene):
    fit, recorder = KINDS["hac"].fit, tiny.Recorder(checkpoint_at=[BUDGET])
    fit(scene, recorder, BUDGET)
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
        trainer = kind.trainer(scene, kind.fit.options(offsets=1), 40, seed, "cpu")
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
