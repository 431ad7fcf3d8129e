"""`bench fetch`: what it downloads where, what it says, and its exit codes."""

from __future__ import annotations

import gzip
import hashlib
from contextlib import contextmanager

import numpy as np
import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.bench.commands import fetch as command
from econgs_bench.bench.commands.lists import size_text
from econgs_bench.bench.metrics import lpips
from econgs_bench.datasets import download
from econgs_bench.datasets.catalogue import list_datasets, open_dataset
from tests.datasets.http_server import CONTENT, serving

ENTRY = """
acknowledgement = "the weavers of ramps"
[[files]]
path = "PATH"
url = "URL"
sha512 = "DIGEST"

[[scenes]]
name = "middle"
bumps = [{ name = "middle", range = [0.3, 0.4, 0.6, 0.7], color = [0.9, 0.6, 0.2], opacity = 0.5 }]
"""
NAME = "ramp/ramp_64x64x64_uint8.raw"


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A server, and a catalogue of the user's that names it; nothing is here yet."""
    monkeypatch.setattr(download, "PAUSES", (0.0,))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY", "BENCH_DATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    monkeypatch.setenv("BENCH_CATALOGUE", str(tmp_path))
    with serving() as running:
        write_entry(tmp_path, f"{running.url}/ramp.raw", CONTENT)
        yield running


def write_entry(folder, url, content):
    text = ENTRY.replace("URL", url).replace("DIGEST", hashlib.sha512(content).hexdigest())
    (folder / "ramp.toml").write_text(text.replace("PATH", NAME))


def row(capsys, name="ramp"):
    capsys.readouterr()
    assert main(["list", "datasets"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 120
    return next(line for line in lines if line.startswith(f"{name} "))


def test_a_missing_set_is_listed_fetched_and_used(server, tmp_path, capsys):
    assert row(capsys).split()[1:5] == ["1", "fetch,", "256", "KiB"]
    assert main(["plan", "quick", "--dataset", "ramp"]) == 2
    assert f"Run `bench fetch {tmp_path / 'ramp.toml'}` (from 127.0.0.1)" in capsys.readouterr().err
    assert main(["fetch", "ramp", "vortices@32"]) == 0
    out, err = capsys.readouterr()
    path = tmp_path / "share" / "econgs-bench" / NAME
    assert out.splitlines() == [
        f"ramp: {path}, 256 KiB, SHA512 matches",
        "vortices: procedural: it needs no files",
    ]
    assert err.splitlines() == [
        "ramp: acknowledgement: the weavers of ramps",
        "ramp: ramp_64x64x64_uint8.raw, 256 KiB, from 127.0.0.1",
    ]
    assert row(capsys).split()[1:3] == ["1", "here"]
    assert open_dataset("ramp").volume("value").values.tobytes() == CONTENT
    assert main(["fetch", "ramp"]) == 0
    assert capsys.readouterr().out == f"ramp: already here: {path}\n"
    assert len(server.requests) == 1


def test_a_zipped_file_lies_where_the_catalogue_looks(server, tmp_path, capsys):
    server.content = gzip.compress(CONTENT)
    write_entry(tmp_path, f"{server.url}/ramp.raw.gz", server.content)
    out = tmp_path / "elsewhere"
    assert main(["fetch", str(tmp_path / "ramp.toml"), "--out", str(out)]) == 0
    assert (out / f"{NAME}.gz").is_file()
    assert f"add {out} to BENCH_DATA" in capsys.readouterr().err
    dataset = open_dataset("ramp", data_dirs=[out])
    np.testing.assert_array_equal(dataset.volume("value").values.ravel(), np.frombuffer(CONTENT, np.uint8))


def test_what_fails_is_named_and_the_rest_goes_on(server, tmp_path, capsys):
    (tmp_path / "zramp.toml").write_text((tmp_path / "ramp.toml").read_text().replace(NAME, "z.npy"))
    server.faults = [("code", 404)]
    assert main(["fetch", "ramp", "combustion", "zramp"]) == 2
    err = capsys.readouterr().err
    assert "answers 404 (Not Found)" in err
    assert "combustion: cannot be fetched. Put combustion/combustion_MF_" in err
    assert "ask the authors" in err
    assert (tmp_path / "share" / "econgs-bench" / "z.npy").is_file()
    server.faults = [("code", 404)]
    assert main(["fetch", "ramp"]) == 1


def test_names_are_checked_before_anything_is_fetched(server, capsys):
    assert main(["fetch", "ramp", "lpisp"]) == 2
    assert "dataset 'lpisp': unknown name. Did you mean lpips?" in capsys.readouterr().err
    assert main(["fetch", "lpips", "--out", "here"]) == 2
    assert "Set TORCH_HOME" in capsys.readouterr().err
    assert not server.requests


def test_ctrl_c_says_what_is_kept(server, tmp_path, capsys, monkeypatch):
    @contextmanager
    def bar(name):
        def update(count, total):
            if count > 100_000:
                raise KeyboardInterrupt

        yield update

    with monkeypatch.context() as patched:
        patched.setattr(command, "_bar", bar)
        assert main(["fetch", "ramp"]) == 130
    assert "ramp_64x64x64_uint8.raw are kept, to be resumed" in capsys.readouterr().err
    assert not next(info for info in list_datasets() if info.name == "ramp").available
    assert main(["fetch", "ramp"]) == 0
    assert server.requests[1][1] is not None


def test_weights_of_lpips_go_where_the_metric_looks(server, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(lpips.Backbone, "url", property(lambda self: f"{server.url}/models/{self.file}"))
    short = hashlib.sha256(CONTENT).hexdigest()[:8]
    for network, backbone in list(lpips.BACKBONES.items()):
        monkeypatch.setitem(lpips.BACKBONES, network, lpips.Backbone(backbone.file, short, backbone.least))
    folder = lpips.checkpoints()
    folder.mkdir(parents=True)
    (folder / "vgg16-397923af.pth").write_bytes(b"damaged")
    assert main(["fetch", "lpips"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == [
        "alexnet-owt-7be5be79.pth",
        "vgg16-397923af.pth",
    ]
    assert all(lpips.is_sound(backbone, folder) for backbone in lpips.BACKBONES.values())
    capsys.readouterr()
    assert main(["fetch", "lpips"]) == 0
    assert capsys.readouterr().out == f"lpips: already here: {folder}\n"
    assert len(server.requests) == 2


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 KiB"), (262144, "256 KiB"), (3 * 2**30, "3.0 GiB")],
)
def test_sizes_for_people(count, text):
    assert size_text(count) == text
