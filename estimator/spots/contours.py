"""Contours of LED images: points on the edge of each identified LED's image, to some hundredths of a pixel.

Along a row or a column that crosses the edge, the light of four pixels, two on each side of it, over the plateau within
is the length of that line inside the LED image: exact for a straight edge and any blur that ends there. Plateau and
background are those of the next two pixels on each side, so that a fall-off over the image cancels. A point is the mean
of the edge over the line's width of a pixel: on a circle of radius r pixels it lies 1 / (24 r) px further inside.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.undistort import has_pinhole_image, pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame, Part
from estimator.io.led_map import Led
from estimator.spots.correspondences import find_correspondences
from estimator.spots.detect import Spot
from estimator.spots.identify import Correspondence
from estimator.spots.lamps import has_stripes

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Pixels of a line beside an edge: two that the edge may reach, and two for the level.
SIDE_PX = 4
# Half the sides of the part of the image around a spot, in radii of a disc of its area: an ellipse at 75 deg has 2.
AROUND_RADII = 3.0
# An ellipse has five parameters, the sides of a square eight: fewer points leave nothing to check them.
MIN_POINTS = 16


@dataclass(frozen=True, eq=False)
class Contour:
    """An LED, its spot, and points on the edge of its image: `image` (n, 2), normalized coordinates of a pinhole."""

    led: Led
    spot: Spot
    image: Floats


def find_contours(frame: DeviceFrame, shape: str | None = None, cut_too: bool = False) -> list[Contour]:
    """Contours of the identified LEDs of a shape, or of all; with `cut_too` also of images that a border may cut.

    Raises EstimationFailure, also if a contour with MIN_POINTS was found of no LED.
    """
    if has_stripes(frame):
        raise EstimationFailure("contour", "the LED images have stripes")
    found = [one for one in find_correspondences(frame, cut_too=cut_too) if shape in (None, one.led.shape)]
    if not found:
        raise EstimationFailure("contour", f"none of the LEDs identified is a {shape}")
    sized = [one for one in found if one.led.has_size]
    if not sized:
        raise EstimationFailure("contour", "the map does not say how large its LEDs are")
    contours = [one for one in (_contour(frame, one) for one in sized) if len(one.image) >= MIN_POINTS]
    if not contours:
        raise EstimationFailure("contour", f"LED images are too small: none has {MIN_POINTS} points on its edge")
    return contours


def _contour(frame: DeviceFrame, correspondence: Correspondence) -> Contour:
    spot = correspondence.spot
    pixels = frame.once(("edge", spot.u_px, spot.v_px), lambda: edge_pixels(frame, spot))
    pixels = pixels[has_pinhole_image(pixels, frame.camera)] if len(pixels) else pixels
    image = pinhole_image(pixels, frame.camera) if len(pixels) else pixels
    return Contour(correspondence.led, spot, image)


def edge_pixels(frame: DeviceFrame, spot: Spot) -> Floats:
    """Points (n, 2) on the edge of the LED image of a spot, (u, v) pixels; none where it was not read out."""
    for part in frame.parts:
        rows, columns = part.image_dn.shape
        u_px, v_px = spot.u_px - part.column, spot.v_px - part.row
        if not (0 <= u_px < columns and 0 <= v_px < rows):
            continue
        radius_px = float(np.sqrt(spot.area_px / np.pi))
        reach_px = AROUND_RADII * radius_px + 2 * SIDE_PX
        left, top = max(int(u_px - reach_px), 0), max(int(v_px - reach_px), 0)
        image_dn = part.image_dn[top : int(v_px + reach_px) + 1, left : int(u_px + reach_px) + 1]
        around = Part(part.row + top, part.column + left, image_dn)
        electrons = frame.electrons(around).astype(np.float64)
        points = edges(electrons, _own(electrons, spot.peak_e, (u_px - left, v_px - top), radius_px))
        return points + (around.column, around.row)
    return np.empty((0, 2))


def _own(electrons: Floats, peak_e: float, centre_px: Sequence[float], radius_px: float) -> Mask:
    """Pixels of an LED image above half of its level: the piece with the most pixels near its centroid."""
    outermost = np.concatenate([electrons[0], electrons[-1], electrons[:, 0], electrons[:, -1]])
    # A neighbour, or the LED itself where it is cut, covers less than three quarters of the outermost pixels.
    background_e = float(np.percentile(outermost, 25))
    plateau_e = peak_e
    for _ in range(2):
        labels = cv2.connectedComponents((electrons > (background_e + plateau_e) / 2).view(np.uint8), connectivity=4)[1]
        low = np.maximum(np.subtract(centre_px, radius_px).astype(int), 0)
        high = np.add(centre_px, radius_px).astype(int) + 1
        counts = np.bincount(labels[low[1] : high[1], low[0] : high[0]].ravel(), minlength=2)
        own = np.asarray((labels == 1 + int(counts[1:].argmax())) & bool(counts[1:].any()))
        plateau_e = float(np.median(electrons[own])) if own.any() else plateau_e
    return own


def edges(electrons: Floats, own: Mask) -> Floats:
    """Points (n, 2), (x, y) with pixel centres at +0.5, on the edge of the pixels `own` of an image (rows, columns)."""
    gradient = np.abs(cv2.Sobel(electrons, cv2.CV_64F, 1, 0)), np.abs(cv2.Sobel(electrons, cv2.CV_64F, 0, 1))
    # Lines that cross the edge at less than 45 deg are left to those of the other direction.
    across, along = gradient[0] >= gradient[1], gradient[1] > gradient[0]
    right = _right_edges(electrons, own, across)
    left = _right_edges(electrons[:, ::-1], own[:, ::-1], across[:, ::-1]) * [-1, 1] + [own.shape[1], 0]
    lower = _right_edges(electrons.T, own.T, along.T)
    upper = _right_edges(electrons.T[:, ::-1], own.T[:, ::-1], along.T[:, ::-1]) * [-1, 1] + [own.shape[0], 0]
    return np.concatenate([right, left, lower[:, ::-1], upper[:, ::-1]])


def _right_edges(electrons: Floats, own: Mask, used: Mask) -> Floats:
    """Points (n, 2), (x, y), of the edges in `used` that have `own` pixels on their left."""
    rows, last = np.nonzero(own[:, :-1] & ~own[:, 1:] & used[:, :-1])
    whole = (last >= SIDE_PX - 1) & (last < own.shape[1] - SIDE_PX)
    row, column = rows[whole, None], last[whole, None] + np.arange(1 - SIDE_PX, SIDE_PX + 1)
    inside, light = own[row, column], electrons[row, column]
    clear = inside[:, :SIDE_PX].all(axis=1) & ~inside[:, SIDE_PX:].any(axis=1)
    row, column, light = row[clear, 0], column[clear], light[clear]
    plateau, background = light[:, :2].mean(axis=1), light[:, -2:].mean(axis=1)
    falls = plateau > background  # in noise some do not, and say nothing of an edge
    row, column, light, background = row[falls], column[falls], light[falls], background[falls]
    lit = (light[:, 2:-2] - background[:, None]).sum(axis=1) / (plateau[falls] - background)
    return np.column_stack([column[:, 2] + lit, row + 0.5])
