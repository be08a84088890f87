"""What pixels tell of a frame's unknowns: the slopes of their light by pose, places and faces of LEDs, and brightness.

The light of each LED and its change with every step of the pose are rendered (`moving_led`), for as many pixels as are
asked for at a time. All else follows from the changes by the camera's x and y: a move of the camera by (dx, dy) shifts
the point of an LED's plane that a pixel sees by (dx, dy).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import Roi
from vlcrender.rendering.face_motions import FACE_NUMBERS
from vlcrender.rendering.halo import LightOfLed, SourceOfLight
from vlcrender.rendering.led_coverage import intersections_with_plane
from vlcrender.rendering.led_radiance import face_of_led
from vlcrender.rendering.moving_led import MovingLed
from vlcrender.rendering.seen_pixels import SeenPixels
from vlcrender.scene.leds import Leds

Array = NDArray[np.float64]
HaloOf = Callable[[Sequence[SourceOfLight], Roi], Array]
"""The halo of some light in a region of the sensor, electrons a second."""


@dataclass(frozen=True)
class PixelSlopes:
    """Slopes of the light of a frame's pixels, electrons. Of each pixel those of the unknowns that it shows alone."""

    mounted: Mounted
    main: Pose
    steps: tuple[float, ...]
    """Steps of x, y, z in metres and tilt_x, tilt_y, yaw in radians, to either side, by which light changes."""
    exposure_s: float
    halo_of: HaloOf | None
    """Halos of a lens with glare."""

    def by_pose(self, inside: Sequence[MovingLed], tile: Roi) -> tuple[Array, list[int]]:
        """Of some pixels, slopes by the pose and by brightness and level, and the numbers of these columns: 6, one for
        each of `inside`, and one.

        Those by the pose are changes from the step to one side to that to the other, electrons a second; the others
        are electrons.
        """
        lit = [number for number, led in enumerate(inside) if led.roi.overlaps(tile)]
        columns = np.zeros((6 + len(lit) + 1, *tile.shape))
        if self.halo_of is not None:
            for unknown in range(6):
                columns[unknown] = self._halo(inside, 1 + unknown, tile)
            for column, number in zip(columns[6:], lit, strict=False):
                column[:] = self._halo([inside[number]], 0, tile)
        for column, number in zip(columns[6:], lit, strict=False):
            roi = inside[number].roi.intersection(tile)
            here, (light, *changes) = tile.slices(roi), inside[number].pixels(roi)
            column[here] += light
            column *= self.exposure_s
            for slope, change in zip(columns, changes, strict=False):
                slope[here] += change
        columns[-1] = 1.0
        return columns, [*range(6), *(6 + number for number in lit), 6 + len(inside)]

    def by_places(
        self, inside: Sequence[MovingLed], leds: Leds, index_of: Mapping[int, int], tile: Roi
    ) -> tuple[Array, list[int]]:
        """Of some pixels, slopes by brightness and level, and by a shift along u and v of each of `inside`; and the
        numbers of these columns.
        """
        lit = [number for number, led in enumerate(inside) if led.roi.overlaps(tile)]
        columns = np.ones((3 * len(lit) + 1, *tile.shape))
        shifts = columns[len(lit) + 1 :].reshape(len(lit), 2, *tile.shape)
        for light, shift, number in zip(columns, shifts, lit, strict=False):
            light[:], by_position = self._light_and_slopes(tile, inside[number])
            shift[:] = self._shift_slopes(tile, leds, index_of[inside[number].led_id], by_position)
        free = len(inside) + 1
        return columns, [*lit, len(inside), *(free + 2 * number + axis for number in lit for axis in range(2))]

    def by_faces(
        self,
        inside: Sequence[MovingLed],
        places: Sequence[int],
        leds: Leds,
        index_of: Mapping[int, int],
        k: int,
        tile: Roi,
    ) -> tuple[Array, list[int]]:
        """Of some pixels, slopes by brightness and level, by the gradients and by the faces of k LEDs, of which
        `places` are the numbers of those inside; and the numbers of these columns.
        """
        first, columns, which = len(inside) + 1, [np.ones(tile.shape)], [len(inside)]
        seen = SeenPixels(self.mounted.posed(self.main), tile)
        for number, (place, led) in enumerate(zip(places, inside, strict=True)):
            if not led.roi.overlaps(tile):
                continue
            light, by_position = self._light_and_slopes(tile, led)
            i = index_of[led.led_id]
            x, y, rim_x, rim_y = self._on_face(seen, leds, i)
            columns.append(light)
            which.append(number)
            if leds.diffusers[i] is None:
                columns.extend(light * np.clip(np.stack([x, y]) / leds.half_widths_m[i], -1, 1))
                which.extend(range(first + 2 * place, first + 2 * place + 2))
            by_shift = -by_position
            columns.extend(slope * arm for arm in (1.0, rim_x, rim_y) for slope in by_shift)
            face = first + 2 * k + FACE_NUMBERS * place
            which.extend(range(face, face + FACE_NUMBERS))
        return np.stack(columns), which

    def _halo(self, leds: Sequence[MovingLed], change: int, roi: Roi) -> Array | float:
        """The halo of the light of some LEDs in a region, electrons a second, or the change of this number of it."""
        if self.halo_of is None:
            return 0.0
        image, whole = np.zeros(roi.shape), [led.pixels(led.roi)[change] for led in leds]
        for sign in (1.0, -1.0):  # a halo is that of light, which is positive
            light = [
                LightOfLed(led.led_id, led.roi, np.maximum(sign * pixels, 0.0))
                for led, pixels in zip(leds, whole, strict=True)
            ]
            image += sign * self.halo_of(light, roi)
        return image

    def _light_and_slopes(self, roi: Roi, led: MovingLed) -> tuple[Array, Array]:
        """Light of one LED in a region, electrons, and its slopes by the camera's x and y, (2, rows, columns)."""
        light, *by_position = led.within(roi)[:3]
        light = (self._halo([led], 0, roi) + light) * self.exposure_s
        slopes = [
            (self._halo([led], 1 + unknown, roi) + change) * self.exposure_s / (2 * self.steps[unknown])
            for unknown, change in enumerate(by_position)
        ]
        return light, np.stack(slopes)

    def _on_face(self, seen: SeenPixels, leds: Leds, i: int) -> tuple[Array, Array, Array, Array]:
        """Of each pixel's centre, the point (x, y) on an LED's plane and the point of the rim next to it, from the
        face's centre, m.

        An LED's light changes at the rim, however far the lens blurs the change.
        """
        face = face_of_led(leds, i)
        x, y = seen.on_plane(seen.roi, face.center_m)
        return x, y, *face.shape.nearest_on_rim(x, y)

    def _shift_slopes(self, roi: Roi, leds: Leds, i: int, by_position: Array) -> Array:
        """Slopes of one LED's light by a shift of its image along u and v, (2, rows, columns), electrons per pixel.

        by_position: slopes by the camera's x and y, (2, rows, columns). A move of the camera by (dx, dy) shifts the
        point of the LED's plane that a pixel sees by (dx, dy); a shift of the image by du shifts it by -du times the
        derivative of the point by u.
        """
        posed = self.mounted.posed(self.main)
        center_m = face_of_led(leds, i).center_m
        u, v = roi.centers_px()
        slopes = []
        for du, dv in ((0.5, 0.0), (0.0, 0.5)):
            x1, y1 = intersections_with_plane(posed, center_m, u + du, v + dv)
            x0, y0 = intersections_with_plane(posed, center_m, u - du, v - dv)
            slopes.append(-((x1 - x0) * by_position[0] + (y1 - y0) * by_position[1]))
        return np.stack(slopes)
