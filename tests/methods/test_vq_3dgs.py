"""What vq-3dgs adds to the contract (test_contract.py): it is 3DGS, quantised well, at honest sizes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.codebooks import Codebook
from econgs_bench.methods.gaussian_splatting.training import PARAMETERS, Trainer
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.quantised_scene import QuantisedScene, placed, read_folder
from econgs_bench.methods.vq_3dgs.model import gaussians, grouped, quantised
from econgs_bench.methods.vq_3dgs.training import VqTrainer
from tests.methods.conftest import Fits
from tests.methods.test_formats import asymmetric

fit = Fits("vq-3dgs", max_gaussians=400, positions="float16")


@pytest.fixture(scope="module")
def fitted(tiny, scene):
    recorder = tiny.Recorder()
    return fit(scene, recorder, 250), recorder


def test_until_it_is_quantised_it_is_3dgs_bit_for_bit(scene):
    plain = Trainer(scene, Fits("3dgs").options(max_gaussians=400), 40, 3, "cpu")
    quantising = VqTrainer(scene, fit.options(tuning=0.2), 50, 3, "cpu")
    for _ in range(40):
        assert plain.step() == quantising.step()
    for name in PARAMETERS:
        assert torch.equal(plain.optimiser[name], quantising.optimiser[name])


def test_a_fit_approaches_views_that_it_never_saw(tiny, scene, fitted):
    model, recorder = fitted
    assert tiny.psnr(model, scene.validation) > 24.0
    assert (recorder.stages[0], recorder.stages[-2], recorder.stages[-1]) == (
        "growth",
        "refinement",
        "codebooks",
    )


def test_tuning_recovers_some_of_what_few_words_lose(tiny, scene, tmp_path):
    """At the same codebooks: with and without the steps that tune them."""
    tuned = VqTrainer(scene, fit.options(codebook_size=16, stages=1, tuning=0.5, tuning_lr=3), 300, 0, "cpu")
    for _ in range(151):
        tuned.step()
    before = tiny.psnr(tuned.model(), scene.train)
    tuned.run(tiny.Recorder())
    assert tiny.psnr(tuned.model(), scene.train) > before + 0.5


@pytest.fixture(scope="module")
def plain(scene):
    """Gaussians before they are quantised."""
    trainer = VqTrainer(scene, fit.options(), 250, 0, "cpu")
    while trainer.iteration < 200:
        trainer.step()
    return trainer._plain()


def test_sizes_trade_bytes_for_quality(plain, tmp_path):
    sizes, losses = [], []
    for size in (16, 64, 256):
        coded = quantised(plain, fit.options(codebook_size=size), 0)
        sizes.append(sum(coded.write(tmp_path, "sizes").values()))
        again = gaussians(coded)
        losses.append(float((again.log_scales - plain.log_scales[-len(again.means) :]).square().mean()))
    assert sizes == sorted(sizes)
    assert losses == sorted(losses, reverse=True)


def test_bytes_are_ids_words_and_positions(plain, tmp_path):
    coded = quantised(plain, fit.options(codebook_size=16), 0)
    ledger = coded.write(tmp_path, "bytes")
    count = len(coded.positions)
    assert ledger["positions"] == 6 * count
    # 2 stages of 16 words: half a byte per group and stage, at most.
    for group in ("color", "sh1", "scale", "rotation"):
        assert ledger[group] <= 2 * math.ceil(count / 2)
    words = 2 * 2 * 16 * (3 + 9 + 15 + 21 + 3 + 4)
    assert words <= ledger["codebooks"] <= words + 2 * 256


def test_only_the_visible_is_stored_and_rotations_keep_their_sense(scene):
    trainer = VqTrainer(scene, fit.options(), 10, 0, "cpu")
    plain = trainer._plain()
    plain.logits[:10] = math.log(1 / 300)
    plain.quats[10:20] *= -3.0
    coded = quantised(plain, fit.options(codebook_size=1024, stages=1), 0)
    assert len(coded.positions) == len(plain.means) - 10
    again = gaussians(coded)
    torch.testing.assert_close(again.quats, grouped(plain)["rotation"][10:], atol=1e-3, rtol=0)
    assert (again.quats[:, 0] >= 0).all()
    torch.testing.assert_close(again.log_scales, plain.log_scales[10:], atol=2e-2, rtol=0)


def test_a_fit_too_short_to_tune_is_quantised_all_the_same(tiny, scene, tmp_path):
    model = fit(scene, tiny.Recorder(), 1)
    model.save(tmp_path)
    camera = scene.validation.cameras[0]
    assert torch.equal(fit.method.load(tmp_path, "cpu").render(camera)[0], model.render(camera)[0])


def test_a_model_under_way_renders_but_is_not_saved(tiny, scene, tmp_path):
    recorder = tiny.Recorder(checkpoint_at=[5])
    fit(scene, recorder, 20)
    recorder.models[0].render(scene.validation.cameras[0])
    with pytest.raises(Refused, match="last part"):
        recorder.models[0].save(tmp_path)


@pytest.mark.parametrize(
    "change", [{"sh degree": 9}, {"sh degree": None}, {"codebook size": "big"}, {}, None]
)
def test_metadata_that_are_not_its_own_are_named(fitted, tmp_path, change):
    from safetensors.torch import save_file

    fitted[0].save(tmp_path)
    (file,) = tmp_path.glob("tiny.*")
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()["model"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    about["about"] = about["about"] | change if change else change
    save_file(tensors, file, metadata={"model": json.dumps(about)})
    with pytest.raises(DataError, match="tiny"):
        fit.method.load(tmp_path, "cpu")


@pytest.mark.parametrize("skew", [True, False])
def test_ids_are_entropy_coded_only_where_that_is_shorter(tmp_path, skew):
    """With few ids for many words, frequencies cost more than they save."""
    count, words = (4000, 4) if skew else (100, 64)
    ids = torch.arange(count) % words
    if skew:
        ids[: count // 2] = 0
    book = Codebook(torch.linspace(-1, 1, words)[:, None].half().float(), ids)
    positions = torch.zeros(count, 3)
    scene = QuantisedScene("tiny", (1.0, 1.0, 1.0), {}, positions, {"a": (book,)}, "entropy")
    ledger = scene.write(tmp_path, "ids")
    fixed = count * book.bits // 8
    assert ledger["a"] < 0.95 * fixed if skew else ledger["a"] == fixed
    ((again, _),) = read_folder(tmp_path, "m", "ids", {"a": 1}, lambda one: one)
    assert torch.equal(again.column("a", 1), scene.column("a", 1))
    assert again.write(tmp_path, "ids") == ledger


def test_files_whose_ids_are_all_entropy_coded_are_read(tmp_path, monkeypatch):
    """Those of version 5."""
    book = Codebook(torch.linspace(-1, 1, 64)[:, None].half().float(), torch.arange(100) % 64)
    scene = QuantisedScene("tiny", (1.0, 1.0, 1.0), {}, torch.zeros(100, 3), {"a": (book,)}, "entropy")
    with monkeypatch.context() as patch:
        patch.setattr("econgs_bench.methods.shared.quantised_scene.pack_ids", lambda book: bytes(1000))
        assert scene.write(tmp_path, "ids")["a"] > 75
    ((again, _),) = read_folder(tmp_path, "m", "ids", {"a": 1}, lambda one: one)
    assert torch.equal(again.column("a", 1), scene.column("a", 1))


def test_coded_positions_take_fewer_bytes_and_every_row_stays_together(tmp_path):
    options, scene = fit.options(codebook_size=1024, stages=1), asymmetric(200)
    loose, coded = (quantised(scene, replace(options, positions=form), 0) for form in ("float16", "coded"))
    assert coded.grid.cell[0] == pytest.approx(
        0.08 * float(scene.log_scales.mean(1).median().exp()), rel=0.01
    )
    for one, error in ((loose, 2e-3), (coded, 0.5 * coded.grid.cell[0] + 1e-6)):
        rows = torch.cdist(scene.means, one.positions).argmin(1)
        assert len(rows.unique()) == 200
        assert (scene.means - one.positions[rows]).abs().max() < error
        kept = gaussians(one)
        for name in ("log_scales", "logits", "sh_dc", "sh_rest"):
            assert torch.equal(getattr(kept, name)[rows], getattr(scene, name).half().float())
    assert coded.write(tmp_path, "coded")["positions"] < 0.6 * loose.write(tmp_path, "float16")["positions"]


def test_a_fit_with_coded_positions_goes_on_and_comes_back(tiny, scene, tmp_path):
    stops = tiny.Recorder(checkpoint_at=[45])
    whole = fit(scene, stops, 50, positions="coded")
    resumed = fit(scene, tiny.Recorder(), 50, positions="coded", resume=stops.checkpoints[45])
    folders = [tmp_path / name for name in ("whole", "resumed", "again")]
    camera = scene.validation.cameras[0]
    loaded = None
    for folder, model in zip(folders, (whole, resumed, None), strict=True):
        folder.mkdir()
        (loaded if model is None else model).save(folder)
        loaded = fit.method.load(folders[0], "cpu")
    files = [(folder / "tiny.safetensors").read_bytes() for folder in folders]
    assert files[0] == files[1] == files[2]
    assert torch.equal(loaded.render(camera)[0], whole.render(camera)[0])


@pytest.mark.parametrize("scale", [1e-7, 0.01, 3.0])
@pytest.mark.parametrize("count", [1, 2, 500])
def test_positions_on_a_grid_are_the_same_when_they_are_written_again(scale, count):
    """Also where scales are smaller than what single precision tells apart."""
    generator = torch.Generator().manual_seed(0)
    means = 5.0 + torch.rand((count, 3), generator=generator)
    order, positions, grid = placed(means, torch.full((count, 3), scale).log(), 0.08)
    assert order.sort().values.tolist() == list(range(count))
    far = (positions - means[order]).abs().max()
    assert far <= 0.5 * max(grid.cell) + 1e-6
    np.testing.assert_array_equal(grid.positions(grid.codes(positions.numpy())), positions.numpy())


def test_nothing_to_place_has_no_grid():
    order, positions, grid = placed(torch.zeros(0, 3), torch.zeros(0, 3), 0.08)
    assert (len(order), positions.shape, grid) == (0, (0, 3), None)


@pytest.mark.parametrize(
    "change",
    [
        {"count": 7},
        {"count": -1},
        {"count": 1e9},
        {"count": None},
        {"extent": [1, 1, 1]},
        {"extent": [9.5, 9, 9]},
        {"extent": [1 << 16, 9, 9]},
        {"extent": [9, 9]},
        {"cell": [0.0, 1.0, 1.0]},
        {"cell": [float("inf"), 1.0, 1.0]},
        {"origin": "x"},
    ],
)
def test_damaged_grids_are_named(plain, tmp_path, change):
    from safetensors.torch import save_file

    coded = quantised(plain, fit.options(positions="coded"), 0)
    coded.write(tmp_path, "econgs-bench vq-3dgs 1")
    (file,) = tmp_path.glob("*.safetensors")
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()["model"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    del about["crc32"]
    about["grid"] |= change
    save_file(tensors, file, metadata={"model": json.dumps(about)})
    with pytest.raises(DataError, match="tiny"):
        fit.method.load(tmp_path, "cpu")
