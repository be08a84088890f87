"""Linear model of what a device does not know exactly, and by how much that moves the centroids of LED images.

A device states its camera, its LED map and the map's datum with standard deviations (datasets/FORMAT.md). The errors
are independent and normal with mean 0; here they are the parameters of a linear model of the pixels at a pose. Their
slopes are exact to first order. Three groups of parameters differ in which frames share an error: those of the
`device`, of a `shot` (one frame), and of the `map`.

The parameters by name, with the LED or luminaire that they belong to:

- `device` and `shot`: the intrinsics, `estimator.io.camera.INTRINSICS`;
- `map`: `datum_x`, `datum_y`, `datum_z` (m) and `datum_scale` (relative, about the world's origin); of a luminaire
  `luminaire_x`, `luminaire_y`, `luminaire_z` (m) and `turn_x`, `turn_y`, `turn_z` (rad, about its centre); of an LED
  `led_x`, `led_y`, `led_z` (m), `size` (half width, m) and `gradient_x`, `gradient_y` (relative, over the half width).

A gradient g of luminance over a face of half width r and mean square extent s^2 moves the centroid as a shift of the
LED by g s^2 / r does: g r / 4 for a disc, g r / 3 for a square. An error of the size changes the eccentricity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.camera.intrinsics import intrinsic_slopes_px
from estimator.camera.pose import Pose
from estimator.camera.projection import projection_of
from estimator.io.camera import INTRINSICS, Camera, CameraUncertainty
from estimator.io.led_map import Led, Luminaire, MapDatum

Floats = NDArray[np.float64]

Group = Literal["device", "shot", "map"]
AXES = ("x", "y", "z")
AS_SOLD = {"focal": 0.01, "aspect": 3e-4, "principal_point_um": 54.0, "radial_um": 6.0, "decentering_um": 1.2}
"""Standard deviations of a camera as sold: relative, and micrometres on the sensor. `radial_um` and `decentering_um`
are displacements at the sensor's corner by k1, and by p1 or p2. The principal point is that of a device, 48 um, and of
a shot, 24 um, together."""


class Parameter(NamedTuple):
    """Error of a stated value: its group, its name, and the id of its luminaire or LED, None if it has none."""

    group: Group
    name: str
    of: int | None = None


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Parameters of the errors that move the images of n LEDs in one frame, k of them, and their priors.

    `parameters` (k,) are named in the order of `sigmas` (k,), their standard deviations, all positive. The first of
    them are intrinsics: `intrinsics` are their indices in INTRINSICS. The others are of the map: `levers` (n, 3, k_map)
    are the derivatives of the LEDs' world positions by them. A size has no lever; `sizes` (n, k_map) are those of the
    relative lift (`estimator.solvers.observations`), per metre. `leds_m` (n, 3) are the LEDs' centres, `lift_m2` (n,)
    is 4 s^2 of each, m^2.
    """

    camera: Camera
    leds_m: Floats
    lift_m2: Floats
    parameters: tuple[Parameter, ...]
    sigmas: Floats
    intrinsics: NDArray[np.int64]
    levers: Floats
    sizes: Floats

    def only(self, chosen: NDArray[np.bool_]) -> "Uncertainty":
        """The same parameters for the chosen LEDs, (n,)."""
        return replace(
            self,
            leds_m=self.leds_m[chosen],
            lift_m2=self.lift_m2[chosen],
            levers=self.levers[chosen],
            sizes=self.sizes[chosen],
        )

    def with_camera(self, camera: Camera) -> "Uncertainty":
        """The same errors of the map with those that another camera states."""
        parameters, sigmas, intrinsics = _of_camera(camera)
        before = len(self.intrinsics)
        return replace(
            self,
            camera=camera,
            parameters=(*parameters, *self.parameters[before:]),
            sigmas=np.array([*sigmas, *self.sigmas[before:]]),
            intrinsics=np.array(intrinsics, dtype=np.int64),
        )

    def slopes_px(self, pose: Pose) -> Floats:
        """Derivatives (n, 2, k) of the centroids' pixels by the parameters; NaN for an LED without an image."""
        p_cam = pose.in_camera(self.leds_m)
        image, by_point = projection_of(self.camera).project(p_cam)
        by_led = self.camera.matrix()[:2, :2] @ by_point @ pose.R_cam_world
        offset = self.leds_m - pose.position_m
        lifted = self.lift_m2 * offset[:, 2] / (offset**2).sum(axis=1)
        of_map = by_led @ self.levers + by_led[:, :, 2:] * (lifted[:, None] * self.sizes)[:, None, :]
        of_camera = intrinsic_slopes_px(p_cam, image, self.camera)[:, :, self.intrinsics]
        return np.concatenate([of_camera, of_map], axis=2)

    def covariance_px2(self, pose: Pose) -> Floats:
        """Covariance (2n, 2n) of the centroids by all parameters, in the order u, v of each LED in turn."""
        slopes = self.slopes_px(pose) * self.sigmas
        flat = slopes.reshape(2 * len(self.leds_m), -1)
        return np.asarray(flat @ flat.T)


def uncertainty(
    camera: Camera, leds: Sequence[Led], luminaires: Mapping[int, Luminaire], datum: MapDatum | None
) -> Uncertainty:
    """Parameters of all errors that are stated, of a camera and of n LEDs in its view.

    A standard deviation of 0, or one that is not stated, has no parameter.
    """
    parameters, sigmas, intrinsics = _of_camera(camera)
    leds_m = np.array([led.position_m for led in leds]).reshape(-1, 3)
    of_map = _MapParameters(leds_m)
    _add_datum(of_map, datum)
    _add_luminaires(of_map, leds, luminaires)
    _add_leds(of_map, leds)
    return Uncertainty(
        camera=camera,
        leds_m=leds_m,
        lift_m2=np.array([4 * led.mean_square_extent_m2 for led in leds]),
        parameters=(*parameters, *of_map.parameters),
        sigmas=np.array([*sigmas, *of_map.sigmas]),
        intrinsics=np.array(intrinsics, dtype=np.int64),
        levers=of_map.levers(),
        sizes=of_map.sizes(),
    )


@lru_cache(maxsize=16)
def _of_camera(camera: Camera) -> tuple[tuple[Parameter, ...], tuple[float, ...], tuple[int, ...]]:
    """Parameters of the intrinsics that are stated, their standard deviations, and their indices in INTRINSICS."""
    parameters: list[Parameter] = []
    sigmas: list[float] = []
    intrinsics: list[int] = []
    if camera.uncertainty is not None:
        stated: dict[Group, Floats] = {
            "device": camera.uncertainty.device_sigmas(),
            "shot": camera.uncertainty.shot_sigmas(),
        }
        for group, of_group in stated.items():
            for index in np.flatnonzero(of_group).tolist():
                parameters.append(Parameter(group, INTRINSICS[index]))
                sigmas.append(float(of_group[index]))
                intrinsics.append(index)
    return tuple(parameters), tuple(sigmas), tuple(intrinsics)


@lru_cache(maxsize=16)
def assumed_camera(camera: Camera) -> Camera:
    """A camera with the errors of `assumed_uncertainty`."""
    return camera.model_copy(update={"uncertainty": assumed_uncertainty(camera)})


def assumed_uncertainty(camera: Camera) -> CameraUncertainty:
    """Errors of a camera as sold, by AS_SOLD and the radius of its sensor's corner."""
    lengths_px = [
        AS_SOLD[name] / camera.pixel_pitch_um for name in ("principal_point_um", "radial_um", "decentering_um")
    ]
    principal_point_px, radial_px, decentering_px = lengths_px
    corner_px = np.hypot(camera.width_px, camera.height_px) / 2
    radius = corner_px / camera.K[0][0]
    k1, p = radial_px / (corner_px * radius**2), decentering_px / (3 * corner_px * radius)
    of_lens = (k1, p, p) if camera.projection == "perspective" else (0.0, 0.0, 0.0)
    sigmas = (AS_SOLD["focal"], AS_SOLD["aspect"], principal_point_px, principal_point_px, *map(float, of_lens))
    return CameraUncertainty(
        parameters=INTRINSICS,
        device_sigma=sigmas,
        shot_sigma=(0.0,) * len(INTRINSICS),
        offset_sigma_m=0.0,
        rotation_sigma_deg=0.0,
    )


class _MapParameters:
    """Parameters of the map that are stated, gathered one block after another."""

    def __init__(self, leds_m: Floats) -> None:
        self.leds_m = leds_m
        self.parameters: list[Parameter] = []
        self.sigmas: list[float] = []
        self._levers: list[Floats] = [np.zeros((len(leds_m), 3, 0))]
        self._sizes: list[Floats] = [np.zeros((len(leds_m), 0))]

    def add(self, names: Sequence[str], of: Sequence[int | None], sigmas: Floats, levers: Floats) -> None:
        """Add parameters (k,) with levers (n, 3, k); those with a sigma of 0 are left out."""
        used = np.flatnonzero(sigmas > 0)
        self.parameters += [Parameter("map", names[k], of[k]) for k in used.tolist()]
        self.sigmas += sigmas[used].tolist()
        self._levers.append(levers[:, :, used])
        self._sizes.append(np.zeros((len(self.leds_m), len(used))))

    def add_sizes(self, of: Sequence[int], sigmas: Floats, relative: Floats) -> None:
        """Add an error of size for each of the n LEDs, by which the lift grows by `relative` (n,) per metre."""
        count = len(self.leds_m)
        used = np.flatnonzero(sigmas > 0)
        self.add(["size"] * count, list(of), sigmas, np.zeros((count, 3, count)))
        self._sizes[-1] = np.diag(relative)[:, used]

    def levers(self) -> Floats:
        return np.concatenate(self._levers, axis=2)

    def sizes(self) -> Floats:
        return np.concatenate(self._sizes, axis=1)


def _add_datum(of_map: _MapParameters, datum: MapDatum | None) -> None:
    if datum is None:
        return
    levers = np.concatenate([np.tile(np.eye(3), (len(of_map.leds_m), 1, 1)), of_map.leds_m[:, :, None]], axis=2)
    names = [*(f"datum_{axis}" for axis in AXES), "datum_scale"]
    of_map.add(names, [None] * 4, datum.sigmas(), levers)


def _add_luminaires(of_map: _MapParameters, leds: Sequence[Led], luminaires: Mapping[int, Luminaire]) -> None:
    if not luminaires:
        return
    of_led = np.array([-1 if led.luminaire is None else led.luminaire for led in leds], dtype=np.int64)
    names = [f"{kind}_{axis}" for kind in ("luminaire", "turn") for axis in AXES]
    for key in np.unique(of_led[of_led >= 0]).tolist():
        if key not in luminaires:
            continue
        luminaire = luminaires[key]
        x, y, z = (of_map.leds_m - luminaire.position_m).T
        zero, one = np.zeros_like(x), np.ones_like(x)
        # A small turn w about the centre moves a point at the offset d by w x d.
        levers = np.stack(
            [
                np.stack([one, zero, zero, zero, z, -y], axis=1),
                np.stack([zero, one, zero, -z, zero, x], axis=1),
                np.stack([zero, zero, one, y, -x, zero], axis=1),
            ],
            axis=1,
        )
        levers[of_led != key] = 0.0
        of_map.add(names, [key] * 6, luminaire.sigmas(), levers)


def _add_leds(of_map: _MapParameters, leds: Sequence[Led]) -> None:
    if not any(led.states_errors for led in leds):
        return
    sigmas = np.array([led.sigmas() for led in leds]).reshape(-1, 6)
    count = len(leds)
    ids = [led.id for led in leds]
    each = np.zeros((count, 3, count, 3))
    each[np.arange(count), :, np.arange(count)] = np.eye(3)
    names = [f"led_{axis}" for axis in AXES] * count
    of_map.add(names, np.repeat(ids, 3).tolist(), sigmas[:, :3].ravel(), each.reshape(count, 3, 3 * count))
    shift_m = np.array([led.shift_by_gradient_m for led in leds])
    of_face = (each[:, :, :, :2] * shift_m[:, None, None, None]).reshape(count, 3, 2 * count)
    of_map.add(["gradient_x", "gradient_y"] * count, np.repeat(ids, 2).tolist(), sigmas[:, 4:].ravel(), of_face)
    # The lift is proportional to the half width squared.
    of_map.add_sizes(ids, sigmas[:, 3], 2 / np.array([led.half_width_m for led in leds]))
