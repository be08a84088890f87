"""Registry of all variants by name: this package's own, and those that other packages register (docs/own_variant.md).

Another package registers a function `f(frame: DeviceFrame) -> Estimate`, or a `Variant`, as an entry point of the group
`estimator.variants`, under the variant's name. It is imported only when the variant is requested.
"""

import inspect
import logging
import re
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Self

from estimator.errors import EstimationFailure, InputError
from estimator.io.device import DeviceFrame
from estimator.io.estimates import NAME
from estimator.io.records import first_line
from estimator.methods.catalogue import OWN, VARIANTS, variant_named
from estimator.methods.variant import Estimate, Variant
from estimator.receiver.receive import with_identities

logger = logging.getLogger(__name__)

GROUP = "estimator.variants"
OPTIONS = ":"
"""Separates the name of one of this package's variants from its options, which `variant_named` reads."""


@dataclass(frozen=True)
class Registry:
    """Registered variants by name; `problems` has a message for each plug-in whose name cannot be used."""

    plugins: dict[str, EntryPoint]
    problems: tuple[str, ...]

    @classmethod
    def read(cls) -> Self:
        """Read the entry points of the installed packages; no plug-in is imported."""
        # A package found twice on the path counts once.
        found = {(point.name, point.value): point for point in entry_points(group=GROUP)}
        plugins: dict[str, EntryPoint] = {}
        problems = []
        for name in dict.fromkeys(name for name, _ in found):
            points = [point for (of_name, _), point in found.items() if of_name == name]
            if name in OWN:
                problems += [f"{_title(point)}: not used, the estimator has a variant of that name" for point in points]
            elif not re.fullmatch(NAME, name) or OPTIONS in name:
                problems += [f"{_title(point)}: not used, the name may hold A-Z a-z 0-9 . _ , + -" for point in points]
            elif len(points) > 1:
                values = " and ".join(point.value for point in points)
                problems.append(f"variant {name!r}: not used, registered more than once, as {values}")
            else:
                plugins[name] = points[0]
        return cls(plugins, tuple(problems))

    def named(self, name: str) -> Variant:
        """The variant of a name; a plug-in is imported. Raises InputError."""
        if name in self.plugins:
            return _load(self.plugins[name])
        if name.split(OPTIONS)[0] not in OWN:
            raise InputError(f"variant {name}: unknown; allowed: {', '.join([*OWN, *self.plugins])}")
        return variant_named(name)

    def all(self) -> tuple[list[Variant], tuple[str, ...]]:
        """Variants that run by default, plug-ins among them, and a message for each plug-in that cannot be used."""
        variants, problems = list(VARIANTS.values()), list(self.problems)
        for name in self.plugins:
            try:
                variants.append(self.named(name))
            except InputError as error:
                problems.append(str(error))
        return variants, tuple(problems)

    def source(self, name: str) -> str:
        """Package of a plug-in, `package version`; empty for this package's own variants."""
        return _source(self.plugins[name]) if name in self.plugins else ""


def variants() -> list[Variant]:
    """Variants that run by default: most of this package's own, then the usable plug-ins of other packages.

    A plug-in that cannot be used is left out, with a warning in the log. The methods published since the paper
    (docs/rivals.md) run where they are named.

    Returns
    -------
    list of Variant
        Each with its `name`, a `summary` of one line, and the function `estimate`.
    """
    usable, problems = Registry.read().all()
    for problem in problems:
        logger.warning(problem)
    return usable


def estimate(frame: DeviceFrame, variant: str | Variant = "ml") -> Estimate:
    """Estimate the position of a frame's camera.

    A variant that uses all frames of a device uses this one alone; give it more by `estimate_device`. `self-calibrated`
    does, and `gravity-fit`, `up2p` and `ml`, to find out whether a camera is as exact as the device states.

    Parameters
    ----------
    frame
        A frame, by `read_frame` or `frame`.
    variant
        A variant, or the name of one, with options after a colon (`huynh2016:denoise=none`).

    Returns
    -------
    Estimate
        `position_m` (3,) is the projection centre, world metres; `covariance_m2` (3, 3) its covariance, `ranges_m` the
        distances to LEDs by id, and `ambiguous`, where the method provides them.

    Raises
    ------
    EstimationFailure
        The frame has no position by this method; `stage` names the stage that failed.
    InputError
        There is no variant of that name.
    """
    chosen = Registry.read().named(variant) if isinstance(variant, str) else variant
    return chosen.estimate(with_identities(frame))


def estimate_device(
    frames: Iterable[DeviceFrame], variant: str | Variant = "self-calibrated"
) -> list[Estimate | EstimationFailure]:
    """Estimate the positions of the frames of one device together.

    Parameters
    ----------
    frames
        Frames of one device in one building, by `read_frame` or `frame`. A generator will do: one image at a time is
        needed. Frames of several devices do not belong together: their cameras have other errors.
    variant
        A variant, or the name of one. A variant that uses one frame at a time estimates each by itself.

    Returns
    -------
    list
        For each frame, in order, its Estimate, or the EstimationFailure that says why it has no position.

    Raises
    ------
    InputError
        There is no variant of that name, or `frames` are of several devices.
    """
    chosen = Registry.read().named(variant) if isinstance(variant, str) else variant
    method = chosen.of_device
    results: dict[int, Estimate | EstimationFailure] = {}
    observed: dict[int, object] = {}
    numbers: set[int] = set()
    for index, one in enumerate(frames):
        numbers.add(one.device)
        try:
            one = with_identities(one)
            if method is None:
                results[index] = chosen.estimate(one)
            else:
                observed[index] = method.observe(one)
        except EstimationFailure as failure:
            results[index] = failure
    if len(numbers) > 1:
        of_devices = ", ".join(map(str, sorted(numbers)))
        raise InputError(f"frames: of the devices {of_devices}; needed the frames of one device")
    if method is not None and observed:
        results.update(zip(observed, method.solve(list(observed.values())), strict=True))
    return [results[index] for index in sorted(results)]


def _load(point: EntryPoint) -> Variant:
    try:
        loaded = point.load()
    except (Exception, SystemExit) as error:
        raise InputError(f"{_title(point)}: cannot be loaded ({type(error).__name__}: {first_line(error)})") from None
    if isinstance(loaded, Variant):
        if loaded.name != point.name:
            raise InputError(f"{_title(point)}: is a Variant of another name, {loaded.name!r}")
        return loaded
    if not callable(loaded) or isinstance(loaded, type):
        raise InputError(f"{_title(point)}: is a {type(loaded).__name__}, needed a function or a Variant")
    summary = (inspect.getdoc(loaded) or "").strip().split("\n")[0]
    return Variant(point.name, summary or "(no description)", loaded)


def _title(point: EntryPoint) -> str:
    return f"variant {point.name!r} of {_source(point)} ({point.value})"


def _source(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else "an unknown package"
