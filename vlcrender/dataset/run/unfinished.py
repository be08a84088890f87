"""A dataset that is being made: its folder, the frames that are done, and its tables at the end. Resumable."""

import hashlib
import json
import logging
import os
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib.metadata import version
from itertools import accumulate
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vlcrender.core.digest import sha256_of
from vlcrender.core.program import LIBRARIES, program_sha256
from vlcrender.dataset.format.camera_entries import SensorEntry
from vlcrender.dataset.format.downlink_entry import downlink_entry
from vlcrender.dataset.format.files import FRAMES, sync_folder, whole_file, write_json
from vlcrender.dataset.format.layout import extra_folders
from vlcrender.dataset.format.lock import LOCK
from vlcrender.dataset.format.manifest import JOURNAL, PLAN, entry_of, write_manifest, write_sealed
from vlcrender.dataset.format.rows import FileEntry, FrameRecord, FrameRow
from vlcrender.dataset.format.schema import (
    DATA_VERSION,
    FORMAT_VERSION,
    DatasetFile,
    NamesEntry,
    accelerometer_entry,
    camera_entry,
    gyroscope_entry,
    led_map,
    luminaire_entries,
    map_datum_entry,
)
from vlcrender.dataset.format.shard import incomplete
from vlcrender.dataset.format.summary import summary_of
from vlcrender.dataset.format.tables import write_table
from vlcrender.dataset.format.withheld_entry import Withheld
from vlcrender.dataset.recipe.file_settings import FilesEntry
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.run.frame_job import Job
from vlcrender.dataset.verify.verify import verify
from vlcrender.dataset.world.truth_tables import write_truth
from vlcrender.dataset.world.withheld import Seal, same_file_times
from vlcrender.errors import InputError
from vlcrender.scene.as_built import luminaires_of
from vlcrender.scene.scene_files import check_sources

log = logging.getLogger(__name__)


def is_complete(directory: Path, file: str, wanted: Mapping[str, Any], other: str) -> bool:
    """Whether a folder holds the complete dataset or sweep that `wanted` names; `file` is its last file.

    Another program may have made it whole: then `data_version` and the libraries' versions alone have to be the same.
    Raises InputError where it holds another, `other`, or is damaged.
    """
    if not (directory / file).exists():
        return False
    check_same(directory / file, wanted, other, ignored=("program_sha256",))
    for leftover in (PLAN, JOURNAL):  # of a run that was killed after the last file
        (directory / leftover).unlink(missing_ok=True)
    damage = verify(directory)
    if damage:
        raise InputError(
            f"{directory}: complete but damaged: {damage[0]}; repair it (vlcrender verify --repair), delete it "
            "or choose another --out"
        )
    return True


def check_same(path: Path, wanted: Mapping[str, Any], other: str, ignored: Sequence[str] = ()) -> None:
    """Raise InputError that names a difference where the JSON file `path` has not the values of `wanted`.

    It then holds `other`. Keys that `wanted` has not, and those `ignored` in the provenance, are not compared.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        there, here = {key: tree.get(key) for key in wanted}, json.loads(json.dumps(wanted))
        for provenance in (there["provenance"], here["provenance"]):
            for key in ignored:
                provenance.pop(key, None)
        found = _difference(there, here)
    except (ValueError, RecursionError, AttributeError, OSError):
        raise InputError(f"{path}: damaged; delete {path.parent} or choose another --out") from None
    if found is not None:
        raise InputError(
            f"{path.parent}: holds {other}; nothing was changed; choose another --out or delete it; "
            f"they differ in {found}"
        )


def _difference(there: Any, here: Any, key: str = "") -> str | None:
    """The first key in which two JSON trees differ, with both values; None where they agree."""
    if isinstance(there, dict) and isinstance(here, dict):
        if key.endswith("provenance.") and set(here) - set(there):
            return f"{key}{min(set(here) - set(there))}, which is not stated there"
        # A key of the recipe or of the scene says more than what follows from it.
        for name in sorted({*there, *here}, key=lambda name: (name == "program_sha256", name)):
            if (found := _difference(there.get(name), here.get(name), f"{key}{name}.")) is not None:
                return found
        return None
    if isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = enumerate(zip(there, here, strict=True))
        return next((found for i, (a, b) in pairs if (found := _difference(a, b, f"{key}{i}."))), None)
    if there == here:
        return None
    name = key.removesuffix(".").removeprefix("provenance.")
    if name.startswith("sources."):
        state = {(True, False): "is new", (False, True): "is missing"}.get((there is None, here is None), "was changed")
        return f"the file {name.removeprefix('sources.')}, which {state}"
    if name == "commitment":
        return "recipe, scene or key file, all of which the commitment of a withheld truth is made of"
    if name == "program_sha256":
        return "the program: the source of vlcrender was changed since; a set is made by one program"
    return f"{name}: {_short(there)} there, {_short(here)} here"


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def prepare_folder(directory: Path, wanted: Mapping[str, Any], other: str) -> None:
    """Make a folder for an unfinished dataset or sweep. Raises InputError where it holds anything but the same one."""
    plan_file = directory / PLAN
    if plan_file.exists():
        check_same(plan_file, wanted, other)
    elif directory.exists() and (not directory.is_dir() or any(path.name != LOCK for path in directory.iterdir())):
        raise InputError(f"{directory}: neither empty nor a dataset; nothing was changed; choose another --out")
    directory.mkdir(parents=True, exist_ok=True)
    write_json(plan_file, wanted)


def provenance_of(plan: Plan, seal: Seal | None = None) -> dict[str, Any]:
    """What a dataset states that it is made of: of a withheld set (`seal`), nothing that gives the truth away."""
    return _whole_provenance(plan) if seal is None else seal.public_provenance(_whole_provenance(plan))


def _whole_provenance(plan: Plan) -> dict[str, Any]:
    """The resolved recipe and scene, the cell of a sweep, files, program and versions."""
    recipe = plan.recipe.model_dump(mode="json")
    recipe["seed"] = str(plan.recipe.seed)  # JSON readers round integers beyond 2**53
    return {
        "recipe": recipe,
        "scene": plan.scene.settings.model_dump(mode="json"),
        **({"sweep": dict(plan.values)} if plan.values else {}),
        "sources": dict(plan.scene.sources),
        "program_sha256": program_sha256(),
        "data_version": DATA_VERSION,
        "versions": _versions(),
    }


@cache
def _versions() -> dict[str, str]:
    return {**{package: version(package) for package in ("vlcrender", *LIBRARIES)}, "python": platform.python_version()}


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

        Raises InputError where the folder holds anything else, or where the scene was changed since it was planned.
        """
        if self._places is not None:
            return
        plan = self.plan()
        self._check_scene(plan)
        recipe, wanted = plan.recipe, {"provenance": provenance_of(plan, self.seal)}
        prepare_folder(self._directory, wanted, "an unfinished dataset of another recipe, scene or version")
        for name in [FRAMES, *extra_folders(recipe.expected, recipe.processed is not None, recipe.files)]:
            (self._directory / name).mkdir(exist_ok=True)
        self._remove_partial()
        self._places = _journal(self._directory, recipe, self.seal)

    def missing(self, frames: range) -> list[int]:
        """Those of some frames that are not done."""
        places = self._places or {}
        return [frame for frame in frames if frame < self.frame_count and frame not in places]

    def add(self, record: FrameRecord) -> None:
        """Write the line of a frame that was made, whose files are on the disk, to the journal, on the disk too."""
        assert self._places is not None  # opened before its frames are made
        is_new = not (self._directory / JOURNAL).exists()
        with (self._directory / JOURNAL).open("ab") as journal:
            self._places[record.frame] = journal.tell()
            journal.write(_line(record, self.seal))
            journal.flush()
            os.fsync(journal.fileno())
        if is_new:
            sync_folder(self._directory)

    def finish(self) -> None:
        """Write the tables and dataset.json of a dataset whose frames are all done.

        Raises InputError where the scene was changed since it was planned.
        """
        assert self._places is not None
        plan = self.plan()
        self._check_scene(plan)
        self._remove_partial()  # of workers that were killed in this run
        records = partial(_recorded, self._directory / JOURNAL, self._places, self.seal)
        write_dataset(plan, self._directory, records, self.seal)
        (self._directory / PLAN).unlink()
        (self._directory / JOURNAL).unlink()
        if self.seal is not None:
            same_file_times(self._directory)

    def _remove_partial(self) -> None:
        """Remove files that were not written to their end."""
        for leftover in self._directory.rglob("*.partial"):
            leftover.unlink(missing_ok=True)

    def _check_scene(self, plan: Plan) -> None:
        """Raise InputError where a plan has another scene than the job: its file was changed and read again."""
        if plan.scene.settings.model_dump_json() != self.job.scene_json:
            raise InputError(f"{plan.recipe.scene}: the scene was changed while the set was planned; start again")
        if self.job.sources is not None:
            check_sources(plan.scene.settings, plan.scene.folder, dict(self.job.sources))


def _journal(directory: Path, recipe: Recipe, seal: Seal | None) -> dict[int, int]:
    """Frames that an interrupted run finished and whose files are still intact; the journal then holds these alone.

    Each with the place of its line in the journal: the memory of a run does not grow with records of frames.
    """
    path = directory / JOURNAL
    if not path.exists():
        return {}
    done: dict[int, bytes] = {}

    @cache
    def is_intact(name: str, entry: FileEntry) -> bool:
        file = directory / name
        return file.is_file() and file.stat().st_size == entry.bytes and sha256_of(file) == entry.sha256

    lines = path.read_bytes().splitlines(keepends=True)
    for line in lines:
        record = _record_of(line, seal)
        if record is not None and all(is_intact(name, entry) for name, entry in record.files.items()):
            done[record.frame] = line
    for frame in incomplete(done, recipe.files.frames_per_file, recipe.frame_count):
        del done[frame]
    if len(done) < len(lines):
        log.warning("%s: %d frames are damaged or incomplete and are made again", path, len(lines) - len(done))
    with whole_file(path) as partial:
        partial.write_bytes(b"".join(done.values()))
    return dict(zip(done, accumulate(map(len, done.values()), initial=0), strict=False))


def _line(record: FrameRecord, seal: Seal | None) -> bytes:
    """The journal's line of a frame: the SHA-256 of the record's JSON, and the record; sealed with `seal`."""
    content = record.model_dump_json().encode()
    line = b'{"sha256": "' + hashlib.sha256(content).hexdigest().encode() + b'", "record": ' + content + b"}\n"
    return line if seal is None else seal.line(line)


def _record_of(line: bytes, seal: Seal | None) -> FrameRecord | None:
    """The frame of a line of the journal; None where the line is not as it was written, after a crash for example."""
    plain = line if seal is None else seal.plain_line(line)
    try:
        record = FrameRecord.model_validate_json(plain[RECORD_START:-2])
    except (ValidationError, ValueError):
        return None
    return record if _line(record, seal) == line else None


RECORD_START = len('{"sha256": "", "record": ') + 64
"""Place of the record in a line of the journal."""


def _recorded(path: Path, places: dict[int, int], seal: Seal | None) -> Iterator[FrameRecord]:
    """The frames of a journal, of which each has its place, in order of their numbers."""
    with path.open("rb") as journal:
        for frame in sorted(places):
            journal.seek(places[frame])
            record = _record_of(journal.readline(), seal)
            if record is None:
                raise InputError(f"{path}: the line of frame {frame} was changed; run the same command again")
            yield record


FRAMES_TABLE = "frames.parquet"

Records = Callable[[], Iterable[FrameRecord]]
"""Gives the records of all frames, in order; called more than once, so that not all are in memory."""


def write_tables(plan: Plan, directory: Path, records: Records) -> list[str]:
    """Write the tables of a dataset, and return their names. Raises InputError where one cannot be written."""
    write_table(directory / FRAMES_TABLE, (record.device for record in records()), FrameRow)
    return [FRAMES_TABLE, *write_truth(plan, directory, (record.truth for record in records()))]


def _write_withheld(plan: Plan, directory: Path, records: Records, seal: Seal) -> tuple[list[str], Withheld]:
    """`write_tables` of a set whose truth is withheld, with truth.sealed among the names."""
    write_table(directory / FRAMES_TABLE, (record.device for record in records()), FrameRow)
    splits = {record.frame: record.device.split for record in records()}
    whole = _whole_provenance(plan), summary_of(plan.recipe, records(), directory, plan.warnings)
    names, withheld = seal.write_truth(plan, directory, *whole, lambda: (r.truth for r in records()), splits)
    return [FRAMES_TABLE, *names], withheld


def _entries(directory: Path, tables: list[str], records: Records) -> Iterator[tuple[str, FileEntry]]:
    """The entries of manifest.json in its order: those of the tables as they are, those of frames as they were made."""
    for name in sorted(tables):
        yield name, entry_of(directory / name)
    before: Mapping[str, FileEntry] = {}
    for record in records():
        # A shard is a file of several frames that follow each other.
        yield from ((name, entry) for name, entry in sorted(record.files.items()) if name not in before)
        before = record.files


def write_dataset(plan: Plan, directory: Path, records: Records, seal: Seal | None = None) -> None:
    """Write the tables, manifest.json and dataset.json of a dataset whose frames are made, in this order.

    seal: of a set whose truth is withheld.
    """
    recipe, scene, withheld = plan.recipe, plan.scene, None
    if seal is None:
        tables = write_tables(plan, directory, records)
    else:
        tables, withheld = _write_withheld(plan, directory, records, seal)
    manifest_sha256 = write_manifest(directory, _entries(directory, tables, records))
    sigmas = luminaires = None
    told_map = recipe.map == "given"
    if recipe.belief is not None:
        sigmas = recipe.belief.stated_sigmas(recipe.cameras, recipe.accelerometer)
        luminaires = luminaires_of(scene.settings, scene.leds) if told_map else None
    dataset = DatasetFile(
        format="vlcrender-dataset",
        version=FORMAT_VERSION,
        name=recipe.name,
        frame_count=recipe.frame_count,
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
        files=FilesEntry(format=recipe.files.format),
        summary=summary_of(recipe, records(), directory, plan.warnings, rounded=seal is not None),
        licence=recipe.licence,
        names=NamesEntry.model_validate(plan.presets),
        withheld=withheld,
        provenance=provenance_of(plan, seal),
        manifest_sha256=manifest_sha256,
    )
    write_sealed(directory / "dataset.json", dataset.model_dump(mode="json", exclude={"seal"}))
