"""A recipe into a dataset: plan, frames, tables. Resumable; the same bits for any order and number of workers."""

import json
import multiprocessing
import os
import platform
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from importlib.metadata import version
from pathlib import Path
from typing import Any

from vlcrender.dataset.files import (
    FRAMES,
    FRAMES_SCHEMA,
    TRUTH_SCHEMA,
    AccelerometerEntry,
    DatasetFile,
    SensorEntry,
    camera_entry,
    led_map,
    sha256_of,
    write_json,
    write_table,
)
from vlcrender.dataset.frame_job import Job, Record, make_frame, poses_of
from vlcrender.dataset.recipe import Plan, Recipe
from vlcrender.dataset.verify import folders_of, missing_files, problems_of
from vlcrender.errors import InputError
from vlcrender.light.lightmap import bake, room_mesh
from vlcrender.rendering.renderer import check_inside, share_cores


def generate(
    plan: Plan,
    directory: Path,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    baking: Callable[[str, float], None] = lambda stage, share: None,
) -> bool:
    """Make the dataset of a plan in `directory`. Returns False where it was already there, complete and intact.

    Goes on from an interrupted run of the same plan. `progress` is told (frames done, frames in all), `baking` (stage
    of the room's light, share done). Raises InputError where the folder holds anything else.
    """
    try:
        str(directory).encode()
    except UnicodeEncodeError:
        raise InputError(f"--out {directory}: is no UTF-8 name, which EXR files need") from None
    provenance = _provenance(plan)
    if (directory / "dataset.json").exists():
        _check_same(directory / "dataset.json", provenance, "a dataset of another recipe, scene or version")
        damage = problems_of(directory)
        if damage:
            raise InputError(f"{directory}: is complete but damaged: {damage[0]}; delete it or choose another --out")
        return False
    for pose_number in range(plan.recipe.poses.count):  # impossible poses are found before the first image
        for which in range(len(plan.recipe.cameras)):
            _, during = poses_of(plan.recipe, plan.scene, pose_number, which)
            check_inside(plan.scene, during[0])
            check_inside(plan.scene, during[-1])
    room_mesh(plan.scene)  # furniture that cannot be used is found before anything is written
    _prepare(directory, provenance, plan.recipe)
    job = Job(
        plan.recipe.model_dump_json(), plan.scene.settings.model_dump_json(), str(plan.scene.folder), str(directory)
    )
    done = _journal(directory, plan.recipe)
    missing = [frame for frame in range(plan.recipe.frame_count) if frame not in done]
    if done:
        progress(len(done), plan.recipe.frame_count)
    bake(plan.scene, progress=baking)  # into the cache, from which every worker takes it
    with (directory / "journal.jsonl").open("a", encoding="utf-8") as journal:
        for record in _records(job, missing, workers, scheduler):
            done[record["frame"]] = record
            journal.write(json.dumps(record) + "\n")
            journal.flush()
            progress(len(done), plan.recipe.frame_count)
    _finish(plan, directory, provenance, [done[frame] for frame in sorted(done)])
    return True


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
    pool = ProcessPoolExecutor(min(workers, len(frames)), context, _start_worker, (workers,))
    pending: set[Future[Record]] = set()
    queue = iter(frames)
    try:
        while True:
            # Children start as tasks come. Interrupts are the parent's: they would otherwise each print a traceback.
            # A mask is inherited; an interrupt that came meanwhile is delivered after.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                while len(pending) < 2 * workers and (frame := next(queue, None)) is not None:
                    pending.add(pool.submit(make_frame, job, frame))
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            if not pending:
                return
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                yield future.result()
    except BrokenProcessPool:
        raise InputError(
            f"{job.directory}: a worker process died (out of memory?); run the same command again to go on, "
            "with fewer --workers"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(workers: int) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    share_cores(workers)


def _end_with_parent() -> None:
    """Where the parent is killed, nobody would ever tell its children to stop."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


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
            **{package: version(package) for package in ("vlcrender", "mitsuba", "drjit", "numpy", "OpenEXR")},
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


def _prepare(directory: Path, provenance: dict[str, Any], recipe: Recipe) -> None:
    plan_file = directory / "plan.json"
    if plan_file.exists():
        _check_same(plan_file, provenance, "an unfinished dataset of another recipe, scene or version")
    elif directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise InputError(f"{directory}: is not empty and not a dataset; nothing was changed; choose another --out")
    for name in [FRAMES, *folders_of(recipe.expected, recipe.processed is not None)]:
        (directory / name).mkdir(parents=True, exist_ok=True)
    for leftover in directory.rglob("*.partial"):
        leftover.unlink()
    write_json(plan_file, {"provenance": provenance})


def _journal(directory: Path, recipe: Recipe) -> dict[int, Record]:
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
    folders = folders_of(recipe.expected, recipe.processed is not None)
    for frame in missing_files(directory, folders, list(done)):
        del done[frame]
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
        version=3,
        name=recipe.name,
        frame_count=len(records),
        cameras={mounted.name: camera_entry(mounted) for mounted in recipe.cameras},
        sensor=SensorEntry(**recipe.sensor.acting()),
        accelerometer=AccelerometerEntry(kind=recipe.accelerometer.kind, error_deg=recipe.accelerometer.error_deg),
        led_map=led_map(scene.leds),
        room_m=scene.settings.room.size_m,
        provenance=provenance,
    )
    write_json(directory / "dataset.json", dataset.model_dump(mode="json"))
    (directory / "plan.json").unlink()
    (directory / "journal.jsonl").unlink()
