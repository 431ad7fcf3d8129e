"""What vq-3dgs adds to the contract (test_contract.py): it is 3DGS, quantised well, at honest sizes."""

import json
import math

import pytest
import torch
from safetensors import safe_open

from datasets.errors import DataError
from methods.gaussian_splatting.training import PARAMETERS, Trainer
from methods.interface import Refused
from methods.vq_3dgs.model import gaussians, grouped, quantised
from methods.vq_3dgs.spec import SIZES
from methods.vq_3dgs.training import VqTrainer
from tests.methods.conftest import Fits

fit = Fits("vq-3dgs", max_gaussians=400)


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


def test_sizes_trade_bytes_for_quality(tiny, scene, fitted, tmp_path):
    model, _ = fitted
    sizes, qualities = [], []
    for size in SIZES:
        folder = tmp_path / str(size)
        folder.mkdir()
        ledger = model.save(folder, float(size))["tiny"]
        sizes.append(sum(ledger.values()))
        qualities.append(tiny.psnr(fit.method.load(folder, "cpu"), scene.validation))
    assert sizes == sorted(sizes)
    assert qualities[2] > qualities[0]
    (tmp_path / "default").mkdir()
    assert sum(model.save(tmp_path / "default")["tiny"].values()) == sizes[SIZES.index(256)]
    with pytest.raises(Refused, match="no codebooks of 100 words"):
        model.save(tmp_path / "default", 100.0)


def test_bytes_are_ids_words_and_positions(fitted, tmp_path):
    model, _ = fitted
    ledger = model.save(tmp_path, 16.0)["tiny"]
    count = model.primitives()
    assert ledger["positions"] == 6 * count
    # 2 stages of 16 words: at most one byte per group, and 2 bytes per word and stage for their frequencies.
    for group in ("color", "sh1", "scale", "rotation"):
        assert ledger[group] <= 1.02 * count + 2 * 2 * 16 + 16
    words = 2 * 2 * 16 * (3 + 9 + 15 + 21 + 3 + 4)
    assert words <= ledger["codebooks"] <= words + 2 * 256


def test_only_the_visible_is_stored_and_rotations_keep_their_sense(scene):
    trainer = VqTrainer(scene, fit.options(), 10, 0, "cpu")
    plain = trainer._plain()
    plain.logits[:10] = math.log(1 / 300)
    plain.quats[10:20] *= -3.0
    coded = quantised(plain, 1024, 1, 0)
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
