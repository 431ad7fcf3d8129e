"""3dgs-coded: one fit, several codecs; what is rendered is what the file of the codec holds."""

from __future__ import annotations

import pytest
import torch

from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.coded.model import CodedModel
from econgs_bench.methods.coded.spec import CODECS, DEFAULT, SPEC
from econgs_bench.methods.gaussian_splatting.spec import SPEC as PLAIN
from econgs_bench.methods.interface import Refused, check_ledger
from econgs_bench.reports.style import RATES, label
from tests.methods.test_formats import asymmetric


def test_it_is_the_fit_of_3dgs_and_its_rates_have_names():
    assert SPEC.options is PLAIN.options
    assert SPEC.iterations == PLAIN.iterations
    assert RATES[SPEC.name] == {number: codec.name for number, codec in CODECS.items()}
    assert label(SPEC.name, "", 3.0) == "3DGS, coded @ spz"
    assert label("ivr-gs", "", 64.0) == "iVR-GS @ 64"


def test_every_codec_counts_its_bytes_and_names_itself(tmp_path):
    model = CodedModel.of([asymmetric(60)])
    for number, codec in CODECS.items():
        folder = tmp_path / codec.name
        folder.mkdir()
        ledger = model.save(folder, number)
        files = [file for file in folder.iterdir() if file.is_file()]
        check_ledger(ledger, sum(file.stat().st_size for file in files), model.scenes)
        parts = {part for part in ledger["a"] if part != "metadata"}
        assert all(part.startswith(f"{codec.name}: ") for part in parts)
        loaded = CodedModel.load(folder, "cpu")
        assert loaded.scene("a").background == (0.0, 0.5, 1.0)
        assert loaded.primitives() == 60
        again = tmp_path / f"{codec.name}-again"
        again.mkdir()
        loaded.save(again)
        assert {f.name: f.read_bytes() for f in again.iterdir()} == {f.name: f.read_bytes() for f in files}


def test_without_loss_means_every_gaussian(tmp_path):
    """Faint ones too: along a long ray they show."""
    scene = asymmetric(30)
    scene.logits[:5] = -7.0
    CodedModel.of([scene]).save(tmp_path, 1)
    kept = CodedModel.load(tmp_path, "cpu").scene("a")
    assert torch.equal(kept.logits, scene.logits)
    assert torch.equal(kept.means, scene.means)


def test_a_loaded_model_has_one_size(tmp_path):
    CodedModel.of([asymmetric(20)]).save(tmp_path)
    loaded = CodedModel.load(tmp_path, "cpu")
    other = next(number for number in CODECS if number != DEFAULT)
    with pytest.raises(Refused, match=r"loaded from files of the codec integer: it has no others"):
        loaded.save(tmp_path, other)
    with pytest.raises(Refused, match=r"no codec 99, only 1 \(ply-zstd\)"):
        loaded.save(tmp_path, 99)


def test_a_missing_file_of_gaussians_is_named(tmp_path):
    CodedModel.of([asymmetric(20)]).save(tmp_path)
    next(tmp_path.glob("*.ints")).unlink()
    with pytest.raises(DataError, match=r"a\.ints"):
        CodedModel.load(tmp_path, "cpu")
