"""Truth of a dataset, opened with a key file where it is withheld (datasets/FORMAT.md, Withheld truth)."""

import hashlib
import hmac
import io
import re
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, Strict, ValidationError

from estimator.errors import InputError
from estimator.io.dataset import Dataset
from estimator.io.records import Row, first_problem, read_rows
from estimator.io.truth import COLUMNS, TrueMapLed, TruthRow, read_true_map

SplitName = Literal["train", "validation", "test"]
SEALED = "truth.sealed"
MAGIC = b"VLCSEAL1"
NONCE_BYTES = 12
KEY_LINE = re.compile(r"vlcrender-truth-key-1 ([0-9a-f]{64})\n?")
TABLES = ("truth.parquet", "truth_map.parquet")
"""Tables of the truth that scores need."""


class Withheld(Row):
    """What dataset.json says of a withheld truth: digest of truth.sealed, and the frames without a row elsewhere."""

    sha256: str = Field(pattern="^[0-9a-fA-F]{64}$")
    frames: Literal["all"] | Annotated[tuple[Annotated[int, Field(ge=0)], ...], Strict(False)]


class _Stated(Row):
    withheld: Withheld | None = None


@dataclass(frozen=True)
class JudgedTruth:
    """Truth of the frames that are judged: those of a split, or all frames of a set without one."""

    frames: tuple[int, ...]
    rows: tuple[TruthRow, ...]
    """One of each of `frames`."""
    true_map: tuple[TrueMapLed, ...]
    """Empty where devices have a map."""


def read_withheld(folder: Path) -> Withheld | None:
    """What dataset.json says of a withheld truth; None where the set has its truth. Raises InputError."""
    path = folder / "dataset.json"
    try:
        return _Stated.model_validate_json(path.read_bytes()).withheld
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error)}") from None


def read_judged_truth(dataset: Dataset, key_file: Path | None, split: SplitName = "test") -> JudgedTruth:
    """Truth of the frames of a split, or of all frames of a set without one; key_file: needed where it is withheld.

    Raises InputError where the truth is withheld and there is no key, where the key is another's, a file is damaged, or
    the split has no frame.
    """
    folder, withheld = dataset.folder, read_withheld(dataset.folder)
    frames = tuple(record.frame for record in dataset.frames if record.split == split)
    if all(record.split is None for record in dataset.frames):
        frames = tuple(record.frame for record in dataset.frames)
    if not frames:
        raise InputError(f"{folder}: has no {split} frame, so there is nothing to judge")
    if withheld is None or (withheld.frames != "all" and not set(frames) & set(withheld.frames)):
        return _judged(dataset, folder, frames)
    if key_file is None:
        raise InputError(f"{folder}: the truth of its {split} frames is withheld; give its key file with --truth")
    plain = _opened(folder / SEALED, withheld.sha256, key_file)
    with tempfile.TemporaryDirectory(prefix="estimator-truth-") as opened:
        try:
            with zipfile.ZipFile(io.BytesIO(plain)) as archive:
                for name in set(TABLES) & set(archive.namelist()):
                    (Path(opened) / name).write_bytes(archive.read(name))
        except zipfile.BadZipFile as error:
            raise InputError(f"{folder / SEALED}: is no archive of a truth: {error}") from None
        return _judged(dataset, Path(opened), frames)


def _judged(dataset: Dataset, tables: Path, frames: tuple[int, ...]) -> JudgedTruth:
    """The truth of some frames, from the folder with its tables."""
    path = tables / "truth.parquet"
    truth = {row.frame: row for row in read_rows(path, COLUMNS, TruthRow)}
    if missing := set(frames) - set(truth):
        raise InputError(f"{path}: has no row of frame {min(missing)}")
    true_map = () if dataset.leds else read_true_map(tables / "truth_map.parquet")
    return JudgedTruth(frames, tuple(truth[frame] for frame in frames), true_map)


def _opened(path: Path, sha256: str, key_file: Path) -> bytes:
    """The archive in truth.sealed."""
    try:
        from cryptography.exceptions import InvalidTag
        from cryptography.hazmat.primitives.ciphers.aead import AESGCM
    except ImportError:
        raise InputError("a withheld truth needs cryptography: pip install 'vlcrender[benchmark]'") from None
    try:
        found = KEY_LINE.fullmatch(key_file.read_bytes()[:1000].decode("ascii", errors="replace"))
        sealed = path.read_bytes()
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror or error}") from None
    if found is None:
        raise InputError(f"{key_file}: is no key file (one line, vlcrender-truth-key-1 and 64 hex digits)")
    if hashlib.sha256(sealed).hexdigest() != sha256.lower():
        raise InputError(f"{path}: damaged or changed (its sha256 is not the one in dataset.json)")
    key = hmac.digest(bytes.fromhex(found[1]), b"truth\0", "sha256")
    start = len(MAGIC) + NONCE_BYTES
    try:
        if not sealed.startswith(MAGIC):
            raise InputError(f"{path}: does not start with {MAGIC.decode()}")
        plain: bytes = AESGCM(key).decrypt(sealed[len(MAGIC) : start], sealed[start:], MAGIC)
    except (InvalidTag, ValueError):
        raise InputError(f"{key_file}: is not the key of {path}") from None
    return plain
