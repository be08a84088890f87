"""Figures of the errors: by frame, and their distribution. The page's style sheet sets the colours."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from estimator.evaluate.score import VariantScore
from estimator.evaluate.score_table import length_text
from estimator.report.svg import cross, line, mark, picture, text

WIDTH = 960
LEFT, RIGHT, TOP, BOTTOM = 72, 28, 12, 40
INNER = WIDTH - LEFT - RIGHT
HEIGHT = 300
"""Height of the axes; each variant adds LANE for its failed frames."""
LANE = 12
MIN_SHOWN_M = 1e-6
MAX_LABELS = 12
MAX_LARGE_MARKS = 1000
SHARES = (0, 25, 50, 75, 95, 100)


@dataclass(frozen=True)
class Decades:
    """A logarithmic axis from 10**low to 10**high metres."""

    low: int
    high: int

    @classmethod
    def of(cls, variants: Sequence[VariantScore]) -> "Decades":
        """Axis that contains all errors and bounds of the variants."""
        rows = [row for variant in variants for row in variant.rows]
        errors_m = [row.error_3d_m for row in rows if row.error_3d_m is not None]
        shown_m = [max(size_m, MIN_SHOWN_M) for size_m in errors_m + [b for _, b in frames_with_bound(variants)]]
        return cls.around(shown_m)

    @classmethod
    def around(cls, shown_m: Sequence[float]) -> "Decades":
        """Axis that contains some lengths, all positive."""
        low = math.floor(math.log10(min(shown_m, default=1e-3)))
        return cls(low, max(math.ceil(math.log10(max(shown_m, default=1.0))), low + 1))

    def share(self, size_m: float) -> float:
        """Position along the axis, 0 to 1."""
        return (math.log10(max(size_m, MIN_SHOWN_M)) - self.low) / (self.high - self.low)

    def labelled_m(self) -> list[float]:
        """Decades to label, all of them up to MAX_LABELS."""
        step = math.ceil((self.high - self.low) / MAX_LABELS)
        return [10.0**decade for decade in range(self.low, self.high + 1, step)]


def frames_with_bound(variants: Sequence[VariantScore]) -> list[tuple[int, float]]:
    """Frames with a Cramer-Rao bound, and the root of its trace, metres; they are the same for every variant."""
    rows = variants[0].rows if variants else ()
    return [(row.frame, row.bound_m) for row in rows if row.bound_m is not None]


def error_plot(variants: Sequence[VariantScore]) -> str:
    """SVG of the 3D error of each frame on a logarithmic axis; failed frames are crosses in lanes below."""
    decades = Decades.of(variants)
    frames = max((v.frames for v in variants), default=0)
    lanes_top = TOP + HEIGHT + 14
    bottom = lanes_top + LANE * len(variants)

    def x(frame: float) -> float:
        return LEFT + INNER * (frame + 0.5) / max(frames, 1)

    def y(error_m: float) -> float:
        return TOP + HEIGHT * (1 - decades.share(error_m))

    radius = 3 if frames * len(variants) <= MAX_LARGE_MARKS else 2
    parts = []
    for decade_m in decades.labelled_m():
        parts.append(line(LEFT, y(decade_m), WIDTH - RIGHT, y(decade_m), "rule"))
        parts.append(text(LEFT - 8, y(decade_m) + 4, length_text(decade_m), "end"))
    steps = (digit * 10**decade for decade in itertools.count() for digit in (1, 2, 5))
    ticks = range(0, frames, next(step for step in steps if MAX_LABELS * step >= frames))
    parts += [text(x(frame), bottom + 16, str(frame), "middle") for frame in ticks]
    parts.append(text(LEFT + INNER / 2, bottom + 34, "frame", "middle"))
    parts.append(text(LEFT - 20, (lanes_top + bottom) / 2 + 4, "failed", "end"))
    for index, variant in enumerate(variants):
        lane_y = lanes_top + LANE * (index + 0.5)
        parts.append(line(LEFT, lane_y, WIDTH - RIGHT, lane_y, "rule"))
        parts.append(mark(LEFT - 10, lane_y, 3, index))
        for row in variant.rows:
            place = f"{variant.variant}, frame {row.frame}"
            if row.error_3d_m is None:
                parts.append(cross(x(row.frame), lane_y, index, f"{place}: {row.reason}"))
            else:
                title = f"{place}: {length_text(row.error_3d_m)}"
                parts.append(mark(x(row.frame), y(row.error_3d_m), radius, index, title))
    half = min(0.4 * INNER / max(frames, 1), 8.0)
    ledges = [f"M{x(frame) - half:.1f} {y(size_m):.1f}h{2 * half:.1f}" for frame, size_m in frames_with_bound(variants)]
    if ledges:
        parts.append(f'<path class="bound" d="{"".join(ledges)}"/>')
    return picture(WIDTH, bottom + BOTTOM, "3D error of each frame", parts)


def distribution_plot(variants: Sequence[VariantScore]) -> str:
    """SVG of the cumulative distribution of the 3D error over all frames; a curve ends at the success rate."""
    decades = Decades.of(variants)
    bottom = TOP + HEIGHT

    def x(error_m: float) -> float:
        return LEFT + INNER * decades.share(error_m)

    def y(share: float) -> float:
        return bottom - HEIGHT * share

    parts = []
    for percent in SHARES:
        parts.append(line(LEFT, y(percent / 100), WIDTH - RIGHT, y(percent / 100), "rule"))
        parts.append(text(LEFT - 8, y(percent / 100) + 4, f"{percent} %", "end"))
    for decade_m in decades.labelled_m():
        parts.append(line(x(decade_m), TOP, x(decade_m), bottom, "rule"))
        parts.append(text(x(decade_m), bottom + 16, length_text(decade_m), "middle"))
    parts.append(text(LEFT + INNER / 2, bottom + 34, "3D error, share of all frames", "middle"))
    bounds_m = [size_m for _, size_m in frames_with_bound(variants)]
    if bounds_m:
        rms_m = math.sqrt(math.fsum(size_m**2 for size_m in bounds_m) / len(bounds_m))
        parts.append(line(x(rms_m), TOP, x(rms_m), bottom, "bound"))
    for index, variant in enumerate(variants):
        errors_m = sorted(row.error_3d_m for row in variant.rows if row.error_3d_m is not None)
        steps = [f"H{x(error_m):.1f}V{y(k / variant.frames):.1f}" for k, error_m in enumerate(errors_m, 1)]
        parts.append(f'<path class="curve v{index}" d="M{LEFT} {bottom}{"".join(steps)}H{WIDTH - RIGHT}"/>')
        parts.append(mark(WIDTH - RIGHT, y(len(errors_m) / max(variant.frames, 1)), 3.5, index))
    return picture(WIDTH, bottom + BOTTOM, "distribution of the 3D errors over all frames", parts)


def device_plot(variants: Sequence[VariantScore], nees: bool) -> str:
    """SVG of the RMSE of each device on a logarithmic axis, or of its mean NEES; devices are grouped by map.

    The line of NEES is 3, the mean of a consistent covariance.
    """
    devices = [(one.device, one.map) for one in variants[0].by_device] if variants else []
    devices.sort(key=lambda one: (one[1], one[0]))
    place = {device: index for index, device in enumerate(devices)}
    found = [
        (index, one, value)
        for index, variant in enumerate(variants)
        for one in variant.by_device
        if (value := one.nees if nees else one.rmse_m) is not None
    ]
    decades = Decades.around([max(value, MIN_SHOWN_M) for *_, value in found] + ([3.0] if nees else []))
    bottom = TOP + HEIGHT

    def x(device: float) -> float:
        return LEFT + INNER * (device + 0.5) / max(len(devices), 1)

    def y(value: float) -> float:
        return TOP + HEIGHT * (1 - decades.share(value))

    parts = []
    for decade in decades.labelled_m():
        parts.append(line(LEFT, y(decade), WIDTH - RIGHT, y(decade), "rule"))
        parts.append(text(LEFT - 8, y(decade) + 4, f"{decade:g}" if nees else length_text(decade), "end"))
    if nees:
        parts.append(line(LEFT, y(3.0), WIDTH - RIGHT, y(3.0), "bound"))
    step = max(1, math.ceil(len(devices) / (2 * MAX_LABELS)))
    parts += [text(x(place[one]), bottom + 16, str(one[0]), "middle") for one in devices[::step]]
    for before, after in itertools.pairwise(devices):
        if before[1] != after[1]:
            edge = x(place[after] - 0.5)
            parts.append(line(edge, TOP, edge, bottom, "rule"))
    parts.append(text(LEFT + INNER / 2, bottom + 34, "device, grouped by map", "middle"))
    for index, one, value in found:
        shown = f"{value:.3g}" if nees else length_text(value)
        title = f"{variants[index].variant}, device {one.device}, map {one.map}: {shown}"
        parts.append(mark(x(place[one.device, one.map]), y(value), 3, index, title))
    label = "mean NEES of each device" if nees else "RMSE of each device"
    return picture(WIDTH, bottom + BOTTOM, label, parts)
