"""The page of the paper in a real browser: silent, within the window, light and dark; its plots show whole words."""

from collections.abc import Iterator
from typing import Any

import pytest
from browsing import OVERFLOWING, console, open_browser, show
from conftest import ROOT

PAGE = ROOT / "docs" / "paper.html"
PLOTS = sorted((ROOT / "docs" / "paper").glob("*.svg"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with open_browser() as found:
        yield found


def test_the_page_is_silent_and_within_the_window(browser: Any) -> None:
    grounds = set()
    for width, dark in ((400, False), (400, True), (1280, False), (1280, True)):
        show(browser, PAGE, width, dark)
        assert browser.execute_script(OVERFLOWING) == []
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        pictures = browser.execute_script("return [...document.images].map((one) => one.naturalWidth)")
        assert len(pictures) == len(PLOTS)
        assert min(pictures) > 0
        grounds.add(browser.execute_script("return getComputedStyle(document.body).backgroundColor"))
    assert len(grounds) == 2
    assert console(browser) == []


def test_words_of_a_plot_end_within_it(browser: Any) -> None:
    """Names in a legend, titles of heat maps: of every plot that the page shows."""
    script = """
    const wide = document.documentElement.viewBox.baseVal.width;
    return [...document.querySelectorAll("text")].filter((one) => {
      const box = one.getBBox();
      return box.x < 0 || box.x + box.width > wide;
    }).map((one) => one.textContent);
    """
    for path in PLOTS:
        show(browser, path, 1280)
        assert browser.execute_script("return document.querySelectorAll('text').length") > 5
        assert browser.execute_script(script) == [], path.name
