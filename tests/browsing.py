"""A headless browser for tests of pages: Debian's chromium, driven by selenium.

Where neither is installed tests are skipped by name; BROWSER_REQUIRED=1, as CI sets it, makes that a failure.
"""

import base64
import os
import re
import shutil
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")


def _missing(what: str) -> None:
    if os.environ.get("BROWSER_REQUIRED") == "1":
        pytest.fail(f"{what} is not installed, and BROWSER_REQUIRED is set")
    pytest.skip(f"{what} is not installed: apt-get install chromium chromium-driver; pip install selenium")


@contextmanager
def open_browser() -> Iterator[Any]:
    """A headless browser whose console is recorded."""
    program = next((found for name in PROGRAMS if (found := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        _missing("chromium or its driver")
    try:
        from selenium import webdriver
    except ImportError:
        _missing("selenium")
    options = webdriver.ChromeOptions()
    options.binary_location = str(program)
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        yield browser
    finally:
        browser.quit()


def show(browser: Any, path: Path, width: int, dark: bool = False) -> None:
    """Open a page at a width in CSS pixels, light or dark."""
    theme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": theme})
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(path.as_uri())


def console(browser: Any) -> list[str]:
    """Messages of the console since the last call."""
    return [str(entry["message"]) for entry in browser.get_log("browser")]


def printed(browser: Any) -> bytes:
    """The page as PDF, on the paper that its style sheet names."""
    options = {"preferCSSPageSize": True, "printBackground": True}
    return base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", options)["data"])


def page_streams(pdf: bytes) -> list[bytes]:
    """What draws each page of a PDF of chromium, whose objects stand one after another and uncompressed."""
    objects = {int(number): body for number, body in re.findall(rb"(?ms)^(\d+) 0 obj\s(.*?)^endobj", pdf)}
    streams = []
    for body in objects.values():
        if re.search(rb"/Type\s*/Page\b", body):
            (content,) = re.findall(rb"/Contents (\d+) 0 R", body)
            streams.append(zlib.decompress(objects[int(content)].split(b"stream", 1)[1].lstrip(b"\r\n")))
    return streams


def points_per_pixel(page: bytes) -> float:
    """Size of a CSS pixel on one of `page_streams`: 0.75 points, less where chromium shrinks what is too wide."""
    outer, inner = re.findall(rb"([\d.]+) 0 0 -?[\d.]+ [-\d.]+ [-\d.]+ cm", page)[:2]
    return float(outer) * float(inner)


def fills(pages: Iterable[bytes]) -> set[tuple[int, ...]]:
    """Colours, in bytes of red, green and blue, with which `page_streams` fill letters and areas."""
    found = {one for page in pages for one in re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) rg", page)}
    return {tuple(round(255 * float(part)) for part in one) for one in found}


OVERFLOWING = """
const wide = document.documentElement.clientWidth;
const scrolls = (node) => node && (getComputedStyle(node).overflowX !== "visible" || scrolls(node.parentElement));
return [...document.body.querySelectorAll("*")].filter((node) => {
  const box = node.getBoundingClientRect();
  return box.width && (box.right > wide + 0.5 || box.left < -0.5) && !scrolls(node) && !node.closest("svg svg");
}).map((node) => `${node.tagName} ${node.className.baseVal ?? node.className}`);
"""
"""Script: elements beyond the sides of the page that no scrolling box holds."""

SQUEEZED = """
const scrolls = (node) => node && (getComputedStyle(node).overflowX !== "visible" || scrolls(node.parentElement));
return [...document.querySelectorAll("table")].filter((node) => {
  const [own, around] = [node.getBoundingClientRect(), node.parentElement.getBoundingClientRect()];
  return own.width && own.right > around.right + 0.5 && !scrolls(node);
}).map((node) => node.className);
"""
"""Script: tables that end beyond the box they stand in."""

UNREACHED = """
const parts = 'button, select, input, summary, a[href], [tabindex="0"]';
return [...document.querySelectorAll(parts)]
  .filter((node) => node.checkVisibility() && node.tabIndex >= 0 && !node.seen)
  .map((node) => node.outerHTML.slice(0, 80));
"""
"""Script: visible controls that were not marked as `seen`."""


def reached_by_tab(browser: Any, most: int = 300) -> tuple[int, list[str], list[str]]:
    """Controls that the tabulator reaches, those that it does not, and those whose focus cannot be seen."""
    from selenium.webdriver import ActionChains, Keys

    unseen: list[str] = []
    for count in range(most):
        ActionChains(browser).send_keys(Keys.TAB).perform()
        state = browser.execute_script(
            "const one = document.activeElement; if (one === document.body) return null;"
            "const style = getComputedStyle(one), again = Boolean(one.seen); one.seen = true;"
            "const ring = style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) >= 1;"
            "return [again, ring, one.outerHTML.slice(0, 80)];"
        )
        if state is None or state[0]:
            return count, browser.execute_script(UNREACHED), unseen
        if not state[1]:
            unseen.append(state[2])
    raise AssertionError(f"more than {most} controls")
