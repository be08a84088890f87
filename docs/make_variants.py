"""Make docs/variants.md from the catalogue of variants and the docstrings of modules: python docs/make_variants.py"""

import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import estimator.methods
from estimator.methods.catalogue import OWN, VARIANTS
from estimator.methods.variant import Needs, Variant

PAGE = Path(__file__).parent / "variants.md"
INTRODUCTION = """\
# Variants and their papers

Made by `make docs` from the variants and the docstrings of their modules (`docs/make_variants.py`). A docstring names
the publication, says what is known of it, and what had to be chosen here. `estimator run DIR` runs the variants of the
first table; `--variant NAME`, which may be repeated, runs the named ones of both. [rivals.md](rivals.md) has their
measured errors, and the stages of `huynh2016` that can be chosen. [own_variant.md](own_variant.md) adds a variant of
your own.
"""


def page() -> str:
    """The page, Markdown."""
    text = INTRODUCTION
    for heading, variants in (
        ("Run by default", VARIANTS.values()),
        ("Run where they are named", [variant for name, variant in OWN.items() if name not in VARIANTS]),
    ):
        text += f"\n## {heading}\n| variant | what it is | needs |\n| --- | --- | --- |\n"
        for variant in variants:
            text += f"| `{variant.name}` | {variant.summary} | {_needs(variant.needs)} |\n"
    for module, variants in _modules().items():
        names = ", ".join(f"`{variant.name}`" for variant in variants)
        docstring = inspect.getdoc(importlib.import_module(module))
        text += f"\n## {names}\n{docstring}\n\nModule `{module}`.\n"
    return text


def _needs(needs: Needs | None) -> str:
    if needs is None:
        return ""
    parts = [f"{needs.leds} LEDs"]
    if needs.faces != "any":
        parts.append(f"{needs.faces} faces")
    if needs.sizes:
        parts.append("their sizes")
    parts += needs.sensors
    if needs.attitude == "level":
        parts.append("a level camera")
    optional = f"; uses {', '.join(needs.optional)} if there" if needs.optional else ""
    return ", ".join(parts) + optional


def _modules() -> dict[str, list[Variant]]:
    """Variants by the module that defines them, both in the order of the catalogue."""
    homes = {}
    for found in pkgutil.iter_modules(estimator.methods.__path__, "estimator.methods."):
        module = importlib.import_module(found.name)
        source = inspect.getsource(module)
        for name, value in vars(module).items():
            if isinstance(value, Variant) and re.search(rf"^{name}\b[^=\n]*=", source, re.MULTILINE):
                homes[value.name] = found.name
    modules: dict[str, list[Variant]] = {}
    for variant in OWN.values():
        modules.setdefault(homes[variant.name], []).append(variant)
    return modules


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
