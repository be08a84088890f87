"""What scores.json states about a variant beside its scores, and about the programs that made it."""

import platform
from importlib.metadata import version
from typing import Literal

from estimator.errors import InputError
from estimator.io.dataset import Dataset
from estimator.io.records import Row
from estimator.methods.looks import Look, look_of
from estimator.methods.registry import Registry
from estimator.methods.variant import Needs

Sensor = Literal["accelerometer", "second camera", "fish-eye lens"]
PROGRAMS = ("numpy", "scipy", "opencv-python-headless")


class VariantEntry(Row):
    """A variant's one-line summary, its look in pages and plots, and the sensors that it needs beside one camera.

    `inapplicable` says why the variant cannot answer any frame of the dataset; null where it can, or where nothing
    states its needs. All but the look are empty for a variant that is not installed.
    """

    summary: str = ""
    look: Look
    needs: tuple[Sensor, ...] = ()
    inapplicable: str | None = None


class MadeBy(Row):
    """Programs and machine that scored a dataset."""

    estimator: str
    python: str
    packages: dict[str, str]
    machine: str

    @classmethod
    def here(cls) -> "MadeBy":
        """This process."""
        return cls(
            estimator=version("vlcrender"),
            python=platform.python_version(),
            packages={name: version(name) for name in PROGRAMS},
            machine=f"{platform.system()} {platform.machine()}",
        )


def entry_of(name: str, dataset: Dataset | None = None) -> VariantEntry:
    """Entry of a variant by its name, with what `dataset` lacks of its needs."""
    try:
        variant = Registry.read().named(name)
    except InputError:
        return VariantEntry(look=look_of(name))
    needs = variant.needs
    return VariantEntry(
        summary=" ".join(variant.summary.split()),
        look=look_of(name, variant.family, variant.mark),
        needs=() if needs is None else needs.sensors,
        inapplicable=None if needs is None or dataset is None else lacking(needs, dataset),
    )


def lacking(needs: Needs, dataset: Dataset) -> str | None:
    """What a dataset lacks that a variant needs in every frame, as text; None if nothing."""
    cameras = list(dataset.cameras.values())
    faces = {led.shape for led in dataset.leds.values()}
    checks = (
        ("accelerometer" in needs.sensors and dataset.accelerometer is None, "needs an accelerometer"),
        ("second camera" in needs.sensors and len(cameras) < 2, "needs two cameras"),
        (
            "fish-eye lens" in needs.sensors and all(one.projection != "equidistant" for one in cameras),
            "needs a fish-eye lens",
        ),
        (needs.faces != "any" and bool(faces) and needs.faces not in faces, f"needs LEDs with {needs.faces} faces"),
    )
    return next((text for fails, text in checks if fails), None)
