"""Changes of LED images with the camera, to first order: what the Cramér-Rao bound differentiates.

The light of a pixel is an integral over the part of the face that the pixel sees. Where the rim moves through a pixel,
its light changes by the area that the rim sweeps, times the luminance at the rim. The rim is a polygon of pixel
positions, cut at the borders of pixels; a piece dp that moves by w sweeps w x dp (Reynolds' transport theorem). Where
the luminance varies over the face, the light changes inside too: the face moves behind the pixel. Displacements come
from projected points, so that slopes by different unknowns agree in what they share: directions that the pixels hardly
determine depend on small differences between them.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat

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


@dataclass(frozen=True)
class PlaneMotion:
    """How the points of an LED's plane that its pixels see move, and its luminance by direction changes, by each change
    of a camera: at three by three pixels of the image, between which they are interpolated.
    """

    u_px: Array
    v_px: Array
    at_nodes: Array
    """(changes, 2 or 3, 3, 3): by x and y, m, and of the luminance by direction unless it is even."""

    @classmethod
    def of_image(cls, changes: Sequence[Cameras], image: LedImage) -> "PlaneMotion":
        """The motion of an image's whole plane."""
        origin_m, order = _origin_m(image.leds, image.index), _order(image.leds, image.index)
        u, v = (_nodes(at.ravel()) for at in image.roi.centers_px())

        def seen_by(camera: PosedCamera) -> Array:
            at = u[None, :], v[:, None]
            of_plane = intersections_with_plane(camera, origin_m, *at)
            return np.stack(of_plane if _is_even(order) else [*of_plane, beam(camera, order, *at)])

        return cls(u, v, np.stack([seen_by(after) - seen_by(before) for after, before in changes]))

    def within(self, roi: Roi) -> Iterator[Array]:
        """By each change, in the pixels of a region, (2 or 3, rows, columns)."""
        u, v = roi.centers_px()
        of_u, of_v = _quadratic(self.u_px, u[0]), _quadratic(self.v_px, v[:, 0])
        for of_change in self.at_nodes:
            # not `@`: the last bits of a matrix product may depend on threads and processor
            yield np.einsum("vi,ciu->cvu", of_v, np.einsum("cij,uj->ciu", of_change, of_u))


@dataclass(frozen=True)
class LedMotion:
    """How one LED's image changes: what the pieces of its rim sweep, and what moves inside."""

    plane: PlaneMotion | None
    """None for a face of even luminance."""
    split: int
    """Parts across an edge pixel that the blur needs, 1 for no split."""
    roi: Roi
    """The whole image."""
    u: Array
    v: Array
    """Positions of the pieces' middles, (m,), pixels from the image's first."""
    swept: Array
    """Light over that of the LED's luminance that each piece sweeps by each change, (changes, m)."""

    def slopes(self, image: LedImage) -> Iterator[LedSlope]:
        """The changes of an image or of a part of it, one for each pair of cameras: after minus before.

        The occluded share of a pixel counts as constant.
        """
        roi, split, swept = image.roi, self.split, self.swept
        u, v = self.u + float(self.roi.column - roi.column), self.v + float(self.roi.row - roi.row)
        inside = (u >= 0) & (u < roi.columns) & (v >= 0) & (v < roi.rows)
        if not inside.all():
            u, v, swept = u[inside], v[inside], swept[:, inside]
        within: Iterable[Array | None] = repeat(None, len(swept))
        if self.plane is not None:
            within = _within(self.plane, image)
        if not len(u):
            yield from (LedSlope(np.zeros(roi.shape) if by_face is None else by_face, None) for by_face in within)
            return
        full = image.full
        column, row = ((at * split).astype(np.int64) for at in (u, v))
        cells = row // split * roi.columns + column // split
        pixels, number = np.unique(cells, return_inverse=True) if split > 1 else (cells, cells)
        rows, columns = pixels // roi.columns, pixels % roi.columns
        parts = (number * split + row % split) * split + column % split
        for by_piece, by_face in zip(swept, within, strict=True):
            change: Array = np.bincount(cells, by_piece, roi.pixels).reshape(roi.shape).astype(np.float64, copy=False)
            edges = None
            if split > 1:
                of_parts = np.bincount(parts, by_piece, len(pixels) * split**2).reshape(-1, split, split) * split**2
                excess = of_parts - change[rows, columns][:, None, None]
                edges = LedEdges(rows + roi.row, columns + roi.column, excess).times(full, roi)
            change *= full
            if by_face is not None:
                change += by_face
            yield LedSlope(change, edges)


def led_motions(
    leds: Leds,
    posed: PosedCamera,
    changes: Sequence[Cameras],
    images: Mapping[int, LedImage],
    splits: Mapping[int, int],
) -> Iterator[tuple[int, LedMotion]]:
    """Of each image, by the LED's index, how it changes with some small changes of the camera.

    images: at `posed`; splits: `LedMotion.split` of these LEDs.
    """
    rims = _rims(posed, changes, [face_of_led(leds, i) for i in images], [image.roi for image in images.values()])
    for (i, image), rim in zip(images.items(), rims, strict=True):
        roi, light = image.roi, leds.diffusers[i] or leds.profile(i)
        u, v, swept = _swept(*rim, splits[i])
        inside = (u >= 0) & (u < roi.columns) & (v >= 0) & (v < roi.rows) & np.isfinite(swept).all(axis=0)
        if not inside.all():
            u, v, swept = u[inside], v[inside], swept[:, inside]
        if light is not None:
            x, y = intersections_with_plane(posed, _origin_m(leds, i), u + roi.column, v + roi.row)
            swept = swept * light.at(x, y)
        even = light is None and _is_even(_order(leds, i))
        plane = None if even else PlaneMotion.of_image(changes, image)
        yield i, LedMotion(plane, splits[i], roi, u, v, swept)


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
    node, after = np.divmod(piece + middle, split * NODE_STEP)
    node, share = node.astype(np.int64), after / (split * NODE_STEP)
    along_u, along_v = (
        moved.take(node, axis=1) + _steps(moved).take(node, axis=1) * share for moved in np.moveaxis(moved_px, -1, 0)
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
    if parts == 1:
        return np.ascontiguousarray(line)
    steps, between = _steps(line), np.empty((*line.shape, parts))
    for part in range(parts):
        np.add(line, steps * (part / parts), out=between[..., part])
    return between.reshape(*line.shape[:-1], -1)


def _within(motion: PlaneMotion, image: LedImage) -> Iterator[Array]:
    """By each change, that of each pixel's light inside the face, whose luminance moves behind the pixel."""
    leds, i = image.leds, image.index
    light = leds.diffusers[i] or leds.profile(i)
    slope_x, slope_y, value = np.zeros(()), np.zeros(()), np.ones(())
    if light is not None:
        x, y = image.on_plane(_origin_m(leds, i))
        (slope_x, slope_y), value = light.slopes(x, y), light.at(x, y)
    lit, by_direction = image.coverage * image.weight, image.beam
    for dx, dy, *dbeam in motion.within(image.roi):
        change = by_direction * (slope_x * dx + slope_y * dy)
        yield lit * (change + value * dbeam[0] if dbeam else change)


def _order(leds: Leds, i: int) -> float:
    """Lambertian order of what a camera sees of LED number i: 1 for a diffuser."""
    return 1.0 if leds.diffusers[i] is not None else float(leds.orders[i])


def _origin_m(leds: Leds, i: int) -> Array:
    """Origin of the positions that the luminance of LED number i depends on: the room's for a diffuser."""
    if leds.diffusers[i] is not None:
        return np.array([0.0, 0.0, leds.centers_m[i, 2]])
    center: Array = leds.centers_m[i]
    return center


def _is_even(order: float) -> bool:
    """Whether a camera sees the same luminance from all directions."""
    return abs(order - 1.0) < 1e-12


def _nodes(at: Array) -> Array:
    """Three nodes along pixel positions (n,)."""
    middle, half = (at[0] + at[-1]) / 2, max((at[-1] - at[0]) / 2, 0.5)
    nodes: Array = middle + half * np.array([-1.0, 0.0, 1.0])
    return nodes


def _quadratic(nodes: Array, at: Array) -> Array:
    """Weights of quadratic interpolation between three nodes at some positions (n,), (n, 3)."""
    t = (at - nodes[1]) / (nodes[2] - nodes[1])
    return np.stack([t * (t - 1) / 2, 1 - t * t, t * (t + 1) / 2], axis=1)
