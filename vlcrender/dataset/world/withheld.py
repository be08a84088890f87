"""Withheld truth of a benchmark: sealed with the key of a file, left out of the set, and written again at the release.

datasets/FORMAT.md has the files, docs/benchmark.md what an attacker may try. AES-256-GCM of the package `cryptography`.
"""

import hashlib
import hmac
import io
import json
import os
import re
import secrets
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format.files import first_line, read_dataset_file, whole_file
from vlcrender.dataset.format.frame_numbers import Summary
from vlcrender.dataset.format.lock import LOCK, locked
from vlcrender.dataset.format.manifest import DATASET_FILE, frames_per_file, manifest_of_files, write_sealed
from vlcrender.dataset.format.rows import TruthRow
from vlcrender.dataset.format.schema import DatasetFile
from vlcrender.dataset.format.summary import disk_use
from vlcrender.dataset.format.tables import write_table
from vlcrender.dataset.format.withheld_entry import Withheld
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.pose_sampling import AimedPoses
from vlcrender.dataset.world.truth_tables import TRUTH, TRUTH_TABLES, write_truth
from vlcrender.errors import InputError
from vlcrender.sensor.accelerometer import Imu

SEALED = "truth.sealed"
"""File with the sealed truth."""
PROVENANCE = "provenance.json"
"""Member of the sealed archive with the whole provenance."""
SUMMARY = "summary.json"
"""Member of the sealed archive with the summary in all digits."""
MAGIC = b"VLCSEAL1"
KEY_BYTES, NONCE_BYTES, SEED_BITS, SERIAL_BITS = 32, 12, 128, 63
MAX_SEALED_BYTES = 2**31 - 1
"""Most bytes that one call of the cipher takes."""
KEY_LINE = re.compile(r"vlcrender-truth-key-1 ([0-9a-f]{64})\n?")
KEY_RULE = "one line, vlcrender-truth-key-1 and 64 hex digits"
PUBLIC_KEYS = ("program_sha256", "data_version", "versions")
"""Keys of the provenance that a withheld set states; a new key is sealed unless it is named here.

`sources` is sealed: digests of meshes and textures tell which of many known files a scene is made of.
"""
PUBLIC_RECIPE_KEYS = ("expected", "processed", "files", "burst")
"""Keys of the recipe that a withheld set states: which files there are, and how frames follow each other."""


@dataclass(frozen=True)
class Seal:
    """The key of a withheld truth, and all that is made with it."""

    key: bytes
    """32 random bytes."""

    @classmethod
    def of_file(cls, path: Path, directory: Path) -> Self:
        """The key of a file, which is made where it is missing; directory: of the dataset.

        Raises InputError where the file is no key file or within the dataset, where it is missing and the dataset has
        been started with it, and where `cryptography` is not installed.
        """
        _cipher(bytes(KEY_BYTES))
        if directory.resolve() in path.resolve().parents:
            raise InputError(f"{path}: is within the dataset, which is to be published; put the key file elsewhere")
        if not path.exists():
            if directory.is_dir() and any(found.name != LOCK for found in directory.iterdir()):
                raise InputError(f"{path}: is missing, and {directory} is not empty; give the key file of that run")
            key = secrets.token_bytes(KEY_BYTES)
            try:
                descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            except OSError as error:
                raise InputError(f"{path}: cannot be made: {error.strerror}") from None
            with os.fdopen(descriptor, "w", encoding="ascii") as file:
                file.write(f"vlcrender-truth-key-1 {key.hex()}\n")
                file.flush()
                os.fsync(file.fileno())
        return cls.read(path)

    @classmethod
    def read(cls, path: Path) -> Self:
        """The key of an existing file. Raises InputError where it is missing or no key file."""
        try:
            found = KEY_LINE.fullmatch(path.read_bytes()[:1000].decode("ascii", errors="replace"))
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
        if found is None:
            raise InputError(f"{path}: is no key file ({KEY_RULE}); nothing was changed")
        return cls(bytes.fromhex(found[1]))

    def derived(self, purpose: str, data: bytes = b"") -> bytes:
        """HMAC-SHA256 of a purpose and data, 32 bytes: a key, or a number, that tells nothing of any other."""
        return hmac.digest(self.key, purpose.encode() + b"\0" + data, "sha256")

    def encrypt(self, plain: bytes, purpose: str) -> bytes:
        """MAGIC, nonce and AES-256-GCM of some bytes. The nonce is a digest of them: the same bytes are sealed alike.

        Raises InputError for more than MAX_SEALED_BYTES.
        """
        if len(plain) > MAX_SEALED_BYTES - 1000:
            raise InputError(f"{len(plain)} bytes of truth: at most {MAX_SEALED_BYTES - 1000} can be sealed")
        nonce = self.derived(f"{purpose} nonce", hashlib.sha256(plain).digest())[:NONCE_BYTES]
        sealed: bytes = _cipher(self.derived(purpose)).encrypt(nonce, plain, MAGIC)
        return MAGIC + nonce + sealed

    def decrypt(self, sealed: bytes, purpose: str) -> bytes | None:
        """What `encrypt` was given; None for another key, another purpose, or bytes that were changed."""
        from cryptography.exceptions import InvalidTag

        start = len(MAGIC) + NONCE_BYTES
        if sealed[: len(MAGIC)] != MAGIC or len(sealed) < start + 16:
            return None
        try:
            plain: bytes = _cipher(self.derived(purpose)).decrypt(sealed[len(MAGIC) : start], sealed[start:], MAGIC)
        except InvalidTag:
            return None
        return plain

    def line(self, line: bytes) -> bytes:
        """A line of the journal, sealed, as one line of hex digits."""
        return self.encrypt(line, "journal").hex().encode() + b"\n"

    def plain_line(self, line: bytes) -> bytes:
        """What `line` was given; no bytes for a line that was changed."""
        try:
            return self.decrypt(bytes.fromhex(line.decode("ascii")), "journal") or b""
        except ValueError:
            return b""

    def secret_plan(self, plan: Plan) -> Plan:
        """The plan that is made in place of one: its seed and serial numbers follow from the key and the whole plan.

        Plans that differ in anything share no pose: sets of one key do not show the same places.
        """
        recipe = plan.recipe
        files = json.dumps(dict(plan.scene.sources), sort_keys=True)
        whole = f"{recipe.model_dump_json()}\0{plan.scene.settings.model_dump_json()}\0{files}".encode()

        def number(purpose: str, bits: int) -> int:
            return int.from_bytes(self.derived(purpose, whole), "little") >> (8 * KEY_BYTES - bits)

        sensor = recipe.sensor.model_copy(update={"serial": number("sensor serial", SERIAL_BITS)})
        changes: dict[str, Any] = {"seed": number("seed", SEED_BITS), "sensor": sensor}
        if isinstance(recipe.accelerometer, Imu):
            serial = number("accelerometer serial", SERIAL_BITS)
            changes["accelerometer"] = recipe.accelerometer.model_copy(update={"serial": serial})
        return replace(plan, recipe=recipe.model_copy(update=changes))

    def public_provenance(self, provenance: Mapping[str, Any]) -> dict[str, Any]:
        """What a withheld set states of its provenance: nothing of poses, errors, scene or seed, but a commitment.

        The commitment is a keyed digest of the rest: another key, recipe or scene has another, another program has not.
        """
        rest = {key: value for key, value in provenance.items() if key not in PUBLIC_KEYS}
        whole = json.dumps(rest, sort_keys=True).encode()
        return {
            "recipe": {key: provenance["recipe"][key] for key in PUBLIC_RECIPE_KEYS},
            **{key: provenance[key] for key in PUBLIC_KEYS},
            "commitment": self.derived("commitment", whole).hex(),
        }

    def write_truth(
        self,
        plan: Plan,
        directory: Path,
        provenance: Mapping[str, Any],
        summary: Summary,
        rows: Callable[[], Iterable[TruthRow]],
        splits: Mapping[int, str | None],
    ) -> tuple[list[str], Withheld]:
        """Write truth.sealed, and truth.parquet of the frames that are not withheld; the whole truth is in no file.

        provenance, summary: whole; rows: of all frames; splits: of each frame. Withheld are the test frames, or all
        frames where the recipe has no [split]. Returns the names of the files too.
        """
        archive = io.BytesIO()
        with (
            tempfile.TemporaryDirectory(prefix="vlcrender-truth-") as folder,
            zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as file,
        ):
            for name in write_truth(plan, Path(folder), rows()):
                file.writestr(zipfile.ZipInfo(name), (Path(folder) / name).read_bytes())
            file.writestr(zipfile.ZipInfo(SUMMARY), summary.model_dump_json())
            file.writestr(zipfile.ZipInfo(PROVENANCE), json.dumps(provenance, indent=1))
        with whole_file(directory / SEALED) as partial:
            partial.write_bytes(self.encrypt(archive.getvalue(), "truth"))
        digest = sha256_of(directory / SEALED)
        if plan.recipe.split is None:
            return [SEALED], Withheld(sha256=digest, frames="all")
        withheld = Withheld(sha256=digest, frames=tuple(n for n, split in splits.items() if split == "test"))
        told = set(withheld.frames_with_truth(len(splits)))
        write_table(directory / TRUTH, (row for row in rows() if row.frame in told), TruthRow)
        return [SEALED, TRUTH], withheld


def _cipher(key: bytes) -> Any:
    try:
        from cryptography.hazmat.primitives.ciphers.aead import AESGCM
    except ImportError:
        raise InputError("a withheld truth needs cryptography: pip install 'vlcrender[benchmark]'") from None
    return AESGCM(key)


def check_withholdable(plan: Plan) -> None:
    """Raise InputError where a plan gives its truth away, whatever its seed."""
    if problem := _revealed(plan):
        raise InputError(f"--withhold-truth: {problem}")


def _revealed(plan: Plan) -> str | None:
    """How a plan gives its truth away; None where it does not."""
    recipe = plan.recipe
    if plan.cells is not None or plan.values:
        return "cells of a sweep show the same poses again and again; remove [[sweep]]"
    if not isinstance(recipe.poses, AimedPoses):
        return (
            f'poses.kind = "{recipe.poses.kind}": the recipe and the order of the frames give the poses away; '
            'choose "aimed"'
        )
    if recipe.expected:
        return "expected = true: images without noise are no frames of a device; set expected = false"
    if recipe.regions is not None and recipe.regions.overscan:
        return "regions.overscan = true: shows what no camera sees; remove it"
    if recipe.split is not None and recipe.split.test == 0:
        return "split.test = 0: leaves nothing to withhold; raise it, or remove [split]"
    if recipe.split is not None and recipe.belief is not None:
        return (
            "[split] with [belief]: training rows state the true camera and map of devices that take test frames; "
            "remove either"
        )
    return None


def _sealed_problem(path: Path, withheld: Withheld) -> str | None:
    """What is wrong with the file truth.sealed."""
    if not path.is_file():
        return f"{path}: is missing"
    if sha256_of(path) != withheld.sha256:
        return f"{path}: SHA-256 differs from dataset.json: the file was changed or truncated"
    return None


def withheld_problems(directory: Path, dataset: DatasetFile, damaged: Collection[str] = ()) -> list[str]:
    """What is wrong with the sealed truth of a withheld set, by what can be seen without the key.

    damaged: files that have a line already.
    """
    if dataset.withheld is None:
        return []
    problem = None if SEALED in damaged else _sealed_problem(directory / SEALED, dataset.withheld)
    problems = [] if problem is None else [problem]
    frames = dataset.withheld.frames
    if frames != "all" and not set(frames) <= set(range(dataset.frame_count)):
        problems.append(f"{directory / 'dataset.json'}: withheld.frames: has to be of frames 0 to frame_count - 1")
    open_tables = TRUTH_TABLES if frames == "all" else TRUTH_TABLES[1:]
    problems += [f"{directory / name}: is there, but withheld" for name in open_tables if (directory / name).exists()]
    return problems


def same_file_times(directory: Path) -> None:
    """Give all files of a dataset the time of dataset.json: times of frames tell how long each took to render."""
    times = (directory / DATASET_FILE).stat()
    for path in directory.rglob("*"):
        os.utime(path, ns=(times.st_mtime_ns, times.st_mtime_ns))


def release(directory: Path, key_file: Path) -> None:
    """Write the truth of a withheld set again, after which the set is that of `generate` with the true seed.

    A release that was interrupted is made again. Raises InputError where the set has its truth already, where the key
    is another's or the sealed truth damaged, and where the folder is in use.
    """
    with locked(directory, "vlcrender release"):
        _release(directory, Seal.read(key_file), key_file)


def _release(directory: Path, seal: Seal, key_file: Path) -> None:
    """`release` in a folder that is locked."""
    dataset = read_dataset_file(directory)
    path = directory / SEALED
    if dataset.withheld is None:
        raise InputError(f"{directory}: its truth is not withheld")
    if (problem := _sealed_problem(path, dataset.withheld)) is not None:
        raise InputError(problem)
    plain = seal.decrypt(path.read_bytes(), "truth")
    if plain is None:
        raise InputError(f"{key_file}: is not the key of {path}")
    try:
        with zipfile.ZipFile(io.BytesIO(plain)) as archive:
            provenance = json.loads(archive.read(PROVENANCE))
            summary = Summary.model_validate_json(archive.read(SUMMARY))
            for name in set(archive.namelist()) & set(TRUTH_TABLES):
                with whole_file(directory / name) as partial:
                    partial.write_bytes(archive.read(name))
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise InputError(f"{path}: is no archive of a truth: {first_line(str(error))}") from None
    # The sealed truth goes last: until dataset.json has the provenance, it alone has it.
    per_file = frames_per_file({"provenance": provenance})
    changes = {
        "withheld": None,
        "provenance": provenance,
        "manifest_sha256": manifest_of_files(directory, per_file, directory, without=(SEALED,)),
        "summary": summary.model_copy(update={"bytes": disk_use(directory)}),
    }
    write_sealed(directory / DATASET_FILE, dataset.model_copy(update=changes).model_dump(mode="json", exclude={"seal"}))
    path.unlink()
