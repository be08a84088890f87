"""A dataset that is being made: its folder, the frames that are done, and its tables at the end. Resumable."""

import json
import logging
import platform
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from importlib.metadata import version
from itertools import accumulate
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vlcrender.dataset.downlink_entry import downlink_entry
from vlcrender.dataset.files import FRAMES, sha256_of, whole_file, write_json
from vlcrender.dataset.frame_job import Job
from vlcrender.dataset.plan import Plan
from vlcrender.dataset.recipe import Recipe
from vlcrender.dataset.schema import (
    DATA_VERSION,
    FORMAT_VERSION,
    DatasetFile,
    FrameRecord,
    FrameRow,
    SensorEntry,
    accelerometer_entry,
    camera_entry,
    gyroscope_entry,
    led_map,
    luminaire_entries,
    map_datum_entry,
)
from vlcrender.dataset.shard import incomplete
from vlcrender.dataset.tables import write_table
from vlcrender.dataset.truth_tables import write_truth
from vlcrender.dataset.verify import extra_folders, missing_files, verify
from vlcrender.dataset.withheld import Seal, same_file_times
from vlcrender.errors import InputError
from vlcrender.scene.as_built import luminaires_of

log = logging.getLogger(__name__)

JOURNAL = "journal.jsonl"
"""File of an unfinished dataset with a line for each frame that is complete."""
PLAN = "plan.json"
"""File of an unfinished dataset, or sweep, with what it is made of."""


def is_complete(directory: Path, file: str, wanted: Mapping[str, Any], other: str) -> bool:
    """Whether a folder holds the complete dataset or sweep that `wanted` names; `file` is its last file.

    Raises InputError where it holds another, `other`, or is damaged.
    """
    if not (directory / file).exists():
        return False
    check_same(directory / file, wanted, other)
    damage = verify(directory)
    if damage:
        raise InputError(f"{directory}: complete but damaged: {damage[0]}; delete it or choose another --out")
    return True


def check_same(path: Path, wanted: Mapping[str, Any], other: str) -> None:
    """Raise InputError where the JSON file `path` has other values of the keys of `wanted`: it then holds `other`."""
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        same = all(tree[key] == value for key, value in json.loads(json.dumps(wanted)).items())
    except (ValueError, KeyError, TypeError, OSError):
        raise InputError(f"{path}: damaged; delete {path.parent} or choose another --out") from None
    if not same:
        raise InputError(f"{path.parent}: holds {other}; nothing was changed; choose another --out or delete it")


def prepare_folder(directory: Path, wanted: Mapping[str, Any], other: str) -> None:
    """Make a folder for an unfinished dataset or sweep. Raises InputError where it holds anything but the same one."""
    plan_file = directory / PLAN
    if plan_file.exists():
        check_same(plan_file, wanted, other)
    elif directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise InputError(f"{directory}: neither empty nor a dataset; nothing was changed; choose another --out")
    directory.mkdir(parents=True, exist_ok=True)
    write_json(plan_file, wanted)


def provenance_of(plan: Plan, seal: Seal | None = None) -> dict[str, Any]:
    """What a dataset states that it is made of: of a withheld set (`seal`), nothing that gives the truth away."""
    return _whole_provenance(plan) if seal is None else seal.public_provenance(_whole_provenance(plan))


def _whole_provenance(plan: Plan) -> dict[str, Any]:
    """The resolved recipe and scene, the cell of a sweep, and program versions."""
    recipe = plan.recipe.model_dump(mode="json")
    recipe["seed"] = str(plan.recipe.seed)  # JSON readers round integers beyond 2**53
    return {
        "recipe": recipe,
        "scene": plan.scene.settings.model_dump(mode="json"),
        **({"sweep": dict(plan.values)} if plan.values else {}),
        "data_version": DATA_VERSION,
        "versions": _versions(),
    }


@cache
def _versions() -> dict[str, str]:
    packages = ("vlcrender", "mitsuba", "drjit", "numpy", "OpenEXR")
    return {**{package: version(package) for package in packages}, "python": platform.python_version()}


class Unfinished:
    """A dataset that is being made. `open` its folder before a frame of it is made."""

    def __init__(self, plan: Callable[[], Plan], job: Job, frame_count: int, seal: Seal | None = None) -> None:
        """plan: makes or returns its plan, which is not kept. seal: of a set whose truth is withheld."""
        self.plan = plan
        self.seal = seal
        self.job = job
        self.frame_count = frame_count
        self._directory = Path(job.directory)
        self._places: dict[int, int] | None = None

    def resume(self) -> bool:
        """Whether the folder holds the complete dataset; if it holds frames of an interrupted run, `open` it.

        Raises InputError where the folder holds anything else, or is damaged.
        """
        if not self._directory.exists():
            return False
        wanted = {"provenance": provenance_of(self.plan())}
        if is_complete(self._directory, "dataset.json", wanted, "a dataset that is no such cell of this sweep"):
            return True
        self.open()
        return False

    @property
    def done(self) -> int:
        """Number of frames that are done."""
        return len(self._places or ())

    def open(self) -> None:
        """Make the folder, or find the frames that an interrupted run has finished. Without effect the second time.

        Raises InputError where the folder holds anything else.
        """
        if self._places is not None:
            return
        plan = self.plan()
        recipe, wanted = plan.recipe, {"provenance": provenance_of(plan, self.seal)}
        prepare_folder(self._directory, wanted, "an unfinished dataset of another recipe, scene or version")
        for name in [FRAMES, *extra_folders(recipe.expected, recipe.processed is not None, recipe.files)]:
            (self._directory / name).mkdir(exist_ok=True)
        for leftover in self._directory.rglob("*.partial"):
            leftover.unlink()
        self._places = _journal(self._directory, recipe, self.seal)

    def missing(self, frames: range) -> list[int]:
        """Those of some frames that are not done."""
        places = self._places or {}
        return [frame for frame in frames if frame < self.frame_count and frame not in places]

    def add(self, record: FrameRecord) -> None:
        """Write the line of a frame that was made to the journal."""
        assert self._places is not None  # opened before its frames are made
        with (self._directory / JOURNAL).open("ab") as journal:
            self._places[record.frame] = journal.tell()
            journal.write(_line(record, self.seal))

    def finish(self) -> None:
        """Write the tables and dataset.json of a dataset whose frames are all done."""
        assert self._places is not None
        plan = self.plan()
        _finish(plan, self._directory, self._places, self.seal)


def _journal(directory: Path, recipe: Recipe, seal: Seal | None) -> dict[int, int]:
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
            record = _record_of(line.encode(), seal)
        except ValidationError:
            continue  # a line that a crash truncated: its frame is made again
        file = directory / record.device.file
        if file.is_file() and digest(file) == record.device.sha256:
            done[record.frame] = _line(record, seal)
    folders = extra_folders(recipe.expected, recipe.processed is not None, recipe.files)
    for frame in missing_files(directory, folders, list(done), recipe.files):
        del done[frame]
    for frame in incomplete(done, recipe.files.frames_per_file, recipe.frame_count):
        del done[frame]
    if len(done) < len(lines):
        log.warning("%s: %d frames are damaged or incomplete and are made again", path, len(lines) - len(done))
    with whole_file(path) as file:
        file.write_bytes(b"".join(done.values()))
    return dict(zip(done, accumulate(map(len, done.values()), initial=0), strict=False))


def _line(record: FrameRecord, seal: Seal | None) -> bytes:
    """The journal's line of a frame."""
    line = record.model_dump_json().encode()
    return line + b"\n" if seal is None else seal.line(line)


def _record_of(line: bytes, seal: Seal | None) -> FrameRecord:
    """The frame of a line of the journal. Raises ValidationError for a line that is damaged."""
    return FrameRecord.model_validate_json(line if seal is None else seal.plain_line(line))


def _recorded(path: Path, places: dict[int, int], seal: Seal | None) -> Iterator[FrameRecord]:
    """The frames of a journal, of which each has its place, in order of their numbers."""
    with path.open("rb") as journal:
        for frame in sorted(places):
            journal.seek(places[frame])
            yield _record_of(journal.readline(), seal)


def _finish(plan: Plan, directory: Path, places: dict[int, int], seal: Seal | None) -> None:
    recipe, scene, journal = plan.recipe, plan.scene, directory / JOURNAL
    records = partial(_recorded, journal, places, seal)
    write_table(directory / "frames.parquet", (record.device for record in records()), FrameRow)
    withheld = None
    if seal is None:
        write_truth(plan, directory, (record.truth for record in records()))
    else:
        splits = {record.frame: record.device.split for record in records()}
        withheld = seal.write_truth(
            plan, directory, _whole_provenance(plan), lambda: (record.truth for record in records()), splits
        )
    sigmas = luminaires = None
    told_map = recipe.map == "given"
    if recipe.belief is not None:
        sigmas = recipe.belief.stated_sigmas(recipe.cameras, recipe.accelerometer)
        luminaires = luminaires_of(scene.settings, scene.leds) if told_map else None
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
        withheld=withheld,
        provenance=provenance_of(plan, seal),
    )
    write_json(directory / "dataset.json", dataset.model_dump(mode="json"))
    (directory / PLAN).unlink()
    journal.unlink()
    if seal is not None:
        same_file_times(directory, directory / "dataset.json")
