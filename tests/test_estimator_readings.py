"""Sorting of pixels, and readings of them, against sums over single pixels by NumPy."""

from collections import defaultdict

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from estimator.pixels.polygon_raster import RoiStack
from estimator.pixels.readings import BLOCKS, EDGE_PX, NEAR_PX, Faces, known_shares, read, sorted_pixels

ROIS = RoiStack(np.array([3, 40]), np.array([7, 2]), np.array([23, 18]), np.array([20, 25]))
CENTRES = np.array([[17.3, 14.6], [14.2, 49.4]])
TO_FACE = np.array([[[0.11, 0.03], [-0.02, 0.12]], [[0.09, -0.04], [0.05, 0.1]]])


def on_pixels(values: np.ndarray) -> np.ndarray:
    """Cells with these values in the regions' pixels, and 1e9 in those beyond their ends, which belong to no pixel."""
    cells = np.full(ROIS.cells(), 1e9)
    for k in range(len(ROIS.rows)):
        region = ROIS.roi(cells, k)
        region[:] = np.resize(values, region.shape)
    return cells


@pytest.mark.parametrize("sites", [1, 4])
@pytest.mark.parametrize("sends", [False, True])
def test_readings_are_the_edge_pixels_and_sums_over_blocks(rng: np.random.Generator, sites: int, sends: bool) -> None:
    """One region's LED sends, the other's does not. Sums of some ten numbers agree to rounding."""
    fall_off, electrons = on_pixels(rng.uniform(0.5, 1, 500)), on_pixels(rng.uniform(0, 100, 500)).astype(np.float32)
    kind = on_pixels(rng.integers(0, 3, 500))
    edge, inside = kind == 1, kind == 2
    lines = np.zeros(0, dtype=np.int64)
    if sends:
        lines = on_pixels(np.zeros(1)).astype(np.int64)
        ROIS.roi(lines, 0)[:] = -1
        ROIS.roi(lines, 1)[:] = 100 + np.arange(18)[:, None]
    found = read(ROIS, Faces(CENTRES, TO_FACE, fall_off), electrons, edge, inside, lines, sites)

    assert found.led.tolist() == np.repeat([0, 1], sites).tolist()
    singles = 0
    for group, k in enumerate(found.led.tolist()):
        site, start, end = group % sites, *found.starts[group : group + 2].tolist()
        blocks: dict[tuple[int, int], np.ndarray] = defaultdict(lambda: np.zeros(6))
        at = start
        for row in range(ROIS.heights[k]):
            for column in range(ROIS.widths[k]):
                v, u = row + ROIS.rows[k], column + ROIS.columns[k]
                if sites == 4 and (v % 2) * 2 + u % 2 != site:
                    continue
                (cell,) = ROIS.cell(np.array([k]), np.array([v]), np.array([u]))
                a, b = TO_FACE[k] @ (np.array([u, v]) + 0.5 - CENTRES[k])
                basis, line = np.array([1, a, b, a * a + b * b]), int(lines[cell]) if sends else -1
                if edge[cell]:
                    assert (found.edges[singles], found.cells[singles]) == (at, cell)
                    assert (found.pixel_counts[at], found.uniform_light[at]) == (1, 0)
                    assert found.electrons[at] == electrons[cell]
                    assert found.lines[at] == max(line, 0)
                    np.testing.assert_allclose(found.background[at], fall_off[cell] * basis, rtol=1e-12)
                    np.testing.assert_allclose(found.face[at], basis[1:] - [0, 0, 0.5], rtol=1e-12, atol=1e-14)
                    at, singles = at + 1, singles + 1
                elif inside[cell]:
                    place = np.clip(((np.array([a, b]) + 1) * BLOCKS / 2).astype(int), 0, BLOCKS - 1)
                    blocks[max(line, 0), int(place @ [BLOCKS, 1])] += [1, electrons[cell], *(fall_off[cell] * basis)]
        assert end - at == len(blocks) > BLOCKS
        for reading, ((line, _), (count, total, *sums)) in zip(range(at, end), sorted(blocks.items()), strict=True):
            assert (found.pixel_counts[reading], found.lines[reading]) == (count, line)
            assert found.electrons[reading] == pytest.approx(total, rel=1e-12)
            np.testing.assert_allclose(found.background[reading], sums, rtol=1e-12, atol=1e-12)
            assert found.uniform_light[reading] == found.background[reading, 0]
            mean = np.array(sums[1:]) / sums[0] - [0, 0, 0.5]
            np.testing.assert_allclose(found.face[reading], mean, rtol=1e-12, atol=1e-12)
    assert singles == len(found.edges) == edge.sum()


def test_a_group_without_an_edge_is_no_group() -> None:
    """What its amplitude and background are, no edge tells."""
    inside = on_pixels(np.ones(1)) == 1
    edge = np.zeros(len(inside), dtype=bool)
    ROIS.roi(edge, 1)[4, 5] = True
    faces = Faces(CENTRES, TO_FACE, np.ones(len(edge)))
    found = read(
        ROIS, faces, np.ones(len(edge), dtype=np.float32), edge, inside & ~edge, np.zeros(0, dtype=np.int64), 1
    )
    assert found.led.tolist() == [1]
    assert found.pixel_counts.sum() == 18 * 25


def test_pixels_are_sorted_by_what_lies_around_them(rng: np.random.Generator) -> None:
    """Each mask is a maximum over a square, within the region: nothing passes from one region to another."""
    share = np.where(rng.uniform(size=500) < 0.9, 0.0, rng.uniform(size=500))
    share[100:140] = 1.0
    fall_off = on_pixels(rng.uniform(0.5, 1, 500))
    light = on_pixels(share) * fall_off
    fall_off[on_pixels(share) == 1e9] = 0.0  # beyond the ends of rows
    found = sorted_pixels(ROIS, light, fall_off)
    for k in range(2):
        own = np.resize(share, (ROIS.heights[k], ROIS.widths[k]))
        lit = own > 1e-3
        for mask, px, seeds in (
            (found.edge, EDGE_PX, lit & (own < 1 - 1e-3)),
            (found.lit, EDGE_PX, lit),
            (found.near, NEAR_PX, lit),
        ):
            expected = maximum_filter(seeds, 2 * px + 1, mode="constant")
            np.testing.assert_array_equal(ROIS.roi(mask, k), expected)
        np.testing.assert_allclose(ROIS.roi(found.share, k), own, rtol=1e-12)


def test_the_share_of_known_pixels_is_that_of_those_wholly_inside() -> None:
    share, known = on_pixels(np.zeros(1)), np.zeros(ROIS.cells(), dtype=bool)
    ROIS.roi(share, 0)[2:4, 3:8] = 1.0
    ROIS.roi(share, 0)[9, 9] = 0.99
    ROIS.roi(known, 0)[2, 3:6] = ROIS.roi(known, 0)[9, 9] = True
    found = known_shares(share, known, ROIS.heights, ROIS.widths, ROIS.starts)
    assert found.tolist() == [0.3, 1.0]
