"""Generation of a dataset, or of the cells of a sweep, from a plan. Resumable; any number of workers, same bytes."""

import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.core.warn_once import warn_once
from vlcrender.dataset.format.lock import locked
from vlcrender.dataset.format.manifest import PLAN, write_sealed
from vlcrender.dataset.recipe.dependence import Seen, keyed_recipe
from vlcrender.dataset.recipe.light_checks import light_warnings
from vlcrender.dataset.recipe.plan import Plan, PlannedCells
from vlcrender.dataset.recipe.sweep import SWEEP_FILE, sweep_tree
from vlcrender.dataset.run.frame_job import Job, SceneKey
from vlcrender.dataset.run.possible import check_possible
from vlcrender.dataset.run.progress import FRAMES_STAGE, Progress, ProgressCallback
from vlcrender.dataset.run.unfinished import Unfinished, is_complete, prepare_folder, provenance_of
from vlcrender.dataset.run.workers import Task, done_frames
from vlcrender.dataset.world.withheld import Seal, check_withholdable, same_file_times
from vlcrender.errors import InputError
from vlcrender.light.lightmap import Lightmap, bake
from vlcrender.modulation.flicker import flicker_of, flicker_warning
from vlcrender.rendering.electron_rates import ElectronRates
from vlcrender.sensor.quantisation import MIN_NOISE_STEPS, noise_steps
from vlcrender.sensor.radiometry import detectors

log = logging.getLogger(__name__)


def generate(
    plan: Plan,
    directory: Path,
    workers: int = 1,
    scheduler: str | None = None,
    progress: ProgressCallback | None = None,
    withhold_truth: Path | None = None,
) -> bool:
    """Generate the dataset of a plan in `directory`, or its cells; False where it is already complete and intact.

    Resumes an interrupted run of the same plan. `workers` is the number of processes; `scheduler` is the address of a
    dask scheduler whose workers share the folder. `progress` is called with each report. With `withhold_truth`, a key
    file that is made where it is missing, the truth is sealed (`withheld.Seal`). Raises InputError where the folder
    holds anything else or is in use, and where a pose, the furniture, or a true camera or LED of the plan is
    impossible: before the first frame, except for a pose among thousands (`possible`).
    """
    try:
        str(directory).encode()
    except UnicodeEncodeError:
        raise InputError(f"--out {directory}: not a UTF-8 name; EXR files need one") from None
    seal = None
    if withhold_truth is not None:
        check_withholdable(plan)
        seal = Seal.of_file(withhold_truth, directory)
        plan = seal.secret_plan(plan)
    if scheduler is not None:
        directory = Path(os.path.abspath(directory))  # workers have working folders of their own
    with locked(directory, "vlcrender generate"):
        return _generate(plan, directory, workers, scheduler, progress, seal)


def _generate(
    plan: Plan,
    directory: Path,
    workers: int,
    scheduler: str | None,
    progress: ProgressCallback | None,
    seal: Seal | None,
) -> bool:
    """`generate` in a folder that is locked. seal: where the truth is withheld; the plan is then the secret one."""
    report = progress or (lambda report: None)
    if plan.cells is None:
        file, kind = "dataset.json", "dataset"
        wanted: dict[str, Any] = {"provenance": provenance_of(plan, seal)}
    else:
        file, kind = SWEEP_FILE, "sweep"
        wanted = {**sweep_tree(plan.recipe.name, plan.cells.sweep), "provenance": provenance_of(plan)}
    if is_complete(directory, file, wanted, f"a {kind} of another recipe, scene or version"):
        if seal is not None:
            same_file_times(directory)  # a run may have been killed before it did that
        log.info("%s: complete and intact already", directory)
        return False
    if plan.cells is None:
        check_possible(plan, lambda share: report(Progress("poses", share, 1.0)))
        datasets = [Unfinished(lambda: plan, Job.of(plan, directory), plan.frame_count, seal)]
        datasets[0].open()
        lit = iter([plan])
    else:
        datasets = _cells(plan.cells, directory)
        prepare_folder(directory, wanted, "an unfinished sweep of another recipe, scene or version")
        datasets = [dataset for dataset in datasets if not dataset.resume()]
        lit = _with_each_scene(datasets)
    # Into the cache, from which every worker reads it.
    for of_scene in lit:
        light = bake(of_scene.scene, progress=lambda step, share: report(Progress(step, share, 1.0)))
        _warn_of_coarse_steps(of_scene, light)
        _warn_of_flicker(of_scene)
        for warning in (*of_scene.warnings, *light_warnings(of_scene.recipe, of_scene.scene)):
            warn_once(log, warning)
    done = total = plan.frame_count
    done -= sum(dataset.frame_count - dataset.done for dataset in datasets)
    if done:
        log.info("%s: resumed with %d of %d frames", directory, done, total)
        report(Progress(FRAMES_STAGE, done, total))
    unfinished = {dataset.job.directory: dataset for dataset in datasets}
    tasks, count = _tasks(datasets)
    # Workers end before the lock is released, also after an interrupt.
    with closing(done_frames(tasks, count, workers, scheduler, directory)) as made:
        for job, record in made:
            dataset = unfinished[job.directory]
            dataset.add(record)
            done += 1
            report(Progress(FRAMES_STAGE, done, total))
            if dataset.done == dataset.frame_count:
                unfinished.pop(job.directory).finish()
    for dataset in unfinished.values():  # of which an interrupted run had made all frames
        dataset.finish()
    if plan.cells is not None:
        write_sealed(directory / SWEEP_FILE, wanted)
        (directory / PLAN).unlink()
    return True


def _cells(cells: PlannedCells, directory: Path) -> list[Unfinished]:
    """The datasets of all cells. An impossible pose, or one of the other things of `generate`, is refused by cell."""
    datasets, possible = [], set()
    texts: dict[str, str] = {}
    for cell in cells.sweep:
        plan = cells.plan(cell.number)
        job = Job.of(plan, directory / cell.folder)
        # One text for all cells that share a scene: a task that has many of them is then sent with one.
        job = replace(job, scene_json=texts.setdefault(job.scene_json, job.scene_json))
        if _view_of(job) not in possible:
            try:
                check_possible(plan)
            except InputError as error:
                raise InputError(f"{cells.source}: {cell}: {error}") from None
            possible.add(_view_of(job))
        datasets.append(Unfinished(partial(cells.plan, cell.number), job, plan.frame_count))
    return datasets


def _view_of(job: Job) -> tuple[SceneKey, Seen]:
    """What the views of a job's frames depend on."""
    return job.scene_key, keyed_recipe(job.recipe_json).seen


def _with_each_scene(datasets: list[Unfinished]) -> Iterator[Plan]:
    """The plan of the first dataset with each scene, and of the last dataset; one scene at a time is in memory."""
    first = {d.job.scene_key: d for d in reversed(datasets)}
    return (dataset.plan() for dataset in dict.fromkeys([*reversed(first.values()), *datasets[-1:]]))


def _tasks(datasets: Iterable[Unfinished]) -> tuple[Iterator[Task], int]:
    """The frames that are not made, in the order in which most is shared, and the number of tasks or more.

    A task is a burst, a single shot, or the frames of a file that holds several, in all datasets whose views are the
    same. Its datasets are open. Tasks of one scene follow one another, then those of one view in the order of poses.
    """
    scenes: dict[SceneKey, dict[tuple[Seen, int], list[Unfinished]]] = {}
    for dataset in datasets:
        recipe = keyed_recipe(dataset.job.recipe_json).recipe
        together = len(recipe.cameras) * recipe.burst_frames
        if recipe.files.frames_per_file > 1:
            together = recipe.files.frames_per_file
        scene, seen = _view_of(dataset.job)
        scenes.setdefault(scene, {}).setdefault((seen, together), []).append(dataset)
    groups = [(group, together) for of_scene in scenes.values() for (_, together), group in of_scene.items()]
    shots = (
        (group, range(start, start + together))
        for group, together in groups
        for start in range(0, group[0].frame_count, together)
    )

    def tasks() -> Iterator[Task]:
        for group, frames in shots:
            missing = {dataset: dataset.missing(frames) for dataset in group}
            task = [(dataset.job, frame) for dataset in group for frame in missing[dataset]]
            for dataset in group:
                if missing[dataset]:
                    dataset.open()
            if task:
                yield task

    return tasks(), sum(-(-group[0].frame_count // together) for group, together in groups)


def _warn_of_coarse_steps(plan: Plan, light: Lightmap) -> None:
    """Warn where the noise of the background is so far below a digital number that rounding errors are alike.

    The background is the mean over all surfaces that face down, on the axis of the camera `main`.
    """
    recipe, sensor, mesh = plan.recipe, plan.recipe.sensor, light.mesh
    if recipe.added_noise is not None and recipe.added_noise.metering is None:
        return  # rounding follows the added noise
    exposure_s = recipe.max_exposure_s
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
