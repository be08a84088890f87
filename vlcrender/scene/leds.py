"""LEDs of a scene: identity, place, size, luminance and its profile, beam and diffuser of each."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.face_profile import FaceProfile
from vlcrender.core.random_keys import stream
from vlcrender.errors import InputError
from vlcrender.modulation.transmission import Transmitter, transmission_of
from vlcrender.scene.bounding_spheres import BoundingSpheres
from vlcrender.scene.diffuser import MIN_DISTANCE_RADII, Diffuser
from vlcrender.scene.schema import PanelDiffuser, PanelGrid, PanelLeds, SceneSettings
from vlcrender.scene.surfaces import TOUCH_M, panel_centers_m, panel_opening_m

LEDS_AT_ONCE = 500
"""LEDs whose neighbours are looked up together: bounds the memory where many are at one place."""


@dataclass(frozen=True)
class Leds:
    """All n LEDs of a scene, sorted by id: discs and squares that face down (normal 0, 0, -1)."""

    ids: NDArray[np.int64]
    """Identities, (n,)."""
    centers_m: NDArray[np.float64]
    """Centre of each face, (n, 3), world. Of an LED behind a diffuser: the point of the diffuser straight below it."""
    half_widths_m: NDArray[np.float64]
    """Radius of a disc, half the side of a square, (n,)."""
    luminances_cd_m2: NDArray[np.float64]
    """Luminance along the normal, mean over the face, (n,)."""
    orders: NDArray[np.float64]
    """Lambertian order m, (n,): luminance at an angle theta from the normal is luminance * cos^(m-1)(theta)."""
    squares: NDArray[np.bool_]
    """True for a square with sides along x and y, False for a disc, (n,)."""
    diffusers: tuple[Diffuser | None, ...]
    """The part of a diffuser that each LED lights, which a camera images in place of the LED's face. None: bare LED."""
    face_gradients: NDArray[np.float64]
    """Relative rise of luminance from each face's centre to its border along x and y, (n, 2); (0, 0): even."""
    face_falloffs: NDArray[np.float64]
    """Luminance at each face's rim over that at its centre, without the gradient, (n,); 1: even."""
    transmitters: tuple[Transmitter, ...] = ()
    """Single LEDs and panels with what they transmit, in the order of their numbers."""

    def __len__(self) -> int:
        """Number of LEDs."""
        return len(self.ids)

    @cached_property
    def areas_m2(self) -> NDArray[np.float64]:
        """Area of each face, (n,)."""
        return np.where(self.squares, 4.0, np.pi) * self.half_widths_m**2

    @cached_property
    def fluxes_lm(self) -> NDArray[np.float64]:
        """Luminous flux that each LED sends into the room, (n,): 2 pi L A / (m + 1), less what a diffuser absorbs."""
        through = np.array([1.0 if diffuser is None else diffuser.transmittance for diffuser in self.diffusers])
        fluxes: NDArray[np.float64] = 2 * np.pi * self.luminances_cd_m2 * self.areas_m2 / (self.orders + 1) * through
        return fluxes

    def profile(self, i: int) -> FaceProfile | None:
        """Luminance over the face of LED number i, relative to the mean; None for an even face."""
        gradient, falloff = self.face_gradients[i].tolist(), float(self.face_falloffs[i])
        if gradient == [0.0, 0.0] and falloff == 1.0:
            return None
        return FaceProfile.of((gradient[0], gradient[1]), falloff, float(self.half_widths_m[i]), bool(self.squares[i]))

    @cached_property
    def circumradii_m(self) -> NDArray[np.float64]:
        """Distance from each centre to the farthest luminous point, (n,).

        The rim of a disc, a corner of a square or of the lit part of a diffuser.
        """
        reaches = np.where(self.squares, np.sqrt(2.0), 1.0) * self.half_widths_m
        for i, diffuser in enumerate(self.diffusers):
            if diffuser is not None:
                x0, y0, x1, y1 = diffuser.lit_m
                x, y = diffuser.foot_m
                reaches[i] = np.hypot(max(x - x0, x1 - x), max(y - y0, y1 - y))
        return reaches

    @cached_property
    def spheres(self) -> BoundingSpheres:
        """Spheres of the circumradii, n of them."""
        return BoundingSpheres(self.centers_m, self.circumradii_m)


def leds_of(settings: SceneSettings, source: str) -> Leds:
    """All LEDs of a scene, single ones and those of panels.

    Raises InputError that starts with `source` for a scene without LEDs, for an id used twice, for LEDs that overlap,
    do not fit onto their panel or are outside the room, and for what LEDs cannot transmit.
    """
    ids: list[int] = []
    centers: list[NDArray[np.float64]] = []
    half_widths: list[float] = []
    luminances: list[float] = []
    half_powers: list[float] = []
    shapes: list[str] = []
    gradients: list[tuple[float, float]] = []
    falloffs: list[float] = []
    origins: list[str] = []
    panel_diffusers: list[tuple[PanelDiffuser, tuple[float, float, float, float]] | None] = []
    for index, entry in enumerate(settings.led):
        ids.append(entry.id)
        centers.append(np.array(entry.position_m))
        half_widths.append(entry.half_width_m)
        luminances.append(entry.luminance_cd_m2)
        half_powers.append(entry.half_power_deg)
        shapes.append(entry.shape)
        gradients.append(entry.face_gradient)
        falloffs.append(entry.face_falloff)
        origins.append(f"led[{index}]")
        panel_diffusers.append(None)
    for index, grid in enumerate(settings.panels):
        array = grid.leds
        _check_led_array(array, grid, f"{source}: panels[{index}]")
        x = array.pitch_m[0] * (np.arange(array.columns) - (array.columns - 1) / 2)
        y = array.pitch_m[1] * (np.arange(array.rows) - (array.rows - 1) / 2)
        yy, xx = np.meshgrid(y, x, indexing="ij")
        offsets = np.stack([xx.ravel(), yy.ravel(), np.zeros(xx.size)], axis=1)
        positions = (panel_centers_m(grid)[:, None, :] + offsets[None, :, :]).reshape(-1, 3)
        low, high = array.luminance_cd_m2
        ids += range(array.first_id, array.first_id + len(positions))
        centers += list(positions)
        half_widths += [array.half_width_m] * len(positions)
        luminances += list(stream(array.luminance_seed, 0, "led-luminance").uniform(low, high, len(positions)))
        half_powers += [array.half_power_deg] * len(positions)
        shapes += [array.shape] * len(positions)
        gradients += [array.face_gradient] * len(positions)
        falloffs += [array.face_falloff] * len(positions)
        origins += [f"panels[{index}].leds"] * len(positions)
        for center in panel_centers_m(grid).tolist():
            diffuser = None if grid.diffuser is None else (grid.diffuser, panel_opening_m(grid, center[0], center[1]))
            panel_diffusers += [diffuser] * len(offsets)
    if not ids:
        raise InputError(f"{source}: has no LED; add [[led]] or [[panels]]")
    order = np.argsort(ids, kind="stable")
    leds = Leds(
        np.array(ids, dtype=np.int64)[order],
        np.array(centers)[order],
        np.array(half_widths)[order],
        np.array(luminances)[order],
        -np.log(2) / np.log(np.cos(np.radians(half_powers)))[order],
        np.array([shape == "square" for shape in shapes])[order],
        (None,) * len(ids),
        np.array(gradients)[order],
        np.array(falloffs)[order],
        transmitters_of(settings),
    )
    diffusers = [
        None
        if panel_diffuser is None
        else Diffuser(
            (float(leds.centers_m[i, 0]), float(leds.centers_m[i, 1])),
            panel_diffuser[0].distance_m,
            panel_diffuser[0].transmittance,
            float(leds.areas_m2[i]),
            float(leds.orders[i]),
            panel_diffuser[1],
        )
        for i, panel_diffuser in enumerate(panel_diffusers[number] for number in order)
    ]
    leds = replace(leds, diffusers=tuple(diffusers))
    _check_leds(leds, [origins[i] for i in order], np.array(settings.room.size_m), source)
    try:
        transmission_of(leds.transmitters)
    except ValueError as error:
        raise InputError(f"{source}: {error}") from None
    return leds


def transmitters_of(settings: SceneSettings) -> tuple[Transmitter, ...]:
    """Single LEDs in the order of the scene file, then panels grid by grid, with what they transmit."""
    found = [
        Transmitter(number, f"led[{number}]", entry.downlink, (entry.id,), entry.position_m)
        for number, entry in enumerate(settings.led)
    ]
    for index, grid in enumerate(settings.panels):
        per_panel, first = grid.leds.columns * grid.leds.rows, grid.leds.first_id
        for x, y, z in panel_centers_m(grid).tolist():
            ids = tuple(range(first, first + per_panel))
            found.append(Transmitter(len(found), f"panels[{index}]", grid.downlink, ids, (x, y, z)))
            first += per_panel
    return tuple(found)


def _check_led_array(array: PanelLeds, grid: PanelGrid, where: str) -> None:
    rim = 0.0 if grid.frame is None else grid.frame.width_m
    for axis, name, count in ((0, "columns", array.columns), (1, "rows", array.rows)):
        extent = (count - 1) * array.pitch_m[axis] + 2 * array.half_width_m
        if extent > grid.size_m[axis] - 2 * rim + TOUCH_M:
            within = "" if grid.frame is None else f", and its frame leaves {grid.size_m[axis] - 2 * rim:.4g} m"
            raise InputError(
                f"{where}.leds: {count} {name} {array.pitch_m[axis]} m apart and {2 * array.half_width_m:.4g} m wide "
                f"span {extent:.4g} m; the panel is {grid.size_m[axis]} m{within}"
            )
    if grid.diffuser is not None:
        lowest, highest = MIN_DISTANCE_RADII * array.half_width_m, grid.size_m[2]
        if not lowest - TOUCH_M <= grid.diffuser.distance_m <= highest + TOUCH_M:
            raise InputError(
                f"{where}.diffuser.distance_m = {grid.diffuser.distance_m}: is not from {lowest:.4g} m "
                f"({MIN_DISTANCE_RADII:g} radii or half sides of the LEDs) to {highest:.4g} m (the panel's height)"
            )
    if array.luminance_cd_m2[0] > array.luminance_cd_m2[1]:
        raise InputError(f"{where}.leds.luminance_cd_m2 = {list(array.luminance_cd_m2)}: put the lower value first")


def _check_leds(leds: Leds, origins: list[str], room_m: NDArray[np.float64], source: str) -> None:
    repeated = np.flatnonzero(np.diff(leds.ids) == 0)
    if len(repeated):
        raise InputError(f"{source}: {origins[repeated[0] + 1]}: LED id {leds.ids[repeated[0]]} is used twice")
    half_extents = np.stack([leds.half_widths_m, leds.half_widths_m, np.zeros(len(leds))], axis=1)
    outside = ((leds.centers_m - half_extents < -TOUCH_M) | (leds.centers_m + half_extents > room_m + TOUCH_M)).any(
        axis=1
    )
    if outside.any():
        i = int(np.flatnonzero(outside)[0])
        center = [round(float(v), 4) for v in leds.centers_m[i]]
        raise InputError(
            f"{source}: {origins[i]}: LED {leds.ids[i]} at {center} m, {2 * leds.half_widths_m[i]:.4g} m wide, "
            f"is not inside the room of {room_m.tolist()} m"
        )
    for one, other in _neighbours(leds):
        between = leds.centers_m[other] - leds.centers_m[one]
        both_square = leds.squares[other] & leds.squares[one]
        apart = np.where(both_square, np.abs(between).max(axis=1), np.linalg.norm(between, axis=1))
        close = np.flatnonzero(apart < leds.half_widths_m[other] + leds.half_widths_m[one] - TOUCH_M)
        if len(close):
            near, first, second = apart[close[0]], one[close[0]], other[close[0]]
            raise InputError(
                f"{source}: {origins[second]}: LEDs {leds.ids[first]} and {leds.ids[second]} overlap: centres "
                f"{near:.4g} m apart, widths {2 * leds.half_widths_m[first]:.4g} and "
                f"{2 * leds.half_widths_m[second]:.4g} m"
            )


def _neighbours(leds: Leds) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """All pairs of LEDs that may overlap, as indices (n,) and larger indices (n,), for some LEDs at a time.

    LEDs are sorted along the longer side of their field; each is paired with those of the next ones that are near
    enough along this side.
    """
    axis = int(np.argmax(np.ptp(leds.centers_m, axis=0)))
    order = np.argsort(leds.centers_m[:, axis], kind="stable")
    along_m = leds.centers_m[order, axis]
    ends = np.searchsorted(along_m, along_m + leds.half_widths_m[order] + leds.half_widths_m.max())
    for start in range(0, len(leds), LEDS_AT_ONCE):
        here = np.arange(start, min(start + LEDS_AT_ONCE, len(leds)))
        counts = ends[here] - here - 1
        one = np.repeat(here, counts)
        step = np.arange(len(one)) - np.repeat(np.cumsum(counts) - counts, counts)
        pair = order[one], order[one + 1 + step]
        yield np.minimum(*pair), np.maximum(*pair)
