"""Changes of LED images with the camera, to first order: what the Cramér-Rao bound differentiates.

The light of a pixel is an integral over the part of the face that the pixel sees. Where the rim moves through a pixel,
its light changes by the area that the rim sweeps, times the luminance at the rim. The rim is a polygon of pixel
positions, cut at the borders of pixels; a piece dp that moves by w sweeps w x dp (Reynolds' transport theorem). Where
the luminance varies over the face, the light changes inside too: the face moves behind the pixel. Displacements come
from projected points, so that slopes by different unknowns agree in what they share: directions that the pixels hardly
determine depend on small differences between them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.planar_shapes import Disc
from vlcrender.rendering.led_coverage import LedFace, intersections_with_plane
from vlcrender.rendering.led_edges import LedEdges
from vlcrender.rendering.led_radiance import LedImage, beam, face_of_led
from vlcrender.scene.leds import Leds

Array = NDArray[np.float64]
RIM_POINTS = 1440
"""Points of a rim: pixels of an edge err by less than 1 % of the largest slope (at grazing edges; 0.05 % RMS)."""
MAX_PIECE_PX = 0.7
"""Largest distance of two points in a region: a piece between two then crosses at most one border each way."""
NODE_STEP = 4
"""Every so many points of the rim are displaced, those between linearly: right to (2 pi / 360)^2 / 8 = 4e-5."""
Cameras = tuple[PosedCamera, PosedCamera]
"""A camera after and before a small change."""


@dataclass(frozen=True)
class LedSlope:
    """Change of one LED's light before blur, in the region of its image, over the light of its luminance.

    `edges` as in `LedImage`, for narrow blurs.
    """

    change: Array
    edges: LedEdges | None


def led_slopes(
    leds: Leds,
    posed: PosedCamera,
    changes: Sequence[Cameras],
    images: Mapping[int, LedImage],
    splits: Mapping[int, int],
) -> Iterator[tuple[int, list[LedSlope]]]:
    """Of each image, by the LED's index, its changes, one for each pair of cameras: after minus before.

    images: at `posed`; splits: of these LEDs, parts across an edge pixel that the blur needs, 1 for no split. The
    occluded share of a pixel counts as constant.
    """
    rims = _rims(posed, changes, [face_of_led(leds, i) for i in images], [image.roi for image in images.values()])
    for (i, image), rim in zip(images.items(), rims, strict=True):
        yield i, _slopes_of_led(leds, posed, changes, i, image, splits[i], rim)


def _slopes_of_led(
    leds: Leds,
    posed: PosedCamera,
    changes: Sequence[Cameras],
    i: int,
    image: LedImage,
    split: int,
    rim: tuple[Array, Array],
) -> list[LedSlope]:
    roi, light = image.roi, leds.diffusers[i] or leds.profile(i)
    u, v, swept = _swept(*rim, split)
    inside = (u >= 0) & (u < roi.columns) & (v >= 0) & (v < roi.rows) & np.isfinite(swept).all(axis=0)
    if not inside.all():
        u, v, swept = u[inside], v[inside], swept[:, inside]
    if light is not None:
        x, y = intersections_with_plane(posed, _origin_m(leds, i), u + roi.column, v + roi.row)
        swept = swept * light.at(x, y)
    full = image.full
    column, row = ((at * split).astype(np.int64) for at in (u, v))
    cells = row // split * roi.columns + column // split
    of_rim = [np.bincount(cells, by_piece, roi.pixels).reshape(roi.rows, roi.columns) for by_piece in swept]
    edges: list[LedEdges | None] = [None] * len(changes)
    if split > 1:
        pixels, number = np.unique(cells, return_inverse=True)
        rows, columns = pixels // roi.columns, pixels % roi.columns
        parts = (number * split + row % split) * split + column % split
        for k, (by_piece, mean) in enumerate(zip(swept, of_rim, strict=True)):
            of_parts = np.bincount(parts, by_piece, len(pixels) * split**2).reshape(-1, split, split) * split**2
            excess = of_parts - mean[rows, columns][:, None, None]
            edges[k] = LedEdges(rows + roi.row, columns + roi.column, excess).times(full, roi)
    return [
        LedSlope(full * by_rim + inside, of_edges)
        for by_rim, inside, of_edges in zip(of_rim, _within(posed, changes, leds, i, image), edges, strict=True)
    ]


def _rims(
    posed: PosedCamera, changes: Sequence[Cameras], faces: Sequence[LedFace], rois: Sequence[Roi]
) -> Iterator[tuple[Array, Array]]:
    """Of each face's image, points of its rim (n, 2), pixels from its region's first, less than a pixel apart in the
    region; and the displacement of every NODE_STEP-th by each change (changes, n / NODE_STEP, 2). NaN for points that
    the lens does not image.
    """
    rims_m = [_rim_m(face, RIM_POINTS) for face in faces]
    rims_px = np.split(posed.project(np.concatenate(rims_m)), len(faces)) if faces else []
    for number, (face, roi, rim_px) in enumerate(zip(faces, rois, rims_px, strict=True)):
        rim_px -= [roi.column, roi.row]
        near = ((rim_px >= -1) & (rim_px <= [roi.columns + 1, roi.rows + 1])).all(axis=1)
        longest = float(np.hypot(*(np.roll(rim_px, -1, axis=0) - rim_px)[near].T).max(initial=0.0))
        if longest > MAX_PIECE_PX:
            rims_m[number] = _rim_m(face, RIM_POINTS * int(np.ceil(longest / MAX_PIECE_PX)))
            rims_px[number] = posed.project(rims_m[number]) - [roi.column, roi.row]
    nodes_m = [rim_m[::NODE_STEP] for rim_m in rims_m]
    ends = np.cumsum([len(nodes) for nodes in nodes_m])[:-1]
    together = np.concatenate([*nodes_m, np.zeros((0, 3))])
    moved_px = np.stack([after.project(together) - before.project(together) for after, before in changes])
    return zip(rims_px, np.split(moved_px, ends, axis=1) if faces else [], strict=True)


def _rim_m(face: LedFace, count: int) -> Array:
    """Points of a face's rim, (count, 3), world: of a disc, the vertices of a polygon of its area."""
    rim = face.shape.rim(count)
    if isinstance(face.shape, Disc):
        rim = rim / np.sqrt(np.sinc(2 / count))
    return np.column_stack([rim, np.zeros(len(rim))]) + face.center_m


def _swept(rim_px: Array, moved_px: Array, split: int) -> tuple[Array, Array, Array]:
    """Middles u and v (m,) of the pieces of a rim that no border of a pixel's parts crosses, and the area that each
    sweeps by each change, (changes, m), pixels; positive where the face grows. Arguments as `_rims` returns them.
    """
    u, v = _subdivided(rim_px.T, split)
    moved_u, moved_v = _subdivided(np.moveaxis(moved_px, -1, 0), split * NODE_STEP)
    du, dv = _steps(u), _steps(v)
    crossings = []
    for at, step in ((u, du), (v, dv)):
        cell = np.floor(at * split)
        next_cell = np.append(cell[1:], cell[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = (np.maximum(cell, next_cell) / split - at) / step
        crossings.append(np.where(cell == next_cell, 0.0, np.clip(crossing, 0.0, 1.0)))
    cuts = np.stack([np.zeros(len(u)), np.minimum(*crossings), np.maximum(*crossings), np.ones(len(u))])
    lengths = np.diff(cuts, axis=0)
    part, piece = np.nonzero(lengths > 0)
    length, middle = lengths[part, piece], (cuts[part, piece] + cuts[part + 1, piece]) / 2
    along_u, along_v = (
        moved.take(piece, axis=1) + _steps(moved).take(piece, axis=1) * middle for moved in (moved_u, moved_v)
    )
    outward = np.copysign(length, np.nansum(u * dv - v * du))
    swept = along_u * (dv[piece] * outward) - along_v * (du[piece] * outward)
    return u[piece] + du[piece] * middle, v[piece] + dv[piece] * middle, swept


def _steps(line: Array) -> Array:
    """Steps from each number along a closed line (..., n) to the next."""
    steps = np.empty_like(line)
    np.subtract(line[..., 1:], line[..., :-1], out=steps[..., :-1])
    np.subtract(line[..., 0], line[..., -1], out=steps[..., -1])
    return steps


def _subdivided(line: Array, parts: int) -> Array:
    """Numbers along a closed line (..., n) with `parts` - 1 more between each two, (..., n * parts)."""
    steps, between = _steps(line), np.empty((*line.shape, parts))
    for part in range(parts):
        np.add(line, steps * (part / parts), out=between[..., part])
    return between.reshape(*line.shape[:-1], -1)


def _within(
    posed: PosedCamera, changes: Sequence[Cameras], leds: Leds, i: int, image: LedImage
) -> Sequence[Array | float]:
    """Change of each pixel's light inside the face, where its luminance moves behind the pixel; 0 for an even face."""
    light, order = leds.diffusers[i] or leds.profile(i), _order(leds, i)
    if light is None and abs(order - 1.0) < 1e-12:
        return [0.0] * len(changes)
    origin_m = _origin_m(leds, i)
    u, v = image.roi.centers_px()
    (u_nodes, of_u), (v_nodes, of_v) = _nodes(u[0]), _nodes(v[:, 0])
    slope_x, slope_y, value = np.zeros(()), np.zeros(()), np.ones(())
    if light is not None:
        x, y = intersections_with_plane(posed, origin_m, u, v)
        (slope_x, slope_y), value = light.slopes(x, y), light.at(x, y)

    def at_nodes(camera: PosedCamera) -> Array:
        x, y = intersections_with_plane(camera, origin_m, u_nodes[None, :], v_nodes[:, None])
        return np.stack([x, y, beam(camera, order, u_nodes[None, :], v_nodes[:, None])])

    found, lit, by_direction = [], image.coverage * image.weight, image.beam
    for after, before in changes:
        # not `@`: the last bits of a matrix product may depend on threads and processor
        across = np.einsum("cij,uj->ciu", at_nodes(after) - at_nodes(before), of_u)
        dx, dy, dbeam = np.einsum("vi,ciu->cvu", of_v, across)
        of_light = slope_x * dx + slope_y * dy
        found.append(lit * (by_direction * of_light + value * dbeam))
    return found


def _order(leds: Leds, i: int) -> float:
    """Lambertian order of what a camera sees of LED number i: 1 for a diffuser."""
    return 1.0 if leds.diffusers[i] is not None else float(leds.orders[i])


def _origin_m(leds: Leds, i: int) -> Array:
    """Origin of the positions that the luminance of LED number i depends on: the room's for a diffuser."""
    if leds.diffusers[i] is not None:
        return np.array([0.0, 0.0, leds.centers_m[i, 2]])
    center: Array = leds.centers_m[i]
    return center


def _nodes(at: Array) -> tuple[Array, Array]:
    """Three nodes along pixel positions (n,), and the weights of quadratic interpolation between them, (n, 3)."""
    middle, half = (at[0] + at[-1]) / 2, max((at[-1] - at[0]) / 2, 0.5)
    t = (at - middle) / half
    return middle + half * np.array([-1.0, 0.0, 1.0]), np.stack([t * (t - 1) / 2, 1 - t * t, t * (t + 1) / 2], axis=1)
