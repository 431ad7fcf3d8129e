"""A page that is sent: opened from disk, it draws what the harness draws, and asks nobody."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.bench.suites.edits import parse_edits
from econgs_bench.bench.view.sent import part, sent
from econgs_bench.bench.view.sources import Opened
from econgs_bench.datasets.camera_paths import training_cameras
from econgs_bench.datasets.edits import Edit
from econgs_bench.methods.gaussian_splatting.model import GaussianModel
from econgs_bench.reports.page.document import write_report
from tests.bench.view.conftest import CAMERAS, HOSTILE, harmonic, shaded
from tests.bench.view.test_page import SOFTWARE, WHITE, Page, psnr
from tests.reports.conftest import Maker
from tests.reports.page.browser import executable

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium here")
ATTACK = HOSTILE + "</script><script>document.title='hit'</script>"


class Sent(Page):
    """The file, in a browser."""

    opened: Opened

    def show(self, folder: Path, opened: Opened, label: str = "a model") -> None:
        """Write the page of a model, and open it from disk."""
        parts = [part(opened, name, training_cameras(42, 0.87, 64, 64), WHITE) for name in opened.scenes]
        file = folder / "page.html"
        self.file = sent(opened, label, parts)
        file.write_text(self.file.text, encoding="utf-8", newline="\n")
        self.opened = opened
        self.problems.clear()
        self.requests.clear()
        self.open(file)
        self.settled()

    def native(self, edits: dict[str, Edit] | None = None) -> np.ndarray:
        """The picture of the model itself, on white."""
        shown = self.run("bench.scenes()")
        return self.opened.picture(self.camera(), shown, edits or {}, WHITE, None)[0]


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sent]:
    with Sent(tmp_path_factory.mktemp("profile"), *SOFTWARE) as page:
        page.emulate(1000, 700)
        yield page


@pytest.fixture
def page(driver: Sent) -> Iterator[Sent]:
    """Whatever is done with it, nothing goes wrong, and nobody is asked."""
    yield driver
    assert driver.problems == []
    assert all(one.startswith(("file:", "blob:")) for one in driver.requests), driver.requests


def opened(model, *edits: str) -> Opened:
    return Opened(model.scenes, WHITE, CAMERAS, model, edits=frozenset(edits), size=1234)


def test_harmonics_are_drawn_as_they_are(page: Sent, tmp_path: Path) -> None:
    page.show(tmp_path, opened(harmonic("other"), "opacity"))
    assert psnr(page.pixels(), page.native()) > 50.0
    page.drag(80, 30)
    page.settled()
    assert psnr(page.pixels(), page.native()) > 50.0
    page.set("#scenes input[name=opacity]", 0.5)
    page.settled()
    edited = page.native({"other": Edit(opacity=0.5)})
    assert psnr(page.pixels(), edited) > 50.0 > 30.0 > psnr(page.native(), edited)
    for hidden in ("#modes", "#save", "#models"):
        assert page.run(f"getComputedStyle(document.querySelector('{hidden}')).display") == "none"


def test_a_shaded_model_is_fitted_and_follows_its_palette(page: Sent, tmp_path: Path) -> None:
    page.show(tmp_path, opened(shaded("cores"), "palette", "opacity", "light"))
    plain = page.pixels()
    assert psnr(plain, page.native()) > 30.0
    text = page.run("document.querySelector('#scenes input[type=color]').value")
    own = np.array([int(text[i : i + 2], 16) for i in (1, 3, 5)])
    assert np.abs(own - 255 * np.array([0.7, 0.3, 0.2])).max() < 3
    page.set("#scenes input[type=color]", "#2060e0")
    page.settled()
    edited = page.native(parse_edits(["cores.palette=#2060e0"]))
    assert psnr(page.pixels(), edited) > 28.0 > psnr(plain, edited) + 5.0
    assert page.run("document.querySelectorAll('#scenes input[name=around]').length") == 0


def test_scenes_are_shown_together(page: Sent, tmp_path: Path) -> None:
    first, second = harmonic("a").scene("a"), harmonic("b", 500).scene("b")
    model = GaussianModel([first, replace(second, means=-0.9 * second.means)])
    page.show(tmp_path, opened(model, "opacity"))
    assert page.run("bench.scenes()") == ["a"]
    page.click("#scenes details:last-child input[type=checkbox]")
    page.settled()
    assert page.run("bench.scenes()") == ["a", "b"]
    assert psnr(page.pixels(), page.native()) > 50.0


def test_names_that_attack_are_text(page: Sent, tmp_path: Path) -> None:
    page.show(tmp_path, opened(harmonic(ATTACK), "opacity"), ATTACK)
    assert page.run("document.title") == page.run("document.getElementById('title').textContent") == ATTACK
    assert ATTACK in page.run("document.getElementById('scenes').textContent")
    page.set("#scenes input[name=opacity]", 0.5)
    page.settled()
    assert psnr(page.pixels(), page.native({ATTACK: Edit(opacity=0.5)})) > 50.0


def test_a_report_opens_the_pages_inside_it(page: Sent, tmp_path: Path) -> None:
    maker = Maker(tmp_path)
    for method in ("3dgs", "econgs"):
        maker.run("fuel", "core", method)
    page.show(tmp_path, opened(harmonic(ATTACK), "opacity"), ATTACK)
    models = {"measure-0000": tmp_path / "page.html"}
    report = write_report(maker.tables(), tmp_path, tmp_path / "report.html", models=models)
    (tmp_path / "page.html").unlink()
    page.open(report)
    page.run("globalThis.open = (address) => { location.href = address; }")
    page.run("for (const part of document.querySelectorAll('details')) part.open = true")
    page.run("for (const row of document.querySelectorAll('tr.row.scene')) row.cells[0].click()")
    assert page.run("document.querySelectorAll('tr.detail').length") == 2
    assert page.run("document.querySelectorAll('tr.detail a').length") == 1
    page.run("document.querySelector('tr.detail a').click()")
    page.until("document.title.startsWith('<')")
    page.settled()
    assert page.run("document.title") == ATTACK
    assert psnr(page.pixels(), page.native()) > 50.0


def test_bytes_of_gaussians_take_four_thirds_of_them() -> None:
    few, many = (
        sent(one, "a", [part(one, "a", (), WHITE)])
        for one in (opened(harmonic("a", count)) for count in (100, 5100))
    )
    assert many.half - few.half == 5000 * 2 * 59
    assert (len(many.text) - len(few.text)) / (many.half - few.half) < 1.35
    assert len(few.text) < 80_000
