"""Generation of a dataset from a plan: frames, tables, dataset.json. Resumable; any number of workers, same bytes."""

import json
import logging
import multiprocessing
import os
import platform
import signal
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache, partial
from importlib.metadata import version
from itertools import accumulate, groupby, product
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from vlcrender.core.warn_once import warn_once
from vlcrender.dataset.downlink_entry import downlink_entry
from vlcrender.dataset.files import FRAMES, sha256_of, whole_file, write_json
from vlcrender.dataset.frame_job import Job, made_frames, make_frames, poses_of
from vlcrender.dataset.light_checks import light_warnings
from vlcrender.dataset.progress import FRAMES_STAGE, Progress, ProgressCallback
from vlcrender.dataset.recipe import Plan, Recipe
from vlcrender.dataset.schema import (
    DATA_VERSION,
    FORMAT_VERSION,
    DatasetFile,
    DeviceTruthRow,
    FrameRecord,
    FrameRow,
    MapTruthRow,
    SensorEntry,
    TruthRow,
    accelerometer_entry,
    camera_entry,
    gyroscope_entry,
    led_map,
    luminaire_entries,
    map_datum_entry,
)
from vlcrender.dataset.shard import incomplete
from vlcrender.dataset.tables import write_table
from vlcrender.dataset.true_world import built_leds, device_of_pose, device_rows, map_rows, true_camera
from vlcrender.dataset.verify import extra_folders, missing_files, verify
from vlcrender.errors import InputError
from vlcrender.light.lightmap import Lightmap, bake, room_mesh
from vlcrender.modulation.flicker import flicker_of, flicker_warning
from vlcrender.rendering.electron_rates import ElectronRates
from vlcrender.rendering.readout import RollingPoses
from vlcrender.rendering.renderer import check_inside, share_cores
from vlcrender.scene.as_built import luminaires_of
from vlcrender.sensor.quantisation import MIN_NOISE_STEPS, noise_steps
from vlcrender.sensor.radiometry import detectors

log = logging.getLogger(__name__)

JOURNAL = "journal.jsonl"
"""File of an unfinished dataset with a line for each frame that is complete."""


def generate(
    plan: Plan,
    directory: Path,
    workers: int = 1,
    scheduler: str | None = None,
    progress: ProgressCallback | None = None,
) -> bool:
    """Generate the dataset of a plan in `directory`. Returns False where it is already complete and intact.

    Resumes an interrupted run of the same plan. `workers` is the number of processes; `scheduler` is the address of a
    dask scheduler whose workers share the folder. `progress` is called with each report. Raises InputError where the
    folder holds anything else, and where a pose, the furniture, or a true camera or LED of the plan is impossible.
    """
    report = progress or (lambda report: None)
    try:
        str(directory).encode()
    except UnicodeEncodeError:
        raise InputError(f"--out {directory}: not a UTF-8 name; EXR files need one") from None
    provenance = _provenance(plan)
    if (directory / "dataset.json").exists():
        _check_same(directory / "dataset.json", provenance, "a dataset of another recipe, scene or version")
        damage = verify(directory)
        if damage:
            raise InputError(f"{directory}: complete but damaged: {damage[0]}; delete it or choose another --out")
        log.info("%s: complete and intact already", directory)
        return False
    mounted_of = cache(partial(true_camera, plan.recipe))
    numbers = {0} if plan.recipe.motion is None else {0, plan.recipe.burst_frames - 1}
    for pose_number in range(plan.recipe.poses.count):  # an impossible pose ends the run before the first frame
        for which, number in product(range(len(plan.recipe.cameras)), numbers):
            mounted = mounted_of(which, device_of_pose(plan.recipe, pose_number))
            *_, during = poses_of(plan.recipe, plan.scene, pose_number, mounted, number)
            first, last = during.ends if isinstance(during, RollingPoses) else (during[0], during[-1])
            check_inside(plan.scene, first)
            check_inside(plan.scene, last)
    if plan.recipe.belief is not None:
        for map_number in range(plan.recipe.belief.maps):  # an impossible LED, too
            built_leds(plan.recipe, plan.scene, map_number)
    room_mesh(plan.scene)  # impossible furniture ends the run before anything is written
    _prepare(directory, provenance, plan.recipe)
    job = Job.of(plan, directory)
    done = _journal(directory, plan.recipe)
    total = plan.recipe.frame_count
    missing = [frame for frame in range(total) if frame not in done]
    if done:
        log.info("%s: resumed with %d of %d frames", directory, len(done), total)
        report(Progress(FRAMES_STAGE, len(done), total))
    # Into the cache, from which every worker reads it.
    light = bake(plan.scene, progress=lambda step, share: report(Progress(step, share, 1.0)))
    _warn_of_coarse_steps(plan, light)
    _warn_of_flicker(plan)
    for warning in light_warnings(plan.recipe, plan.scene):
        warn_once(log, warning)
    with (directory / JOURNAL).open("ab") as journal:
        for record in _records(job, _bursts(missing, plan.recipe), workers, scheduler):
            done[record.frame] = journal.tell()
            journal.write(_line(record))
            journal.flush()
            report(Progress(FRAMES_STAGE, len(done), total))
    _finish(plan, directory, provenance, done)
    return True


def _warn_of_coarse_steps(plan: Plan, light: Lightmap) -> None:
    """Warn where the noise of the background is so far below a digital number that rounding errors are alike.

    The background is the mean over all surfaces that face down, on the axis of the camera `main`.
    """
    recipe, sensor, mesh = plan.recipe, plan.recipe.sensor, light.mesh
    exposure_s = recipe.exposure_s if recipe.exposure is None else recipe.exposure.max_s
    assert exposure_s is not None  # Recipe checks it
    count = len(mesh.vertices_m)
    weights = mesh.areas_m2() * (mesh.normals[:, 2] < 0)
    led, ambient = (np.average(cd_m2[:count], weights=weights) for cd_m2 in (light.led_cd_m2(), light.ambient_cd_m2()))
    rates = [ElectronRates.of(plan.scene, recipe.camera, detector) for detector in detectors(sensor)]
    background_e = max(float(rate.led * led + rate.ambient * ambient) for rate in rates) * exposure_s
    steps = noise_steps(sensor, background_e, exposure_s)
    if background_e < sensor.saturation_e and steps < MIN_NOISE_STEPS:
        warn_once(
            log,
            f"sensor: a digital number is {sensor.gain_at_iso_e_per_dn:.3g} electrons, and the noise of the background "
            f"{steps:.2f} of it: below {MIN_NOISE_STEPS} neighbouring pixels have the same rounding error; raise "
            "sensor.iso, or sensor.bits with a smaller sensor.gain_e_per_dn, or choose a smaller --scale",
        )


def _warn_of_flicker(plan: Plan) -> None:
    """Warn where LEDs of the scene flicker beyond the low risk of IEEE 1789."""
    warning = flicker_warning(flicker_of(plan.scene.leds.transmitters))
    if warning is not None:
        warn_once(log, f"{plan.recipe.scene}: {warning}")


def _bursts(frames: list[int], recipe: Recipe) -> list[list[int]]:
    """Frames that one worker makes, one after another: those of a burst, which share a view, or those of a file."""
    together = recipe.files.frames_per_file
    if together == 1 and recipe.burst_frames > 1:
        together = len(recipe.cameras) * recipe.burst_frames
    return [list(group) for _, group in groupby(frames, key=lambda frame: frame // together)]


def _records(job: Job, bursts: list[list[int]], workers: int, scheduler: str | None) -> Iterator[FrameRecord]:
    if scheduler is not None:
        yield from _on_cluster(job, bursts, scheduler)
    elif workers == 1 or len(bursts) <= 1:
        for burst in bursts:
            yield from made_frames(job, burst)
    else:
        yield from _in_processes(job, bursts, workers)


def _in_processes(job: Job, bursts: list[list[int]], workers: int) -> Iterator[FrameRecord]:
    # spawn: a forked child of a process that ran kernels is left with one thread
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(bursts)), context, _start_worker, (workers,))
    pending: set[Future[list[FrameRecord]]] = set()
    queue = iter(bursts)
    try:
        while True:
            with _interrupts_deferred():  # submit() starts children
                while len(pending) < 2 * workers and (burst := next(queue, None)) is not None:
                    pending.add(pool.submit(make_frames, job, burst))
            if not pending:
                return
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                yield from future.result()
    except BrokenProcessPool:
        raise InputError(
            f"{job.directory}: a worker process died (out of memory?); run the same command again, "
            "with fewer --workers, to resume"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Deliver an interrupt (SIGINT) after this block; child processes started in it never receive one.

    Children inherit the blocked signal, so that only the parent handles an interrupt and no child prints a traceback.
    The handler is needed beside the mask: a mask holds for this thread alone, another thread may receive the signal,
    and Python then runs the handler in the main thread, in the middle of starting a child.
    """
    received = threading.Event()
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, lambda *_: received.set()) if in_main_thread else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
    if received.is_set():
        signal.raise_signal(signal.SIGINT)


def _start_worker(workers: int) -> None:
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    share_cores(workers)


def _exit_with_parent() -> None:
    """Exit when the parent process dies."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _on_cluster(job: Job, bursts: Iterable[list[int]], address: str) -> Iterator[FrameRecord]:
    try:
        from dask.distributed import Client, as_completed
    except ImportError:
        raise InputError(f"--scheduler {address}: needs dask.distributed: pip install 'vlcrender[cluster]'") from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: no answer from a scheduler: {error}") from None
    with client:
        futures = client.map(lambda burst: make_frames(job, burst), list(bursts), pure=False)
        for future in as_completed(futures):
            yield from future.result()
            future.release()


def _provenance(plan: Plan) -> dict[str, Any]:
    recipe = plan.recipe.model_dump(mode="json")
    recipe["seed"] = str(plan.recipe.seed)  # JSON readers round integers beyond 2**53
    return {
        "recipe": recipe,
        "scene": plan.scene.settings.model_dump(mode="json"),
        "data_version": DATA_VERSION,
        "versions": {
            **{package: version(package) for package in ("vlcrender", "mitsuba", "drjit", "numpy", "OpenEXR")},
            "python": platform.python_version(),
        },
    }


def _check_same(path: Path, provenance: dict[str, Any], other: str) -> None:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        same = tree["provenance"] == json.loads(json.dumps(provenance))
    except (ValueError, KeyError, TypeError, OSError):
        raise InputError(f"{path}: damaged; delete {path.parent} or choose another --out") from None
    if not same:
        raise InputError(f"{path.parent}: holds {other}; nothing was changed; choose another --out or delete it")


def _prepare(directory: Path, provenance: dict[str, Any], recipe: Recipe) -> None:
    plan_file = directory / "plan.json"
    if plan_file.exists():
        _check_same(plan_file, provenance, "an unfinished dataset of another recipe, scene or version")
    elif directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise InputError(f"{directory}: neither empty nor a dataset; nothing was changed; choose another --out")
    for name in [FRAMES, *extra_folders(recipe.expected, recipe.processed is not None, recipe.files)]:
        (directory / name).mkdir(parents=True, exist_ok=True)
    for leftover in directory.rglob("*.partial"):
        leftover.unlink()
    write_json(plan_file, {"provenance": provenance})


def _journal(directory: Path, recipe: Recipe) -> dict[int, int]:
    """Frames that an interrupted run finished and whose files are still intact; the journal then holds these alone.

    Each with the place of its line in the journal: the memory of a run does not grow with records of frames.
    """
    path = directory / JOURNAL
    if not path.exists():
        return {}
    done: dict[int, bytes] = {}
    digest = cache(sha256_of)
    lines = path.read_text(encoding="utf-8").splitlines()
    for line in lines:
        try:
            record = FrameRecord.model_validate_json(line)
        except ValidationError:
            continue  # a line that a crash truncated: its frame is made again
        file = directory / record.device.file
        if file.is_file() and digest(file) == record.device.sha256:
            done[record.frame] = _line(record)
    folders = extra_folders(recipe.expected, recipe.processed is not None, recipe.files)
    for frame in missing_files(directory, folders, list(done), recipe.files):
        del done[frame]
    for frame in incomplete(done, recipe.files.frames_per_file, recipe.frame_count):
        del done[frame]
    if len(done) < len(lines):
        log.warning("%s: %d frames are damaged or incomplete and are made again", path, len(lines) - len(done))
    with whole_file(path) as partial:
        partial.write_bytes(b"".join(done.values()))
    return dict(zip(done, accumulate(map(len, done.values()), initial=0), strict=False))


def _line(record: FrameRecord) -> bytes:
    """The journal's line of a frame."""
    return record.model_dump_json().encode() + b"\n"


def _recorded(path: Path, places: dict[int, int]) -> Iterator[FrameRecord]:
    """The frames of a journal, of which each has its place, in order of their numbers."""
    with path.open("rb") as journal:
        for frame in sorted(places):
            journal.seek(places[frame])
            yield FrameRecord.model_validate_json(journal.readline())


def _finish(plan: Plan, directory: Path, provenance: dict[str, Any], places: dict[int, int]) -> None:
    recipe, scene, journal = plan.recipe, plan.scene, directory / JOURNAL
    write_table(directory / "frames.parquet", (record.device for record in _recorded(journal, places)), FrameRow)
    write_table(directory / "truth.parquet", (record.truth for record in _recorded(journal, places)), TruthRow)
    sigmas = luminaires = None
    told_map = recipe.map == "given"
    if recipe.belief is not None:
        sigmas = recipe.belief.stated_sigmas(recipe.cameras, recipe.accelerometer)
        luminaires = luminaires_of(scene.settings, scene.leds) if told_map else None
        write_table(directory / "truth_devices.parquet", device_rows(recipe), DeviceTruthRow)
    if recipe.belief is not None or not told_map:
        write_table(directory / "truth_map.parquet", map_rows(recipe, scene), MapTruthRow)
    dataset = DatasetFile(
        format="vlcrender-dataset",
        version=FORMAT_VERSION,
        name=recipe.name,
        frame_count=len(places),
        cameras={
            mounted.name: camera_entry(mounted, None if sigmas is None else sigmas.cameras[mounted.name])
            for mounted in recipe.cameras
        },
        sensor=SensorEntry(**recipe.sensor.acting()),
        accelerometer=accelerometer_entry(recipe.accelerometer, sigmas),
        gyroscope=gyroscope_entry(recipe.gyroscope),
        led_map=led_map(scene.leds, luminaires, sigmas) if told_map else None,
        luminaires=() if luminaires is None or sigmas is None else luminaire_entries(luminaires, sigmas),
        map_datum=None if sigmas is None else map_datum_entry(sigmas),
        downlink=downlink_entry(scene.leds, recipe.demodulation),
        room_m=scene.settings.room.size_m,
        provenance=provenance,
    )
    write_json(directory / "dataset.json", dataset.model_dump(mode="json"))
    (directory / "plan.json").unlink()
    journal.unlink()
