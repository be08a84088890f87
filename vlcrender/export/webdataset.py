"""WebDataset: tar shards; of each frame NUMBER.npz (`image`, and `is_read` with regions), NUMBER.json and its truth.

Source: WebDataset documentation, file names up to the first point are the key of a sample. NumPy archives decode to
arrays without a decoder that cuts to 8 bits. Shards do not depend on time or user.
"""

import io
import json
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.export.source import Source

FRAMES_PER_SHARD = 1000
MAX_SHARD_BYTES = 10**9


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write frames-NUMBER.tar and description.json: dataset.json without `provenance`, whose seed gives the truth."""
    truths = [row.model_dump(mode="json") for row in source.truth] if source.has_truth else [None] * len(source.frames)
    shard, held, size = -1, FRAMES_PER_SHARD, 0
    tar: tarfile.TarFile | None = None
    for row, truth in zip(source.frames, truths, strict=True):
        if tar is None or held >= FRAMES_PER_SHARD or size >= MAX_SHARD_BYTES:
            if tar is not None:
                tar.close()
            shard, held, size = shard + 1, 0, 0
            tar = tarfile.open(out / f"frames-{shard:06d}.tar", "w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115
        image = source.image(row)
        arrays = {"image": image.dn.astype(np.uint16) if image.dn.max() <= np.iinfo(np.uint16).max else image.dn}
        if image.is_read is not None:
            arrays["is_read"] = image.is_read  # type: ignore[assignment]
        packed = io.BytesIO()
        np.savez_compressed(packed, **arrays)  # type: ignore[arg-type]
        told = row.model_dump(mode="json", exclude={"file", "part", "sha256"})
        size += _add(tar, f"{row.frame:06d}.npz", packed.getvalue())
        size += _add(tar, f"{row.frame:06d}.json", _json(told))
        if truth is not None:
            size += _add(tar, f"{row.frame:06d}.truth.json", _json(truth))
        held += 1
    if tar is not None:
        tar.close()
    description = source.dataset.model_dump(mode="json", exclude={"provenance"})
    (out / "description.json").write_bytes(_json(description))
    return {"shards": shard + 1, "truth": source.has_truth, "pixel_centres": "+0.5", "pixels_not_read": 0}


def _json(tree: Mapping[str, Any]) -> bytes:
    return json.dumps(tree, allow_nan=False).encode()


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> int:
    member = tarfile.TarInfo(name)
    member.size = len(content)
    tar.addfile(member, io.BytesIO(content))
    return len(content)
