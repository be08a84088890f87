"""Every variant by its name: this package's own, and those that other packages register (docs/own_variant.md).

Another package registers a function `f(frame: DeviceFrame) -> Estimate`, or a `Variant`, as an entry point of the group
`estimator.variants`, under the variant's name. It is imported only where it is asked for.
"""

import inspect
import re
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Self

from estimator.errors import InputError
from estimator.io.estimates import NAME
from estimator.io.records import first_line
from estimator.variants.catalogue import VARIANTS, variant_named
from estimator.variants.variant import Variant

GROUP = "estimator.variants"
OPTIONS = ":"
"""After a name of this package's own come its options, which `variant_named` reads."""


@dataclass(frozen=True)
class Registry:
    """Names and what they stand for; `complaints` has a line for each plug-in whose name cannot be used."""

    plugins: dict[str, EntryPoint]
    complaints: tuple[str, ...]

    @classmethod
    def read(cls) -> Self:
        """What is installed now; nothing is imported yet."""
        # The same package found twice on the path is one.
        found = {(point.name, point.value): point for point in entry_points(group=GROUP)}
        plugins: dict[str, EntryPoint] = {}
        complaints = []
        for name in dict.fromkeys(name for name, _ in found):
            points = [point for (of_name, _), point in found.items() if of_name == name]
            if name in VARIANTS:
                complaints += [
                    f"{_title(point)}: not used, the estimator has a variant of that name" for point in points
                ]
            elif not re.fullmatch(NAME, name) or OPTIONS in name:
                complaints += [
                    f"{_title(point)}: not used, the name may hold A-Z a-z 0-9 . _ , + -" for point in points
                ]
            elif len(points) > 1:
                values = " and ".join(point.value for point in points)
                complaints.append(f"variant {name!r}: not used, registered more than once, as {values}")
            else:
                plugins[name] = points[0]
        return cls(plugins, tuple(complaints))

    def named(self, name: str) -> Variant:
        """The variant of this name, imported where it is a plug-in's; raises InputError."""
        if name in self.plugins:
            return _load(self.plugins[name])
        if name.split(OPTIONS)[0] not in VARIANTS:
            raise InputError(f"variant {name}: unknown; allowed: {', '.join([*VARIANTS, *self.plugins])}")
        return variant_named(name)

    def all(self) -> tuple[list[Variant], tuple[str, ...]]:
        """This package's own variants and every plug-in that can be used, and a line for each that cannot."""
        variants, complaints = list(VARIANTS.values()), list(self.complaints)
        for name in self.plugins:
            try:
                variants.append(self.named(name))
            except InputError as error:
                complaints.append(str(error))
        return variants, tuple(complaints)

    def source(self, name: str) -> str:
        """Whose plug-in a variant is, `package version`; empty for one of this package's own."""
        return _source(self.plugins[name]) if name in self.plugins else ""


def _load(point: EntryPoint) -> Variant:
    try:
        thing = point.load()
    except (Exception, SystemExit) as error:
        raise InputError(f"{_title(point)}: cannot be loaded ({type(error).__name__}: {first_line(error)})") from None
    if isinstance(thing, Variant):
        if thing.name != point.name:
            raise InputError(f"{_title(point)}: is a Variant of another name, {thing.name!r}")
        return thing
    if not callable(thing) or isinstance(thing, type):
        raise InputError(f"{_title(point)}: is a {type(thing).__name__}, needed a function or a Variant")
    summary = (inspect.getdoc(thing) or "").strip().split("\n")[0]
    return Variant(point.name, summary or "(no description)", thing)


def _title(point: EntryPoint) -> str:
    return f"variant {point.name!r} of {_source(point)} ({point.value})"


def _source(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else "an unknown package"
