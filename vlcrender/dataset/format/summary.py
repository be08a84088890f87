"""The summary of a set: what a person would check before use, and warnings where something is odd.

It is made of numbers that each frame leaves in the journal: no image is read again, and a resumed run has the same.
"""

import os
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from vlcrender.dataset.format.files import EXPECTED, FRAMES, PREVIEWS, PROCESSED
from vlcrender.dataset.format.frame_numbers import LedCounts, Summary
from vlcrender.dataset.format.rows import FrameRecord
from vlcrender.dataset.recipe.recipe import Recipe

MANY_SATURATED = 0.5
"""Share of saturated pixels above which a set is odd."""


def summary_of(
    recipe: Recipe,
    records: Iterable[FrameRecord],
    directory: Path,
    warnings: Iterable[str] = (),
    rounded: bool = False,
) -> Summary:
    """The summary of a set whose frames and tables are written; `warnings` are those of its plan.

    rounded: numbers of pixels have two digits. Exact ones of a withheld set would tell of a frame what its noise hides.
    """
    leds: Counter[int] = Counter()
    backgrounds_e = array("d")
    pixels = saturated = frames_saturated = 0
    brightest_e, known = 0.0, True
    for record in records:
        leds[sum(led.visible_fraction == 1 for led in record.truth.leds)] += 1
        numbers = record.numbers
        if numbers is None:
            known = False
            continue
        backgrounds_e.append(numbers.background_e)
        pixels += numbers.pixels
        saturated += numbers.saturated
        frames_saturated += numbers.saturated > 0
        brightest_e = max(brightest_e, numbers.brightest_e)
    share, background_e = saturated / max(pixels, 1), float(np.median(backgrounds_e)) if known else 0.0
    if rounded:
        share, brightest_e, background_e = (float(f"{value:.2g}") for value in (share, brightest_e, background_e))
    found = list(warnings)
    if known and share > MANY_SATURATED:
        found.append(f"{100 * share:.0f} % of all pixels are saturated; choose a shorter exposure")
    elif known and frames_saturated == len(backgrounds_e):
        found.append(
            f"every frame has saturated pixels: the brightest has {brightest_e:.0f} electrons, and a pixel holds "
            f"{recipe.sensor.saturation_e:.0f}; choose a shorter exposure if that is not meant"
        )
    if leds[0]:
        found.append(f"{leds[0]} of {leds.total()} frames show no whole LED")
    return Summary(
        saturated_share=share if known else None,
        leds=_counts(leds),
        field_of_view_deg={mounted.name: mounted.camera.view_angles_deg()[0] for mounted in recipe.cameras},
        brightest_e=brightest_e if known else None,
        background_e=background_e if known else None,
        saturation_e=recipe.sensor.saturation_e,
        bytes=disk_use(directory),
        warnings=tuple(found),
    )


def _counts(leds: Mapping[int, int]) -> LedCounts:
    """Smallest, median and largest of numbers of which each occurs so many times."""
    numbers = sorted(number for number, times in leds.items() if times)
    ends = np.cumsum([leds[number] for number in numbers])
    last = int(ends[-1])
    low, high = (numbers[int(np.searchsorted(ends, place, side="right"))] for place in ((last - 1) // 2, last // 2))
    return LedCounts(min=numbers[0], median=(low + high) / 2, max=numbers[-1])


def disk_use(directory: Path) -> int:
    """Bytes of a set's files of frames and of its tables; not of partial files."""
    return sum(
        entry.stat().st_size
        for folder in ("", FRAMES, EXPECTED, PREVIEWS, PROCESSED)
        for entry in _files(directory / folder)
        if not entry.name.endswith(".partial") and (folder or entry.name.endswith(".parquet"))
    )


def _files(folder: Path) -> Iterator["os.DirEntry[str]"]:
    if folder.is_dir():
        with os.scandir(folder) as entries:
            yield from (entry for entry in entries if entry.is_file())


def summary_lines(summary: Summary) -> list[str]:
    """The summary as aligned lines, with the warnings at the end."""
    views = ", ".join(
        f"{angle:.1f} deg" if len(summary.field_of_view_deg) == 1 else f"{name} {angle:.1f} deg"
        for name, angle in summary.field_of_view_deg.items()
    )
    leds = summary.leds
    lines = [
        ("LEDs a frame", f"{leds.min} to {leds.max}, median {leds.median:g} (whole ones)"),
        ("field of view", f"{views} across"),
    ]
    if summary.saturated_share is not None and summary.brightest_e is not None and summary.background_e is not None:
        share = 100 * summary.saturated_share
        percent = f"{share:.2g}" if share < 10 else f"{share:.0f}"
        lines += [
            ("saturated", f"{percent} % of the pixels" if summary.saturated_share else "no pixel"),
            (
                "brightest LED",
                f"{_number(summary.brightest_e)} electrons; a pixel saturates at {_number(summary.saturation_e)}",
            ),
            ("background", f"{_number(summary.background_e, 3)} electrons (median; mostly the ceiling)"),
        ]
    lines.append(("disk use", size_text(summary.bytes)))
    return [f"{name:<14}{value}" for name, value in lines] + [f"warning: {text}" for text in summary.warnings]


def _number(value: float, digits: int = 4) -> str:
    """A number to some digits, without an exponent where it is large."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if float(text) >= 10**digits else text


def size_text(count: float) -> str:
    """A number of bytes, such as "12.3 MB"."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
