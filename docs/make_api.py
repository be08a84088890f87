"""Make docs/api.md from the docstrings of both packages' public names: python docs/make_api.py"""

from collections.abc import Iterator
from pathlib import Path

import griffe

DOCS = Path(__file__).parent
PAGE = DOCS / "api.md"
PACKAGES = ("vlcrender", "estimator")
INTRODUCTION = """\
# Python API

Made by `make docs` from the docstrings (`docs/make_api.py`). What is not listed here is internal and may change.
[Notebooks](notebooks/first_frame.ipynb) show the API at work. [reference.md](reference.md) has the range and unit of
every setting: a class of settings, such as `Camera` or `Sensor`, raises `pydantic.ValidationError`, a `ValueError`, for
a value out of range.
"""


def page() -> str:
    """The page of the API, Markdown."""
    return INTRODUCTION + "".join(map(_package, PACKAGES))


def _package(name: str) -> str:
    package = griffe.load(name, search_paths=[str(DOCS.parent)])
    names = [public for public in package.exports or [] if public != "__version__"]
    if not names:
        return ""
    objects = {public: _target(package.members[str(public)]) for public in names}
    text = f"\n## {name}\n\n{_docstring(package)}\n"
    for public in sorted(names, key=lambda public: (objects[public].kind is griffe.Kind.CLASS, str(public).lower())):
        text += _entry(str(public), objects[public])
    return text


def _target(member: griffe.Object | griffe.Alias) -> griffe.Object:
    return member.final_target if isinstance(member, griffe.Alias) else member


def _entry(name: str, target: griffe.Object) -> str:
    text = f"\n### {name}\n\n"
    if isinstance(target, griffe.Function):
        text += f"```python\n{_signature(target)}\n```\n\n"
    elif isinstance(target, griffe.Class):
        bases = ", ".join(str(base) for base in target.bases)
        text += f"```python\nclass {name}{f'({bases})' if bases else ''}\n```\n\n"
    text += f"{_docstring(target)}\n"
    if isinstance(target, griffe.Class):
        members = list(_members(target))
        text += "\n" if members else ""
        text += "".join(f"- {line}\n" for line in members)
    return text


def _members(target: griffe.Class) -> Iterator[str]:
    """A line for each public field, property and method, in the order of the source."""
    for name, member in target.members.items():
        if name.startswith("_") or name == "model_config":
            continue
        text = _summary(member)
        if isinstance(member, griffe.Function):
            yield f"`{_signature(member)}`: {text}"
        elif isinstance(member, griffe.Attribute):
            kind = f": {member.annotation}" if member.annotation is not None else ""
            settings = "Settings" in map(str, target.bases)
            default = f" = {member.value}" if member.value is not None and "property" not in member.labels else ""
            if settings and "property" not in member.labels:
                kind = ""  # types and ranges are in reference.md
            yield f"`{name}{kind}{default}`{f': {text}' if text else ''}"


def _signature(function: griffe.Function) -> str:
    whole = str(function.signature())
    for first in ("self", "cls"):
        whole = whole.replace(f"({first}, ", "(").replace(f"({first})", "()")
    return whole


def _docstring(target: griffe.Object | griffe.Alias) -> str:
    """The docstring, Markdown: sections of the numpydoc convention become lists."""
    return "\n\n".join(filter(None, (_section(section) for section in _sections(target))))


def _summary(target: griffe.Object | griffe.Alias) -> str:
    """The docstring without its lists, in one line."""
    texts = [section.value for section in _sections(target) if section.kind is griffe.DocstringSectionKind.text]
    return " ".join(" ".join(texts).split())


def _sections(target: griffe.Object | griffe.Alias) -> list[griffe.DocstringSection]:
    return [] if target.docstring is None else target.docstring.parse("numpy", warnings=False)


def _section(section: griffe.DocstringSection) -> str:
    if section.kind is griffe.DocstringSectionKind.text:
        return str(section.value).strip()
    if section.kind is griffe.DocstringSectionKind.examples:
        return "\n\n".join(str(text) for _, text in section.value)
    lines = []
    for item in section.value:
        name = str(getattr(item, "name", "") or item.annotation or "")
        lines.append(f"- `{name}`: {' '.join(item.description.split())}")
    return f"{section.kind.value.capitalize()}:\n\n" + "\n".join(lines)


def files() -> dict[Path, str]:
    """All that is made, by path."""
    return {PAGE: page()}


def main() -> None:
    """Write the page."""
    for path, text in files().items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
