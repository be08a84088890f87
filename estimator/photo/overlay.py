"""Overlay: a picture of what was found in a photograph: outlines, identities, frequencies and residuals."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.errors import InputError
from estimator.io.atomic import write_atomically
from estimator.photo.pictures import Picture

Floats = NDArray[np.float64]

MAX_SIDE_PX = 2400
# Blue, green, red.
IDENTIFIED, REJECTED, RESIDUAL = (80, 220, 80), (60, 60, 240), (0, 200, 255)
RESIDUAL_SCALE = 20.0
INSET_PX = 240
INSET_MARGIN = 1.3


@dataclass(frozen=True, eq=False)
class Mark:
    """A lamp in the overlay: its centre (u, v), outline (n, 2), text, and residual (2,) if it has one."""

    u_px: float
    v_px: float
    contour_px: Floats
    text: str
    identified: bool
    residual_px: Floats | None = None


def write_overlay(path: Path, picture: Picture, marks: Sequence[Mark]) -> None:
    """Write a PNG: the picture, marks on it, and lamps enlarged below it. Residuals are drawn RESIDUAL_SCALE times."""
    scale = min(1.0, MAX_SIDE_PX / max(picture.width_px, picture.height_px))
    coded = picture.coded.astype(np.uint8)
    small = cv2.resize(coded, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    whole = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    for mark in marks:
        _draw(whole, mark, np.array([scale, scale]), np.zeros(2))
    insets = [_inset(coded, mark) for mark in marks[: max(whole.shape[1] // INSET_PX, 1)]]
    if insets:
        row = np.zeros((INSET_PX, max(whole.shape[1], INSET_PX * len(insets)), 3), np.uint8)
        for number, inset in enumerate(insets):
            row[:, number * INSET_PX : (number + 1) * INSET_PX] = inset
        if row.shape[1] > whole.shape[1]:
            whole = cv2.copyMakeBorder(whole, 0, 0, 0, row.shape[1] - whole.shape[1], cv2.BORDER_CONSTANT)
        whole = np.vstack([whole, row])
    written, data = cv2.imencode(".png", whole)
    if not written:
        raise InputError(f"{path}: the overlay cannot be written")
    write_atomically(path, data.tobytes())


def _draw(image: NDArray[np.uint8], mark: Mark, scale: Floats, origin: Floats) -> None:
    colour = IDENTIFIED if mark.identified else REJECTED
    outline = np.rint((mark.contour_px - origin) * scale).astype(np.int32)
    cv2.polylines(image, [outline.reshape(-1, 1, 2)], True, colour, 1, cv2.LINE_AA)
    centre = (np.array([mark.u_px, mark.v_px]) - origin) * scale
    u, v = np.rint(centre).astype(int).tolist()
    cv2.drawMarker(image, (u, v), colour, cv2.MARKER_CROSS, 8, 1, cv2.LINE_AA)
    if mark.residual_px is not None:
        end = np.rint(centre + RESIDUAL_SCALE * mark.residual_px * scale).astype(int).tolist()
        cv2.arrowedLine(image, (u, v), (end[0], end[1]), RESIDUAL, 1, cv2.LINE_AA, tipLength=0.2)
    below = round(float(outline[:, 1].max())) + 16
    for number, line in enumerate(mark.text.split("\n")):
        place = (max(u - 60, 2), below + 16 * number)
        cv2.putText(image, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)


def _inset(coded: NDArray[np.uint8], mark: Mark) -> NDArray[np.uint8]:
    """A lamp enlarged, INSET_PX square."""
    half = INSET_MARGIN * float(np.abs(mark.contour_px - (mark.u_px, mark.v_px)).max()) + 4
    low = np.array([mark.u_px - half, mark.v_px - half])
    scale = INSET_PX / (2 * half)
    moved = np.array([[scale, 0, -low[0] * scale], [0, scale, -low[1] * scale]])
    image = cv2.cvtColor(
        cv2.warpAffine(coded, moved, (INSET_PX, INSET_PX), flags=cv2.INTER_NEAREST), cv2.COLOR_GRAY2BGR
    )
    colour = IDENTIFIED if mark.identified else REJECTED
    outline = np.rint((mark.contour_px - low) * scale).astype(np.int32)
    cv2.polylines(image, [outline.reshape(-1, 1, 2)], True, colour, 1, cv2.LINE_AA)
    cv2.putText(image, mark.text.split("\n")[0], (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    return np.asarray(image, dtype=np.uint8)
