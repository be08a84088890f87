"""Exposure: expected electrons to digital numbers, through the chain that `sensor` describes step by step."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.core.philox import kernel_seed, normals, uniforms
from vlcrender.core.random_keys import random_key
from vlcrender.sensor.pixel_indices import pixel_indices
from vlcrender.sensor.poisson import MAX_MEAN, draw, poisson_of_regions
from vlcrender.sensor.sensor import Electrons, Sensor, clip_full_well


def variance_e2(
    sensor: Sensor, expected_e: NDArray[np.float32], exposure_s: float, added_dn: float = 0.0
) -> NDArray[np.float64]:
    """Variance of each pixel's digital number in electrons squared, same shape; inf where the pixel is saturated.

    added_dn: standard deviation of noise that `expose` adds, digital numbers.

    Fixed patterns count as noise, independent in each pixel: an estimator does not know them. A pixel is saturated
    where its mean is at the full well or the upper limit of the ADC. Rounding adds gain^2 / 12, except where digital
    numbers are counts of electrons. Hot pixels, which are few, are left out: they hold less information.
    """
    variance = np.empty(expected_e.shape)
    for band in Roi(0, 0, *expected_e.shape).bands():
        variance[band] = _variance_e2(sensor, expected_e[band], exposure_s, added_dn)
    return variance


def _variance_e2(
    sensor: Sensor, expected_e: NDArray[np.float32], exposure_s: float, added_dn: float
) -> NDArray[np.float64]:
    """`variance_e2` of a few rows, which the cache holds."""
    gain, full = sensor.gain_at_iso_e_per_dn, sensor.noise == "full"
    mean = expected_e.astype(np.float64)
    level = mean + sensor.dark_electrons(exposure_s) if full else mean
    variance = level.copy()
    if full:
        added = (sensor.dark_noise_e, sensor.dsnu_e, sensor.row_offset_e, sensor.column_offset_e)
        variance += (sensor.prnu * mean) ** 2 + sum(sigma**2 for sigma in added)
    variance += (added_dn * gain) ** 2
    if full or gain != 1.0 or added_dn:
        variance += gain**2 / 12
    variance[level >= sensor.saturation_e] = np.inf
    return variance


@dataclass(frozen=True)
class AddedDn:
    """Normal noise of mean 0, independent in each pixel, that is no part of the sensor."""

    sigma: float
    """Standard deviation, digital numbers."""
    key: str
    """Names its random numbers."""

    def numbers_dn(self, rois: Sequence[Roi]) -> NDArray[np.float64]:
        """The noise of all pixels of some regions, as `pixel_indices` has them, (pixels,), digital numbers."""
        with exact_math():
            noise, _ = normals(kernel_seed(self.key), *pixel_indices(rois))
            dr.eval(noise)
        numbers_dn: NDArray[np.float64] = self.sigma * noise.numpy().astype(np.float64)
        return numbers_dn


def expose(
    sensor: Sensor,
    expected_e: NDArray[np.float32],
    key: str,
    row: int = 0,
    column: int = 0,
    *,
    exposure_s: float,
    camera: str = "main",
) -> NDArray[np.uint32]:
    """Digital numbers of expected electrons (rows, columns), finite and >= 0; same shape.

    `key` names the random numbers of this exposure. The region starts at pixel (row, column) of the frame and gets the
    noise that the whole frame has there. With `noise = "full"`, dark current collects electrons for `exposure_s`, and
    the fixed patterns derive from the sensor's `serial` and the name of the camera. Raises ValueError for other means.
    """
    region = RegionImage(Roi(row, column, *expected_e.shape), expected_e)
    (exposed,) = expose_regions(sensor, [region], key, exposure_s=exposure_s, camera=camera)
    return exposed.image


def expose_regions(
    sensor: Sensor,
    expected_e: Sequence[RegionImage],
    key: str,
    *,
    exposure_s: float,
    camera: str = "main",
    added: AddedDn | None = None,
) -> list[RegionImage]:
    """`expose` of one or more regions of a frame, by one launch of one kernel.

    added: noise that is added to the digital numbers before rounding.
    """
    rois = [roi for roi, _ in expected_e]
    images = [image.ravel() for _, image in expected_e]
    flat = np.concatenate(images) if len(images) > 1 else images[0]
    if sensor.noise == "full":
        dn = _full_chain(sensor, flat, key, random_key(sensor.serial, camera), rois, exposure_s, added)
    elif sensor.noise == "shot" and added is None:
        dn = _shot_noise(sensor, flat, key, rois)
    else:
        electrons: Electrons = poisson_of_regions(flat, key, rois) if sensor.noise == "shot" else flat
        electrons = clip_full_well(electrons, sensor.full_well_e)
        if added is not None:  # in electrons, as if read noise
            electrons = electrons + sensor.gain_at_iso_e_per_dn * added.numbers_dn(rois)
        dn = sensor.quantise(electrons)
    parts = np.split(dn, np.cumsum([roi.pixels for roi in rois])[:-1])
    return [RegionImage(roi, part.reshape(roi.rows, roi.columns)) for roi, part in zip(rois, parts, strict=True)]


def _shot_noise(sensor: Sensor, expected_e: NDArray[np.float32], key: str, rois: Sequence[Roi]) -> NDArray[np.uint32]:
    """Steps 4, 6, 8 and 9 of the chain; where counts are digital numbers, in one kernel."""
    most = int(min(sensor.full_well_e, 2**32 - 1))
    if sensor.gain_at_iso_e_per_dn != 1.0:
        return sensor.quantise(poisson_of_regions(expected_e, key, rois, most))
    counts = poisson_of_regions(expected_e, key, rois, min(most, sensor.largest_dn - sensor.black_level_dn))
    return counts + np.uint32(sensor.black_level_dn) if sensor.black_level_dn else counts


def _full_chain(
    sensor: Sensor,
    expected_e: NDArray[np.float32],
    key: str,
    individual: str,
    rois: Sequence[Roi],
    exposure_s: float,
    added: AddedDn | None,
) -> NDArray[np.uint32]:
    """Steps 2 to 9 of the chain in the docstring of `sensor`, in one kernel; means and numbers as `pixel_indices`."""
    low, high = float(expected_e.min()), float(expected_e.max())
    if not 0 <= low <= high:
        raise ValueError(f"means from {low} to {high} electrons; 0 and more are allowed")

    def number(value: float) -> Any:  # as data: each literal would compile a kernel of its own
        return dr.opaque(mi.Float, value)

    with exact_math():
        column, row = pixel_indices(rois)
        response, offset = normals(kernel_seed(individual, "pixels"), column, row)
        mean = dr.minimum(mi.Float(expected_e), MAX_MEAN)
        mean = mean * dr.maximum(1.0 + number(sensor.prnu) * response, 0.0)  # 2
        mean = mean + number(sensor.dark_electrons(exposure_s))  # 3
        if sensor.hot_pixel_share > 0:
            mean = mean + number(sensor.hot_electrons(exposure_s)) * _of_hot_pixels(sensor, individual, column, row)
        dr.eval(mean, offset)
        electrons = mi.Float(draw(mean, kernel_seed(key), rois))  # 4
        electrons = electrons + number(sensor.dsnu_e) * offset  # 5
        electrons = dr.minimum(electrons, number(sensor.full_well_e))  # 6
        # 7 and 8: read and ADC noise are normal and both follow the clip, so one draw has the sum of their variances.
        noise, _ = normals(kernel_seed(key, "read"), column, row)
        of_row = _of_lines(kernel_seed(individual, "rows"), row, [(roi.row, roi.end_row) for roi in rois], 1)
        of_column = _of_lines(
            kernel_seed(individual, "columns"), column, [(roi.column, roi.end_column) for roi in rois], 0
        )
        electrons = electrons + number(sensor.dark_noise_e) * noise
        electrons = electrons + number(sensor.row_offset_e) * of_row + number(sensor.column_offset_e) * of_column
        level = electrons / number(sensor.gain_at_iso_e_per_dn)
        if added is not None:
            level = level + number(added.sigma) * normals(kernel_seed(added.key), column, row)[0]
        level = dr.round(level) + number(sensor.black_level_dn)  # 8 and 9
        dn: Any = mi.UInt32(dr.clip(level, 0.0, number(sensor.largest_dn)))
        dr.eval(dn)
    image: NDArray[np.uint32] = dn.numpy()
    return image


def _of_lines(seed: Any, line: Any, extents: Sequence[tuple[int, int]], axis: int) -> Any:
    """A normal number of each pixel's row (axis 1) or column (axis 0), numbered `line`: drawn once for all its pixels.

    extents: of the regions, first row or column and that after the last.
    """
    first, end = min(one for one, _ in extents), max(end for _, end in extents)
    offset = dr.opaque(mi.UInt32, first % 2**32)
    place = [mi.UInt32(0), mi.UInt32(0)]
    place[axis] = dr.arange(mi.UInt32, end - first) + offset
    drawn, _ = normals(seed, *place)
    dr.eval(drawn)
    return dr.gather(mi.Float, drawn, line - offset)


def _of_hot_pixels(sensor: Sensor, individual: str, column: Any, row: Any) -> Any:
    """Exponential numbers of mean 1 in hot pixels, 0 in all others; the same in every frame of a sensor."""
    chance, size, _, _ = uniforms(kernel_seed(individual, "hot pixels"), column, row, mi.UInt32(0))
    return dr.select(chance < dr.opaque(mi.Float, sensor.hot_pixel_share), -dr.log(1.0 - size), 0.0)
