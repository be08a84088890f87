"""Error budget of a recipe: what each thing that a device does not know contributes to its position's error.

The estimator is generalised least squares of the spots of one frame and the accelerometer, to first order
(`rendering/spot_errors.py`). A second estimator trusts what it is told: its weights hold pixel noise and accelerometer
alone, as if lens and map were exact. Figures are root mean squares over the poses of the recipe.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.rig import MAIN, Mounted
from vlcrender.camera.roi import RegionImage
from vlcrender.core.warn_once import warn_once
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.pose_sampling import pose_of_frame
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.dataset.world.bound_uncertainty import uncertainty_of
from vlcrender.dataset.world.true_world import tilt_sigmas_deg
from vlcrender.errors import InputError
from vlcrender.rendering.bayer import MosaicRenderer
from vlcrender.rendering.crlb import FrameSlopes
from vlcrender.rendering.renderer import Renderer
from vlcrender.rendering.spot_errors import ACCELEROMETER, NOISE, SpotErrors
from vlcrender.rendering.uncertainty import Uncertainty
from vlcrender.sensor.signal_chain import variance_e2

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Share:
    """The position's error by one unknown, or by several: root mean square over the poses, mm."""

    horizontal_mm: float
    vertical_mm: float

    @property
    def total_mm(self) -> float:
        """Of the distance in space, mm."""
        return float(np.hypot(self.horizontal_mm, self.vertical_mm))

    def record(self) -> dict[str, float]:
        """The three figures by name, for JSON."""
        return {"horizontal_mm": self.horizontal_mm, "vertical_mm": self.vertical_mm, "total_mm": self.total_mm}


@dataclass(frozen=True)
class BudgetRow:
    """One unknown of an error budget."""

    key: str
    name: str
    sigma: str
    """Its standard deviation, with unit."""
    share: Share
    """Its contribution to the error of the estimator that knows all standard deviations."""
    exact_mm: float | None
    """Error of that estimator in space if this unknown had no error: what calibrating it would give, mm. None for pixel
    noise, which cannot be calibrated."""
    trusting: Share
    """Its contribution to the error of the estimator that takes lens and map as exact."""


@dataclass(frozen=True)
class ErrorBudget:
    """Contributions of all unknowns of a recipe to the position of one camera, the largest first."""

    recipe: str
    camera: str
    poses: int
    """Poses that the figures are from."""
    undetermined: int
    """Further poses, whose spots do not determine a position; no figure contains them."""
    median_leds: float
    """Median over the poses of the whole LEDs in view."""
    median_luminaires: float
    """Median over the poses of the luminaires that these LEDs belong to."""
    rows: tuple[BudgetRow, ...]
    total: Share
    """Error of the estimator that knows all standard deviations; its square is the sum of the rows' squares."""
    trusting_total: Share
    """Error of the estimator that takes lens and map as exact."""
    bound: Share | None
    """Hybrid Cramér-Rao bound of the pixels; None where it was not computed."""

    def record(self) -> dict[str, Any]:
        """The budget for JSON: fields by name, rows in order, errors as of `Share.record`."""
        rows = [
            {
                "key": row.key,
                "name": row.name,
                "sigma": row.sigma,
                **row.share.record(),
                "exact_mm": row.exact_mm,
                "trusting": row.trusting.record(),
            }
            for row in self.rows
        ]
        return {
            "recipe": self.recipe,
            "camera": self.camera,
            "poses": self.poses,
            "undetermined": self.undetermined,
            "median_leds": self.median_leds,
            "median_luminaires": self.median_luminaires,
            "rows": rows,
            "total": self.total.record(),
            "trusting_total": self.trusting_total.record(),
            "bound": self.bound and self.bound.record(),
        }


@dataclass(frozen=True)
class _Part:
    """A row before its figures: the effect of `SpotErrors` it belongs to, and its share of the effect's variance."""

    key: str
    name: str
    sigma: str
    effect: str
    share: float


def error_budget(
    plan: Plan,
    renderer: Callable[[], Renderer | MosaicRenderer],
    poses: int,
    camera: str = MAIN,
    bound: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> ErrorBudget:
    """The error budget of a recipe's camera, over so many of its poses, evenly spread.

    renderer: makes the scene's renderer, once the recipe is known to be good.
    bound: compute the hybrid bound of the pixels too, at about three times the cost. progress: called with the number
    of finished poses and of all. Raises InputError for a camera that is not on the rig, for a recipe with motion or
    without noise, and where no pose determines a position.
    """
    recipe, scene = plan.recipe, plan.scene
    if plan.cells is not None:
        raise InputError("budget: is of one recipe; remove [[sweep]], or --set sweep=[]")
    mounted = _mounted(recipe, camera)
    if recipe.motion is not None:
        raise InputError("budget: needs a camera at rest; remove [motion]")
    if recipe.sensor.noise == "none":
        raise InputError('budget: needs noise; sensor.noise must not be "none"')
    if any(transmitter.modulated for transmitter in scene.leds.transmitters):
        warn_once(log, "budget: LEDs are modulated; the figures are those of steady light with the same mean")
    if poses < 1:
        raise InputError(f"poses = {poses}: has to be 1 or more")
    uncertainty = uncertainty_of(recipe, scene, mounted)
    parts = _parts(recipe, mounted)
    scales_without = [{part.effect: float(np.sqrt(max(0.0, 1.0 - part.share)))} for part in parts]
    of_scene = renderer()
    made = recipe.pose_numbers
    numbers = np.unique(np.linspace(made[0], made[-1], min(poses, len(made))).round().astype(int))
    shares, trusting, exact, bounds, leds, luminaires = [], [], [], [], [], []
    for done, number in enumerate(numbers.tolist()):
        model, of_pixels = spot_errors_at(plan, of_scene, mounted, number, uncertainty, bound)
        own = None if model is None else model.gain()
        if model is not None and own is not None:
            contributions = model.contributions_m2(own)
            shares.append(_diagonals(contributions, parts))
            exact.append([_trace_without(model, scales) for scales in scales_without])
            blind = model.gain(dict.fromkeys(set(model.effects) - {NOISE, ACCELEROMETER}, 0.0))
            trusting.append(_diagonals(model.contributions_m2(own if blind is None else blind), parts))
            bounds.append(np.full(3, np.nan) if of_pixels is None else np.diag(of_pixels))
            leds.append(model.effects[NOISE].shape[1] // 2)
            luminaires.append(model.effects["luminaire_yaw"].shape[1])
        if progress is not None:
            progress(done + 1, len(numbers))
    if not shares:
        raise InputError(
            f"budget: none of {len(numbers)} poses of camera {camera!r} sees LEDs that determine a position"
        )
    share, blind_share = np.mean(shares, axis=0), np.mean(trusting, axis=0)
    without_mm = 1e3 * np.sqrt(np.mean(exact, axis=0))
    rows = [
        BudgetRow(
            part.key,
            part.name,
            part.sigma,
            _share(share[i]),
            None if part.effect == NOISE else float(without_mm[i]),
            _share(blind_share[i]),
        )
        for i, part in enumerate(parts)
    ]
    return ErrorBudget(
        recipe=recipe.name,
        camera=camera,
        poses=len(shares),
        undetermined=len(numbers) - len(shares),
        median_leds=float(np.median(leds)),
        median_luminaires=float(np.median(luminaires)),
        rows=tuple(sorted(rows, key=lambda row: -row.share.total_mm)),
        total=_share(share.sum(axis=0)),
        trusting_total=_share(blind_share.sum(axis=0)),
        bound=_share(np.mean(bounds, axis=0)) if bound else None,
    )


def _mounted(recipe: Recipe, camera: str) -> Mounted:
    by_name = {mounted.name: mounted for mounted in recipe.cameras}
    if camera not in by_name:
        raise InputError(f"camera {camera!r}: is not on the rig; cameras: {', '.join(by_name)}")
    return by_name[camera]


def spot_errors_at(
    plan: Plan,
    renderer: Renderer | MosaicRenderer,
    mounted: Mounted,
    number: int,
    uncertainty: Uncertainty,
    bound: bool,
) -> tuple[SpotErrors | None, Array | None]:
    """The spots' model at a pose of the recipe, and with `bound` the hybrid bound of the pixels, (3, 3), m2.

    None where the pose sees no LED whole; the bound also where the pixels do not determine a position.
    """
    recipe, scene = plan.recipe, plan.scene
    main = pose_of_frame(recipe.poses, number, recipe.seed, recipe.camera, scene)
    at = mounted.posed(main)
    view = renderer.expected_image(at, recipe.regions)
    exposure_s = recipe.time_s(view)
    tilts = tilt_sigmas_deg(recipe, main)

    expected = [RegionImage(part.roi, part.expected_electrons(exposure_s)) for part in view.parts]
    added_dn = recipe.added_noise_dn(expected) or 0.0
    slopes = FrameSlopes.rendered(
        mounted,
        main,
        partial(renderer.led_slopes, regions=recipe.regions),
        exposure_s,
        [RegionImage(roi, variance_e2(recipe.sensor, mean, exposure_s, added_dn)) for roi, mean in expected],
        float(np.median(np.linalg.norm(scene.leds.centers_m - at.position_m, axis=1))),
        recipe.regions is not None and recipe.regions.overscan,
        halo_of=renderer.halo_of(mounted.camera),
        unknowns=6 if bound else 2,
    )
    if slopes is None:
        return None, None
    of_pixels = slopes.hybrid_bound_m2(tilts, scene.leds, uncertainty) if bound else None
    return SpotErrors.of_frame(slopes, tilts, scene.leds, uncertainty), of_pixels


def _diagonals(contributions: Mapping[str, Array], parts: Sequence[_Part]) -> Array:
    """Variances along x, y and z of each part, (parts, 3), m2."""
    return np.stack([part.share * np.diag(contributions[part.effect]) for part in parts])


def _trace_without(model: SpotErrors, scales: Mapping[str, float]) -> float:
    """Variance in space of the estimator, m2, with some effects scaled down; NaN without noise."""
    gain = None if NOISE in scales else model.gain(scales)
    if gain is None:
        return float("nan")
    return float(sum(np.trace(part) for part in model.contributions_m2(gain, scales).values()))


def _share(variances_m2: Array) -> Share:
    x, y, z = map(float, variances_m2)
    return Share(1e3 * float(np.sqrt(x + y)), 1e3 * float(np.sqrt(z)))


def _parts(recipe: Recipe, mounted: Mounted) -> list[_Part]:
    """The unknowns of a recipe that have an error, with those of device and shot apart."""
    pixel_noise = _Part("noise", "pixel noise", "", NOISE, 1.0)
    if recipe.belief is None:
        sigma = f"{recipe.accelerometer.error_deg:g} deg"
        accelerometer = [_Part("accelerometer", "accelerometer", sigma, ACCELEROMETER, 1.0)]
        return [*(accelerometer if recipe.accelerometer.error_deg else []), pixel_noise]
    sigmas = recipe.belief.true_sigmas(recipe.cameras, recipe.accelerometer)
    own = sigmas.cameras[mounted.name]
    camera = mounted.camera
    device, shot = own.device, own.shot
    corner = float(np.hypot(camera.width_px, camera.height_px)) / (2 * camera.focal_px)
    radial_px, decentering_px = device[4] * corner**3 * camera.focal_px, 3 * device[5] * corner**2 * camera.focal_px
    mm = [f"{1e3 * x:g}" for x in (*sigmas.luminaire_m, *sigmas.led_m, *sigmas.datum_m)]
    tilt_deg, _, yaw_deg = sigmas.luminaire_rotation_deg
    pairs = [
        *_device_and_shot("focal", "focal length", device[0], shot[0], lambda s: f"{100 * s:g} %"),
        ("aspect", "fx / fy", f"{100 * device[1]:g} %", "aspect", device[1], 1.0),
        *_device_and_shot("principal_point", "principal point", device[2], shot[2], lambda s: f"{s:g} px"),
        ("radial", "radial distortion", f"{radial_px:.3g} px at the corner", "radial", device[4], 1.0),
        ("decentering", "decentering", f"{decentering_px:.3g} px at the corner", "decentering", device[5], 1.0),
        ("luminaire_xy", "luminaires, x and y", _both(mm[0], mm[1]), "luminaire_xy", sigmas.luminaire_m[:2].any(), 1.0),
        ("luminaire_z", "luminaires, z", f"{mm[2]} mm", "luminaire_z", sigmas.luminaire_m[2], 1.0),
        ("luminaire_tilt", "luminaires, tilt", f"{tilt_deg:g} deg", "luminaire_tilt", tilt_deg, 1.0),
        ("luminaire_yaw", "luminaires, yaw", f"{yaw_deg:g} deg", "luminaire_yaw", yaw_deg, 1.0),
        ("led_xy", "LEDs in their luminaire, x and y", _both(mm[3], mm[4]), "led_xy", sigmas.led_m[:2].any(), 1.0),
        ("led_z", "LEDs in their luminaire, z", f"{mm[5]} mm", "led_z", sigmas.led_m[2], 1.0),
        (
            "led_gradient",
            "gradient over an LED's face",
            f"{100 * sigmas.led_gradient:g} %",
            "led_gradient",
            sigmas.led_gradient,
            1.0,
        ),
        ("datum", "map as a whole", f"{', '.join(mm[6:])} mm", "datum", sigmas.datum_m.any(), 1.0),
        ("scale", "scale of the map", f"{sigmas.datum_scale_ppm:g} ppm", "scale", sigmas.datum_scale_ppm, 1.0),
        *_device_and_shot(
            "accelerometer",
            "accelerometer",
            sigmas.accelerometer_device_deg,
            sigmas.accelerometer_shot_deg,
            lambda s: f"{s:.3g} deg",
            ACCELEROMETER,
        ),
        ("mounting", "mounting, rotation", f"{own.rotation_deg:g} deg", "mounting", own.rotation_deg, 1.0),
    ]
    parts = [_Part(key, name, sigma, effect, share) for key, name, sigma, effect, size, share in pairs if size]
    return [*parts, pixel_noise]


def _both(x: str, y: str) -> str:
    return f"{x} mm" if x == y else f"{x}, {y} mm"


def _device_and_shot(
    key: str, name: str, device: float, shot: float, text: Callable[[float], str], effect: str | None = None
) -> list[tuple[str, str, str, str, float, float]]:
    """The two parts of an unknown whose error has one part by device and one by shot."""
    variance = device**2 + shot**2 or 1.0
    return [
        (f"{key}_device", f"{name}, device", text(device), effect or key, device, device**2 / variance),
        (f"{key}_shot", f"{name}, each shot", text(shot), effect or key, shot, shot**2 / variance),
    ]
