"""Hold the error budget against rendered sets, one unknown at a time: python docs/measure_budget.py [UNKNOWN ...]

For each unknown a set is rendered in which it alone errs, by its sigma in the preset `calibrated`; all else is as told.
The device is told the sigmas of all unknowns, so that the estimator weights its spots as the budget does. Each pose has
a device of its own and one of MAPS maps, of which it sees one to three of 49 luminaires.

A line for each unknown: RMSE of the estimates; what the budget's first order makes of the errors that were drawn, which
the same luck is in; and the budget's row, the root mean square over all luck. The last two differ by chance, by some
1 / sqrt(2 frames).
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

import estimator as est
import vlcrender as vr
from estimator.camera.leveling import tilt_from_gravity
from vlcrender.api import renderer_of
from vlcrender.dataset.recipe.pose_sampling import pose_of_frame
from vlcrender.dataset.world.bound_uncertainty import uncertainty_of
from vlcrender.dataset.world.error_budget import spot_errors_at

RECIPE = "calibrated"
UNKNOWNS: Mapping[str, Mapping[str, object]] = {
    "focal_device": {"camera.focal_percent": 0.1},
    "aspect": {"camera.aspect_percent": 0.01},
    "principal_point_device": {"camera.principal_point_um": 6.0},
    "radial": {"camera.radial_corner_um": 1.2},
    "decentering": {"camera.decentering_corner_um": 0.36},
    "luminaire_xy": {"luminaires.position_mm": [3.0, 3.0, 0.0]},
    "luminaire_z": {"luminaires.position_mm": [0.0, 0.0, 3.0]},
    "luminaire_tilt": {"luminaires.tilt_deg": 0.2},
    "luminaire_yaw": {"luminaires.yaw_deg": 0.2},
    "led_xy": {"leds.position_mm": [0.3, 0.3, 0.0]},
    "led_z": {"leds.position_mm": [0.0, 0.0, 0.3]},
    "led_gradient": {"leds.gradient_percent": 5.0},
    "accelerometer_device": {"accelerometer.device_error_deg": 0.3},
}
"""By the key of a budget's row, what [belief] holds where that unknown alone errs."""
MAPS = 10
"""Maps as built; frames see different luminaires of them."""
NOTHING: Mapping[str, Mapping[str, object]] = {
    "camera": dict.fromkeys(
        ("focal_percent", "aspect_percent", "principal_point_um", "radial_corner_um", "decentering_corner_um"), 0.0
    ),
    "shot": {"focal_percent": 0.0, "principal_point_um": 0.0},
    "luminaires": {"position_mm": [0.0, 0.0, 0.0], "yaw_deg": 0.0, "tilt_deg": 0.0},
    "leds": {"position_mm": [0.0, 0.0, 0.0], "radius_percent": 0.0, "gradient_percent": 0.0},
    "accelerometer": {"device_error_deg": 0.0, "shot_error_deg": 0.0},
}
"""[belief] in which nothing errs."""


def overrides(poses: int, belief: Mapping[str, object] | None = None) -> dict[str, object]:
    """Of the recipe: a device and a map for each pose; in `belief` alone errs what it holds, everything without it."""
    common: dict[str, object] = {
        "poses.count": poses,
        "bound": False,
        "belief.devices": poses,
        "belief.maps": min(poses, MAPS),
    }
    if belief is None:
        return common
    nothing = {f"{table}.{key}": value for table, of_table in NOTHING.items() for key, value in of_table.items()}
    return {**common, **{f"belief.{key}": value for key, value in {**nothing, **belief}.items()}}


def state_all(folder: Path, stated: Path) -> None:
    """Let a set's dataset.json state the sigmas that another set's states."""
    tree, other = (json.loads((path / "dataset.json").read_text(encoding="utf-8")) for path in (folder, stated))
    for name, camera in tree["cameras"].items():
        camera["uncertainty"] = other["cameras"][name]["uncertainty"]
    for key in ("luminaires", "led_map", "map_datum", "accelerometer"):
        tree[key] = other[key]
    (folder / "dataset.json").write_text(json.dumps(tree), encoding="utf-8")


def first_order(folder: Path, poses: int, scale: int) -> dict[int, np.ndarray]:
    """By frame, the position's error that the budget's estimator makes of the errors drawn in a set, (3,), m."""
    plan = vr.load_recipe(RECIPE, overrides(poses), scale=scale)
    recipe, scene = plan.recipe, plan.scene
    (mounted,) = recipe.cameras
    uncertainty = uncertainty_of(recipe, scene, mounted)
    rows = zip(
        pq.read_table(folder / "frames.parquet").to_pylist(),
        pq.read_table(folder / "truth.parquet").to_pylist(),
        strict=True,
    )
    errors = {}
    for device, truth in rows:
        model, _ = spot_errors_at(plan, renderer_of(plan), mounted, device["pose"], uncertainty, bound=False)
        true_px = {led["led"]: (led["u_px"], led["v_px"]) for led in truth["leds"]}
        gain = None if model is None else model.gain()
        if model is None or gain is None or not true_px.keys() >= set(model.led_ids.tolist()):
            continue
        main = pose_of_frame(recipe.poses, device["pose"], recipe.seed, recipe.camera, scene)
        told_px = mounted.posed(main).project(scene.leds.centers_m[np.searchsorted(scene.leds.ids, model.led_ids)])
        shifts = np.array([true_px[led] for led in model.led_ids.tolist()]) - told_px
        tilts = np.array(tilt_from_gravity(np.array(device["accelerometer_m_s2"])))
        tilts -= np.radians([truth["tilt_x_deg"], truth["tilt_y_deg"]])
        errors[truth["frame"]] = gain @ np.concatenate([shifts.ravel(), tilts])
    return errors


def rms_mm(errors: list[np.ndarray]) -> float:
    """Root mean square of the lengths of vectors, mm."""
    return 1e3 * float(np.sqrt(np.mean([error @ error for error in errors])))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("unknowns", nargs="*", metavar="UNKNOWN", help=f"of {', '.join(UNKNOWNS)}; all by default")
    parser.add_argument("--out", type=Path, default=Path("out/budget"), help="folder of the sets")
    parser.add_argument("--poses", type=int, default=200)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--variant", default="gravity-fit")
    options = parser.parse_args()
    unknown = sorted(set(options.unknowns) - set(UNKNOWNS))
    if unknown:
        sys.exit(f"unknown {', '.join(unknown)}: allowed: {', '.join(UNKNOWNS)}")
    poses, scale = options.poses, options.scale
    all_err = options.out / "all"
    vr.generate(RECIPE, all_err, overrides=overrides(1), scale=scale)
    budget = vr.budget(vr.load_recipe(RECIPE, overrides(poses), scale=scale), poses=poses, bound=False)
    rows = {row.key: row for row in budget.rows}
    print(f"{RECIPE}, {poses} poses, scale {scale}: RMSE of {options.variant} in space, mm")
    print("| unknown | sigma | frames | rendered | by draws | budget | rendered / draws | rendered / budget |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for key in options.unknowns or UNKNOWNS:
        folder = options.out / f"{key}-{poses}-{scale}"
        if not (folder / "estimates").is_dir():
            vr.generate(RECIPE, folder, overrides=overrides(poses, UNKNOWNS[key]), scale=scale, workers=options.workers)
            state_all(folder, all_err)
        estimates = est.run(folder, [options.variant], options.workers)[options.variant]
        truth = {
            row["frame"]: np.array(row["position_m"]) for row in pq.read_table(folder / "truth.parquet").to_pylist()
        }
        found = {row.frame: np.array(row.position_m) - truth[row.frame] for row in estimates if row.status == "ok"}
        expected = first_order(folder, poses, scale)
        both = sorted(found.keys() & expected.keys())
        rendered, draws = rms_mm([found[i] for i in both]), rms_mm([expected[i] for i in both])
        row = rows[key]
        by_draws, ratio = (f"{draws:.4g}", f"{rendered / draws:.3f}") if key != "led_gradient" else ("", "")
        print(
            f"| {row.name} | {row.sigma} | {len(both)} of {poses} | {rendered:.4g} | {by_draws} | "
            f"{row.share.total_mm:.4g} | {ratio} | {rendered / row.share.total_mm:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
