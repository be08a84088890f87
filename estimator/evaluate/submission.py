"""Submissions to a benchmark: bundles of estimates with digests, and their scores by the truth.

A bundle is untrusted: nothing of it becomes a path, and sizes, names and digests are checked before it is read.
"""

import hashlib
import io
import platform
import re
import tempfile
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field, Strict, StringConstraints, ValidationError

from estimator.errors import InputError
from estimator.evaluate.identities import score_identities
from estimator.evaluate.known import KnownEstimates, estimate_paths
from estimator.evaluate.score import VariantScore, score_variant
from estimator.io.atomic import write_atomically
from estimator.io.dataset import Dataset, read_dataset
from estimator.io.estimates import NAME, NAME_RULE, frames_sha256
from estimator.io.records import Row, first_line, first_problem
from estimator.io.withheld import JudgedTruth, SplitName, read_judged_truth

MEMBER = "submission.json"
MAX_DESCRIPTION_BYTES = 1_000_000
MAX_ESTIMATES_BYTES = 256 * 2**20
"""Largest file of estimates in a bundle, packed and unpacked."""
MAX_VARIANTS = 100
Line = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]+$")]
"""A text of one line."""
Digest = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]


class SubmittedEstimates(Row):
    """File of estimates in a bundle: `estimates/VARIANT.parquet`."""

    variant: Annotated[str, StringConstraints(pattern=f"^{NAME}$")]
    sha256: Digest
    bytes: int = Field(ge=1, le=MAX_ESTIMATES_BYTES)

    @property
    def member(self) -> str:
        """Its name in the bundle."""
        return f"estimates/{self.variant}.parquet"


class Submission(Row):
    """Description of a bundle, submission.json."""

    format: Literal["estimator-submission"] = "estimator-submission"
    version: Literal[1] = 1
    name: Line
    author: Line | None
    dataset: Line
    frames_sha256: Digest
    """Digest of the dataset's frames.parquet: which frames were estimated."""
    versions: dict[Line, Line]
    estimates: Annotated[tuple[SubmittedEstimates, ...], Strict(False), Field(min_length=1, max_length=MAX_VARIANTS)]


@dataclass(frozen=True)
class Bundle:
    """A bundle that was read: its description, and the bytes of its estimates by variant."""

    source: str
    description: Submission
    files: dict[str, bytes]


@dataclass(frozen=True)
class Entry:
    """Score of a variant of a submission over the judged frames."""

    name: str
    author: str | None
    score: VariantScore


def submit(folder: Path, out: Path, name: str, author: str | None = None, variants: Sequence[str] = ()) -> Submission:
    """Write a bundle with the estimates of a dataset: of some variants, or of all where none is named.

    Raises InputError where there are none, or they are damaged or of other frames.
    """
    dataset = read_dataset(folder)
    digest = frames_sha256(dataset.folder)
    paths = {path.stem: path for path in estimate_paths(folder)}
    chosen = list(dict.fromkeys(variants)) or list(paths)
    if not chosen:
        raise InputError(f"{folder / 'estimates'}: no estimates to submit; make them with `estimator run {folder}`")
    files = {}
    for variant in chosen:
        if variant not in paths:
            raise InputError(
                f"{folder / 'estimates'}: none of variant {variant}; there are: {', '.join(paths) or 'none'}"
            )
        for _ in KnownEstimates.of(paths[variant], dataset, len(dataset.frames), digest).rows():
            pass  # damaged rows are refused
        files[variant] = paths[variant].read_bytes()
    try:
        description = Submission(
            name=name,
            author=author,
            dataset=dataset.name,
            frames_sha256=digest,
            versions={"estimator": version("vlcrender"), "python": platform.python_version()},
            estimates=tuple(
                SubmittedEstimates(variant=variant, sha256=hashlib.sha256(data).hexdigest(), bytes=len(data))
                for variant, data in files.items()
            ),
        )
    except ValidationError as error:
        raise InputError(f"submission: {first_problem(error)}") from None
    bundle = Bundle(str(out), description, files)
    for variant, data in files.items():
        _check_size(bundle, variant, data, len(dataset.frames))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        # ZipInfo's fixed time: the same estimates make the same bundle.
        for member, data in (
            (MEMBER, description.model_dump_json(indent=1).encode() + b"\n"),
            *((one.member, files[one.variant]) for one in description.estimates),
        ):
            archive.writestr(zipfile.ZipInfo(member), data, zipfile.ZIP_DEFLATED)
    write_atomically(out, packed.getvalue())
    return description


def read_bundle(path: Path) -> Bundle:
    """Read a bundle and check names, sizes and digests; raises InputError that names the bundle and what is wrong."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.namelist()
            if len(set(members)) != len(members):
                raise InputError(f"{path}: a member is there twice")
            if MEMBER not in members:
                raise InputError(f"{path}: not a submission (it has no {MEMBER})")
            content = _member(path, archive, MEMBER, MAX_DESCRIPTION_BYTES)
            try:
                description = Submission.model_validate_json(content)
            except ValidationError as error:
                raise InputError(f"{path}: {MEMBER}: {first_problem(error)}") from None
            wanted = [one.member for one in description.estimates]
            if len(set(wanted)) != len(wanted):
                raise InputError(f"{path}: {MEMBER}: a variant is there twice")
            if odd := sorted(set(members) ^ {MEMBER, *wanted}):
                state = "is missing" if odd[0] in wanted else f"is not in {MEMBER}"
                raise InputError(f"{path}: {odd[0]!r} {state}")
            files = {}
            for one in description.estimates:
                data = _member(path, archive, one.member, one.bytes)
                if len(data) != one.bytes or hashlib.sha256(data).hexdigest() != one.sha256:
                    raise InputError(f"{path}: {one.member}: damaged or changed (its sha256 is not that of {MEMBER})")
                files[one.variant] = data
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (zipfile.BadZipFile, zlib.error, OSError, RuntimeError, EOFError) as error:
        raise InputError(f"{path}: not a readable bundle ({first_line(error)})") from None
    return Bundle(str(path), description, files)


def _member(path: Path, archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """A member's bytes, of which no more than `limit` are unpacked."""
    with archive.open(name) as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise InputError(f"{path}: {name}: has more than {limit} bytes")
    return data


def score_bundles(
    bundles: Sequence[Path], folder: Path, key_file: Path | None = None, split: SplitName = "test"
) -> list[Entry]:
    """Score of each variant of each bundle over the judged frames of a dataset, in the order of the bundles.

    Judged are the frames of a split, or all frames of a set without one. Raises InputError for a bundle that is damaged
    or of other frames, and as `read_judged_truth`.
    """
    dataset = read_dataset(folder)
    digest = frames_sha256(dataset.folder)
    truth = read_judged_truth(dataset, key_file, split)
    entries = []
    for path in bundles:
        bundle = read_bundle(path)
        if bundle.description.frames_sha256 != digest:
            raise InputError(f"{path}: estimates of other frames than {dataset.folder / 'frames.parquet'} has")
        for variant, data in bundle.files.items():
            _check_size(bundle, variant, data, len(dataset.frames))
            score = _score(bundle, variant, data, dataset, truth)
            entries.append(Entry(bundle.description.name, bundle.description.author, score))
    return entries


def _check_size(bundle: Bundle, variant: str, data: bytes, frame_count: int) -> None:
    """Refuse estimates of another number of frames, or too many bytes, before rows are read."""
    where = f"{bundle.source}: estimates/{variant}.parquet"
    try:
        metadata = pq.read_metadata(io.BytesIO(data))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{where}: not a readable Parquet file ({first_line(error)})") from None
    if metadata.num_rows != frame_count:
        raise InputError(f"{where}: {metadata.num_rows} rows, needed one for each of the {frame_count} frames")
    size = sum(metadata.row_group(group).total_byte_size for group in range(metadata.num_row_groups))
    if size > MAX_ESTIMATES_BYTES:
        raise InputError(f"{where}: has more than {MAX_ESTIMATES_BYTES} bytes unpacked")


def _score(bundle: Bundle, variant: str, data: bytes, dataset: Dataset, truth: JudgedTruth) -> VariantScore:
    if not re.fullmatch(NAME, variant):
        raise InputError(f"{bundle.source}: variant {variant!r}: allowed: {NAME_RULE}")
    chosen = set(truth.frames)
    with tempfile.TemporaryDirectory(prefix="estimator-bundle-") as opened:
        path = Path(opened) / f"{variant}.parquet"
        path.write_bytes(data)
        try:
            known = KnownEstimates.of(path, dataset, len(dataset.frames), bundle.description.frames_sha256)
            judged = [row for row in known.rows() if row.frame in chosen]
        except InputError as error:
            raise InputError(f"{bundle.source}: {str(error).replace(f'{path}', f'estimates/{path.name}')}") from None
    records = tuple(dataset.frames[frame] for frame in truth.frames)
    downlink = score_identities(judged, truth.rows, replace(dataset, frames=records), truth.true_map)
    return score_variant(variant, judged, truth.rows, known.leds_m, [record.device for record in records], downlink)
