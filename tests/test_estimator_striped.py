"""Striped LED images: one spot each, its centre, its covariance, its profile."""

import numpy as np
import pytest
from scipy.stats import chi2
from striped_images import Array, code, coverage, gains, readout

from estimator.spots.glow import _isophote
from estimator.spots.led_light import Readout
from estimator.spots.line_edges import LineEdges
from estimator.spots.line_profile import profile_of
from estimator.spots.outlines import EdgeEllipse, EdgeParallelogram
from estimator.spots.parallelogram_fit import _Ends, _TurnedModel
from estimator.spots.striped import Lamp, find_lamps
from estimator.spots.striped_blobs import BlobLight, StripedBlob, TurnedRegion

ROW_US, EXPOSURE_US, CHIP_US = 10.0, 40.0, 25.0
STRIPE_PX = (4 * CHIP_US + EXPOSURE_US) / ROW_US
SENSOR_PX = 12_000_000


def wave(rng: np.random.Generator, lines: int, chip_us: float = CHIP_US) -> Array:
    starts = np.arange(lines) * ROW_US + 1000 * rng.random()
    return gains(code(rng), chip_us, starts, EXPOSURE_US)


def lamps(one: Readout, along: str = "rows", any_square: bool = False) -> tuple[Lamp, ...]:
    return find_lamps([one], along, STRIPE_PX, SENSOR_PX, any_square)  # type: ignore[arg-type]


def errors(
    count: int,
    semi_axes: tuple[float, float],
    angle: float,
    lit_e: float,
    blur_px: float = 0.0,
    full_e: float = np.inf,
    square: bool = False,
    chip_us: float = CHIP_US,
) -> tuple[int, Array, Array]:
    """Number of images with exactly one spot, its errors (n, 2), and their squared Mahalanobis lengths (n,)."""
    rng = np.random.default_rng(5)
    size = round(2.9 * max(semi_axes) if square else 2 * max(semi_axes)) + 40
    off, nees = [], []
    for _ in range(count):
        centre = size / 2 + rng.uniform(-0.5, 0.5, 2)
        covered = coverage(size, centre, np.array(semi_axes), angle, square)
        found = lamps(readout(covered, wave(rng, size, chip_us), lit_e, rng, blur_px, full_e), any_square=square)
        if len(found) == 1:
            error = np.array([found[0].u_px, found[0].v_px]) - centre
            off.append(error)
            nees.append(error @ np.linalg.solve(found[0].covariance_px2, error))
    return len(off), np.array(off), np.array(nees)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("semi_axes", "angle", "lit_e", "blur_px", "limit_px"),
    [
        pytest.param((43, 43), 0.0, 1000.0, 0.0, 0.03, id="86 px disc"),
        pytest.param((43, 43), 0.0, 1000.0, 0.7, 0.03, id="blurred"),
        pytest.param((29, 20), 0.6, 1000.0, 0.0, 0.03, id="58 x 40 ellipse"),
        pytest.param((43, 43), 0.0, 60.0, 0.0, 0.1, id="dim"),
    ],
)
def test_a_striped_disc_is_one_spot_at_its_centre(
    semi_axes: tuple[float, float], angle: float, lit_e: float, blur_px: float, limit_px: float
) -> None:
    """0.03 px is what the requirement allows at 1 000 e; at 60 e noise is sqrt(1000 / 60), four times, as much."""
    count = 40
    single, off, nees = errors(count, semi_axes, angle, lit_e, blur_px)
    assert single == count
    assert np.sqrt((off**2).mean(axis=0)).max() < limit_px
    # Of a true covariance the sum is chi-square; the model error in it, of which there is none here, makes it larger.
    assert chi2.ppf(1e-4, 2 * count) / 2 < nees.sum() < chi2.isf(1e-4, 2 * count)


@pytest.mark.slow
def test_saturated_lines_displace_the_centre_by_less_than_the_covariance_says() -> None:
    count = 30
    single, off, nees = errors(count, (43, 43), 0.0, 3000.0, full_e=2000.0)
    assert single == count
    assert np.sqrt((off**2).mean(axis=0)).max() < 0.03
    assert nees.sum() < chi2.isf(1e-4, 2 * count)


@pytest.mark.slow
def test_a_turned_square_is_measured_by_its_sides() -> None:
    count = 20
    single, off, nees = errors(count, (40, 40), 0.5, 1000.0, square=True)
    assert single == count
    assert np.sqrt((off**2).mean(axis=0)).max() < 0.03
    assert nees.sum() < chi2.isf(1e-4, 2 * count)


@pytest.mark.slow
def test_the_covariance_of_a_square_across_the_lines_says_that_its_place_along_them_is_open() -> None:
    """Dark lines at its ends hide where they are, by up to a stripe."""
    count = 20
    single, off, nees = errors(count, (40.0, 40.0), 0.0, 1000.0, square=True)
    assert single == count
    assert np.sqrt((off[:, 1] ** 2).mean()) > 0.2
    assert nees.sum() < chi2.isf(1e-4, 2 * count)


def test_columns_as_lines_give_the_same_with_u_and_v_exchanged() -> None:
    rng = np.random.default_rng(1)
    centre = np.array([41.3, 40.8])
    covered, line_gains = coverage(84, centre, np.array([29.0, 20.0]), 0.6), wave(rng, 84)
    (by_rows,) = lamps(readout(covered, line_gains, 1000.0, np.random.default_rng(2), origin=(100, 200)))
    image = readout(covered, line_gains, 1000.0, np.random.default_rng(2)).raw_e.T.copy()
    (by_columns,) = lamps(Readout(200, 100, image, image, np.zeros(image.shape, bool), 9.0), "columns")
    assert (by_rows.u_px, by_rows.v_px) == pytest.approx((by_columns.v_px, by_columns.u_px), abs=1e-9)
    assert by_rows.covariance_px2 == pytest.approx(by_columns.covariance_px2[::-1, ::-1])
    assert by_rows.u_px == pytest.approx(241.3, abs=0.1)
    assert by_rows.v_px == pytest.approx(140.8, abs=0.1)
    assert (by_rows.profile.lines == by_columns.profile.lines).all()
    assert by_rows.profile.lines.min() > 100


def test_the_profile_is_the_gain_of_each_line_times_the_level() -> None:
    rng = np.random.default_rng(3)
    covered, line_gains = coverage(126, np.array([63.2, 62.9]), np.array([43.0, 43.0]), 0.0), wave(rng, 126)
    (lamp,) = lamps(readout(covered, line_gains, 1000.0, rng))
    off = (lamp.profile.level_e - 1000 * line_gains[lamp.profile.lines]) * np.sqrt(lamp.profile.weight)
    assert len(off) >= 80
    # Errors of the chord, 0.02 px of up to 86, add to the noise, which alone would give chi-square over n of 1 +- 0.16.
    assert (off**2).mean() < 1.8
    assert lamp.striped
    assert lamp.chord(lamp.profile.lines).max() == pytest.approx(86, abs=0.2)


def test_a_steady_lamp_is_not_striped() -> None:
    rng = np.random.default_rng(4)
    covered = coverage(126, np.array([63.2, 62.9]), np.array([43.0, 43.0]), 0.0)
    (lamp,) = lamps(readout(covered, np.full(126, 0.5), 1000.0, rng))
    assert not lamp.striped


def test_two_lamps_beside_each_other_are_two_and_a_lamp_cut_by_the_border_is_flagged() -> None:
    rng = np.random.default_rng(6)
    size = 160
    covered = coverage(size, np.array([40.3, 70.2]), np.array([22.0, 22.0]), 0.0)
    covered += coverage(size, np.array([112.1, 78.4]), np.array([22.0, 22.0]), 0.0)
    covered += coverage(size, np.array([62.0, 155.0]), np.array([16.0, 16.0]), 0.0)
    image = readout(covered, wave(rng, size), 1000.0, rng).raw_e
    found = lamps(Readout(0, 0, image, image, np.zeros(image.shape, bool), 9.0))
    whole = sorted((one.u_px, one.v_px) for one in found if not one.touches_border)
    assert np.array(whole) == pytest.approx(np.array([(40.3, 70.2), (112.1, 78.4)]), abs=0.2)
    assert [one.touches_border for one in found].count(True) == len(found) - 2


@pytest.mark.slow
@pytest.mark.parametrize("side", ["above", "beside"])
def test_the_visible_part_of_a_cut_lamp_tells_its_centre(side: str) -> None:
    """A disc of 30 px radius with its centre 10 px below the upper border, or 22 to 28 px beside the left one, which
    cuts its longest lines. NEES of two degrees a draw, within its 99.9 % interval; a centroid would be some 10 px off.
    """
    rng, nees = np.random.default_rng(31), []
    for _ in range(12):
        centre = np.array([60.0, 10.0] if side == "above" else [rng.uniform(22, 28), 60.0]) + rng.random(2)
        covered = coverage(120, centre, np.array([30.0, 30.0]), 0.0)
        found = lamps(readout(covered, wave(rng, 120), 1000.0, rng))
        if side == "beside" and not (found and found[0].measured):
            continue
        assert found[0].touches_border
        assert found[0].measured
        error = np.array([found[0].u_px, found[0].v_px]) - centre
        nees.append(error @ np.linalg.solve(found[0].covariance_px2, error))
    assert len(nees) >= 8
    assert sum(nees) < chi2.isf(5e-4, 2 * len(nees))


def test_a_lamp_cut_beyond_its_centre_is_not_measured() -> None:
    rng = np.random.default_rng(32)
    for centre in ([60.0, -3.0], [60.0, 3.0], [-3.0, 60.0]):
        covered = coverage(120, np.array(centre), np.array([30.0, 30.0]), 0.0)
        for one in lamps(readout(covered, wave(rng, 120), 1000.0, rng)):
            assert one.touches_border
            assert not one.measured


def test_noise_alone_has_no_lamp() -> None:
    rng = np.random.default_rng(7)
    image = rng.normal(10, 3, (120, 120)).astype(np.float32)
    assert lamps(Readout(0, 0, image, image, np.zeros(image.shape, bool), 9.0)) == ()


def test_edges_are_averages_over_a_line() -> None:
    """Against the mean over a thousand points of each line; the ends, where the chord is 0 in part, included."""
    ellipse = EdgeEllipse(10.0, 20.3, 0.2, 7.0, 9.0)
    lines = np.arange(10.0, 31.0)
    y = lines[:, None] + (np.arange(1000) + 0.5) / 1000
    half = 7.0 * np.sqrt(np.maximum(1 - ((y - 20.3) / 9.0) ** 2, 0.0))
    low, high = ellipse.edges(lines)
    assert (high - low) / 2 == pytest.approx(half.mean(axis=1), abs=1e-3)
    assert (low + high) / 2 == pytest.approx(10.0 + 0.2 * (lines + 0.5 - 20.3))


def test_moments_are_those_of_the_uniform_area() -> None:
    """Sums over a fine grid; the tolerance is its step over the size."""
    ellipse = EdgeEllipse(0.0, 0.0, 0.3, 7.0, 9.0)
    square = EdgeParallelogram(0.0, 0.0, ((0.1, 0.05), (-0.06, 0.12)))
    grid = np.stack(np.meshgrid(np.linspace(-20, 20, 2001), np.linspace(-20, 20, 2001)), axis=-1).reshape(-1, 2)
    x, y = grid.T
    in_ellipse = ((x - 0.3 * y) / 7.0) ** 2 + (y / 9.0) ** 2 <= 1
    in_square = np.maximum(np.abs(0.1 * x + 0.05 * y), np.abs(-0.06 * x + 0.12 * y)) <= 1
    for outline, inside in ((ellipse, in_ellipse), (square, in_square)):
        points = grid[inside]
        assert outline.moments == pytest.approx(points.T @ points / len(points), rel=5e-3, abs=0.05)
        assert outline.extent == pytest.approx(points.max(axis=0), abs=0.04)


def test_the_correction_for_blur_is_half_its_variance_times_the_edge_s_curvature() -> None:
    """The curvature of the ellipse's right edge by differences of a step of 0.01 lines, right to 1e-4 of it."""
    at, lines, step = (
        EdgeEllipse(x0=5.0, y0=30.0, slope=0.0, half_chord=20.0, half_extent=25.0),
        np.arange(20.0, 41),
        0.01,
    )

    def edge(y: Array) -> Array:
        return 5.0 + 20.0 * np.sqrt(1 - ((y - 30.0) / 25.0) ** 2)

    middle = lines + 0.5
    curvature = (edge(middle + step) - 2 * edge(middle) + edge(middle - step)) / step**2
    none = np.zeros(len(lines))
    found = LineEdges(lines, none, none, none, none, 4.0).unblurred(at)
    np.testing.assert_allclose(found.right, -4.0 / 2 * curvature, rtol=1e-4)
    np.testing.assert_allclose(found.left, 4.0 / 2 * curvature, rtol=1e-4)


def test_an_isophote_is_the_ellipse_of_its_pixels() -> None:
    """Chords are whole pixels, an edge is right to 0.3 px in rms and the fit of 40 lines to half a pixel at most."""
    y, x = np.mgrid[0:60, 0:50] + 0.5
    found = _isophote(((x - 24.3) / 14.0) ** 2 + ((y - 30.6) / 21.0) ** 2 < 1)
    assert found is not None
    assert (found.x0, found.y0, found.half_chord, found.half_extent) == pytest.approx((24.3, 30.6, 14.0, 21.0), abs=0.5)


def test_turned_squares_are_first_tried_in_the_middle_of_their_edges() -> None:
    """A square whose diagonal lies along the readout: the mean of all edges is its centre, and the line (10 + 30) / 2
    its middle. A start elsewhere may end in another minimum.
    """
    lines = np.arange(10.0, 30.0)
    half = 10 - np.abs(lines + 0.5 - 20)
    edges = LineEdges(lines, 57.0 - half, 57.0 + half, np.full(20, 0.01), np.full(20, 1000.0), 0.0)
    starts = _TurnedModel.starts(edges, _Ends(10.0, 30.0, 2.0))
    assert [one.start[:2].tolist() for one in starts] == [pytest.approx([57.0, 20.0], abs=1e-9)] * 2


def test_a_band_within_a_lamp_without_edges_has_the_lamp_s_level() -> None:
    """Half the chord of 32 px: the 16 columns from 22 to 38, none more."""
    rows, columns = 40, 60
    one, light = np.ones((rows, columns), dtype=bool), np.full((rows, columns), 100.0)
    blob = StripedBlob(0, 0, columns, rows, one, ~one, rows * columns)
    turned = TurnedRegion(0, 0, light.astype(np.float32), ~one, 0.0, 0.0)
    outline = EdgeEllipse(x0=30.0, y0=20.0, slope=0.0, half_chord=16.0, half_extent=15.0)
    profile, level_e = profile_of(turned, blob, BlobLight(light, light, one, np.zeros(rows)), outline, uniform=False)
    assert profile is not None
    assert profile.level_e == pytest.approx(np.full(rows, 100.0), rel=1e-12)
    assert level_e == pytest.approx(100.0, rel=1e-12)


@pytest.mark.parametrize("pairs", [slice(None), slice(None, None, -1)], ids=["steep first", "flat first"])
@pytest.mark.parametrize(("degrees", "lines", "fits"), [(3.0, 2.1, False), (30.0, 20.0, True)])
def test_a_turned_square_needs_lines_that_each_pair_of_sides_bounds(
    degrees: float, lines: float, fits: bool, pairs: slice
) -> None:
    """A square of 40 px turned by an angle has 40 sin(angle) lines at each end whose edge is a flat side: both ends
    together need seven, and four are too few. So it is whichever pair of sides stands first.
    """
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    assert 40 * s == pytest.approx(lines, abs=0.05)
    sides = np.array([(c, s), (-s, c)])[pairs] / 20
    top = np.arange(np.floor(50 - 20 * (c + s)), np.ceil(50 + 20 * (c + s)))
    left, right = EdgeParallelogram(57.0, 50.0, ((c / 20, s / 20), (-s / 20, c / 20))).edges(top)
    lit = right > left
    edges = LineEdges(top[lit], left[lit], right[lit], np.full(lit.sum(), 0.01), np.full(lit.sum(), 1000.0), 0.0)
    start = np.array([57.0, 50.0, *sides.ravel()])
    found = _TurnedModel(edges, _Ends(top[lit][0], top[lit][-1] + 1, 2.0), start).fit()
    assert (found is not None) == fits
