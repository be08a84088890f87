"""Hooks of the site (mkdocs.yml): pages from outside docs/, notebooks as pages, and links between them.

Links in the files are relative to the files themselves, so that they work wherever the repository is browsed. On the
site they lead to the pages that are made of these files. A link to a file that is no part of the site is left as it is,
and ends the build.
"""

import json
import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
OUTSIDE = {name: PurePosixPath(name).name for name in ("datasets/FORMAT.md", "CONTRIBUTING.md", "CHANGELOG.md")}
"""Pages from outside docs/: path in the repository, place on the site."""
ORIGINS = {place: name for name, place in OUTSIDE.items()}
LINK = re.compile(r"\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]+)?\)")
INDENT = re.compile(r"^( {2,})", re.MULTILINE)
LIST = re.compile(r"(^[^\s-].*\n|(?<=\n\n)(?: +\S.*\n)+)(?=- )", re.MULTILINE)
"""The last line of a paragraph, or a further paragraph of an item, before an item."""
FENCED = re.compile(r"^(```.*?^```$)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from outside docs/ and one page for each notebook, which stays beside it to be loaded."""
    for name, place in OUTSIDE.items():
        files.append(File.generated(config, place, abs_src_path=str(ROOT / name)))
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        text = notebook_page(json.loads(notebook.content_string), PurePosixPath(notebook.src_uri).name)
        files.append(File.generated(config, page_of(notebook.src_uri), content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page with links to places on the site in place of links to files of the repository."""
    place = page.file.src_uri
    origin = PurePosixPath(ORIGINS.get(place, f"docs/{place}")).parent

    def on_site(link: re.Match[str]) -> str:
        path, anchor = link.groups()
        target = os.path.normpath(origin / path)
        there = OUTSIDE.get(target) or page_of(target.removeprefix("docs/"))
        return f"]({os.path.relpath(there, PurePosixPath(place).parent)}{anchor or ''})"

    parts = FENCED.split(markdown)
    return "".join(part if part.startswith("```") else _lists(LINK.sub(on_site, part)) for part in parts)


def _lists(markdown: str) -> str:
    """Lists as Python-Markdown reads them: after an empty line, with contents indented by four."""
    return LIST.sub(r"\1\n", INDENT.sub(r"\1\1", markdown))


def page_of(name: str) -> str:
    """Place of the page that shows a file of docs/; a notebook's is beside it."""
    return name.removesuffix(".ipynb") + ".md" if name.endswith(".ipynb") else name


def notebook_page(notebook: dict[str, Any], name: str) -> str:
    """A notebook as Markdown: its text, its code, and the outputs that are kept in it."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        parts += [_shown(output) for output in cell.get("outputs", [])]
    heading, *rest = parts
    # A link that the hook above does not take for one to this page: HTML, the notebook as a file.
    return "\n\n".join([heading, *rest, f'<a href="{name}" download>This page as a notebook</a>']) + "\n"


def _shown(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    if "image/png" in data:
        return f"![Output of the cell above](data:image/png;base64,{''.join(data['image/png'].split())})"
    if "text/html" in data:
        return "".join(data["text/html"]).replace("\n\n", "\n")
    return f"```text\n{''.join(output.get('text') or data['text/plain']).rstrip()}\n```"
