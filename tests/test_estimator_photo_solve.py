"""Pieces of the way from a photograph to positions: readout axis, overlay, hypotheses, errors of centroids."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from estimator_correspondences import device, simulated
from estimator_synthetic import Array, grid, view_of

from estimator.errors import EstimationFailure
from estimator.photo.decode import readout_ratio
from estimator.photo.locate import Options
from estimator.photo.locate import _axis as axis_of
from estimator.photo.overlay import INSET_PX, Mark, write_overlay
from estimator.photo.pictures import Exif, Picture
from estimator.photo.solve import MAX_HYPOTHESES, Centre
from estimator.photo.solve import _assignments as assignments
from estimator.photo.solve import _sigma_px as sigma_px_of

TARGET = (3.0, 2.0, 3.0)
VIEW = view_of(TARGET, 2.8, 5.0, -3.0, 40.0, (4000, 3000, 3000.0))


@pytest.mark.parametrize(
    ("spots", "expected_px"),
    [
        # Two numbers a spot and two of gravity, less six of the pose; the prior counts as 4 residuals of 1.5 px.
        (3, 1.5 * np.sqrt(4 / (4 + 2))),
        (4, 1.5 * np.sqrt(4 / (4 + 4))),
        # No number of residuals of 0 is evidence of lamps better than half of what photographs have shown.
        (12, 1.5 / 2),
    ],
)
def test_spots_without_residuals_have_the_prior_s_errors_and_half_of_them_at_least(
    spots: int, expected_px: float
) -> None:
    leds_m = grid(4, 3, 0.3, TARGET)[[0, 3, 8, 11, 1, 2, 4, 5, 6, 7, 9, 10][:spots]]
    assert sigma_px_of(device(VIEW, 0.5), simulated(VIEW, leds_m)) == pytest.approx(expected_px, rel=1e-4)


def test_what_the_noise_of_the_centroids_explains_is_no_error_of_the_lamps() -> None:
    """The variance of 3 spots without residuals, less that of their own noise of 0.5 px."""
    spots = simulated(VIEW, grid(4, 3, 0.3, TARGET)[[0, 3, 8]])
    noisy = [replace(one, spot=replace(one.spot, covariance_px2=0.5**2 * np.eye(2))) for one in spots]
    assert sigma_px_of(device(VIEW, 0.5), noisy) == pytest.approx(np.sqrt(1.5 - 0.5**2), rel=1e-4)


def lamps_with_two_candidates(count: int) -> list[Centre]:
    """Lamps that may each be one of two LEDs, which no other lamp may be."""
    return [Centre(0.0, 0.0, (1.0, 0.0, 0.0, 1.0), (2 * number, 2 * number + 1)) for number in range(count)]


def test_lamps_with_too_many_hypotheses_are_refused_before_the_first_fit() -> None:
    """Twelve lamps that may be one of two LEDs have 2^12 = 4096 hypotheses, and each takes a fit. Every further lamp
    doubles the time, so that a picture of twenty would take 256 times as long and seem to hang.
    """
    assert MAX_HYPOTHESES == 2**12
    assert len(list(assignments(lamps_with_two_candidates(12)))) == 2**12
    with pytest.raises(EstimationFailure, match="too many lamps of one frequency; give --spots"):
        next(assignments(lamps_with_two_candidates(13)))


def picture_of(light: Array) -> Picture:
    """A picture of linear light from 0 to 1."""
    return Picture(Path("none.png"), light.astype(np.float32), np.zeros(light.shape, dtype=bool), 8, Exif())


STRIPES = np.tile(np.arange(40) // 2 % 2.0, (40, 1)).T
"""Lines are rows."""


@pytest.mark.parametrize(
    ("light", "given", "remark"),
    [
        (STRIPES, "auto", r"readout axis: lines are rows \(.* times the gradient energy of the other axis\)"),
        (STRIPES.T, "auto", r"readout axis: lines are columns \(.*"),
        (STRIPES, "rows", "readout axis: lines are rows, as given"),
        (STRIPES, "columns", r"readout axis: lines are columns, as given; the stripes say rows \(.*"),
        # No axis has 1.5 times the gradients of the other: the picture does not contradict.
        (STRIPES + STRIPES.T, "rows", "readout axis: lines are rows, as given"),
        (STRIPES + STRIPES.T, "columns", "readout axis: lines are columns, as given"),
    ],
)
def test_a_stated_axis_is_taken_and_stripes_that_contradict_it_are_told(
    light: Array, given: Literal["auto", "rows", "columns"], remark: str
) -> None:
    along, said = axis_of(picture_of(light / light.max()), Options(readout=given))
    assert along in remark.split(";")[0]
    assert re.fullmatch(remark, said)


def test_rows_and_columns_are_measured_alike(rng: np.random.Generator) -> None:
    """A lamp of one pixel in dim grain: the transposed picture has the same gradients about it, along the other axis.

    The sums are of a few hundred float32 squares, taken in another order: 1e-6 of them at most.
    """
    light = 0.02 * rng.random((60, 60))
    light[30, 30] = 1.0
    (along, ratio), (other, same) = readout_ratio(picture_of(light)), readout_ratio(picture_of(light.T))
    assert {along, other} == {"rows", "columns"}
    assert same == pytest.approx(ratio, rel=1e-6)


def test_an_inset_has_its_lamp_in_the_middle(tmp_path: Path) -> None:
    """A white pixel in the middle of its mark, in a picture without another: it is white in the middle of the inset
    below the picture, to half a pixel, which is INSET_PX / 2 / (2 (1.3 x 8 + 4)) of the inset's.
    """
    light = np.zeros((90, 300))
    light[30, 200] = 1.0
    contour = np.array([200.5, 30.5]) + [[-8, -8], [8, -8], [8, 8], [-8, 8]]
    write_overlay(tmp_path / "seen.png", picture_of(light), [Mark(200.5, 30.5, contour, "5", identified=True)])
    seen = cv2.imread(str(tmp_path / "seen.png"))
    assert seen is not None
    inset = seen[90:, :INSET_PX]
    assert inset.shape == (INSET_PX, INSET_PX, 3)
    white = np.argwhere(inset.min(axis=2) > 250)  # marks and text are coloured
    assert np.abs(white.mean(axis=0) - INSET_PX / 2).max() <= INSET_PX / 2 / (2 * (1.3 * 8 + 4)) + 1
