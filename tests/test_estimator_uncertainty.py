"""Linear model of stated errors: every slope against the pixels of a camera or map that has the error."""

import json

import numpy as np
import pytest
from estimator_synthetic import Array, description, grid, view_of

from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.io.camera import INTRINSICS, Camera, CameraUncertainty, Distortion
from estimator.io.led_map import DiscLed, Led, Luminaire, MapDatum, SquareLed
from estimator.solvers.uncertainty import AS_SOLD, Parameter, Uncertainty, assumed_uncertainty, uncertainty

VIEW = view_of((3, 3.2, 3.4), 2.0, 15, -10, 30, (4000, 3000, 3000.0))
POSE = Pose(np.array(VIEW.position_m), VIEW.R_cam_world)
LEDS_M = grid(3, 3, 0.4, (3, 3.2, 3.4))
LEDS_M[:, 2] += 0.03 * (np.arange(9) % 5)  # at unequal heights, so that every turn moves every coordinate
RADIUS_M = 0.03
SIGMAS = (1e-3, 2e-4, 5.0, 6.0, 0.01, 2e-4, 3e-4)
STATED = CameraUncertainty(
    parameters=INTRINSICS,
    device_sigma=SIGMAS,
    shot_sigma=(3e-4, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0),
    offset_sigma_m=0.0,
    rotation_sigma_deg=0.0,
)
DATUM = MapDatum(sigma_m=(1e-3, 2e-3, 3e-3), scale_sigma_ppm=50.0)
DISTORTION = Distortion(k1=-0.1, k2=0.0, k3=0.0, p1=1e-3, p2=-2e-3)


def camera(**changes: object) -> Camera:
    of = description(VIEW, 1, np.zeros((0, 3)), RADIUS_M)
    return Camera.model_validate_json(json.dumps(of["cameras"]["main"])).model_copy(  # type: ignore[index]
        update={"uncertainty": STATED, **changes}
    )


def leds(shape: str = "disc") -> list[Led]:
    """LEDs 0 to 8; the first four in luminaire 7, the next four in luminaire 2, the last in none."""
    stated = {"sigma_m": (3e-4, 4e-4, 5e-4), "gradient_sigma": 0.05}
    made: list[Led] = []
    for k, (x, y, z) in enumerate(LEDS_M.tolist()):
        own = {**stated, "id": k, "position_m": (x, y, z), "luminaire": (7, 2, None)[k // 4]}
        if shape == "disc":
            made.append(DiscLed.model_validate({**own, "radius_m": RADIUS_M, "radius_sigma_m": 6e-4}))
        else:
            made.append(SquareLed.model_validate({**own, "side_m": 2 * RADIUS_M, "side_sigma_m": 1.2e-3}))
    return made


def luminaires() -> dict[int, Luminaire]:
    made = {}
    for key, of in ((7, slice(0, 4)), (2, slice(4, 8))):
        x, y, z = LEDS_M[of].mean(axis=0).tolist()
        made[key] = Luminaire(
            id=key, position_m=(x, y, z), sigma_m=(3e-3, 4e-3, 5e-3), sigma_rotation_deg=(0.2, 0.3, 0.4)
        )
    return made


def stated(of: Camera, shape: str = "disc") -> Uncertainty:
    return uncertainty(of, leds(shape), luminaires(), DATUM)


def column(model: Uncertainty, parameter: Parameter) -> Array:
    """Slopes (n, 2) by a parameter."""
    return np.asarray(model.slopes_px(POSE)[:, :, model.parameters.index(parameter)])


@pytest.mark.parametrize("name", INTRINSICS)
@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({}, id="pinhole"),
        pytest.param({"distortion": DISTORTION}, id="distorted"),
        pytest.param({"projection": "equidistant"}, id="fish-eye"),
    ],
)
def test_slopes_by_the_intrinsics_are_those_of_a_changed_camera(name: str, changes: dict[str, object]) -> None:
    """FORMAT.md's errors, put into K and the coefficients; all are linear, but focal times aspect: 1e-12 of 3000 px."""
    of = camera(**changes)
    if of.projection == "equidistant" and name in ("k1", "p1", "p2"):
        assert not column(stated(of), Parameter("device", name)).any()
        return
    step = 1e-6
    K = of.matrix()
    if name in ("focal", "aspect"):
        half = step / 2 if name == "aspect" else step
        K[0, 0] *= 1 + half
        K[1, 1] *= 1 - half if name == "aspect" else 1 + half
    elif name in ("cx_px", "cy_px"):
        K[("cx_px", "cy_px").index(name), 2] += step
    lens = of.distortion or Distortion(k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
    if name in ("k1", "p1", "p2"):
        lens = lens.model_copy(update={name: getattr(lens, name) + step})
    changed = of.model_copy(update={"K": tuple(map(tuple, K.tolist()))})
    if changed.projection == "perspective":
        changed = changed.model_copy(update={"distortion": lens})
    moved = project(LEDS_M, POSE, changed).pixels - project(LEDS_M, POSE, of).pixels
    # Pixels of 4000 keep 1e-12 of themselves, a step of 1e-6 of that 2e-6; slopes are 1 to 3000.
    np.testing.assert_allclose(column(stated(of), Parameter("device", name)), moved / step, rtol=1e-5, atol=5e-6)


def moved_leds(shifts_m: Array) -> Array:
    """Movement (n, 2) of the pixels by shifts of the LEDs (n, 3), to first order by the difference to both sides."""
    of = camera(distortion=DISTORTION)
    return (project(LEDS_M + shifts_m, POSE, of).pixels - project(LEDS_M - shifts_m, POSE, of).pixels) / 2


def shifts(parameter: str, of: int | None, step: float) -> Array:
    """What FORMAT.md says that an error does to the LEDs, (9, 3)."""
    kind, _, axis = parameter.rpartition("_")
    unit = np.eye(3)["xyz".index(axis)] * step if axis in ("x", "y", "z") else np.zeros(3)
    shift = np.zeros_like(LEDS_M)
    in_luminaire = np.arange(9) // 4 == {7: 0, 2: 1}.get(of if of is not None else -1, -1)
    if parameter == "datum_scale":
        return LEDS_M * step
    if kind == "datum":
        shift += unit
    elif kind == "luminaire":
        shift[in_luminaire] = unit
    elif kind == "turn":
        shift[in_luminaire] = np.cross(unit, LEDS_M[in_luminaire] - LEDS_M[in_luminaire].mean(axis=0))
    elif kind == "led":
        shift[of] = unit
    elif kind == "gradient":
        # The mean of x over a disc with luminance 1 + g x / r is g r / 4.
        shift[of] = unit * RADIUS_M / 4
    return shift


@pytest.mark.parametrize(
    ("parameter", "of"),
    [
        *((f"datum_{axis}", None) for axis in ("x", "y", "z", "scale")),
        *((f"{kind}_{axis}", key) for kind in ("luminaire", "turn") for axis in "xyz" for key in (7, 2)),
        *((f"led_{axis}", 5) for axis in "xyz"),
        *((f"gradient_{axis}", 8) for axis in "xy"),
    ],
)
def test_slopes_by_the_map_are_those_of_moved_leds(parameter: str, of: int | None) -> None:
    step = 1e-4
    expected = moved_leds(shifts(parameter, of, step)) / step
    found = column(stated(camera(distortion=DISTORTION)), Parameter("map", parameter, of))
    # The third order of a difference to both sides is (1e-4 / 2 m)^2 of it; of large levers 3.4 times more.
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_the_centroid_of_a_square_moves_by_a_third_of_its_half_side() -> None:
    """The mean of x over a square with luminance 1 + g x / a is g a / 3, for a disc of that radius g a / 4."""
    disc, square = (stated(camera(), shape) for shape in ("disc", "square"))
    parameter = Parameter("map", "gradient_y", 3)
    np.testing.assert_allclose(column(square, parameter), column(disc, parameter) * 4 / 3, rtol=1e-12)


@pytest.mark.parametrize(("shape", "extent"), [("disc", 1 / 4), ("square", 1 / 3)])
def test_a_larger_face_is_lifted_more(shape: str, extent: float) -> None:
    """4 s^2 h / d^2 with s^2 a share of the half width squared: the slope by it, times the pixels by z."""
    of = camera()
    offset = LEDS_M - VIEW.position_m
    lift_slope = 8 * extent * RADIUS_M * offset[:, 2] / (offset**2).sum(axis=1)
    k, step = 4, 1e-4
    shift = np.zeros_like(LEDS_M)
    shift[k, 2] = step
    moved = (project(LEDS_M + shift, POSE, of).pixels - project(LEDS_M - shift, POSE, of).pixels) / (2 * step)
    found = column(stated(of, shape), Parameter("map", "size", k))
    np.testing.assert_allclose(found, moved * lift_slope[:, None], rtol=1e-6, atol=1e-9)


def test_sigmas_are_those_stated_each_by_its_name() -> None:
    model = stated(camera())
    sigma = dict(zip(model.parameters, model.sigmas.tolist(), strict=True))
    assert [sigma[Parameter("device", name)] for name in INTRINSICS] == list(SIGMAS)
    assert {name: sigma[Parameter("shot", name)] for name in ("focal", "cx_px")} == {"focal": 3e-4, "cx_px": 3.0}
    assert Parameter("shot", "aspect") not in sigma
    assert sigma[Parameter("map", "datum_z")] == 3e-3
    assert sigma[Parameter("map", "datum_scale")] == pytest.approx(50e-6, rel=1e-12)
    assert sigma[Parameter("map", "luminaire_y", 2)] == 4e-3
    assert sigma[Parameter("map", "turn_z", 7)] == pytest.approx(np.radians(0.4), rel=1e-12)
    assert sigma[Parameter("map", "led_z", 8)] == 5e-4
    assert sigma[Parameter("map", "size", 8)] == 6e-4
    assert stated(camera(), "square").sigmas[model.parameters.index(Parameter("map", "size", 8))] == 6e-4
    assert sigma[Parameter("map", "gradient_x", 0)] == 0.05
    # 7 + 2 intrinsics, 4 of the datum, 6 of each luminaire, and of each LED 3 + 2 + 1.
    assert len(sigma) == 9 + 4 + 2 * 6 + 9 * 6


def test_nothing_stated_is_no_parameter() -> None:
    plain = [DiscLed(id=k, position_m=(x, y, z), radius_m=RADIUS_M) for k, (x, y, z) in enumerate(LEDS_M.tolist())]
    model = uncertainty(camera(uncertainty=None), plain, {}, None)
    assert model.parameters == ()
    assert model.slopes_px(POSE).shape == (9, 2, 0)
    assert not model.covariance_px2(POSE).any()


def test_the_covariance_is_that_of_drawn_errors(rng: np.random.Generator) -> None:
    """Of 4000 draws a variance is known to sqrt(2 / 4000) = 2.2 %, a covariance to that of the root of the variances'
    product; five of them of the largest of 171.
    """
    model = stated(camera())
    slopes = (model.slopes_px(POSE) * model.sigmas).reshape(18, -1)
    draws = rng.standard_normal((4000, slopes.shape[1])) @ slopes.T
    found, expected = draws.T @ draws / len(draws), model.covariance_px2(POSE)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 5 * np.sqrt(2 / 4000)


def test_chosen_leds_keep_their_errors_in_common() -> None:
    model = stated(camera())
    chosen = np.isin(np.arange(9), [1, 3, 6])
    rows = np.repeat(chosen, 2)
    np.testing.assert_allclose(
        model.only(chosen).covariance_px2(POSE), model.covariance_px2(POSE)[np.ix_(rows, rows)], rtol=1e-12
    )


def test_a_camera_as_sold_moves_the_corner_by_so_many_micrometres() -> None:
    """By FORMAT.md's distortion at the sensor's corner: k1 r^3 and 3 p r^2, in units of the image distance."""
    of = camera(uncertainty=None)
    sold = dict(zip(INTRINSICS, assumed_uncertainty(of).device_sigmas().tolist(), strict=True))
    assert (sold["focal"], sold["aspect"]) == (AS_SOLD["focal"], AS_SOLD["aspect"])
    assert sold["cx_px"] * of.pixel_pitch_um == pytest.approx(AS_SOLD["principal_point_um"], rel=1e-12)
    radius = np.hypot(2000, 1500) / 3000
    assert sold["k1"] * radius**3 * 3000 * of.pixel_pitch_um == pytest.approx(AS_SOLD["radial_um"], rel=1e-12)
    for name in ("p1", "p2"):
        moved_um = 3 * sold[name] * radius**2 * 3000 * of.pixel_pitch_um
        assert moved_um == pytest.approx(AS_SOLD["decentering_um"], rel=1e-12)
    fish_eye = assumed_uncertainty(of.model_copy(update={"projection": "equidistant"}))
    assert not fish_eye.device_sigmas()[4:].any()
    # What is sold is a camera: its place on the rig is none of it; gravity keeps the accelerometer's error alone.
    assert (fish_eye.offset_sigma_m, fish_eye.rotation_sigma_deg) == (0.0, 0.0)


def test_another_camera_leaves_the_map_as_it_is() -> None:
    model = stated(camera(uncertainty=None))
    with_one = model.with_camera(camera())
    whole = stated(camera())
    assert with_one.parameters == whole.parameters
    np.testing.assert_array_equal(with_one.sigmas, whole.sigmas)
    np.testing.assert_array_equal(with_one.slopes_px(POSE), whole.slopes_px(POSE))
