"""Estimates of a dataset's variants: their files, and rows whose ranges are to LEDs at known positions."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from estimator.errors import InputError
from estimator.evaluate.frame_score import Position
from estimator.io.dataset import Dataset
from estimator.io.estimates import EstimateRow, check_digest, iter_estimates


def estimate_paths(folder: Path) -> list[Path]:
    """Files with estimates of a dataset, in order of the variants' names. Raises InputError for an unprintable name."""
    paths = sorted((folder / "estimates").glob("*.parquet"), key=lambda path: path.stem)
    for path in paths:
        if not path.stem.isprintable():
            raise InputError(f"{folder / 'estimates'}: {path.name!r}: needed a name of printable characters")
    return paths


@dataclass(frozen=True)
class KnownEstimates:
    """Estimates of a file, and positions of LEDs by id: those of the map, or those that packets told."""

    path: Path
    frame_count: int
    leds_m: dict[int, Position]

    @classmethod
    def of(cls, path: Path, dataset: Dataset, frame_count: int, digest: str) -> "KnownEstimates":
        """Estimates of all frames of a dataset, of which `frames_sha256` is `digest`.

        Raises InputError for estimates of another dataset. Where the dataset has no map, all rows are read.
        """
        check_digest(path, digest)
        leds_m = {led.id: led.position_m for led in dataset.leds.values()}
        if not leds_m:
            for row in iter_estimates(path, frame_count):
                for one in row.identities or ():
                    if one.led is not None and one.position_m is not None:
                        leds_m[one.led] = one.position_m
        return cls(path, frame_count, leds_m)

    def rows(self) -> Iterator[EstimateRow]:
        """Rows, of which some are in memory at a time. Raises InputError for a range to an LED without a position."""
        for row in iter_estimates(self.path, self.frame_count):
            for led_range in row.ranges:
                if led_range.led not in self.leds_m:
                    raise InputError(
                        f"{self.path}: frame {row.frame}: a range to LED {led_range.led}, which is not in led_map"
                    )
            yield row
