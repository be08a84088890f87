"""A recipe into a dataset: plan, frames, tables. Resumable; the same bits for any order and number of workers."""

import json
import multiprocessing
import os
import platform
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from vlcrender import __version__
from vlcrender.dataset import (
    FRAMES_SCHEMA,
    TRUTH_SCHEMA,
    AccelerometerEntry,
    DatasetFile,
    SensorEntry,
    camera_entry,
    exr_attributes,
    led_map,
    problems_of,
    sha256_of,
    write_exr,
    write_json,
    write_preview,
    write_table,
)
from vlcrender.downlink import decoded_spots
from vlcrender.errors import InputError
from vlcrender.poses import pose_of_frame
from vlcrender.recipe import Plan, Recipe
from vlcrender.render import Renderer, check_inside
from vlcrender.scene import Scene, SceneSettings, build_scene
from vlcrender.streams import stream

CAMERA_NAME = "main"
FRAMES, EXPECTED, PREVIEWS = "frames", "expected", "previews"

Record = dict[str, Any]
"""One frame's rows: {"frame": n, "device": row of frames.parquet, "truth": row of truth.parquet}."""


@dataclass(frozen=True)
class Job:
    """What a worker needs to make any frame; small, so that it travels."""

    recipe_json: str
    scene_json: str
    directory: str


def generate(
    plan: Plan,
    directory: Path,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> bool:
    """Make the dataset of a plan in `directory`. Returns False where it was already there, complete and intact.

    Goes on from an interrupted run of the same plan. Raises InputError where the folder holds anything else.
    """
    provenance = _provenance(plan)
    if (directory / "dataset.json").exists():
        _check_same(directory / "dataset.json", provenance, "a dataset of another recipe, scene or version")
        damage = problems_of(directory)
        if damage:
            raise InputError(f"{directory}: is complete but damaged: {damage[0]}; delete it or choose another --out")
        return False
    for frame in range(plan.recipe.poses.count):  # impossible poses are found before the first image
        check_inside(plan.scene, _pose(plan.recipe, plan.scene, frame))
    _prepare(directory, provenance, plan.recipe.expected)
    job = Job(plan.recipe.model_dump_json(), plan.scene.settings.model_dump_json(), str(directory))
    done = _journal(directory)
    missing = [frame for frame in range(plan.recipe.poses.count) if frame not in done]
    if done:
        progress(len(done), plan.recipe.poses.count)
    with (directory / "journal.jsonl").open("a", encoding="utf-8") as journal:
        for record in _records(job, missing, workers, scheduler):
            done[record["frame"]] = record
            journal.write(json.dumps(record) + "\n")
            journal.flush()
            progress(len(done), plan.recipe.poses.count)
    _finish(plan, directory, provenance, [done[frame] for frame in sorted(done)])
    return True


def make_frame(job: Job, frame: int) -> Record:
    """Render, expose and write one frame; depends on nothing but its arguments."""
    recipe, renderer = _renderer(job.recipe_json, job.scene_json)
    directory = Path(job.directory)
    pose = _pose(recipe, renderer.scene, frame)
    view = renderer.view(recipe.camera, pose)
    expected = view.expected_electrons(recipe.exposure_s)
    dn = recipe.sensor.expose(expected, stream(recipe.seed, frame, "shot-noise"))
    attributes = exr_attributes(recipe.camera, CAMERA_NAME, recipe.exposure_s, frame)
    file = f"{FRAMES}/{frame:06d}.exr"
    digest = write_exr(directory / file, dn, attributes)
    if recipe.expected:
        write_exr(directory / EXPECTED / f"{frame:06d}.exr", expected, attributes)
    write_preview(directory / PREVIEWS / f"{frame:06d}.png", dn, recipe.sensor.largest_dn)
    size = recipe.camera.width_px, recipe.camera.height_px
    reading = recipe.accelerometer.reading_m_s2(pose, stream(recipe.seed, frame, "accelerometer"))
    device = {
        "frame": frame,
        "file": file,
        "sha256": digest,
        "camera": CAMERA_NAME,
        "exposure_s": recipe.exposure_s,
        "accelerometer_m_s2": reading.tolist(),
        "spots": decoded_spots(view.patches, *size, stream(recipe.seed, frame, "demodulator")),
    }
    truth = {
        "frame": frame,
        "position_m": list(pose.position_m),
        "R_cam_world": pose.rotation.ravel().tolist(),
        "tilt_x_deg": pose.tilt_x_deg,
        "tilt_y_deg": pose.tilt_y_deg,
        "yaw_deg": pose.yaw_deg,
        "leds": [
            {"led": p.led_id, "u_px": p.center_px[0], "v_px": p.center_px[1], "visible_fraction": p.visible_fraction}
            for p in sorted(view.patches, key=lambda p: p.led_id)
        ],
    }
    return {"frame": frame, "device": device, "truth": truth}


def _pose(recipe: Recipe, scene: Scene, frame: int) -> Any:
    return pose_of_frame(recipe.poses, frame, recipe.seed, recipe.camera, scene)


@cache
def _renderer(recipe_json: str, scene_json: str) -> tuple[Recipe, Renderer]:
    """One renderer a process and plan."""
    scene = build_scene(SceneSettings.model_validate_json(scene_json), "scene")
    return Recipe.model_validate_json(recipe_json), Renderer(scene)


def _records(job: Job, frames: list[int], workers: int, scheduler: str | None) -> Iterator[Record]:
    if scheduler is not None:
        yield from _on_cluster(job, frames, scheduler)
    elif workers == 1 or len(frames) <= 1:
        for frame in frames:
            yield make_frame(job, frame)
    else:
        yield from _in_processes(job, frames, workers)


def _in_processes(job: Job, frames: list[int], workers: int) -> Iterator[Record]:
    # spawn: a forked child of a process that ran kernels is left with one thread
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(frames)), context, initializer=_leave_interrupts_to_parent) as pool:
        pending: set[Future[Record]] = set()
        queue = iter(frames)
        try:
            while True:
                while len(pending) < 2 * workers and (frame := next(queue, None)) is not None:
                    pending.add(pool.submit(make_frame, job, frame))
                if not pending:
                    return
                finished, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield future.result()
        finally:
            for future in pending:
                future.cancel()


def _leave_interrupts_to_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _on_cluster(job: Job, frames: Iterable[int], address: str) -> Iterator[Record]:
    try:
        from dask.distributed import Client, as_completed
    except ImportError:
        raise InputError(f"--scheduler {address}: needs dask.distributed: pip install 'vlcrender[cluster]'") from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: no scheduler answers: {error}") from None
    with client:
        futures = client.map(lambda frame: make_frame(job, frame), list(frames), pure=False)
        for future in as_completed(futures):
            yield future.result()
            future.release()


def _provenance(plan: Plan) -> dict[str, Any]:
    recipe = plan.recipe.model_dump(mode="json")
    recipe["seed"] = str(plan.recipe.seed)  # JSON readers round integers beyond 2**53
    return {
        "recipe": recipe,
        "scene": plan.scene.settings.model_dump(mode="json"),
        "versions": {
            "vlcrender": __version__,
            **{package: version(package) for package in ("mitsuba", "drjit", "numpy", "OpenEXR")},
            "python": platform.python_version(),
        },
    }


def _check_same(path: Path, provenance: dict[str, Any], what: str) -> None:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        same = tree["provenance"] == json.loads(json.dumps(provenance))
    except (ValueError, KeyError, TypeError, OSError):
        raise InputError(f"{path}: is damaged; delete {path.parent} or choose another --out") from None
    if not same:
        raise InputError(f"{path.parent}: holds {what}; nothing was changed; choose another --out or delete it")


def _prepare(directory: Path, provenance: dict[str, Any], expected: bool) -> None:
    plan_file = directory / "plan.json"
    if plan_file.exists():
        _check_same(plan_file, provenance, "an unfinished dataset of another recipe, scene or version")
    elif directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise InputError(f"{directory}: is not empty and not a dataset; nothing was changed; choose another --out")
    for name in (FRAMES, PREVIEWS, *([EXPECTED] if expected else [])):
        (directory / name).mkdir(parents=True, exist_ok=True)
    for leftover in directory.rglob("*.partial"):
        leftover.unlink()
    write_json(plan_file, {"provenance": provenance})


def _journal(directory: Path) -> dict[int, Record]:
    """Frames that an interrupted run finished and whose files are still intact."""
    path = directory / "journal.jsonl"
    if not path.exists():
        return {}
    done: dict[int, Record] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            record = json.loads(line)
            file = directory / record["device"]["file"]
            if file.is_file() and sha256_of(file) == record["device"]["sha256"]:
                done[int(record["frame"])] = record
        except (ValueError, KeyError, TypeError):
            continue  # the line a crash cut short: that frame is made again
    write_partial = path.with_suffix(".partial")
    write_partial.write_text("".join(json.dumps(record) + "\n" for record in done.values()), encoding="utf-8")
    os.replace(write_partial, path)
    return done


def _finish(plan: Plan, directory: Path, provenance: dict[str, Any], records: list[Record]) -> None:
    recipe, scene = plan.recipe, plan.scene
    write_table(directory / "frames.parquet", [record["device"] for record in records], FRAMES_SCHEMA)
    write_table(directory / "truth.parquet", [record["truth"] for record in records], TRUTH_SCHEMA)
    dataset = DatasetFile(
        format="vlcrender-dataset",
        version=1,
        name=recipe.name,
        frame_count=len(records),
        cameras={CAMERA_NAME: camera_entry(recipe.camera)},
        sensor=SensorEntry(**recipe.sensor.model_dump()),
        accelerometer=AccelerometerEntry(**recipe.accelerometer.model_dump()),
        led_map=led_map(scene.leds),
        room_m=scene.settings.room.size_m,
        provenance=provenance,
    )
    write_json(directory / "dataset.json", dataset.model_dump(mode="json"))
    (directory / "plan.json").unlink()
    (directory / "journal.jsonl").unlink()
