"""Loops over the pixels of spots, and boxes of pixels, against NumPy on every pixel."""

import cv2
import numpy as np
import pytest
from estimator_synthetic import Array

from estimator.spots.boxes import boxes_around, overlapping
from estimator.spots.led_light import Ellipse, Readout, centroid_on, light_of, surface_of
from estimator.spots.light_loops import LEVEL, above_half_level, brightest, fall_off, median
from estimator.spots.shape_loops import (
    around_face,
    distance2,
    ellipse_spans,
    padded,
    pieces_of,
    pixels_of,
)


@pytest.mark.parametrize("radius_px", [0.0, 0.9, 2.0, 3.7, 5.0, 12.5, 30.0, 200.0])
def test_a_mask_is_padded_by_the_pixels_at_most_a_radius_from_it(radius_px: float) -> None:
    """Against the distance of each pixel from each of the mask, squared: whole numbers. The mask touches a border."""
    rng = np.random.default_rng(5)
    for shape in [(1, 1), (1, 30), (30, 1), (25, 40)]:
        mask = np.zeros(shape, dtype=bool)
        mask.ravel()[rng.integers(0, mask.size, 3)] = True
        at, pixels = np.argwhere(mask), np.argwhere(np.ones(shape, dtype=bool))
        nearest2 = ((pixels[:, None] - at) ** 2).sum(axis=2).min(axis=1).reshape(shape)
        near, nearby = padded(mask, radius_px, radius_px + 3.0)
        np.testing.assert_array_equal(near, nearest2 <= radius_px**2)
        np.testing.assert_array_equal(nearby, nearest2 <= (radius_px + 3.0) ** 2)


def test_the_median_is_numpys() -> None:
    """Of odd and even numbers of values, with none, some and all of them equal, in any order and in order."""
    rng = np.random.default_rng(6)
    for count in [1, 2, 3, 4, 5, 10, 101, 300, 1000, 4001]:
        for most in [1, 2, 30, 10**9]:
            values = rng.integers(0, most, count).astype(np.float64)
            assert median(values) == median(np.sort(values)) == np.median(values)
    assert np.isnan(median(np.full(3, np.nan)))


def test_a_point_is_as_far_from_an_ellipse_as_its_axes_say() -> None:
    """Of a turned ellipse, whose ends are at 1; sums of a dozen products in another order differ by 1e-14."""
    c, s = np.cos(0.7), np.sin(0.7)
    axes, centre, semi_axes = np.array([[c, -s], [s, c]]), np.array([30.2, 28.6]), np.array([9.0, 4.0])
    ellipse = Ellipse((30.2, 28.6), (c, s), (9.0, 4.0), (0.0, 0.0), (60.0, 60.0), 50, 1.0)
    for padding_px in (0.0, 2.5):
        form = ellipse.form(padding_px)
        for k in (0, 1):
            end = centre + axes[:, k] * (semi_axes[k] + padding_px)
            assert distance2(form, *end.tolist()) == pytest.approx(1.0)
        # The second rectangle cuts the ellipse on its right, the third is right of it.
        for left, width in ((18, 25), (8, 25), (45, 12)):
            spans = ellipse_spans(form, left, 15, width, 26)
            assert (spans >= 0).all()
            for column, row in np.ndindex(width, 26):
                point = np.array([left + 0.5 + column, 15.5 + row])
                expected = ((((point - centre) @ axes) / (semi_axes + padding_px)) ** 2).sum()
                assert distance2(form, *point.tolist()) == pytest.approx(expected, abs=1e-12)
                assert (spans[0, row] <= column < spans[1, row]) == (expected <= 1)


def test_of_equally_bright_pixels_in_an_ellipse_the_first_is_the_brightest() -> None:
    """By NumPy's argmax over whole numbers, of which many are equal; outside of the ellipse are brighter ones."""
    rng = np.random.default_rng(7)
    form = Ellipse((30.2, 28.6), (0.8, 0.6), (9.0, 4.0), (0.0, 0.0), (60.0, 60.0), 50, 1.0).form(0.0)
    v, u = np.mgrid[:60, :60] + 0.5
    inside = np.array([distance2(form, *at) <= 1 for at in zip(u.ravel(), v.ravel(), strict=True)]).reshape(60, 60)
    for highest in (1, 2, 5, 1000):
        image = np.where(inside, rng.integers(0, highest, (60, 60)), 2000).astype(np.float32)
        row, column = np.unravel_index(np.argmax(np.where(inside, image, -1)), image.shape)
        clipped, spans = np.zeros((60, 60), dtype=bool), ellipse_spans(form, 15, 15, 30, 30)
        clipped[20, 30] = True
        assert not inside[20, 30]
        assert brightest(image, clipped, 15, 15, spans) == (row, column, False)
        clipped[28, 33] = True
        assert inside[28, 33]
        assert brightest(image, clipped, 15, 15, spans) == (row, column, True)


def test_the_pixels_near_a_point_are_a_box_of_each_region_that_has_some() -> None:
    """Against the distances of pixels' borders; ends are whole pixels towards the region's first one."""
    points = np.array([(10.2, 8.7), (33.0, 21.5), (90.0, 90.0), (25.0, -2.0)])
    regions = [(0, 0, 30, 20), (25, 10, 12, 30), (0, 60, 30, 8)]
    expected = []
    for u, v in points:
        for region, (column, row, width, height) in enumerate(regions):
            left, right = (int(np.clip(u + off - column, 0, width)) for off in (-6.0, 6.0))
            top, bottom = (int(np.clip(v + off - row, 0, height)) for off in (-6.0, 6.0))
            if left < right and top < bottom:
                expected.append([region, left, top, right, bottom])
    assert [box[0] for box in expected] == [0, 0, 1, 0]
    np.testing.assert_array_equal(boxes_around(points, np.array(regions, dtype=float), 6.0), expected)


def test_boxes_overlap_where_the_distances_of_their_centres_say_so() -> None:
    rng = np.random.default_rng(8)
    boxes = np.concatenate([rng.uniform(0, 100, (30, 2)), rng.uniform(2, 20, (30, 2))], axis=1)
    apart = np.abs(boxes[:, None, :2] - boxes[:, :2]) < boxes[:, None, 2:] + boxes[:, 2:]
    expected = np.argwhere(apart.all(axis=2) & ~np.eye(30, dtype=bool))
    assert 0 < len(expected) < 30 * 29
    np.testing.assert_array_equal(overlapping(boxes), expected)


def pieces() -> list[Array]:
    """Masks: discs and ellipses, whole and cut by a border, with a hole, a notch or a second piece, and steps aside."""
    v, u = np.mgrid[:40, :50] + 0.5
    masks = [np.hypot(u - at, (v - 20) * squeezed) <= 14 for at in (25, 9, 47) for squeezed in (1.0, 2.5)]
    for column in (25, 11, 38):
        masks.append(masks[0].copy())
        masks[-1][20, column] = False
    masks.append(masks[0] | (np.hypot(u - 47, v - 20) < 2))
    masks.append(masks[0] | (np.hypot(u - 25, v - 38) < 2))
    masks.append(masks[0] | ((v > 37) & (u > 30)))
    # Rows that touch by a corner are one piece; those a pixel further apart are not.
    masks += [((v < 20) & (u < 20)) | ((v > 20) & (u > aside) & (u < 40)) for aside in (20, 21)]
    return masks


@pytest.mark.parametrize("number", range(len(pieces())))
def test_pixels_above_half_level_are_the_plateau(number: int) -> None:
    """A plateau of 100 e has its half level at 50 e, where the upper quartile is of it."""
    mask = pieces()[number]
    smooth = np.where(mask, 100.0, 49.0).astype(np.float32)
    if mask.mean() > 0.25:
        np.testing.assert_array_equal(above_half_level(smooth, 0, 0, np.ones(mask.shape, dtype=bool), 0.0), mask)


def masks() -> list[Array]:
    """Those of `pieces`, a comb, whose teeth the last row connects, none and all pixels, and noise of all densities."""
    comb = np.zeros((9, 21), dtype=bool)
    comb[:, ::2] = comb[8] = True
    rng = np.random.default_rng(9)
    noise = [rng.random(rng.integers(1, 30, 2)) < share for share in np.linspace(0.05, 0.95, 40)]
    return [*pieces(), comb, comb[::-1], comb.T, comb & False, comb | True, *noise]


@pytest.mark.parametrize("number", range(len(masks())))
def test_pieces_of_a_mask_are_opencvs(number: int) -> None:
    """In the order of their first pixels, with their sums, boxes and pixels."""
    mask = masks()[number]
    found, runs = pieces_of(mask)
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    expected = sorted((labels == label for label in range(1, count)), key=lambda own: int(own.argmax()))
    assert len(found) == len(expected)
    for place, own in enumerate(expected):
        np.testing.assert_array_equal(found[place], piece(own))
        np.testing.assert_array_equal(pixels_of(runs, place, *mask.shape), own)


def piece(mask: Array) -> Array:
    """Sums of 1, u, v, u^2, u v and v^2 over the pixels of a mask, and the box around them, by NumPy."""
    row, column = np.nonzero(mask)
    sums = np.stack([np.ones_like(row), column, row, column**2, column * row, row**2]).sum(axis=1)
    return np.array([*sums, column.min(), row.min(), column.max(), row.max()])


@pytest.mark.parametrize("number", range(len(pieces())))
def test_a_face_is_padded_as_any_mask(number: int) -> None:
    """Support and ring by `padded`, and the plane of the light inside by its own slopes: it follows one, without noise.

    A face without 20 pixels inside tells no plane.

    Rounding: products of float32, 1e-7 of the light, by levers of ten pixels and more.
    """
    face = pieces()[number]
    v, u = np.mgrid[:40, :50] + 0.5
    image = (1000.0 * (1 + 0.002 * (u - 25) - 0.003 * (v - 20))).astype(np.float32)
    for margin_px, border_px in ((2.0, 2.0), (7.0, 0.0), (0.5, 4.3), (2.0, 14.2)):
        support, ring, inside = around_face(face, margin_px, 3.0, border_px)
        near, nearby = padded(face, margin_px, margin_px + 3.0)
        np.testing.assert_array_equal(support, near)
        np.testing.assert_array_equal(ring, np.argwhere(nearby & ~near))
        np.testing.assert_array_equal(inside, ~padded(~face, border_px, 0.0)[0])
        plane = fall_off(image, 0, 0, inside)
        if inside.sum() < 20:
            assert plane == LEVEL
            continue
        middle = u[inside].mean(), v[inside].mean()
        level = 1 + 0.002 * (middle[0] - 25) - 0.003 * (middle[1] - 20)
        np.testing.assert_allclose(plane[:2], middle, rtol=1e-12)
        np.testing.assert_allclose(plane[2:], [0.002 / level, -0.003 / level], rtol=1e-4)


@pytest.mark.parametrize("background_e", [0.0, 40.0])
@pytest.mark.parametrize("amplitude_e", [0.5, 3.0, 30.0, 3000.0])
def test_the_background_and_its_excess_variance_are_those_of_the_ring(background_e: float, amplitude_e: float) -> None:
    """By NumPy's means, medians and variances; backgrounds with a structure have an excess."""
    rng = np.random.default_rng(int(amplitude_e))
    ellipse = Ellipse((30.0, 30.0), (1.0, 0.0), (4.2, 4.2), (0.0, 0.0), (60.0, 60.0), 50, 1.0)
    v, u = np.mgrid[:60, :60] + 0.5
    off_px = np.hypot(u - 30, v - 30)
    mean = background_e * (1 + 0.5 * (u % 4 < 2)) + amplitude_e * (off_px < 4)
    image = (rng.poisson(mean) + rng.normal(0, 2.0, mean.shape)).astype(np.float32)
    readout = Readout(0, 0, image, image, np.zeros(image.shape, bool), 4.0, 0.01)
    light = light_of(readout, ellipse, [], 0)

    electrons = image.astype(np.float64)
    variance_e2 = np.maximum(electrons, 0) + 4.0 + (0.01 * np.maximum(electrons, 0)) ** 2
    support, ring = off_px <= 6.2, (off_px > 6.2) & (off_px <= 9.2)
    gate_e = 3 * np.sqrt(np.median(variance_e2[ring]) + 1)
    even = ring & (abs(electrons - np.median(electrons[ring])) <= gate_e)
    above_e = electrons - electrons[even].mean()
    excess_e2 = electrons[even].var(ddof=1) - variance_e2[even].mean()
    if excess_e2 <= 4 * np.sqrt(2 / even.sum()) * variance_e2[even].mean():
        excess_e2 = 0.0
    assert (excess_e2 > 0) == (background_e > 0)
    variance_e2[support & (above_e <= gate_e)] += excess_e2
    here = np.s_[light.top : light.top + light.support.shape[0], light.left : light.left + light.support.shape[1]]
    np.testing.assert_array_equal(light.support, support[here])
    np.testing.assert_allclose(light.signal_e, np.where(support, above_e, 0.0)[here], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(light.variance_e2, variance_e2[here], rtol=1e-9)
    without_moments = centroid_on(surface_of(readout, ellipse, [], 0), readout)
    np.testing.assert_allclose(without_moments[:4], light.sums[:4], rtol=1e-12)
    noise_e2 = variance_e2[support].sum()
    assert light.sums.signal_to_noise == pytest.approx(above_e[support].sum() / np.sqrt(noise_e2), rel=1e-9)
    offsets = np.stack([u[support] - light.sums.u, v[support] - light.sums.v])
    covariance_px2 = (variance_e2[support] * offsets) @ offsets.T / light.sums.flux**2
    np.testing.assert_allclose(light.covariance_px2(0), covariance_px2, rtol=1e-8, atol=1e-9 * covariance_px2.max())
    moments_px2 = (above_e[support] * offsets) @ offsets.T / light.sums.flux
    expected_px2 = moments_px2[0, 0], moments_px2[0, 1], moments_px2[1, 1]
    np.testing.assert_allclose(light.sums.moments_px2(), expected_px2, rtol=1e-8, atol=1e-9 * abs(moments_px2).max())
    for sigma, offset in zip(light.sums.moment_sigmas_px2(), offsets, strict=True):
        moment = (above_e[support] * offset**2).sum() / light.sums.flux
        expected = np.sqrt((variance_e2[support] * (offset**2 - moment) ** 2).sum()) / abs(light.sums.flux)
        assert abs(sigma) == pytest.approx(expected, rel=1e-6)
