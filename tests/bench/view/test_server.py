"""The server of `bench view`: who may ask, what it answers, and how the command starts and ends."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.bench.suites.edits import given_edits, parse_edits, toml_of
from econgs_bench.bench.view.server import Server, Viewer
from econgs_bench.bench.view.sources import camera_json, found
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.formats import ply
from tests.bench.view.conftest import CAMERAS, HOSTILE, Flat, harmonic, source

CAMERA = camera_json(CAMERAS[1])
JSON = {"Content-Type": "application/json"}


def request(server: Server, path: str, body=None, method: str = "", **headers: str):
    """Status, headers and bytes of an answer; headers with _ for -."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    try:
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        data = None if body is None else json.dumps(body)
        connection.request(
            method or ("GET" if body is None else "POST"),
            path,
            data,
            (JSON if body is not None else {}) | given,
        )
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def ask(server: Server, route: str, **body):
    """Status and JSON of a route; of numbers, the facts and the arrays."""
    status, headers, data = request(server, f"/{server.token}/{route}", body)
    if headers["Content-Type"] == "application/json":
        return status, json.loads(data)
    (length,) = struct.unpack("<I", data[:4])
    facts = json.loads(data[4 : 4 + length])
    for name, (offset, kind, shape) in facts.pop("arrays").items():
        facts[name] = np.frombuffer(data, kind, int(np.prod(shape)), 4 + length + offset).reshape(shape)
    return status, facts


def test_the_page_is_isolated_and_runs_no_foreign_script(server: Server) -> None:
    status, headers, data = request(server, f"/{server.token}/")
    assert status == 200
    assert b"<canvas" in data
    assert headers["Cross-Origin-Opener-Policy"] == "same-origin"
    assert headers["Cross-Origin-Embedder-Policy"] == "require-corp"
    assert headers["X-Content-Type-Options"] == "nosniff"
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert b"style=" not in data
    assert data.count(b"<script") == data.count(b'<script type="module" src="main.js">')


@pytest.mark.parametrize("path", ["/", "/main.js", "/x/main.js", "/{token}x/", "/{token}", "/%00/", "//"])
def test_without_the_token_there_is_nothing(server: Server, path: str) -> None:
    path = path.format(token=server.token)
    assert request(server, path)[0] == 404
    assert request(server, path + "about", {})[0] == 404


@pytest.mark.parametrize(
    "name", ["../server.py", "..%2fserver.py", "%2e%2e/server.py", "server.py", "nothing.js"]
)
def test_only_files_of_the_page_are_served(server: Server, name: str) -> None:
    assert request(server, f"/{server.token}/{name}")[0] == 404


def test_other_hosts_and_origins_are_refused(server: Server) -> None:
    home, route = f"/{server.token}/", f"/{server.token}/about"
    assert request(server, home, Host="evil.example")[0] == 403
    assert request(server, home, Host=f"evil.example:{server.server_port}")[0] == 403
    assert request(server, home, Host=f"localhost:{server.server_port}")[0] == 200
    assert request(server, route, {}, Origin="http://evil.example")[0] == 403
    assert request(server, route, {}, Origin="null")[0] == 403
    assert request(server, route, {}, Origin=f"https://127.0.0.1:{server.server_port}")[0] == 403
    assert request(server, route, {}, Origin=f"http://127.0.0.1:{server.server_port}")[0] == 200
    assert request(server, route, {}, Content_Type="text/plain")[0] == 415
    assert request(server, route, {"x": "y" * (1 << 20)})[0] == 404
    assert request(server, route, method="OPTIONS")[0] == 501


def test_it_listens_on_this_machine_alone(server: Server) -> None:
    assert server.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "change",
    [
        {"matrix": [1.0] * 16}, {"matrix": [0.0] * 3}, {"width": 0}, {"width": 10**9}, {"fx": -1.0},
        {"near": float("nan")}, {"near": None},
    ],
    ids=str,
)  # fmt: skip
def test_a_camera_that_is_none_gets_a_sentence(server: Server, change) -> None:
    status, answer = ask(server, "splats", source=0, camera=CAMERA | change)
    assert status == 400
    assert answer["error"]


def test_bad_requests_get_sentences(server: Server) -> None:
    for body, words in (
        ({"source": 9}, "no source"),
        ({"source": 0, "scenes": []}, "Switch one on"),
        ({"source": 0, "edits": ["cores.palete=#fff"]}, "palette"),
        ({"source": 2}, "does not consist of Gaussians"),
        ({"source": 1, "edits": ["other.palette=#fff"]}, "palette"),
    ):
        status, answer = ask(server, "splats", **{"camera": CAMERA, **body})
        assert (status, words in answer["error"]) == (400, True), answer
    status, answer = ask(server, "truth", source=1, camera=CAMERA, background=[1, 1, 1])
    assert (status, "not at hand" in answer["error"]) == (400, True)
    assert request(server, f"/{server.token}/splats", "[" * 100_000)[0] == 400


def test_what_the_page_has_is_not_sent_again(server: Server) -> None:
    whole = ask(server, "splats", source=0, camera=CAMERA)[1]
    other = camera_json(CAMERAS[2])
    again = ask(server, "splats", source=0, camera=other, has=whole["key"])[1]
    assert "means" in whole
    assert "means" not in again
    assert np.abs(again["colors"] - whole["colors"]).max() > 0.0
    faint = ["cores.opacity=0.5"]
    assert "means" in ask(server, "splats", source=0, camera=other, has=whole["key"], edits=faint)[1]


def test_truth_comes_with_the_harness_s_own_numbers(server: Server) -> None:
    status, answer = ask(server, "truth", source=0, scenes=["cores"], camera=CAMERA, background=[1, 1, 1])
    assert status == 200
    assert answer["pixels"].shape == (64, 64, 4)
    assert set(answer["scores"]) == {"psnr", "ssim", "delta_e_uv"}
    _, drawn = ask(server, "picture", source=0, scenes=["cores"], camera=CAMERA, background=[1, 1, 1])
    over = [one["pixels"][..., :3] + (1.0 - one["pixels"][..., 3:].astype(float)) for one in (answer, drawn)]
    error = np.mean((np.round(255 * np.clip(over[0], 0, 1)) - np.round(255 * np.clip(over[1], 0, 1))) ** 2)
    assert answer["scores"]["psnr"] == pytest.approx(10 * np.log10(255**2 / error), abs=0.05)


def test_edits_survive_their_file(tmp_path: Path) -> None:
    texts = [
        "a b.palette=#2060e0", "a b.opacity=0.5", "a b.light=0,0,1", 'q"\\\n.opacity=2', "c.light=headlight",
        "[x].specular=1.5", "ä.shininess=0.25", "c.shift=-0.5",
    ]  # fmt: skip
    edits = parse_edits(texts)
    file = tmp_path / "edits.toml"
    file.write_text(toml_of(edits), encoding="utf-8")
    assert given_edits([str(file)]) == edits
    assert given_edits([str(file), "a b.opacity=3"])["a b"].opacity == 3.0
    file.write_text("opacity = 3\n")
    with pytest.raises(DataError, match=r"edits\.toml"):
        given_edits([str(file)])


def test_what_cannot_be_looked_at_is_refused_with_a_remedy(tmp_path: Path) -> None:
    def refusal(name: str) -> str:
        with pytest.raises(DataError) as error:
            found([name], tmp_path / "runs", (), "cpu")
        return str(error.value)

    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nnonsense")
    assert "broken.ply" in refusal(str(broken))
    (tmp_path / "model.glb").write_bytes(b"glTF")
    assert "splats in .glb are not read" in refusal(str(tmp_path / "model.glb"))
    assert ".ply, .spz, .sog" in refusal(str(tmp_path / "model.splat"))
    assert "no run store" in refusal("encode-0123456789abcdef")
    assert "Did you mean vortices" in refusal("vorticez")
    (tmp_path / "empty").mkdir()
    assert "empty" in refusal(str(tmp_path / "empty"))


def test_an_exported_file_and_a_dataset_are_looked_at(tmp_path: Path) -> None:
    file = tmp_path / "model.ply"
    ply.write(file, harmonic("one").scene("one"))
    first, second = found([str(file), "vortices@32"], tmp_path, (), "cpu")
    assert first.open().about()["splats"]
    assert first.open().scenes == ("model",)
    assert first.open().about()["viewer"] == "plain"
    about = second.open().about()
    assert (about["model"], about["truth"], about["splats"]) == (False, True, False)
    assert [scene["name"] for scene in about["scenes"]][:2] == ["cores", "sheaths"]
    rgb, alpha = second.open().picture(CAMERAS[0].resized(16, 16), ["cores"], {}, (1.0, 1.0, 1.0), 1)
    assert (rgb.shape, alpha.shape) == ((16, 16, 3), (16, 16))


def test_a_port_in_use_is_named() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(DataError, match="is in use"):
            Server(Viewer([source("flat", Flat())]), taken.getsockname()[1])


def test_names_that_attack_reach_the_page_as_text(server: Server) -> None:
    status, about = ask(server, "about")
    assert (status, about["sources"][3]) == (200, HOSTILE)


def test_the_command_prints_its_address_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "econgs_bench.bench", "view", "vortices@32", "--no-open"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONSAFEPATH": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # deaf to it in a shell's background
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            host, _, path = address.removeprefix("http://").partition("/")
            connection = http.client.HTTPConnection(host, timeout=60)
            connection.request("GET", f"/{path}")
            assert connection.getresponse().status == 200
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
