"""Measure the figures of docs/accuracy.md about devices that do not know the world exactly.

    python docs/measure_belief.py [SECTION ...] [--level LEVEL ...] [--frames N] [--variant NAME ...]

Sections: `stated` (the three levels), `wide` (the same with a phone's wide lens), `wrong_identities` (a tenth of the
identities exchanged), `stated_wrongly` (standard deviations stated three times too large and too small), `unstated` (a
map that is wrong and states nothing, a camera that is wrong and stated as exact), `hall` (luminaires of 60 cm),
`effects` (a halo, uneven faces, small spots), `noise` (of pixels, beside the noise that is stated), `levels` (the plot
of error against level). Datasets that are complete are kept, interrupted ones continued; estimates are made anew, but
for `levels`, which takes those that are there.
"""

import argparse
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from measure import Measurement, figure, heading, length, number, row

import estimator as est
from estimator.evaluate.levels import level_cells, levels_of
from estimator.evaluate.score import VariantScore
from estimator.methods import gravity_fit
from estimator.report.levels import level_picture

LEVELS = ("laboratory", "calibrated", "as_sold")
FITS = ("gravity-fit", "up2p", "pnp", "huynh2016")
PLOTTED = ("huynh2016", "yoshino2008", "ippe", "sqpnp", "pnp", "up2p", "gravity-fit", "ml", "self-calibrated")
"""Variants for one camera with a normal lens, but for `huynh2016-as-printed`, whose errors are kilometres."""
PICTURE = Path(__file__).parent / "pictures" / "levels.svg"
AS_SOLD_CAMERA = {
    "belief.camera.focal_percent": 1.0,
    "belief.camera.aspect_percent": 0.03,
    "belief.camera.principal_point_um": 48.0,
    "belief.camera.radial_corner_um": 6.0,
    "belief.camera.decentering_corner_um": 1.2,
    "belief.shot.focal_percent": 0.1,
    "belief.shot.principal_point_um": 24.0,
}
"""The camera of the preset `as-sold`."""
WRONG_SHARE = 0.1
WRONG: Sequence[Mapping[str, float]] = (
    {},
    {"map_mm": 0.3},
    {"map_mm": 1.0},
    {"map_mm": 10.0},
    {"focal": 1e-3},
    {"focal": 1e-2},
    {"center_px": 5.0},
    {"k1": 0.01},
)
"""Errors of the told map and camera: standard deviation, mm; relative; pixels along u and against v; coefficient."""
SMALL_SPOT_SCALES = (2, 4, 8, 20, 25)
"""LED images of office200 are some 58 px high at full size, 29 to 2.3 px here."""
UNCHECKED_SCALES = (20, 25)
"""Scales at which many frames' residuals do not check the focal length."""
NOISE_DB = (-26.0, -20.0)
"""Levels of the added noise, a twentieth and a tenth of the brightest pixel; shot noise is a sixtieth of it."""
HEADINGS = ("variant", "failed", "with 4 LEDs or more", "RMSE (95 % interval)", "RMSE / bound", "NEES (99 % interval)")


@dataclass(frozen=True)
class Chosen:
    """What the command line asks for."""

    measurement: Measurement
    levels: Sequence[str]
    frames: int
    variants: Sequence[str]

    def dataset(self, level: str, **overrides: object) -> Path:
        """The set of a level, with further overrides in its name."""
        name = "-".join([level, str(self.frames), *(f"{key}={value}" for key, value in overrides.items())])
        changes = {f"belief.{key}": value for key, value in overrides.items()}
        return self.measurement.dataset(name, level, {"poses.count": self.frames, **changes})

    def scaled(self, recipe: str, scale: int, overrides: Mapping[str, object] | None = None) -> Path:
        """The set of a recipe with `scale` x `scale` pixels in one; scale and overrides are in its name."""
        overrides = overrides or {}
        name = "-".join([recipe, *(f"{key}={value}" for key, value in overrides.items()), f"scale={scale}"])
        return self.measurement.dataset(name, recipe, overrides, scale)

    def print_scores(self, folder: Path) -> None:
        """Estimate, score, and print a row a variant."""
        est.run(folder, self.variants, self.measurement.workers)
        heading(*HEADINGS)
        scores = {of_variant.variant: of_variant for of_variant in est.score(folder).variants}
        for name in self.variants:
            print_row(scores[name])


def print_row(score: VariantScore) -> None:
    """Print a variant's row of HEADINGS."""
    (enough,) = (of for of in score.by_good_leds if of.good_leds == 4)
    cells: list[object] = [f"`{score.variant}`", f"{score.failed} of {score.frames}"]
    cells.append(f"{enough.failed} of {enough.frames}")
    interval = score.rmse_interval
    if score.error_3d is None or interval is None:
        row(*cells, "", "", "")
        return
    rmse_m = score.error_3d.rmse_m
    ends = [length(end, rmse_m).rpartition(" ")[0] for end in (interval.low_m, interval.high_m)]
    cells.append(f"{length(rmse_m)} ({ends[0]} to {ends[1]})")
    bound = score.against_bound
    cells.append("" if bound is None or not bound.efficiency else number(1 / bound.efficiency, 4))
    nees = score.nees
    cells.append("" if nees is None else f"{nees.mean:.2f} ({nees.low:.2f} to {nees.high:.2f})")
    row(*cells)


def stated(chosen: Chosen) -> None:
    """Errors of camera, map and accelerometer, stated as they are."""
    for level in chosen.levels:
        figure("level", level)
        folder = chosen.dataset(level)
        chosen.print_scores(folder)
        figure("bound, root mean square", length(_bound_rms_m(folder)))


def wide(chosen: Chosen) -> None:
    """The same errors, stated as they are, with a phone's wide lens; without bounds."""
    for level in chosen.levels:
        figure("level", f"{level}_wide")
        chosen.print_scores(chosen.dataset(f"{level}_wide"))


def _bound_rms_m(folder: Path) -> float:
    bounds = [one for one in pq.read_table(folder / "truth.parquet")["bound_m2"].to_pylist() if one is not None]
    return float(np.sqrt(np.mean([one[0] + one[4] + one[8] for one in bounds])))


def wrong_identities(chosen: Chosen) -> None:
    """A tenth of the decoded identities exchanged for those of other LEDs in view."""
    for level in chosen.levels:
        figure("level", level)
        folder = copied(chosen.dataset(level), f"wrong-{level}")
        table = pq.read_table(folder / "frames.parquet")
        generator = np.random.default_rng(1)
        frames = [_exchanged(spots, generator) for spots in table["spots"].to_pylist()]
        spots = pa.array(frames, type=table.schema.field("spots").type)
        place = table.schema.get_field_index("spots")
        pq.write_table(table.set_column(place, table.schema.field("spots"), spots), folder / "frames.parquet")
        chosen.print_scores(folder)


def _exchanged(spots: list[dict[str, Any]], generator: np.random.Generator) -> list[dict[str, Any]]:
    """Spots of which WRONG_SHARE, rounded, at least two where there are ten, pass their identities around."""
    count = round(WRONG_SHARE * len(spots))
    if count < 2:
        return spots
    wrong = generator.choice(len(spots), count, replace=False)
    led_of = dict(zip(wrong.tolist(), np.roll(wrong, 1).tolist(), strict=True))
    return [{**spot, "led": spots[led_of.get(index, index)]["led"]} for index, spot in enumerate(spots)]


def stated_wrongly(chosen: Chosen) -> None:
    """Standard deviations stated three times too large, and three times too small; frames and truth are the same."""
    for level in chosen.levels:
        for factor in (3.0, 1 / 3):
            figure("level, stated over true", f"{level}, {factor:.3g}")
            name = f"factor-{factor:.3g}-{level}"
            chosen.print_scores(told(chosen.dataset(level), name, partial(_scaled, factor=factor)))


def _scaled(device: dict[str, Any], factor: float) -> dict[str, Any]:
    """dataset.json with every stated standard deviation multiplied."""

    def times(value: Any) -> Any:
        return [times(one) for one in value] if isinstance(value, list) else value and value * factor

    def change(entry: dict[str, Any], *keys: str) -> None:
        entry.update({key: times(entry[key]) for key in keys if key in entry})

    for camera in device["cameras"].values():
        change(camera["uncertainty"], "device_sigma", "shot_sigma", "offset_sigma_m", "rotation_sigma_deg")
    for luminaire in device["luminaires"]:
        change(luminaire, "sigma_m", "sigma_rotation_deg")
    for led in device["led_map"]:
        change(led, "sigma_m", "radius_sigma_m", "side_sigma_m", "gradient_sigma")
    change(device["map_datum"] or {}, "sigma_m", "scale_sigma_ppm")
    change(device["accelerometer"], "error_deg", "device_error_deg", "shot_error_deg")
    return device


def unstated(chosen: Chosen) -> None:
    """An exact world of which the device has a wrong map or camera: it states nothing of the map, an exact camera."""
    for scale in (1, 4):
        exact = chosen.scaled("office200", scale, {"poses.count": chosen.frames})
        for wrong in WRONG:
            text = ", ".join(f"{key} {value:g}" for key, value in wrong.items()) or "nothing"
            figure("scale; wrong", f"{scale}; {text}")
            name = "-".join(["wrong", *(f"{key}={value:g}" for key, value in wrong.items()), exact.name])
            folder = told(exact, name, partial(_wrong, wrong=wrong))
            chosen.print_scores(folder)
            if "map_mm" not in wrong:
                _print_frames_alone(folder)


def _print_frames_alone(folder: Path) -> None:
    """Print what the frames say of the camera by `gravity-fit`, each by itself, and their NEES then."""
    dataset, nees, contradicting = est.read_dataset(folder), [], 0
    for record, true_m in zip(
        dataset.frames, pq.read_table(folder / "truth.parquet")["position_m"].to_pylist(), strict=True
    ):
        judged = gravity_fit.judged(est.read_frame(dataset, record))
        error_m, covariance_m2 = judged.estimate.position_m - np.array(true_m), judged.estimate.covariance_m2
        assert covariance_m2 is not None
        nees.append(float(error_m @ np.linalg.solve(covariance_m2, error_m)))
        contradicting += judged.contradicts
    figure("frames that contradict the camera", f"{contradicting} of {len(nees)}")
    figure("NEES of `gravity-fit`, each frame by itself", f"{np.mean(nees):.2f}")


def _wrong(device: dict[str, Any], wrong: Mapping[str, float]) -> dict[str, Any]:
    """dataset.json with errors of the map (standard deviation) and of the camera, as in WRONG; stated is what was."""
    generator, center_px = np.random.default_rng(1), wrong.get("center_px", 0.0)
    for led in device["led_map"]:
        led["position_m"] = (led["position_m"] + generator.normal(0, wrong.get("map_mm", 0.0) / 1000, 3)).tolist()
    for camera in device["cameras"].values():
        camera["image_distance_mm"] *= 1 + wrong.get("focal", 0.0)
        for axis, shift_px in enumerate((center_px, -center_px)):
            camera["K"][axis][axis] *= 1 + wrong.get("focal", 0.0)
            camera["K"][axis][2] += shift_px
        if "k1" in wrong:
            camera["distortion"] = {"k1": wrong["k1"], "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0}
    return device


def hall(chosen: Chosen) -> None:
    """Luminaires of 60 x 60 cm, all exact: full size, and four pixels by four in one; and cameras as sold."""
    for scale in (1, 4):
        figure("scale", scale)
        folder = chosen.scaled("hall", scale)
        chosen.print_scores(folder)
        figure("scale", f"{scale}, camera states nothing")
        chosen.print_scores(told(folder, f"silent-{folder.name}", _with_a_silent_camera))
    devices = {"belief.devices": 20, **AS_SOLD_CAMERA}
    folder = chosen.measurement.dataset("hall-as-sold-scale=4", "hall", devices, 4)
    figure("scale", "4, 20 cameras as sold, nothing stated")
    chosen.print_scores(told(folder, f"silent-{folder.name}", _with_nothing_stated))


def effects(chosen: Chosen) -> None:
    """A halo of 5 % of the light, faces with a gradient of 4 %, and small spots; all else is exact."""
    count = {"poses.count": chosen.frames}
    figure("effect", "halo of 5 %")
    chosen.print_scores(chosen.scaled("office200", 1, {**count, "camera.glare.share": 0.05}))
    gradient = chosen.scaled("office200", 1, {**count, "belief.leds.gradient_percent": 4.0})
    figure("effect", "gradient of 4 %, stated")
    chosen.print_scores(gradient)
    figure("effect", "gradient of 4 %, not stated")
    chosen.print_scores(told(gradient, f"silent-{gradient.name}", _with_a_silent_map))
    for scale in SMALL_SPOT_SCALES:
        figure("effect", f"scale {scale}")
        folder = chosen.scaled("office200", scale, count)
        chosen.print_scores(folder)
        if scale in UNCHECKED_SCALES:
            figure("effect", f"scale {scale}, camera states nothing")
            chosen.print_scores(told(folder, f"silent-{folder.name}", _with_a_silent_camera))


def noise(chosen: Chosen) -> None:
    """Noise of each pixel that the device is not told of, relative to the brightest pixel; all else is exact."""
    for level_db in NOISE_DB:
        figure("added noise over the brightest pixel", f"{level_db:g} dB")
        of_noise = {"added_noise.level_db": level_db, "added_noise.relative_to": "peak"}
        folder = chosen.scaled("office200", 1, {"poses.count": chosen.frames, **of_noise})
        chosen.print_scores(folder)
        figure("bound, root mean square", length(_bound_rms_m(folder)))


def levels(chosen: Chosen) -> None:
    """Error against level: the plot of the page, from the benchmark recipe and the three levels."""
    ideal = chosen.measurement.dataset(f"office200-{chosen.frames}", "office200", {"poses.count": chosen.frames})
    folders = [ideal, *map(chosen.dataset, LEVELS)]
    found = []
    for folder in folders:
        missing = [name for name in PLOTTED if not (folder / "estimates" / f"{name}.parquet").is_file()]
        if missing:
            est.run(folder, missing, chosen.measurement.workers)
        scores = est.score(folder)
        plotted = tuple(one for one in scores.variants if one.variant in PLOTTED)
        found.append((folder, scores.model_copy(update={"variants": plotted})))
    of_sets = levels_of(found)
    headers, rows = level_cells(of_sets)
    heading(*headers)
    for cells in rows:
        row(*cells)
    PICTURE.write_text(level_picture(of_sets), encoding="utf-8")


def _with_nothing_stated(device: dict[str, Any]) -> dict[str, Any]:
    """dataset.json of a device that is told no standard deviation but its accelerometer's."""
    device["accelerometer"].update({"device_error_deg": None, "shot_error_deg": None})
    return _with_a_silent_camera(_with_a_silent_map(device))


def _with_a_silent_map(device: dict[str, Any]) -> dict[str, Any]:
    """dataset.json of a device that is told no standard deviation of its map."""
    for led in device["led_map"]:
        led.update({key: None for key in led if "sigma" in key})
    return {**device, "luminaires": [], "map_datum": None}


def _with_a_silent_camera(device: dict[str, Any]) -> dict[str, Any]:
    """dataset.json of a device that is told no standard deviation of its cameras."""
    for camera in device["cameras"].values():
        camera["uncertainty"] = None
    return device


def told(dataset: Path, name: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> Path:
    """A copy of a dataset whose device is told something else: `change` maps its dataset.json to another."""
    folder = copied(dataset, name)
    device = json.loads((folder / "dataset.json").read_text(encoding="utf-8"))
    (folder / "dataset.json").write_text(json.dumps(change(device)), encoding="utf-8")
    return folder


def copied(dataset: Path, name: str) -> Path:
    """A copy of a dataset beside it, of which the frames are linked; an older copy is replaced."""
    folder = dataset.parent / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "frames").symlink_to((dataset / "frames").resolve())
    for file in ("dataset.json", *(path.name for path in dataset.glob("*.parquet"))):
        shutil.copy(dataset / file, folder / file)
    return folder


SECTIONS: dict[str, Callable[[Chosen], None]] = {
    section.__name__: section
    for section in (stated, wide, wrong_identities, stated_wrongly, unstated, hall, effects, noise, levels)
}


def main() -> None:
    """Print the sections that are named, by default all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {', '.join(SECTIONS)}; default: all")
    parser.add_argument("--out", type=Path, default=Path("out/measure"), help="folder of the datasets")
    parser.add_argument("--level", action="append", choices=LEVELS, help="may be repeated; default: all")
    parser.add_argument("--variant", action="append", help=f"may be repeated; default: {', '.join(FITS)}")
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    unknown = [name for name in asked.sections if name not in SECTIONS]
    if unknown:
        parser.error(f"SECTION {unknown[0]}: unknown; allowed: {', '.join(SECTIONS)}")
    asked.out.mkdir(parents=True, exist_ok=True)
    chosen = Chosen(Measurement(asked.out, asked.workers), asked.level or LEVELS, asked.frames, asked.variant or FITS)
    for name in asked.sections or SECTIONS:
        print(f"\n## {name}: {SECTIONS[name].__doc__}", flush=True)
        SECTIONS[name](chosen)


if __name__ == "__main__":
    main()
