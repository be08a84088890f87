"""The site is built without a warning, its links lead somewhere, and its pages load nothing from elsewhere.

Links of all Markdown files are also checked as they are, as they work where the repository is browsed.
"""

import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from conftest import ROOT
from mkdocs.commands.build import build
from mkdocs.config import load_config
from mkdocs.exceptions import Abort
from pymdownx.slugs import slugify
from test_reference import script

from estimator.methods.catalogue import OWN

RESOURCES = {
    ("script", "src"),
    ("img", "src"),
    ("link", "href"),
    ("iframe", "src"),
    ("source", "src"),
    ("object", "data"),
}
LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCED = re.compile(r"^ *```.*?^ *```", re.MULTILINE | re.DOTALL)


@dataclass
class Links(HTMLParser):
    """Links, resources and anchors of a page, and paragraphs that hold marks of a list or a table."""

    links: set[str] = field(default_factory=set)
    resources: set[str] = field(default_factory=set)
    anchors: set[str] = field(default_factory=set)
    marks: list[str] = field(default_factory=list)
    in_paragraph: bool = False

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.in_paragraph |= tag == "p"
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif (tag, name) in RESOURCES and value and dict(attrs).get("rel") != "canonical":
                self.resources.add(value)
            elif (tag, name) == ("a", "href") and value:
                self.links.add(value)

    def handle_endtag(self, tag: str) -> None:
        self.in_paragraph &= tag != "p"

    def handle_data(self, data: str) -> None:
        if self.in_paragraph:
            self.marks += re.findall(r"^(?:- |\d\. |\| ).*", data, re.MULTILINE)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make site` builds it."""
    folder = tmp_path_factory.mktemp("site")
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(folder)))  # strict: raises Abort after a warning
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Links]:
    """Every page of the site, read."""
    found = {}
    for path in site.rglob("*.html"):
        found[path] = Links()
        found[path].feed(path.read_text(encoding="utf-8"))
    return found


def test_every_document_is_a_page(pages: dict[Path, Links], site: Path) -> None:
    made = {path.relative_to(site).with_suffix("").as_posix() for path in pages}
    assert made > {path.stem for path in (ROOT / "docs").glob("*.md")} | {"FORMAT", "CONTRIBUTING", "CHANGELOG"}
    assert made > {f"notebooks/{path.stem}" for path in (ROOT / "docs/notebooks").glob("*.ipynb")}


def test_the_page_of_variants_is_what_the_catalogue_says() -> None:
    made = script("make_variants").page()
    assert made == (ROOT / "docs/variants.md").read_text(encoding="utf-8"), "run make docs"
    assert all(f"`{name}`" in made for name in OWN)


def test_links_of_the_site_lead_somewhere(pages: dict[Path, Links], site: Path) -> None:
    broken = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path not in ("", "/") else path
            if parts.path.startswith("/"):  # of the page for addresses that do not exist
                target = site / unquote(parts.path).lstrip("/")
            if target.is_dir():
                target /= "index.html"
            anchors = pages[target].anchors if target in pages else {""}
            if not target.is_file() or (parts.fragment and unquote(parts.fragment) not in anchors):
                broken.append(f"{path.relative_to(site)}: {link}")
    assert broken == []


def test_pages_load_nothing_from_elsewhere(pages: dict[Path, Links], site: Path) -> None:
    for path, page in pages.items():
        for resource in page.resources:
            parts = urlsplit(resource)
            assert parts.scheme in ("", "data"), f"{path.name}: {resource}"
            assert not parts.netloc, f"{path.name}: {resource}"
    for style in site.rglob("*.css"):
        assert not re.findall(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//[^)]*", style.read_text(encoding="utf-8"))


def test_lists_and_tables_are_read_as_such(pages: dict[Path, Links], site: Path) -> None:
    assert {str(path.relative_to(site)): page.marks for path, page in pages.items() if page.marks} == {}


@pytest.mark.parametrize("link", ["nowhere.md", "index.md#nowhere", "../LICENSE", "pictures/"])
def test_a_link_to_no_page_ends_the_build(link: str, tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/index.md").write_text(f"# Page\n\n[link]({link})\n")
    config = load_config(
        str(ROOT / "mkdocs.yml"), docs_dir=str(tmp_path / "docs"), site_dir=str(tmp_path / "site"), nav=["index.md"]
    )
    config.hooks = {}
    with pytest.raises(Abort, match="strict"):
        build(config)


@cache
def anchors_of(path: Path) -> frozenset[str]:
    """Anchors of a Markdown file, as GitHub names them."""
    name = slugify(case="lower")
    headings = re.findall(r"^#+ (.*)$", FENCED.sub("", path.read_text(encoding="utf-8")), re.MULTILINE)
    return frozenset(name(heading.replace("`", ""), "-") for heading in headings)


def relative_links() -> Iterator[tuple[str, str]]:
    """Every relative link of a Markdown file of the repository, with the file's name."""
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True)
    for name in listed.stdout.splitlines():
        if "templates" not in name and (ROOT / name).is_file():
            text = FENCED.sub("", (ROOT / name).read_text(encoding="utf-8"))
            yield from ((name, link) for link in LINK.findall(text) if not urlsplit(link).scheme)


def test_links_of_the_repository_lead_somewhere() -> None:
    links = list(relative_links())
    assert len(links) > 100
    broken = []
    for name, link in links:
        path, _, anchor = link.partition("#")
        target = (ROOT / name).parent / path if path else ROOT / name
        if not target.exists() or (anchor and anchor not in anchors_of(target)):
            broken.append(f"{name}: {link}")
    assert broken == []
