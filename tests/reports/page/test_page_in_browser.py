"""The page as a reader uses it: opened from disk in a browser, with mouse and keyboard."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import Mock, patch

import pytest

from econgs_bench.reports.page import document as page_module
from econgs_bench.reports.pictures import panel_files
from econgs_bench.reports.style import MISSING
from tests.reports.conftest import METHODS, Maker, fill
from tests.reports.page.browser import Browser, executable

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium here")
SLOWER = 2.0  # than the machines that readers have: cores here are shared, and so are their caches
CHART = (
    "Array.from(document.querySelectorAll('svg.chart'))"
    ".find((chart) => chart.nextElementSibling?.textContent.includes('\"keys\"'))"
)
POINT = (  # place of the first point that has rows, its row and the title of its series
    f"(() => {{ const c = {CHART};"
    "const d = JSON.parse(c.nextElementSibling.textContent), s = d.series.find((s) => s.keys);"
    "const m = c.getScreenCTM(), [left, top, width, height] = d.box;"
    "const x = left + width * Math.log(s.x[0] / d.x.low) / Math.log(d.x.high / d.x.low);"
    "const y = top + height * (d.y.high - s.y[0]) / (d.y.high - d.y.low);"
    "return [m.e + m.a * x, m.f + m.d * y, s.keys[0][0], s.title]; })()"
)
VISIBLE = "Array.from(document.querySelectorAll('tr.row')).filter((row) => row.offsetParent)"


def write(maker: Maker) -> Path:
    """The page alone: the files beside it and the paper's tables have tests of their own."""
    with (
        patch.object(page_module, "write_files"),
        patch.object(page_module.chart_files, "output", return_value=nullcontext(Mock())),
        patch.object(page_module, "paper_tables", return_value=[]),
        patch.object(panel_files, "write", return_value="panel"),
    ):
        return page_module.write_report(maker.tables(), maker.root, maker.root / "report.html")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three datasets, three scenes each, eight methods, one failed; pictures of one scene."""
    maker = Maker(tmp_path_factory.mktemp("page"))
    for method, psnr in (("3dgs", 33.0), ("econgs", 36.0), ("hac", 30.0)):
        maker.run("fuel", "core", method, psnr=psnr, views=3)
    maker.run("fuel", "jet", "econgs", status="oom", reason="<b>no memory</b>")
    with patch.object(Maker.run, "__defaults__", (*Maker.run.__defaults__[:-1], 0)):  # no pictures
        fill(maker, "many")
    return write(maker)


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture
def browser(driver: Browser, page: Path) -> Iterator[Browser]:
    """The page, freshly loaded; whatever is done with it, nothing goes wrong and nothing is fetched."""
    driver.emulate(1400, 1000)
    driver.problems.clear()
    driver.requests.clear()
    driver.open(page)
    driver.run("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    assert all("mean" in kind for kind in driver.run(f"{VISIBLE}.map((row) => row.className)"))
    driver.choose("[data-filter=kind]", "")
    yield driver
    assert driver.problems == []
    assert driver.requests == [page.resolve().as_uri()]


def column(browser: Browser, name: str, rows: str = VISIBLE) -> list[str]:
    """Texts of a column's visible cells."""
    return list(browser.run(f"{rows}.map((row) => row.cells[{place(browser, name)}].textContent)"))


def place(browser: Browser, name: str) -> int:
    """Index of a column."""
    heads = browser.run("Array.from(document.querySelectorAll('.results thead th'), (h) => h.textContent)")
    return int(heads.index(name))


def head(browser: Browser, name: str) -> str:
    """Selector of a column's button."""
    return f".results thead th:nth-child({place(browser, name) + 1}) button"


def write_filter(browser: Browser, words: str) -> None:
    """Type into the filter of the rows."""
    browser.run("document.querySelector('[data-filter=text]').focus()")
    for letter in words:
        browser.key(letter)


def test_it_asks_for_nothing_and_would_be_refused(browser: Browser) -> None:
    assert browser.run("fetch('data:text/plain,x').then(() => 'fetched', () => 'refused')") == "refused"
    script = "document.body.append(Object.assign(document.createElement('script'), {text: 'window.bad = 1'}))"
    assert browser.run(f"{script}; window.bad") is None
    browser.problems.clear()  # the refusals themselves


def test_rows_sort_by_click_within_datasets_and_means_stay_below(browser: Browser) -> None:
    before = column(browser, "PSNR [dB]")
    browser.click(head(browser, "PSNR [dB]"))
    assert browser.run("document.querySelectorAll('.results tbody:has(tr)').length") == 4
    assert browser.run("document.querySelector('th[aria-sort]').ariaSort") == "descending"
    for i in range(1, 5):
        rows = f"Array.from(document.querySelectorAll('.results tbody:nth-of-type({i}) tr'))"
        kinds = browser.run(f"{rows}.map((row) => row.classList[0] + (row.classList[1] ?? ''))")
        assert kinds[0] == "group"
        assert kinds[1:] == sorted(kinds[1:], key=["rowscene", "rowmean"].index)
        names = column(browser, "PSNR [dB]", f"{rows}.filter((row) => row.classList.contains('scene'))")
        present = [float(text.split()[0]) for text in names if text != MISSING]  # ≈ may follow
        assert present == sorted(present, reverse=True)
        assert names[: len(present)] == [text for text in names if text != MISSING]  # the missing stand last
    browser.click(head(browser, "PSNR [dB]"))
    assert browser.run("document.querySelector('th[aria-sort]').ariaSort") == "ascending"
    browser.click(head(browser, "PSNR [dB]"))
    assert browser.run("document.querySelector('th[aria-sort]')") is None
    assert column(browser, "PSNR [dB]") == before


def test_rows_sort_by_keyboard_across_datasets(browser: Browser) -> None:
    browser.run("document.querySelector('#flat').focus()")
    browser.key(" ")
    browser.run(f"document.querySelector({json.dumps(head(browser, 'Size [MiB]'))}).focus()")
    browser.key("Enter")
    scenes = f"{VISIBLE}.filter((row) => row.classList.contains('scene'))"
    sizes = [float(text) for text in column(browser, "Size [MiB]", scenes) if text != MISSING]
    assert sizes == sorted(sizes)
    datasets = browser.run(f"{scenes}.slice(0, 12).map((row) => row.dataset.dataset)")
    assert len(set(datasets)) > 1
    assert all(" / " in text for text in column(browser, "Scene", scenes))
    assert not browser.run("document.querySelector('tr.group').offsetParent")


def test_filters_leave_what_fits_and_say_how_much(browser: Browser) -> None:
    total = len(column(browser, "Method"))
    write_filter(browser, "fuel jet")
    assert column(browser, "Method") == ["ECoNGS-R oom"]
    assert browser.run("document.querySelector('#count').textContent") == f"1 of {total} rows"
    assert browser.run(f"{VISIBLE}.length") == 1
    groups = "Array.from(document.querySelectorAll('tr.group')).filter((g) => g.offsetParent)"
    groups = browser.run(f"{groups}.map((g) => g.innerText)")
    assert groups == ["fuel"]
    browser.click("#reset")
    assert 0 < len(column(browser, "Method")) < total  # the means again
    browser.choose("[data-filter=status]", "oom")
    assert column(browser, "Scene") == ["fuel / jet"]
    browser.choose("[data-filter=status]", "")
    browser.choose("[data-filter=method]", "HAC")
    browser.choose("[data-filter=kind]", "mean")
    assert len(column(browser, "Method")) == 4
    assert set(column(browser, "Method")) == {"HAC"}


def test_a_row_opens_to_its_provenance_and_stays_with_it(browser: Browser) -> None:
    browser.run("document.querySelector('tr.row th button').focus()")
    browser.key("Enter")
    details = browser.run("document.querySelector('tr.detail').innerText")
    for words in ("measure-0000", "68a71d8fe012", "laptop", "12.3 ms"):
        assert words in details
    assert browser.run("document.activeElement.ariaExpanded") == "true"
    browser.click(head(browser, "SSIM"))
    assert browser.run("document.querySelector('tr.detail').previousSibling.dataset.key") == "measure-0000"
    browser.click("tr.row.marked td:nth-child(2)")
    assert not browser.run("document.querySelector('tr.detail').offsetParent")


def test_points_of_charts_and_rows_are_linked(browser: Browser) -> None:
    # Cards get their height as they come into sight, and a scroll hides the tip:
    # like a reader's hand, the mouse follows the point until it has it.
    browser.run(f"{CHART}.scrollIntoView({{block: 'center'}})")
    for _ in range(100):
        point = browser.run(POINT)
        browser.point(point[0] + 1, point[1], press=False)
        browser.point(*point[:2], press=False)
        if browser.run("!!document.querySelector('tr.row.hit')") and browser.run(POINT) == point:
            break
    assert browser.run("document.querySelector('tr.row.hit').dataset.key") == point[2]
    assert browser.run("document.querySelector('.tip b').textContent") == point[3]
    browser.point(*point[:2])
    browser.until("!!document.querySelector('tr.row.marked')")
    assert browser.run("document.querySelector('tr.row.marked').dataset.key") == point[2]
    assert browser.run("document.activeElement.closest('tr').dataset.key") == point[2]
    rings = "Array.from(document.querySelectorAll('.chart .marked'), (ring) => ring.dataset.key)"
    assert set(browser.run(rings)) == {point[2]}
    browser.point(3, 3, press=False)
    browser.until("document.querySelector('.tip').hidden && !document.querySelector('tr.row.hit')")


def test_pictures_are_compared_with_the_keyboard_alone(browser: Browser) -> None:
    pictures = "Array.from(document.querySelectorAll('#compare .stage img'))"
    names = f"{pictures}.filter((i) => !i.hidden).map((i) => i.alt)"
    browser.run("document.querySelector('button.compare').focus()")
    browser.key("Enter")
    assert browser.run("document.querySelector('#compare').open")
    view = browser.run("document.querySelector('#compare h3').textContent")
    assert browser.run(names) == [f"{view}: Ground truth", f"{view}: 3DGS"]
    browser.run("document.querySelector('#compare input[type=range]').focus()")
    browser.key("ArrowRight")
    assert browser.run("document.querySelector('#compare .stage').style.getPropertyValue('--at')") == "51%"
    browser.key("f")  # from slider to flip: the other picture
    assert browser.run(names) == [f"{view}: 3DGS"]
    browser.key("f")
    assert browser.run(names) == [f"{view}: Ground truth"]
    assert (
        browser.run("document.querySelector('#compare [role=status]').textContent") == "Shown: Ground truth"
    )
    # Any two models, and the ground truth in place of the one that is shown.
    for side, name in (("a", "ECoNGS-R"), ("b", "HAC")):
        browser.choose(f"#compare select[data-side={side}]", name)
    assert browser.run(names) == [f"{view}: ECoNGS-R"]
    browser.key("f")
    assert browser.run(names) == [f"{view}: HAC"]
    browser.key("g")
    assert browser.run(names) == [f"{view}: Ground truth"]
    browser.key("n")
    other = browser.run("document.querySelector('#compare h3').textContent")
    assert other != view
    assert browser.run(names) == [f"{other}: ECoNGS-R"]
    browser.key("Escape")
    assert not browser.run("document.querySelector('#compare').open")
    assert browser.run("document.activeElement.className") == "compare"


def test_the_first_picture_of_the_page_has_a_slider(browser: Browser) -> None:
    stage = "document.querySelector('div.comparison .stage')"
    names = f"Array.from({stage}.querySelectorAll('img')).map((i) => i.alt.split(': ')[1])"
    assert browser.run(f"{stage}.checkVisibility()")
    assert browser.run(names) == ["Ground truth", "3DGS"]
    first = browser.run("document.querySelector('figure.panel').getBoundingClientRect().top")
    assert browser.run(f"{stage}.getBoundingClientRect().bottom") < first
    browser.choose("div.comparison select[data-side=b]", "ECoNGS-R")
    browser.run("document.querySelector('div.comparison input[type=range]').focus()")
    browser.key("ArrowLeft")
    assert browser.run(f"{stage}.style.getPropertyValue('--at')") == "49%"
    browser.key("g")
    assert browser.run(names) == ["Ground truth", "Ground truth"]
    assert not browser.run("document.querySelector('#compare').open")


def test_light_and_dark_follow_the_system_until_told(browser: Browser, page: Path) -> None:
    background = "getComputedStyle(document.body).backgroundColor"
    light = browser.run(background)
    browser.emulate(1400, 1000, "dark")
    dark = browser.run(background)
    assert dark != light
    browser.click("#theme")
    assert browser.run(background) == light
    browser.call("Page.reload")
    browser.until("document.readyState === 'complete' && !document.querySelector('#theme').hidden")
    assert browser.run(background) == light
    browser.run("localStorage.clear()")
    browser.requests[:] = browser.requests[:1]


def test_text_can_be_read_on_its_background(browser: Browser) -> None:
    """WCAG AA: 4.5 to 1, of whatever text is there."""
    script = """(() => {
      const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
      const light = (c) => c.slice(0, 3).map((v) => v / 255)
        .map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
        .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
      const behind = (e) => { for (; e; e = e.parentElement) {
        const c = rgb(getComputedStyle(e).backgroundColor); if (c.length < 4 || c[3] > 0) return c; }
        return [255, 255, 255]; };
      const bad = new Set();
      for (const e of document.querySelectorAll('.page *')) {
        const own = Array.from(e.childNodes).some((n) => n.nodeType === 3 && n.textContent.trim());
        if (!own || !e.checkVisibility() || e.closest('svg, script')) continue;
        const [a, b] = [light(rgb(getComputedStyle(e).color)), light(behind(e))].sort((x, y) => y - x);
        if ((a + 0.05) / (b + 0.05) < 4.5) bad.add(`${e.className}: ${e.textContent.slice(0, 30)}`);
      }
      return Array.from(bad);
    })()"""
    browser.click("tr.row th button")
    for scheme in ("light", "dark"):
        browser.emulate(1400, 1000, scheme)
        assert browser.run(script) == []


@pytest.mark.parametrize("width", [400, 1400])
def test_only_tables_and_panels_scroll_sideways(browser: Browser, width: int) -> None:
    browser.emulate(width, 900)
    assert browser.run("document.documentElement.scrollWidth") <= width


def test_print_shows_every_row_and_no_controls(browser: Browser) -> None:
    write_filter(browser, "jet")
    assert len(column(browser, "Method")) == 1
    browser.call("Emulation.setEmulatedMedia", media="print")
    rows = browser.run("document.querySelectorAll('tr.row').length")
    assert browser.run(f"{VISIBLE}.length") == rows > 80
    for control in (".controls", "nav", "#theme", "button.compare"):
        assert not browser.run(f"document.querySelector('{control}').checkVisibility()")
    browser.call("Emulation.setEmulatedMedia", media="")


def test_a_thousand_rows_are_there_in_two_seconds(driver: Browser, tmp_path: Path) -> None:
    """Seconds of the processor, the least of three, so that little depends on what else runs here."""
    maker = Maker(tmp_path)
    for i in range(1000):
        method, (psnr, size, fps, seconds) = list(METHODS.items())[i % 8]
        scene = i // 8
        maker.run(
            f"set{scene // 16}", f"tf{scene % 16}", method, psnr=psnr + scene % 5, size=size, fps=fps,
            seconds=seconds, views=0,
        )  # fmt: skip
    page = write(maker)
    driver.emulate(1400, 1000)
    driver.call("Performance.enable", timeDomain="threadTicks")
    loads, sorts = [], []
    for _ in range(3):
        driver.open(page)
        loads.append(busy(driver))
        driver.click(head(driver, "PSNR [dB]"))
        driver.run("document.body.offsetHeight")
        sorts.append(busy(driver) - loads[-1])
    assert driver.run("document.querySelectorAll('tr.row').length") > 1000
    print(f"loaded in {min(loads):.2f} s, sorted in {min(sorts):.2f} s, {page.stat().st_size / 1e6:.1f} MB")
    assert min(loads) < 2.0 * SLOWER
    assert min(sorts) < 1.0 * SLOWER


def busy(browser: Browser) -> float:
    """Seconds that the page's main thread has computed since the page was opened."""
    metrics = browser.call("Performance.getMetrics")["metrics"]
    return float(next(entry["value"] for entry in metrics if entry["name"] == "TaskDuration"))


@pytest.mark.slow
def test_the_page_of_all_bundles_is_small_and_has_its_answer_first(driver: Browser, tmp_path: Path) -> None:
    from econgs_bench.bench.__main__ import main
    from econgs_bench.reports.schema import read_tables

    measured = Path(__file__).parents[3] / "reports" / "measured"
    every = sorted(measured.rglob("*.zip.xz"))
    text = (measured / "README.md").read_text(encoding="utf-8")
    (apart,) = re.findall(r"grep -v '(.*?)'", text)  # the command that makes this page
    words = apart.split(r"\|")
    bundles = [path for path in every if not any(word in path.name for word in words)]
    assert bundles
    assert all(any(word in path.name for path in every) for word in words)
    store = tmp_path / "all"
    assert main(["merge", *map(str, bundles), "--out", str(store)]) == 0
    page = page_module.write_report(read_tables(store / "tables"), store, tmp_path / "page" / "report.html")
    assert page.stat().st_size <= 5e6
    driver.emulate(1300, 900)
    driver.open(page)
    assert driver.run("document.documentElement.scrollHeight") <= 6000
    answer = driver.run("document.querySelector('.answer').getBoundingClientRect().bottom")
    assert 0 < answer <= 900  # on the first screen
    driver.emulate(420, 900)
    cells = "Array.from(document.querySelector('tr.mean').cells)"
    driver.run("document.querySelector('#results').closest('details').open = true")
    heads = driver.run("Array.from(document.querySelectorAll('.results thead th'), (h) => h.textContent)")
    assert heads[:4] == ["Scene", "Method", "PSNR [dB]", "Floor [dB]"]
    assert driver.run(f"{cells}[2].getBoundingClientRect().right") <= 420
