import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from econgs_bench.bench.metrics import lpips as module
from econgs_bench.bench.metrics.lpips import (
    BACKBONES,
    checkpoints,
    declare_torchvision_operators,
    distance,
    load,
)


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    load.cache_clear()
    yield tmp_path
    load.cache_clear()


def put(network: str, monkeypatch) -> Path:
    """Random backbone weights where torch hub keeps them, whose checksum is taken for the right one."""
    declare_torchvision_operators()
    from torchvision import models

    torch.manual_seed(0)
    build = {"vgg": models.vgg16, "alex": models.alexnet}[network]
    with torch.device("meta"):
        shapes = {name: value.shape for name, value in build().state_dict().items()}
    weights = {}
    for name, shape in shapes.items():
        if name.startswith("classifier"):
            weights[name] = torch.zeros(1).expand(shape)  # unused by LPIPS; takes four bytes in the file
        else:
            fan = int(np.prod(shape[1:])) or 1
            weights[name] = torch.randn(shape) * (2.0 / fan) ** 0.5 if len(shape) > 1 else torch.zeros(shape)
    path = checkpoints() / BACKBONES[network].file
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(weights, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    known = BACKBONES[network]
    monkeypatch.setitem(BACKBONES, network, module.Backbone(known.file, digest, known.least))
    return path


def pair(size: int = 64):
    rng = np.random.default_rng(0)
    return rng.random((size, size, 3), np.float32), rng.random((size, size, 3), np.float32)


def test_looks_where_torch_hub_looks(home, monkeypatch):
    assert checkpoints() == Path(torch.hub.get_dir()) / "checkpoints"
    monkeypatch.delenv("TORCH_HOME")
    assert os.fspath(checkpoints()) == os.path.join(torch.hub.get_dir(), "checkpoints")


def test_file_names_are_those_that_torchvision_loads():
    declare_torchvision_operators()
    from torchvision.models import AlexNet_Weights, VGG16_Weights

    for network, weights in (("vgg", VGG16_Weights.IMAGENET1K_V1), ("alex", AlexNet_Weights.IMAGENET1K_V1)):
        assert weights.url.endswith("/" + BACKBONES[network].file)
        assert BACKBONES[network].sha256 in BACKBONES[network].file


def test_missing_weights_give_a_reason_and_no_download(home, monkeypatch):
    def never(*_args, **_kwargs):
        raise AssertionError("a download was tried")

    monkeypatch.setattr(torch.hub, "download_url_to_file", never)
    reason = distance("vgg", *pair())
    assert isinstance(reason, str)
    assert "`bench fetch lpips`" in reason
    assert str(home / "hub" / "checkpoints") in reason


def test_damaged_weights_give_a_reason(home):
    path = checkpoints() / BACKBONES["alex"].file
    path.parent.mkdir(parents=True)
    path.write_bytes(b"half a download")
    reason = distance("alex", *pair())
    assert isinstance(reason, str)
    assert "damaged" in reason


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_equals_the_official_package_called_directly(home, monkeypatch, network):
    put(network, monkeypatch)
    truth, render = pair(48)
    scaled, unscaled = (distance(network, truth, render, unscaled=u) for u in (False, True))
    import lpips

    official = lpips.LPIPS(net=network, verbose=False)
    a, b = (torch.from_numpy(v.transpose(2, 0, 1)[None].copy()) for v in (truth, render))
    with torch.no_grad():
        assert scaled == pytest.approx(official(a, b, normalize=True).item(), rel=1e-5)
        assert unscaled == pytest.approx(official(a, b).item(), rel=1e-5)
    assert scaled != pytest.approx(unscaled, rel=1e-3)
    assert distance(network, truth, truth) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_the_least_size_is_the_network_s_own(home, monkeypatch, network):
    put(network, monkeypatch)
    least = BACKBONES[network].least
    assert isinstance(distance(network, *pair(least)), float)
    assert "smaller" in distance(network, *pair(least - 1))
    a = torch.zeros(1, 3, least - 1, least - 1)
    with pytest.raises(RuntimeError):
        load(network, checkpoints())(a, a)
