"""Lamps of outlines made by hand: which of them are measured, their area, and what counts as stripes."""

import numpy as np
import pytest

from estimator.spots import striped
from estimator.spots.line_profile import Profile, is_striped
from estimator.spots.outlines import EdgeEllipse, OutlineFit
from estimator.spots.striped import Lamp
from estimator.spots.striped_blobs import StripedBlob, TurnedRegion

ROWS, COLUMNS = 80, 90


def lamp_of(monkeypatch: pytest.MonkeyPatch, outline: EdgeEllipse, uniform: bool, first: int = 0) -> Lamp:
    """The lamp of a region that its box fills, with pixels of its own from column `first` to 60.

    Its outline is found by its edges if it is `uniform`, else by isophotes.
    """
    fit = OutlineFit(outline, np.eye(2), 0.0, 0.0, 0.0)
    monkeypatch.setattr(striped, "edges_of", lambda *_: fit if uniform else None)
    monkeypatch.setattr(striped, "_sharp", lambda *_: fit)
    monkeypatch.setattr(striped, "_faded", lambda *_: fit)
    own = np.zeros((ROWS, COLUMNS), dtype=bool)
    own[:60, first:60] = True
    blob = StripedBlob(0, 0, COLUMNS, ROWS, own, np.zeros_like(own), int(own.sum()))
    turned = TurnedRegion(0, 0, np.where(own, 100.0, 1.0).astype(np.float32), np.zeros_like(own), 9.0, 0.0)
    found = striped._lamp(turned, blob, 1.0, False, 14.0, "rows")
    assert found is not None
    return found


@pytest.mark.parametrize(("share", "measured"), [(0.24, False), (0.26, True)])
def test_a_cut_lamp_is_measured_from_a_quarter_of_its_half_extent_on(
    monkeypatch: pytest.MonkeyPatch, share: float, measured: bool
) -> None:
    """A disc of 30 px radius whose centre is this share of it below the upper border."""
    lamp = lamp_of(monkeypatch, EdgeEllipse(45.0, share * 30, 0.0, 30.0, 30.0), uniform=True)
    assert lamp.touches_border
    assert lamp.measured == measured


@pytest.mark.parametrize(("first", "measured"), [(0, False), (1, True)])
def test_isophotes_need_lines_that_end_inside_the_region(
    monkeypatch: pytest.MonkeyPatch, first: int, measured: bool
) -> None:
    """A disc cut by the upper border, with its centre well inside: its lines begin at the left border or behind it."""
    lamp = lamp_of(monkeypatch, EdgeEllipse(31.0, 21.0, 0.0, 30.0, 30.0), uniform=False, first=first)
    assert lamp.touches_border
    assert lamp.measured == measured


def test_a_spot_has_its_outline_s_area(monkeypatch: pytest.MonkeyPatch) -> None:
    """Semi-axes of 20 and 12 px: 240 pi = 754 px."""
    lamp = lamp_of(monkeypatch, EdgeEllipse(40.0, 30.0, 0.0, 20.0, 12.0), uniform=True)
    assert lamp.spot().area_px == 754


@pytest.mark.parametrize(("weight", "expected"), [(1.0, False), (1.01, True)])
def test_levels_two_sigma_off_their_mean_are_not_yet_stripes(weight: float, expected: bool) -> None:
    """Levels of 8 and 12, a fifth off their mean: their mean square is 4 at a weight of 1, exactly the limit."""
    level = np.where(np.arange(20) % 2 == 0, 8.0, 12.0)
    profile = Profile(np.arange(20), level, np.full(20, weight), np.zeros(20, dtype=bool))
    assert is_striped(profile) == expected
