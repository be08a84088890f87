"""Scores as cells of tables, for the terminal and the report."""

from estimator.evaluate.comparison import Comparison
from estimator.evaluate.score import VariantScore
from estimator.evaluate.statistics import Interval, Nees, Summary

ERROR_HEADERS = (
    *(
        "ok",
        "failed",
        "success rate",
        "median of all",
        "p95 of all",
        "median",
        "95 % interval",
        "RMSE",
        "95 % interval",
    ),
    *("mean", "p95", "max", "horizontal", "vertical", "range", "time"),
)
ERROR_NOTE = (
    "Of all: median and 95th percentile over all frames; a failed frame counts as infinite error. The other columns "
    "are over the frames that succeeded: median to max of the 3D error, with bootstrap intervals; medians of "
    "horizontal, vertical and range errors (of all ranges, including those of failed frames) and of the time."
)
LIMIT_HEADERS = (
    *("frames with a bound", "bound", "RMSE there", "efficiency", "exact bound"),
    *("NEES", "99 % interval", "of", "ambiguous"),
)
LIMIT_NOTE = (
    "Bound and RMSE are root mean squares over the frames that succeeded and have a Cramér-Rao bound; efficiency is "
    "their ratio. The bound is that of a frame by itself: a variant that uses several may be below it. Exact bound: of "
    "a device that knows camera and map exactly. NEES is the mean squared error in units "
    "of the covariance that the variant reports, 3 if the covariance is consistent; above its interval the variant is "
    "overconfident, below it conservative. Ambiguous: estimates with a second one that fits nearly as well."
)
GROUP_HEADERS = ("devices", "maps", "RMSE by device", "NEES by device", "NEES by map", "99 % interval")
GROUP_NOTE = (
    "Frames of a device share the errors of its camera and map, devices in one building the map's: intervals are made "
    "of devices and maps. By device: smallest to largest of the devices; by map: the mean, and its interval with the "
    "maps as samples."
)
IDENTITY_HEADERS = (
    *("LED images", "right", "wrong", "rejected", "missed", "wrong elsewhere", "bit errors", "of bits"),
)
IDENTITY_NOTE = (
    "LED images that are whole on the sensor, by what the receiver said; wrong elsewhere: wrong identities of other "
    "images. Bits are the chips of the images that were identified, as their lines show them."
)
LOST_HEADERS = ("no good LED", "1", "2", "3", "4 or more")
LOST_NOTE = "Failed frames of all frames, by the number of LEDs whose whole image is on the sensor."
PAIR_HEADERS = ("both", "only A", "only B", "neither", "A nearer", "median A − B", "95 % interval", "Wilcoxon p")
PAIR_NOTE = (
    "Over the frames where both succeeded: the share where A is nearer, the median of A's 3D error minus B's with its "
    "bootstrap interval, and Wilcoxon's signed-rank test. The first four columns count all frames."
)

UNITS = ((1e-6, "µm"), (1e-3, "mm"), (1.0, "m"))


def error_cells(score: VariantScore) -> tuple[str, ...]:
    """Row of a variant, by ERROR_HEADERS."""
    of_all = [None] * 2 if score.of_all is None else [score.of_all.median_m, score.of_all.p95_m]
    time_s = score.median_time_s
    return (
        str(score.ok),
        str(score.failed),
        share_text(score.ok, score.frames),
        *("–" if score.of_all is None else "∞" if size_m is None else length_text(size_m) for size_m in of_all),
        _of(score.error_3d, "median_m"),
        interval_text(score.median_interval),
        _of(score.error_3d, "rmse_m"),
        interval_text(score.rmse_interval),
        *(_of(score.error_3d, field) for field in ("mean_m", "p95_m", "max_m")),
        *(_of(part, "median_m") for part in (score.horizontal, score.vertical, score.range_error)),
        "–" if time_s is None else f"{time_s * 1e3:.3g} ms",
    )


def _of(part: Summary | None, field: str) -> str:
    return "–" if part is None else length_text(getattr(part, field))


def limit_cells(score: VariantScore) -> tuple[str, ...]:
    """Row of a variant, by LIMIT_HEADERS."""
    bound, exact, consistency = score.against_bound, score.against_exact_bound, score.nees
    of_bound, of_nees = ("0", "–", "–", "–"), ("–", "–", "0")
    if bound is not None:
        efficiency = "–" if bound.efficiency is None else f"{bound.efficiency:.3g}"
        of_bound = (str(bound.frames), length_text(bound.bound_rms_m), length_text(bound.rmse_m), efficiency)
    if consistency is not None:
        of_nees = (nees_text(consistency), nees_interval_text(consistency), str(consistency.frames))
    share = f" ({share_text(score.ambiguous, score.ok)})" if score.ambiguous else ""
    of_exact = "–" if exact is None else length_text(exact.bound_rms_m)
    return (*of_bound, of_exact, *of_nees, f"{score.ambiguous}{share}")


def nees_text(consistency: Nees) -> str:
    """Mean NEES, and the verdict where it is outside its interval."""
    verdict = ""
    if not consistency.within:
        verdict = " (overconfident)" if consistency.mean > consistency.high else " (conservative)"
    return f"{consistency.mean:.3g}{verdict}"


def nees_interval_text(consistency: Nees) -> str:
    """Interval of the mean NEES of a consistent covariance."""
    return f"{consistency.low:.3g} to {consistency.high:.3g}"


def has_groups(score: VariantScore) -> bool:
    """Whether the frames are of several devices or maps."""
    return len(score.by_device) > 1


def group_cells(score: VariantScore) -> tuple[str, ...]:
    """Row of a variant, by GROUP_HEADERS."""
    sizes_m = [one.rmse_m for one in score.by_device if one.rmse_m is not None]
    squares = [one.nees for one in score.by_device if one.nees is not None]
    by_map = score.nees_by_map
    return (
        str(len({one.device for one in score.by_device})),
        str(len(score.by_map)),
        interval_text(Interval(low_m=min(sizes_m), high_m=max(sizes_m))) if sizes_m else "–",
        f"{min(squares):.3g} to {max(squares):.3g}" if squares else "–",
        "–" if by_map is None else nees_text(by_map),
        "–" if by_map is None else nees_interval_text(by_map),
    )


def identity_cells(score: VariantScore) -> tuple[str, ...]:
    """Row of a variant, by IDENTITY_HEADERS."""
    found = score.downlink
    if found is None:
        return ("–",) * len(IDENTITY_HEADERS)
    right = f"{found.right} ({share_text(found.right, found.leds)})"
    return (
        *(str(found.leds), right, str(found.wrong), str(found.rejected), str(found.missed)),
        *(str(found.wrong_elsewhere), str(found.bit_errors), str(found.bits)),
    )


def lost_cells(score: VariantScore) -> tuple[str, ...]:
    """Row of a variant, by LOST_HEADERS."""
    return tuple(f"{one.failed} of {one.frames}" if one.frames else "–" for one in score.by_good_leds)


def pair_cells(pair: Comparison) -> tuple[str, ...]:
    """Row of a comparison, by PAIR_HEADERS."""
    counts = (pair.both, pair.only_a, pair.only_b, pair.neither)
    p = "–" if pair.wilcoxon_p is None else f"{pair.wilcoxon_p:.2g}"
    return (
        *map(str, counts),
        share_text(pair.a_nearer, pair.both),
        length_text(pair.median_difference_m),
        interval_text(pair.interval),
        p,
    )


def length_text(metres: float | None) -> str:
    """Length with a unit, to three digits: `12.3 mm`, `1.23 m`; a dash for None."""
    if metres is None:
        return "–"
    # A value that rounds to 1000 takes the next unit.
    size_m, unit = next((item for item in UNITS if abs(metres) < 999.5 * item[0]), UNITS[-1])
    return f"{metres / size_m:.3g} {unit}"


def interval_text(interval: Interval | None) -> str:
    """Interval with a unit, `12.3 to 14.5 mm`; a dash for None."""
    if interval is None:
        return "–"
    low, high = length_text(interval.low_m), length_text(interval.high_m)
    value, unit = low.rsplit(" ", 1)
    return f"{value} to {high}" if high.endswith(f" {unit}") else f"{low} to {high}"


def share_text(count: int, of: int) -> str:
    """Share in percent, rounded down: `99.5 %`; a dash for a share of nothing."""
    if of == 0:
        return "–"
    tenths = 1000 * count // of
    return f"{tenths / 10:g} %"
