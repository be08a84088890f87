"""The page of scores in a real browser: silent, within the window, right in its figures, usable by the keyboard."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import (
    OVERFLOWING,
    SQUEEZED,
    console,
    fills,
    open_browser,
    page_streams,
    points_per_pixel,
    printed,
    reached_by_tab,
    show,
)
from test_estimator_report import BOUND, many_frames, scored, scores_of

from estimator.evaluate.score import Scores
from estimator.evaluate.scores_file import read_or_score
from estimator.report import page_data
from estimator.report.answer import diagonal_m
from estimator.report.numbers import UNITS, three
from estimator.report.report import page


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with open_browser() as found:
        yield found


@pytest.fixture(scope="module")
def scores(scored_set: Path) -> Scores:
    return read_or_score(scored_set)


@pytest.fixture(scope="module")
def one_set(scored_set: Path, scores: Scores, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "one.html"
    path.write_text(page([(scored_set, scores)]))
    return path


@pytest.fixture(scope="module")
def odd_sets(scored_set: Path, scores: Scores, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sets whose variants are exact, beyond the room, failed, many, long in their names, or none."""
    long = "huynh2016:denoise=none,centroid=brightest,trilateration=all-pairs"
    errors = {"exact": [0.0] * 6, "far": [1e9] * 6, "none": [None] * 6, "some": [0.1, None, 2e-6, 3.0, 9.0, 1e-9]}
    many = [scored(values, name, BOUND) for name, values in errors.items()]
    many += [scored([0.01 * (k + 1)] * 5 + [None], f"{long}{k}", BOUND) for k in range(12)]
    folder = tmp_path_factory.mktemp("odd")
    sets = [(scored_set, scores), (folder, scores_of(many)), (folder, scores_of([])), (folder, scores_of([scored([])]))]
    path = folder / "odd.html"
    path.write_text(page(sets))
    return path


@pytest.mark.parametrize(("width", "dark"), [(400, False), (400, True), (1000, False), (1280, True), (1600, False)])
def test_the_page_is_silent_and_within_the_window(browser: Any, odd_sets: Path, width: int, dark: bool) -> None:
    show(browser, odd_sets, width, dark)
    tabs = browser.find_elements("css selector", '[role="tab"]')
    assert len(tabs) == 4
    for tab in tabs:
        tab.click()
        browser.execute_script("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        assert browser.execute_script(OVERFLOWING) == []
        assert browser.execute_script(SQUEEZED) == []
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    assert console(browser) == []


def test_the_themes_differ_and_their_text_can_be_read(browser: Any, one_set: Path) -> None:
    """Contrast of WCAG 2.1, at least 4.5, of headings, notes, badges and figures on their grounds."""
    script = """
    const channel = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
    const numbers = (text) => text.match(/[\\d.]+/g).map(Number);
    const light = ([r, g, b]) => 0.2126 * channel(r / 255) + 0.7152 * channel(g / 255) + 0.0722 * channel(b / 255);
    const ground = (node) => {
      const found = getComputedStyle(node).backgroundColor;
      return numbers(found)[3] === 0 && node.parentElement ? ground(node.parentElement) : found;
    };
    return [...document.querySelectorAll("h1, h1 span, h2, .note, .badge, td, th, dt, dd, .btn, .lede")]
      .filter((node) => node.checkVisibility() && node.textContent.trim())
      .map((node) => {
        const pair = [light(numbers(getComputedStyle(node).color)), light(numbers(ground(node)))].sort((a, b) => b - a);
        return [(pair[0] + 0.05) / (pair[1] + 0.05), node.outerHTML.slice(0, 60)];
      });
    """
    grounds = []
    for dark in (False, True):
        show(browser, one_set, 1280, dark)
        found = browser.execute_script(script)
        assert len(found) > 50
        assert [one for one in found if one[0] < 4.5] == []
        grounds.append(browser.execute_script("return getComputedStyle(document.body).backgroundColor"))
    assert grounds[0] != grounds[1]


def test_figures_are_those_of_scores_json_in_every_unit(browser: Any, one_set: Path, scores: Scores) -> None:
    show(browser, one_set, 1280)
    variants = {one.variant: one for one in scores.variants if one.ok}
    assert len(variants) >= 8
    for unit, unit_m in UNITS.items():
        browser.find_element("css selector", f'[data-unit="{unit}"]').click()
        shown = browser.execute_script(
            "return [...document.querySelectorAll('.answer tr[data-variant]')].map((row) => [row.dataset.variant,"
            " ...[...row.cells].slice(2, 5).map((cell) => cell.querySelector('.n, .word').textContent)])"
        )
        assert len(shown) == len(variants)
        for name, *cells in shown:
            one = variants[name]
            assert one.of_all is not None
            assert one.error_3d is not None
            for cell, size_m in zip(cells, (one.of_all.median_m, one.of_all.p95_m, one.error_3d.max_m), strict=True):
                far = size_m is not None and size_m > diagonal_m(scores)
                assert cell == ("failed" if size_m is None else "out" if far else three(size_m / unit_m)), name
    # The frame browser, of the second frame in metres, as the last button has it.
    browser.find_element("css selector", '.step[data-step="1"]').click()
    rows = browser.execute_script(
        "return [...document.querySelectorAll('.frame-table tr[data-variant]')].map((row) => [row.dataset.variant,"
        " row.cells[1].textContent])"
    )
    assert rows
    for name, cell in rows:
        error_m = variants[name].rows[1].error_3d_m
        assert error_m is not None
        # The page's data have five digits: the third one may differ by one.
        assert float(cell.replace("\u202f", "")) == pytest.approx(error_m, rel=0.006, abs=1e-9), name


def test_the_keyboard_alone_reaches_everything(browser: Any, odd_sets: Path) -> None:
    from selenium.webdriver import ActionChains, Keys

    show(browser, odd_sets, 1280)
    browser.execute_script("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    count, unreached, unseen = reached_by_tab(browser)
    assert count > 20
    assert (unreached, unseen) == ([], [])

    def press(*keys: str) -> None:
        ActionChains(browser).send_keys(*keys).perform()

    def focus(selector: str) -> None:
        browser.execute_script("document.querySelector(arguments[0]).focus()", selector)

    def text(selector: str) -> str:
        return str(browser.execute_script("return document.querySelector(arguments[0]).textContent", selector))

    focus(".curves svg")
    press(Keys.ARROW_RIGHT)
    before = text(".reading")
    assert before.startswith("Within ")
    press(Keys.ARROW_RIGHT)
    assert text(".reading") != before
    focus(".slide")
    assert text(".which") == "Frame 0"
    press(Keys.ARROW_RIGHT)
    assert text(".which") == "Frame 1"
    focus(".legend .btn")
    curves = "return document.querySelectorAll('.curves path[data-variant]').length"
    shown = browser.execute_script(curves)
    press(Keys.SPACE)
    assert browser.execute_script(curves) == shown - 1
    focus('[role="tab"][aria-selected="true"]')
    press(Keys.ARROW_RIGHT)
    visible = "return [...document.querySelectorAll('article')].map((one) => one.checkVisibility())"
    assert browser.execute_script(visible) == [False, True, False, False]
    assert console(browser) == []


def test_the_policy_stops_what_comes_from_outside(browser: Any, one_set: Path) -> None:
    show(browser, one_set, 1280)
    stopped = browser.execute_async_script(
        """
        const done = arguments[0], found = [];
        document.addEventListener("securitypolicyviolation", (event) => {
          found.push(event.effectiveDirective);
          if (found.length === 3) done(found.sort());
        });
        const script = document.createElement("script");
        script.textContent = "document.title = 'taken'";
        const image = document.createElement("img");
        image.src = "http://127.0.0.1:9/x.png";
        document.body.append(script, image);
        fetch("http://127.0.0.1:9/").catch(() => null);
        """
    )
    assert stopped == ["connect-src", "img-src", "script-src-elem"]
    assert browser.title != "taken"
    console(browser)  # the violations themselves


@pytest.fixture(scope="module")
def thousand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("thousand")
    path = folder / "page.html"
    path.write_text(page([(folder, many_frames(folder, np.random.Generator(np.random.Philox(1000))))]))
    return path


def test_a_thousand_frames_are_three_megabytes_at_most(thousand: Path) -> None:
    """With three variants, all the pictures that the budget allows, and the whole budget of spots."""
    size = thousand.stat().st_size
    assert size > 1_000_000  # the pictures are there
    assert size + page_data.SPOTS_BYTES <= 3_000_000


def test_a_thousand_frames_are_drawn(browser: Any, thousand: Path) -> None:
    show(browser, thousand, 1280)
    steps = browser.execute_script("return document.querySelector('.curves path[data-variant]').getAttribute('d')")
    assert steps.count("V") > 900
    assert browser.execute_script("return document.querySelectorAll('.plot canvas').length") >= 1
    assert console(browser) == []


@pytest.fixture(scope="module")
def two_hundred(scored_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five variants, every part of the page, and the facts of a set."""
    folder = tmp_path_factory.mktemp("two_hundred")
    scores = many_frames(folder, np.random.Generator(np.random.Philox(200)), 5, 200)
    shutil.copy(scored_set / "dataset.json", folder)
    path = folder / "page.html"
    path.write_text(page([(folder, scores)]))
    return path


PAGES = 3
"""Pages of A4 for 200 frames and five variants: facts, errors and curves; the room and what errors depend on; a frame.

A section that is not broken leaves up to its own height free on the page before, so a page less full costs a page.
"""


def test_two_hundred_frames_print_on_three_light_pages(browser: Any, two_hundred: Path) -> None:
    """From any window and theme: the pages are the same, in the light theme's ink, and the window's own come back."""
    pdfs = []
    for width, dark in ((1280, False), (400, True)):
        show(browser, two_hundred, width, dark)
        before = browser.execute_script("return document.querySelector('.curves svg').getAttribute('viewBox')")
        pdfs.append(printed(browser))
        after = browser.execute_script("return document.querySelector('.curves svg').getAttribute('viewBox')")
        assert before == after
        assert not browser.execute_script("return document.documentElement.className")
    for pdf in pdfs:
        pages = page_streams(pdf)
        assert len(pages) <= PAGES
        assert (0x1B, 0x1F, 0x24) in fills(pages)  # --ink of the light theme
        assert (0xEC, 0xEF, 0xF2) not in fills(pages)  # of the dark one
        assert [points_per_pixel(one) for one in pages] == pytest.approx([0.75] * len(pages), rel=1e-3)
    # The same drawing whatever the window's width and theme.
    assert page_streams(pdfs[0]) == page_streams(pdfs[1])
    assert console(browser) == []


def test_the_printed_page_has_no_controls_and_keeps_within_the_paper(browser: Any, odd_sets: Path) -> None:
    """Laid out as for paper in a window as wide as A4's text."""
    show(browser, odd_sets, 688)
    browser.execute_script("window.dispatchEvent(new Event('beforeprint'))")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        assert browser.execute_script(OVERFLOWING) == []
        assert browser.execute_script(SQUEEZED) == []
        controls = browser.find_elements("css selector", "button, select, input, summary")
        assert controls
        assert not any(one.is_displayed() for one in controls)
        assert len(browser.find_elements("css selector", ".curves path.curve")) > 0
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    pages = page_streams(printed(browser))
    assert [points_per_pixel(one) for one in pages] == pytest.approx([0.75] * len(pages), rel=1e-3)
    assert console(browser) == []


def test_without_scripts_the_tables_are_whole(browser: Any, one_set: Path, scores: Scores) -> None:
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        show(browser, one_set, 1280)
        rows = browser.find_elements("css selector", ".answer tbody tr")
        assert len(rows) == sum(one.ok > 0 or one.entry.inapplicable is None for one in scores.variants)
        assert all(cell.text.strip() for row in rows for cell in row.find_elements("css selector", "td:not(.s)"))
        hidden = browser.find_elements("css selector", ".scripted")
        assert hidden
        assert not any(one.is_displayed() for one in hidden)
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
