"""Measure the figures of docs/accuracy.md, docs/rivals.md and README.md: python docs/measure.py [SECTION ...]

A section makes its datasets, runs variants on them, and prints the rows of the pages' tables and the single figures of
their text as `name: value`. Datasets that are complete are kept, interrupted ones continued; estimates are made anew.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from numpy.typing import NDArray

import estimator as est
import vlcrender as vr
from estimator.camera.leveling import level, tilt_from_gravity
from estimator.camera.pose import rotation
from estimator.evaluate.statistics import nees, squared_in_sigmas
from estimator.io.estimates import EstimateRow
from estimator.methods.huynh2016 import SPOTS
from estimator.solvers.ranging import law_of_sines, led_ranges
from estimator.solvers.trilateration import position_from_ranges
from estimator.spots.correspondences import find_correspondences
from estimator.spots.denoise import DENOISERS

Floats = NDArray[np.float64]
UNITS = ((1e3, "km"), (1.0, "m"), (1e-3, "mm"), (1e-6, "um"))
REGIONS = {"regions.kind": "leds"}
EXACT = {"accelerometer.error_deg": 0.0}
TABLE1_DRAWS = 30
PEAK_E = 3309
"""Electrons from the brightest LED on the axis at EXPOSURE_S, from the recipe quickstart."""
EXPOSURE_S = 160e-6
AS_PRINTED = "huynh2016-as-printed"
STAGES = (
    *("denoise=box", "denoise=none", "denoise=anscombe", "denoise=literal", "spot=brightest"),
    *(f"denoise={denoiser},spot=brightest" for denoiser in ("box", "none", "anscombe")),
    *("level=printed", "ranges=printed", "position=z-shift", "position=nonlinear"),
)
CORRECTED_STAGES = tuple(
    f"huynh2016:{stage}" for stage in ("denoise=box", "denoise=none", "denoise=anscombe", "position=nonlinear")
)
SOUND_DENOISERS = ("corrected", "box", "none", "anscombe")
STEP_RAD = 1e-6


@dataclass(frozen=True)
class Measurement:
    """Datasets in a folder, and their scores."""

    out: Path
    workers: int

    def dataset(self, name: str, recipe: str, overrides: Mapping[str, object] | None = None, scale: int = 1) -> Path:
        """The folder of a dataset, made if it is not there."""
        self._say(name)
        vr.generate(recipe, self.out / name, overrides=overrides, workers=self.workers, scale=scale)
        return self.out / name

    def scores(self, folder: Path, variants: Sequence[str]) -> pd.DataFrame:
        """Scores of variants, estimated anew; the index is the variant."""
        self._say(f"{folder.name}: {', '.join(variants)}")
        est.run(folder, variants, self.workers)
        return est.score(folder).to_pandas().set_index("variant").loc[list(variants)]

    def estimates(self, folder: Path, variant: str) -> tuple[EstimateRow, ...]:
        """Rows of a variant, estimated anew."""
        self._say(f"{folder.name}: {variant}")
        return est.run(folder, [variant], self.workers)[variant]

    def _say(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)


def length(metres: float, unit_of: float | None = None) -> str:
    """Three digits with the unit of `unit_of`, by default its own; empty for NaN."""
    if not np.isfinite(metres):
        return ""
    size_m, unit = next((one for one in UNITS if abs(unit_of or metres) >= 0.9995 * one[0]), UNITS[-1])
    return f"{metres / size_m:.3g} {unit}"


def with_interval(score: pd.Series, kind: str) -> str:
    """`median` or `rmse` with its 95 % interval."""
    value = score[f"error_3d_{kind}_m"]
    low, high = score[f"{kind}_interval_low_m"], score[f"{kind}_interval_high_m"]
    ends = [length(end, value).rpartition(" ")[0] for end in (low, high)]
    return f"{length(value)} ({ends[0]} to {ends[1]})" if np.isfinite(value) else ""


def with_limits(score: pd.Series) -> str:
    """NEES with the 99 % interval of consistent covariances."""
    return f"{score['nees_mean']:.2f} ({score['nees_low']:.2f} to {score['nees_high']:.2f})"


def number(value: float, digits: int = 3) -> str:
    """Digits of a number; empty for NaN."""
    return f"{value:.{digits}g}" if np.isfinite(value) else ""


def figure(name: str, value: object) -> None:
    """Print a single figure."""
    print(f"{name}: {value}")


def row(*cells: object) -> None:
    """Print a row of a table."""
    print(f"| {' | '.join(map(str, cells))} |")


def heading(*names: str) -> None:
    """Print the first two lines of a table."""
    print()
    row(*names)
    row(*["---"] * len(names))


def error_row(name: str, score: pd.Series, parts: bool = True) -> None:
    """Failures, median, RMSE and maximum of a variant; with `parts` also horizontal and vertical medians."""
    kinds = ["error_3d_median_m", "error_3d_rmse_m", "error_3d_max_m"]
    kinds += ["horizontal_median_m", "vertical_median_m"] if parts else []
    row(name, f"{score['failed']} of {score['frames']}", *(length(score[kind]) for kind in kinds))


def truth_of(folder: Path) -> list[dict[str, Any]]:
    """Rows of truth.parquet."""
    rows: list[dict[str, Any]] = pq.read_table(folder / "truth.parquet").to_pylist()
    return rows


def whole_leds(folder: Path) -> str:
    """Fewest and most LEDs seen whole in a frame."""
    counts = [sum(led["visible_fraction"] == 1 for led in true["leds"]) for true in truth_of(folder)]
    return f"{min(counts)} to {max(counts)}"


def office200(measure: Measurement) -> None:
    """The benchmark set."""
    folder = measure.dataset("office200", "office200")
    figure("LEDs seen whole", whole_leds(folder))
    scores = measure.scores(folder, [variant.name for variant in est.variants()])
    heading("variant", "failed", "median (95 % interval)", "RMSE (95 % interval)", "maximum", "bound / RMSE", "NEES")
    for name, score in scores.iterrows():
        errors = [with_interval(score, "median"), with_interval(score, "rmse"), length(score["error_3d_max_m"])]
        limits = [number(score["against_bound_efficiency"]), number(score["nees_mean"])]
        row(f"`{name}`", score["failed"], *errors, *limits)
    ml = scores.loc["ml"]
    figure("bound, root mean square", length(ml["against_bound_bound_rms_m"]))
    figure("NEES of ml", with_limits(ml))
    squares, ratios = [], []
    for estimate, true in zip(measure.estimates(folder, "ml"), truth_of(folder), strict=True):
        error_m = np.subtract(estimate.position_m, true["position_m"])
        squares.append(squared_in_sigmas(error_m, tuple(true["bound_m2"])))
        own, bound = (np.reshape(matrix, (3, 3)) for matrix in (estimate.covariance_m2, true["bound_m2"]))
        ratios.append(np.sqrt(np.trace(own) / np.trace(bound)))
    figure("NEES of ml by the bound", f"{nees(squares).mean:.2f}")
    figure("ml's standard deviation over the bound's, smallest and largest", f"{min(ratios):.4f} {max(ratios):.4f}")
    exact = measure.dataset("office200-exact", "office200", {**EXACT, "bound": False})
    for name, score in measure.scores(exact, ["huynh2016", "ml"]).iterrows():
        figure(f"exact accelerometer, {name}, median, maximum", _median_and_maximum(score))


def office20(measure: Measurement) -> None:
    """Twenty whole frames."""
    scores = measure.scores(measure.dataset("office20", "office20"), ["ml", "gravity-fit", "huynh2016"])
    for name, score in scores.iterrows():
        figure(f"{name}, failed", score["failed"])
        figure(f"{name}, median", with_interval(score, "median"))
        figure(f"{name}, RMSE", with_interval(score, "rmse"))
    figure("bound, root mean square", length(scores.loc["ml", "against_bound_bound_rms_m"]))
    figure("NEES of ml", with_limits(scores.loc["ml"]))


def draws(measure: Measurement) -> None:
    """500 draws of one pose."""
    overrides = {"poses.count": 1, "repeats": 500, "bound": True, "accelerometer.error_deg": 0.5, **REGIONS}
    _ml_against_bound(measure, measure.dataset("draws", "quickstart", overrides), "draws")


def blur(measure: Measurement) -> None:
    """Twelve poses through lenses with a blur."""
    overrides = {"poses.count": 12, "bound": True, "accelerometer.error_deg": 0.5, **REGIONS}
    focused = measure.dataset("focused", "quickstart", {**overrides, "camera.focus_distance_m": 3.0})
    _ml_against_bound(measure, focused, "focused at 3 m")
    diffraction = measure.dataset("diffraction", "quickstart", {**overrides, "camera.psf": "diffraction"})
    _ml_against_bound(measure, diffraction, "diffraction")


def _ml_against_bound(measure: Measurement, folder: Path, name: str) -> None:
    score = measure.scores(folder, ["ml"]).loc["ml"]
    figure(f"{name}, ml, failed", score["failed"])
    figure(f"{name}, ml, RMSE", with_interval(score, "rmse"))
    figure(f"{name}, bound, root mean square", length(score["against_bound_bound_rms_m"]))
    figure(f"{name}, NEES", with_limits(score))
    figure(f"{name}, seconds a frame, median", number(score["median_time_s"]))


def _median_and_maximum(score: pd.Series) -> str:
    return f"{length(score['error_3d_median_m'])}, {length(score['error_3d_max_m'])}"


def quickstart(measure: Measurement) -> None:
    """The quickstart set, with noise and without."""
    folder = _noisy(measure)
    figure("LEDs seen whole", whole_leds(folder))
    dataset = est.read_dataset(folder)
    frames = [est.read_frame(dataset, record) for record in dataset.frames]
    figure("most electrons of a pixel", max(float(f.electrons(part).max()) for f in frames for part in f.parts))
    names = ["huynh2016", "huynh2016:ranges=printed", AS_PRINTED, "pnp", "gravity-fit", "ml"]
    scores = measure.scores(folder, names)
    heading("variant", "failed", "median", "RMSE", "maximum", "horizontal, median", "vertical, median")
    for name, score in scores.iterrows():
        error_row(f"`{name}`", score)
    for name in ("yoshino2008", "ippe", "sqpnp", "up2p"):
        figure(f"{name}, median, maximum", _median_and_maximum(measure.scores(folder, [name]).loc[name]))
    ideal = measure.scores(_ideal(measure), ["huynh2016"]).loc["huynh2016"]
    figure("without noise, exact accelerometer, huynh2016, median, maximum", _median_and_maximum(ideal))


def _noisy(measure: Measurement, error_deg: float = 0.1) -> Path:
    """The quickstart set with another error of the accelerometer."""
    name = "quickstart" if error_deg == 0.1 else f"quickstart-{error_deg:g}-deg"
    return measure.dataset(name, "quickstart", {"accelerometer.error_deg": error_deg})


def _exact(measure: Measurement) -> Path:
    return _noisy(measure, 0.0)


def _ideal(measure: Measurement) -> Path:
    return measure.dataset("ideal", "quickstart", {**EXACT, "sensor.noise": "none"})


def table1(measure: Measurement) -> None:
    """Table 1's four LEDs; the shares of poses that see them are printed by `vlcrender show`."""
    grid = {"poses.columns": 3, "poses.rows": 3}
    folder = measure.dataset("table1", "table1", grid)
    for name, score in measure.scores(folder, ["huynh2016", "gravity-fit", "ippe", "pnp"]).iterrows():
        figure(f"{name}, failed of 9, median, maximum", f"{score['failed']}, {_median_and_maximum(score)}")
    folder = measure.dataset("table1-draws", "table1", {**grid, "repeats": TABLE1_DRAWS})
    measure.scores(folder, ["pnp"])
    errors_m = est.score(folder).frames_to_pandas()["error_3d_m"].to_numpy().reshape(-1, TABLE1_DRAWS)
    wrong = (errors_m > 1.0).sum(axis=1)
    figure(f"pnp, draws of {TABLE1_DRAWS} wrong by more than 1 m, by pose", wrong.tolist())


def stages(measure: Measurement) -> None:
    """The stages of the paper's method."""
    exact = _exact(measure)
    titles = {"huynh2016": "(nothing)", AS_PRINTED: "(all as printed)"}
    names = ["huynh2016", *(f"huynh2016:{stage}" for stage in STAGES), AS_PRINTED]
    heading("`huynh2016:`", "failed", "median", "RMSE", "maximum", "horizontal, median", "vertical, median")
    for name, score in measure.scores(exact, names).iterrows():
        error_row(titles.get(name, f"`{name.partition(':')[2]}`"), score)
    columns: dict[str, list[str]] = {}
    for electrons in (100, 8):
        exposure = {"exposure_s": EXPOSURE_S * electrons / PEAK_E}
        folder = measure.dataset(f"{electrons}-electrons", "quickstart", {**EXACT, **exposure})
        for spot in ("centroid", "brightest"):
            scores = measure.scores(folder, [f"huynh2016:denoise={one},spot={spot}" for one in SOUND_DENOISERS])
            failed = [f", {count} failed" if count else "" for count in scores["failed"]]
            columns[f"{electrons} e, {spot}"] = [
                length(median) + more for median, more in zip(scores["error_3d_median_m"], failed, strict=True)
            ]
    heading("`denoise=`", *columns)
    for name, cells in zip(SOUND_DENOISERS, zip(*columns.values(), strict=True), strict=True):
        row(f"`{name}`", *cells)
    for name, score in measure.scores(_noisy(measure), ["huynh2016", *CORRECTED_STAGES]).iterrows():
        figure(f"0.1 deg, {name}, median", length(score["error_3d_median_m"]))
    for name in SOUND_DENOISERS:
        noisy, quiet = spots_px(exact, name, "centroid"), spots_px(_ideal(measure), name, "centroid")
        figure(f"centroid, {name}, with minus without noise", _scatter(noisy, quiet))
    centers = {
        (true["frame"], led["led"]): np.array([led["u_px"], led["v_px"]])
        for true in truth_of(exact)
        for led in true["leds"]
    }
    for name in ("none", "corrected"):
        figure(
            f"brightest pixel, {name}, minus the LED's centre", _scatter(spots_px(exact, name, "brightest"), centers)
        )


def spots_px(folder: Path, denoise: str, spot: str) -> dict[tuple[int, int], Floats]:
    """Spots (u, v) by frame and LED."""
    dataset, denoiser = est.read_dataset(folder), DENOISERS[denoise]
    found = {}
    for record in dataset.frames:
        frame = est.read_frame(dataset, record)
        correspondences = find_correspondences(frame, denoiser)
        for one, place_px in zip(correspondences, SPOTS[spot](correspondences), strict=True):
            found[record.frame, one.led.id] = place_px
    return found


def _scatter(spots: dict[tuple[int, int], Floats], places: dict[tuple[int, int], Floats]) -> str:
    both = spots.keys() & places.keys()
    return f"{np.sqrt(np.mean([np.square(spots[key] - places[key]) for key in both])):.2g} px rms"


def accelerometer(measure: Measurement) -> None:
    """Error of huynh2016 by the accelerometer's: predicted to first order, and measured."""
    columns: dict[str, list[str]] = {}
    for error_deg in (0.0, 0.1, 0.5, 2.0):
        folder = _noisy(measure, error_deg)
        rows = measure.estimates(folder, "huynh2016")
        true_m, predicted_m = (np.array(part) for part in zip(*predictions(folder, rows), strict=True))
        measured_m = np.array([one.position_m for one in rows]) - true_m
        predicted, measured, rest = (
            np.linalg.norm(errors, axis=1) for errors in (predicted_m, measured_m, measured_m - predicted_m)
        )
        columns[f"{error_deg:g} deg"] = [
            *(length(part(errors)) for part in (np.median, np.max) for errors in (predicted, measured)),
            f"{length(np.median(rest))} ({length(rest.max())})",
        ]
    kinds = [f"{kind}, {part}" for part in ("median", "maximum") for kind in ("predicted", "measured")]
    heading("error on each axis", *columns)
    kinds.append("measured minus predicted, as vectors, median (maximum)")
    for kind, cells in zip(kinds, zip(*columns.values(), strict=True), strict=True):
        row(kind, *cells)


def predictions(folder: Path, estimates: Sequence[EstimateRow]) -> Iterator[tuple[Floats, Floats]]:
    """True position and error to first order in the tilt's error, (3,) each, from exact pixels of the LEDs used."""
    dataset = est.read_dataset(folder)
    for record, estimate, true in zip(dataset.frames, estimates, truth_of(folder), strict=True):
        K = dataset.cameras[record.camera].matrix()
        used = {led_range.led for led_range in estimate.ranges}
        leds = [led for led in true["leds"] if led["led"] in used]
        leds_m = np.array([dataset.leds[led["led"]].position_m for led in leds])
        pixels = np.array([(led["u_px"], led["v_px"]) for led in leds])

        def position(tilt: Floats, K: Floats = K, leds_m: Floats = leds_m, pixels: Floats = pixels) -> Floats:
            ranges_m = led_ranges(level(pixels, K, rotation(*tilt)), K, leds_m, law_of_sines)
            return position_from_ranges(leds_m, ranges_m)

        exact = np.radians([true["tilt_x_deg"], true["tilt_y_deg"]])
        error = np.array(tilt_from_gravity(record.accelerometer_m_s2)) - exact
        slope = np.column_stack(
            [(position(exact + STEP_RAD * axis) - position(exact - STEP_RAD * axis)) for axis in np.eye(2)]
        ) / (2 * STEP_RAD)
        yield np.array(true["position_m"]), slope @ error


def rivals(measure: Measurement) -> None:
    """The rivals of Table 3."""
    tilts = {"poses.tilt_x_deg": [0.0, 40.0], "poses.tilt_y_deg": [0.0, 40.0]}
    sets = {
        "`quickstart`, `poses.count=16`": (
            measure.dataset("quickstart16", "quickstart", {"poses.count": 16}),
            ["yoshino2008", "huynh2016"],
        ),
        "`fisheye`, tilted up to 20 deg": (measure.dataset("fisheye", "fisheye"), ["nakazawa2013", "huynh2016"]),
        "`stereo`, level, 10 cm apart": (
            measure.dataset("stereo", "stereo"),
            ["rahman2011", "kim", "yoshino2008", "huynh2016"],
        ),
        "`stereo`, 1 deg on one axis": (
            measure.dataset("stereo-one-degree", "stereo", {"poses.tilt_x_deg": [1.0, 1.0]}),
            ["rahman2011", "kim"],
        ),
        "`stereo`, 0 to 40 deg on both": (measure.dataset("stereo-tilted", "stereo", tilts), ["rahman2011", "kim"]),
    }
    scores = {name: measure.scores(folder, variants) for name, (folder, variants) in sets.items()}
    heading("recipe", "frames", "variant", "failed", "median", "RMSE", "maximum")
    for name, of_set in scores.items():
        for k, (variant, score) in enumerate(of_set.iterrows()):
            errors = (length(score[f"error_3d_{kind}_m"]) for kind in ("median", "rmse", "max"))
            row(*((name, score["frames"]) if k == 0 else ("", "")), f"`{variant}`", score["failed"], *errors)
    level_set, fisheye = scores["`stereo`, level, 10 cm apart"], scores["`fisheye`, tilted up to 20 deg"]
    figure("stereo, rahman2011, range error, median", length(level_set.loc["rahman2011", "range_error_median_m"]))
    for variant in ("yoshino2008", "kim", "rahman2011"):
        figure(f"stereo, {variant}, vertical, median", length(level_set.loc[variant, "vertical_median_m"]))
    figure("fisheye, nakazawa2013, vertical, median", length(fisheye.loc["nakazawa2013", "vertical_median_m"]))


def published_since(measure: Measurement) -> None:
    """Methods published since the paper, on images of a sixteenth of the pixels."""
    fits = ["pnp", "ml"]
    sets = {
        "`hall`, scale 4": (
            measure.dataset("hall-quarter", "hall", scale=4),
            ["gopa", "eca-rssr", "r-p3p", "v-p4l", "lc-vlp", *fits],
        ),
        "`quickstart`, scale 4": (
            measure.dataset("quickstart-quarter", "quickstart", scale=4),
            ["gopa", "eca-rssr", "r-p3p", "v-pca", "circle-centre", "lc-vlp", *fits],
        ),
    }
    heading("recipe", "frames", "variant", "failed", "median", "RMSE", "maximum", "time over `pnp`'s")
    for name, (folder, variants) in sets.items():
        scores = measure.scores(folder, variants)
        for k, (variant, score) in enumerate(scores.iterrows()):
            errors = (length(score[f"error_3d_{kind}_m"]) for kind in ("median", "rmse", "max"))
            times = f"{score['median_time_s'] / scores.loc['pnp', 'median_time_s']:.1f}"
            row(*((name, score["frames"]) if k == 0 else ("", "")), f"`{variant}`", score["failed"], *errors, times)


def self_calibrated(measure: Measurement) -> None:
    """Frames of a device together: 80 frames of each of five devices, at three levels of knowledge."""
    heading("level", "variant", "failed", "median (95 % interval)", "RMSE (95 % interval)", "NEES (99 % interval)")
    for level_name in ("laboratory", "calibrated", "as_sold"):
        overrides = {"belief.devices": 5, "belief.maps": 4, "poses.count": 400, "bound": False}
        folder = measure.dataset(f"{level_name}-5-devices", level_name, overrides)
        scores = measure.scores(folder, ["gravity-fit", "self-calibrated"])
        for name, score in scores.iterrows():
            errors = [with_interval(score, "median"), with_interval(score, "rmse")]
            row(level_name, f"`{name}`", score["failed"], *errors, with_limits(score))
        together, alone = (scores.loc[name, "error_3d_rmse_m"] for name in ("self-calibrated", "gravity-fit"))
        figure(f"{level_name}, RMSE of self-calibrated over that of gravity-fit", number(together / alone))


SECTIONS: dict[str, Callable[[Measurement], None]] = {
    section.__name__: section
    for section in (
        *(office200, office20, draws, blur, quickstart, table1, stages, accelerometer, rivals),
        *(published_since, self_calibrated),
    )
}


def main() -> None:
    """Print the sections that are named, by default all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {', '.join(SECTIONS)}; default: all")
    parser.add_argument("--out", type=Path, default=Path("out/measure"), help="folder of the datasets")
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    unknown = [name for name in chosen.sections if name not in SECTIONS]
    if unknown:
        parser.error(f"SECTION {unknown[0]}: unknown; allowed: {', '.join(SECTIONS)}")
    chosen.out.mkdir(parents=True, exist_ok=True)
    for name in chosen.sections or SECTIONS:
        print(f"\n## {name}: {SECTIONS[name].__doc__}", flush=True)
        SECTIONS[name](Measurement(chosen.out, chosen.workers))


if __name__ == "__main__":
    main()
