"""Coverage of the scores' intervals for frames that share the errors of devices and maps, by simulation.

    python benchmarks/device_intervals.py out/calibrated

Takes poses, devices, maps and stated standard deviations of a dataset with `[belief]`. Each of its frames gets the
error of the best linear estimate from its spots and gravity: the frame's gain times errors of camera, accelerometer and
map, drawn anew for each set, plus its own. Prints how many of the sets the intervals hold: the mean NEES of consistent
covariances in its 99 % interval, and the RMSE over all sets in 95 % intervals. No image is read.
"""

import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from estimator.camera.pose import Pose
from estimator.evaluate.statistics import Groups, nees, nees_by_map, rmse_interval
from estimator.io.dataset import Dataset, read_dataset
from estimator.io.truth import read_truth
from estimator.solvers.device_equations import DeviceEquations, DeviceView, Unknowns

SETS = 2000
SETS_OF_RMSE = 400
CENTROID_SIGMA_PX = 0.02


def view_of(dataset: Dataset, frame: int, row: dict[str, list[float]], leds: list[int]) -> DeviceView:
    """A frame at its true pose, with its LEDs' centroids and gravity as they would be without errors."""
    camera, stated = dataset.cameras[dataset.frames[frame].camera], dataset.accelerometer
    pose = Pose(np.array(row["position_m"]), np.array(row["R_cam_world"]).reshape(3, 3))
    return DeviceView(
        camera=camera,
        leds=tuple(dataset.leds[led] for led in leds),
        luminaires=dataset.luminaires,
        datum=dataset.map_datum,
        centroids_px=np.zeros((len(leds), 2)),
        covariance_px2=np.tile(CENTROID_SIGMA_PX**2 * np.eye(2), (len(leds), 1, 1)),
        tilt_rad=pose.rig_angles(camera)[:2],
        tilt_shot_sigma_rad=np.full(2, np.radians(stated.shot_error_deg or stated.error_deg)),
        tilt_device_sigma_rad=float(np.radians(stated.device_error_deg or 0.0)),
        tilt_lever=np.ones(2),
        pose=pose,
    )


def main(folder: Path) -> None:
    """Print the coverage for a dataset."""
    dataset = read_dataset(folder)
    truth = read_truth(folder / "truth.parquet", len(dataset.frames))
    poses = pq.read_table(folder / "truth.parquet", columns=["position_m", "R_cam_world"]).to_pylist()
    views = [
        view_of(dataset, k, poses[k], [led.led for led in true.leds if led.visible_fraction >= 1 - 1e-6])
        for k, true in enumerate(truth)
    ]
    unknowns = Unknowns([*views, *views], {})  # so that each LED is an unknown
    of_map = np.isin(unknowns.kinds, ["luminaire", "led", "datum"])
    groups = Groups.of([record.device for record in dataset.frames], [true.map for true in truth])
    gains, roots, inverses, total = [], [], [], []
    for view in views:
        line = DeviceEquations(view, unknowns).linear(view.pose, np.zeros(7), np.zeros(unknowns.count))
        # With y the common errors: the position errs by G S^-1 y, S = I + rows^T rows, and by the frame's own errors.
        S = np.eye(len(line.columns)) + line.rows.T @ line.rows
        gain = np.zeros((3, unknowns.count))
        gain[:, line.columns] = np.linalg.solve(S, line.G[:3].T).T
        covariance = line.own[:3, :3] + gain[:, line.columns] @ line.G[:3].T
        gains.append(gain)
        roots.append(np.linalg.cholesky(covariance - gain @ gain.T))
        inverses.append(np.linalg.inv(covariance))
        total.append(np.trace(covariance))
    rng = np.random.default_rng(5)
    held = dict.fromkeys(("NEES by devices", "NEES by maps", "NEES by frames", "RMSE", "RMSE by frames"), 0)
    numbers = np.unique(groups.device)
    for count in range(SETS):
        by_device = {device: rng.standard_normal(unknowns.count) * ~of_map for device in numbers.tolist()}
        by_map = {one: rng.standard_normal(unknowns.count) * of_map for one in np.unique(groups.map).tolist()}
        errors = np.array(
            [
                gain @ (by_device[device] + by_map[one]) + root @ rng.standard_normal(3)
                for gain, root, device, one in zip(gains, roots, groups.device, groups.map, strict=True)
            ]
        )
        squares = np.einsum("ni,nij,nj->n", errors, inverses, errors).tolist()
        for name, found in (
            ("NEES by devices", nees(squares, groups)),
            ("NEES by maps", nees_by_map(squares, groups)),
            ("NEES by frames", nees(squares)),
        ):
            held[name] += found is not None and found.low <= found.mean <= found.high
        if count < SETS_OF_RMSE:
            sizes = np.linalg.norm(errors, axis=1).tolist()
            for name, interval in (("RMSE", rmse_interval(sizes, groups)), ("RMSE by frames", rmse_interval(sizes))):
                held[name] += interval is not None and interval.low_m**2 <= np.mean(total) <= interval.high_m**2
    print(f"{dataset.name}: {len(views)} frames, {groups.devices} devices, {groups.maps} maps, {SETS} sets")
    for name, number in held.items():
        print(f"{name:16} {100 * number / (SETS if name.startswith('NEES') else SETS_OF_RMSE):.1f} %")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
