"""The page of `bench view` in a browser, with mouse and keyboard: it draws what the harness measures."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from econgs_bench.bench.suites.edits import given_edits, parse_edits
from econgs_bench.bench.view.server import Server
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.views import over
from econgs_bench.reports.pictures.cieluv import delta_e_uv
from econgs_bench.reports.pictures.difference import colored
from tests.bench.view.conftest import HOSTILE
from tests.reports.page.browser import Browser, executable

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium here")
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
LEAST = 60.0  # dB between the page's picture and the harness's own
WHITE = (1.0, 1.0, 1.0)


class Page(Browser):
    """The viewer's page."""

    server: Server

    def settled(self) -> None:
        """Wait for full quality."""
        self.until("document.body.dataset.settled !== undefined")

    def set(self, selector: str, value: object, event: str = "input") -> None:
        """Give a control a value, as a hand would."""
        text = json.dumps(str(value))
        self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); e.value = {text};"
            f"e.dispatchEvent(new Event('{event}', {{bubbles: true}})); }})()"
        )

    def look_at(self, place: int) -> None:
        """Choose a source, and wait until it is shown."""
        self.set("#left", place, "change")
        self.until(f"bench.source(0) === {place}")
        self.settled()

    def pixels(self, which: int = 0) -> np.ndarray:
        """(height, width, 3) of one of the two pictures, on white."""
        width, height, text = self.run(
            f"(() => {{ const {{values, width, height}} = bench.read({which}); let text = '';"
            "const bytes = new Uint8Array(values.buffer);"
            "for (let i = 0; i < bytes.length; i += 32768)"
            "  text += String.fromCharCode(...bytes.subarray(i, i + 32768));"
            "return [width, height, btoa(text)]; })()"
        )
        values = np.frombuffer(base64.b64decode(text), np.float32).reshape(height, width, 4)
        return over(values, WHITE).clip(0.0, 1.0)

    def camera(self) -> Camera:
        about = self.run("bench.camera()")
        matrix = np.array(about.pop("matrix")).reshape(4, 4)
        return Camera(matrix, **about)

    def canvas(self) -> np.ndarray:
        """(height, width, 3) uint8 as shown."""
        text = self.run("bench.shot()").partition(",")[2]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB"))

    def drag(self, dx: int, dy: int, steps: int = 6, modifiers: int = 0) -> None:
        """With the left button, from the middle of the picture."""
        x, y = self.run(
            "(() => { const r = document.getElementById('canvas').getBoundingClientRect();"
            "return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        common = {"button": "left", "buttons": 1, "clickCount": 1, "modifiers": modifiers}
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **common)
        for n in range(1, steps + 1):
            place = {"x": x + dx * n / steps, "y": y + dy * n / steps}
            self.call("Input.dispatchMouseEvent", type="mouseMoved", **place, **common)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + dx, y=y + dy, **common)


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory, server: Server) -> Iterator[Page]:
    with Page(tmp_path_factory.mktemp("profile"), *SOFTWARE) as page:
        page.server = server
        page.emulate(1000, 700)
        yield page


@pytest.fixture
def page(driver: Page) -> Iterator[Page]:
    """Freshly loaded; whatever is done with it, nothing goes wrong, and nobody else is asked."""
    driver.problems.clear()
    driver.requests.clear()
    driver.open(driver.server.address)
    driver.settled()
    yield driver
    assert driver.problems == []
    assert all(one.startswith((driver.server.address, "blob:")) for one in driver.requests)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    assert a.shape == b.shape
    error = float(np.mean((a.astype(np.float64) - b) ** 2))
    return 10 * math.log10(1.0 / max(error, 1e-20))


def native(page: Page, place: int = 0, scene: str = "cores", edits: tuple[str, ...] = ()) -> np.ndarray:
    """The picture of the harness at the page's camera, on white."""
    opened = page.server.viewer.sources[place].open()
    return opened.picture(page.camera(), [scene], parse_edits(edits), WHITE, None)[0]


@pytest.mark.parametrize(("place", "scene"), [(0, "cores"), (1, "other"), (2, "cores")])
def test_the_page_draws_what_the_harness_measures(page: Page, place: int, scene: str) -> None:
    page.look_at(place)
    own = native(page, place, scene)
    assert own.min() < 0.7
    for worker in ("true", "false"):  # blended in a worker, and by WebGL
        page.run(f"bench.software({worker})")
        page.settled()
        drawn = page.pixels()
        assert drawn.shape == (400, 400, 3)
        assert psnr(drawn, own) > LEAST
        assert np.abs(page.canvas() / 255.0 - own).max() < 2.5 / 255


def test_in_a_larger_picture_too(page: Page) -> None:
    page.set("#size", 800, "change")
    page.settled()
    assert psnr(page.pixels(), native(page)) > LEAST


def test_mouse_wheel_keys_and_fingers_move_the_camera(page: Page) -> None:
    before = page.camera().camera_to_world
    frames = page.run("bench.frames()")
    page.drag(80, 30)
    page.settled()
    after = page.camera().camera_to_world
    assert np.linalg.norm(after[:3, 3]) == pytest.approx(np.linalg.norm(before[:3, 3]))
    assert np.abs(after - before).max() > 0.1
    assert page.run("bench.frames()") > frames
    assert psnr(page.pixels(), native(page)) > LEAST

    page.drag(40, 0, modifiers=8)  # shift: pan
    panned = page.camera().camera_to_world
    assert np.allclose(panned[:3, :3], after[:3, :3])
    assert np.linalg.norm(panned[:3, 3] - after[:3, 3]) > 0.05
    page.call("Input.dispatchMouseEvent", type="mouseWheel", x=300, y=300, deltaX=0, deltaY=-300)
    page.until(f"bench.camera().matrix[3] !== {panned[0, 3]}")
    page.run("document.getElementById('canvas').focus()")
    zoomed = page.camera().camera_to_world
    for key in ("ArrowLeft", "w", "d", "q", "+"):
        page.key(key)
        moved = page.camera().camera_to_world
        assert np.abs(moved - zoomed).max() > 1e-3, key
        zoomed = moved
    fingers = [{"x": 300, "y": 300, "id": 1}, {"x": 340, "y": 300, "id": 2}]
    page.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=fingers)
    apart = [fingers[0] | {"x": 260}, fingers[1] | {"x": 380}]
    page.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=apart)
    page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    assert np.abs(page.camera().camera_to_world - zoomed).max() > 1e-3
    page.settled()
    assert psnr(page.pixels(), native(page)) > LEAST
    page.click("#reset")
    assert np.allclose(page.camera().camera_to_world, before)
    page.click("#next")
    assert not np.allclose(page.camera().camera_to_world, before)


def test_an_edit_is_saved_and_replayed_to_the_same_picture(page: Page, tmp_path: Path) -> None:
    plain = page.canvas().astype(int)
    page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    page.set("#scenes input[type=color]", "#2060e0")
    page.set("#scenes input[name=opacity]", 0.5)
    page.set("#scenes input[name=specular]", 2)
    page.set("#scenes input[name=around]", 90)
    page.settled()
    assert np.abs(page.canvas() - plain).max() > 50
    page.click("#save")
    file = tmp_path / "edits.toml"
    while not file.exists():
        page.run("new Promise((done) => setTimeout(done, 50))")
    edits = given_edits([str(file)])
    opened = page.server.viewer.sources[0].open()
    assert psnr(page.pixels(), opened.picture(page.camera(), ["cores"], edits, WHITE, None)[0]) > LEAST
    page.click("#unedit")
    page.settled()
    assert np.abs(page.canvas() - plain).max() <= 1


def test_truth_and_difference_beside_the_model(page: Page) -> None:
    page.click("#modes input[value='1']")
    page.until("bench.source(1) === 0")
    page.settled()
    page.until("document.getElementById('facts').textContent.includes('ΔE*uv')")
    opened = page.server.viewer.sources[0].open()
    right = over(opened.truth(page.camera(), ["cores"], {}, None), WHITE).clip(0, 1)
    assert psnr(page.pixels(1), right) > LEAST
    model, shown = native(page), page.canvas() / 255.0
    assert np.abs(shown[:, :190] - model[:, :190]).max() < 0.01
    assert np.abs(shown[:, 210:] - right[:, 210:]).max() < 0.01
    page.click("#modes input[value='3']")
    page.settled()
    apart = np.abs(page.canvas().astype(int) - colored(delta_e_uv(model, right)))
    assert np.mean(apart.max(axis=-1) <= 3) > 0.99
    page.click("#modes input[value='2']")
    page.settled()
    assert page.canvas().shape == (400, 800, 3)


def test_two_models_under_one_camera(page: Page) -> None:
    page.click("#modes input[value='2']")
    page.set("#right", 1, "change")
    page.until("bench.source(1) === 1")
    page.drag(50, 20)
    page.settled()
    assert psnr(page.pixels(0), native(page)) > LEAST
    assert psnr(page.pixels(1), native(page, 1, "other")) > LEAST


def test_names_that_attack_are_text(page: Page) -> None:
    page.look_at(3)
    assert HOSTILE in page.run("document.getElementById('left').selectedOptions[0].textContent")
    assert HOSTILE in page.run("document.getElementById('scenes').textContent")
    assert page.run("document.title") == "bench view"
    assert psnr(page.pixels(), native(page, 3, HOSTILE)) > LEAST
    assert page.run("document.querySelectorAll('aside img').length") == 0


def test_hidden_gaussians_and_no_scene(page: Page) -> None:
    page.set("#least", 0.9)
    page.settled()
    assert (1.0 - native(page)).mean() > 1.5 * (1.0 - page.pixels()).mean()


def test_a_browser_without_webgl_gets_a_sentence(tmp_path: Path, server: Server) -> None:
    with Page(tmp_path / "profile", "--disable-webgl", "--disable-webgl2") as page:
        page.open(server.address)
        page.until("!document.getElementById('message').hidden")
        assert "no WebGL 2" in page.run("document.getElementById('message').textContent")
