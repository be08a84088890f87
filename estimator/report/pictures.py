"""Small pictures of frames in the page, and which frames have one where a budget ends."""

import base64
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from PIL import Image

from estimator.errors import InputError
from estimator.evaluate.score import VariantScore

WIDTH_PX = 400
QUALITY = 60
PICTURES_BYTES = 1_000_000
"""Characters of all pictures in a page of one set."""


def frames_first(variants: Sequence[VariantScore], frame_count: int) -> list[int]:
    """All frames, those that a reader asks for first: worst, median and best of each variant, then evenly spread."""
    chosen: dict[int, None] = {}
    for one in variants:
        errors = sorted((row.error_3d_m, row.frame) for row in one.rows if row.error_3d_m is not None)
        for place in (len(errors) - 1, len(errors) // 2, 0) if errors else ():
            chosen[errors[place][1]] = None
    chosen.update(dict.fromkeys(_spread(frame_count)))
    return list(chosen)


def _spread(count: int) -> Iterator[int]:
    """0 to count - 1, coarse steps first."""
    step = 1 << max(count - 1, 0).bit_length()
    while step >= 1:
        yield from range(0, count, step)
        step //= 2


def pictures(folder: Path, frames: Sequence[int], budget: int = PICTURES_BYTES) -> dict[int, tuple[str, float]]:
    """WebP pictures as text in base 64, with width / height, of frames that have a preview, until the budget ends.

    Raises InputError for a preview that is no picture, OSError where one cannot be read.
    """
    found: dict[int, tuple[str, float]] = {}
    for frame in frames:
        path = folder / f"previews/{frame:06}.png"
        if not path.is_file():
            continue
        content = path.read_bytes()
        try:
            with Image.open(io.BytesIO(content)) as preview:
                aspect = preview.width / preview.height
                small = preview.convert("L")
                small.thumbnail((WIDTH_PX, 4 * WIDTH_PX))
        except (OSError, ValueError, SyntaxError) as error:
            raise InputError(f"{path}: is no picture ({type(error).__name__})") from None
        encoded = io.BytesIO()
        small.save(encoded, "WEBP", quality=QUALITY)
        text = base64.b64encode(encoded.getvalue()).decode()
        budget -= len(text)
        if budget < 0:
            break
        found[frame] = text, aspect
    return found
