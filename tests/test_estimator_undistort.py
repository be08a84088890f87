"""Undistortion: pixels of any lens to those of a pinhole."""

import numpy as np
import pytest
from estimator_synthetic import Array

from estimator.camera.projection import projection_of
from estimator.camera.undistort import has_pinhole_image, pinhole_image, pinhole_pixels
from estimator.errors import EstimationFailure
from estimator.io.camera import Camera, Distortion


def camera(projection: str = "perspective", skew_px: float = 0.0, **coefficients: float) -> Camera:
    """100 pixels to the image distance."""
    none = dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 0.0)
    return Camera.model_validate(
        {
            "width_px": 400,
            "height_px": 300,
            "K": ((100.0, skew_px, 200.0), (0.0, 100.0, 150.0), (0.0, 0.0, 1.0)),
            "pixel_pitch_um": 100.0,
            "focal_length_mm": 10.0,
            "image_distance_mm": 10.0,
            "f_number": 2.0,
            "projection": projection,
            "distortion": Distortion(**{**none, **coefficients}) if coefficients else None,
            "focus_distance_m": None,
            "psf": "none",
            "psf_wavelength_nm": 550.0,
            "psf_kernel": None,
            "R_cam_rig": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
            "offset_m": (0.0, 0.0, 0.0),
        }
    )


def pixels(*rows: tuple[float, float]) -> Array:
    return np.array(rows)


def test_pixels_of_a_pinhole_are_unchanged() -> None:
    given = pixels((1.1, 2.3), (377.7, 3.9))
    assert pinhole_pixels(given, camera()) is given


@pytest.mark.parametrize(
    ("coefficients", "seen", "straight"),
    [
        # x = 0.5: 0.5 (1 - 0.2 / 4) = 0.475
        ({"k1": -0.2}, (247.5, 150.0), (250.0, 150.0)),
        ({"k2": -0.8}, (200.0, 197.5), (200.0, 200.0)),
        ({"k3": 3.2}, (252.5, 150.0), (250.0, 150.0)),
        # (x, y) = (0.5, 0): y + p1 r^2 and x + 3 p2 x^2
        ({"p1": 0.04}, (250.0, 151.0), (250.0, 150.0)),
        ({"p2": 0.04}, (253.0, 150.0), (250.0, 150.0)),
    ],
)
def test_a_point_by_hand(
    coefficients: dict[str, float], seen: tuple[float, float], straight: tuple[float, float]
) -> None:
    assert pinhole_pixels(pixels(seen), camera(**coefficients)) == pytest.approx(pixels(straight), abs=1e-9)


def test_undistortion_moves_pixels_of_a_barrel_outwards_and_of_a_pincushion_inwards() -> None:
    given = pixels((240.0, 150.0), (170.0, 170.0), (200.0, 90.0))
    radius = np.linalg.norm(given - [200, 150], axis=1)
    for k1, sign in ((-0.1, 1), (0.1, -1)):
        moved = np.linalg.norm(pinhole_pixels(given, camera(k1=k1)) - [200, 150], axis=1)
        assert (sign * (moved - radius) > 0.1).all()


def test_skew_is_not_part_of_the_lens() -> None:
    """(x, y) = (0, 0.5) is seen at y = 0.475, half a pixel of skew a pixel down: u = 200 + 50 y."""
    found = pinhole_pixels(pixels((223.75, 197.5)), camera(skew_px=50.0, k1=-0.2))
    assert found == pytest.approx(pixels((225.0, 200.0)), abs=1e-9)


def test_a_fish_eye_by_hand() -> None:
    """45 deg is a radius of 25 pi px, and 1 image distance for a pinhole; the axis does not move."""
    found = pinhole_pixels(pixels((200.0, 150.0 - 25 * np.pi), (200.0, 150.0)), camera("equidistant"))
    assert found == pytest.approx(pixels((200.0, 50.0), (200.0, 150.0)), abs=1e-9)


@pytest.mark.parametrize("theta_deg", [80.1, 95.0])
def test_a_spot_beyond_the_field_angle_is_refused(theta_deg: float) -> None:
    with pytest.raises(EstimationFailure, match=r"^undistort: a spot is 80 deg or more off the optical axis$"):
        pinhole_pixels(pixels((200.0, 150.0), (200.0 + 100 * np.radians(theta_deg), 150.0)), camera("equidistant"))
    both = pixels((200.0, 150.0), (200.0 + 100 * np.radians(theta_deg), 150.0))
    assert has_pinhole_image(both, camera("equidistant")).tolist() == [True, False]


@pytest.mark.parametrize("coefficients", [{"k1": -0.5}, {"k1": -100.0, "k2": 100.0}, {"p2": -0.5}])
def test_a_spot_beyond_the_fold_is_refused(coefficients: dict[str, float]) -> None:
    """The maximum of r (1 - r^2 / 2) is 0.55."""
    with pytest.raises(EstimationFailure, match=r"^undistort: the distortion cannot be undone at a spot$"):
        pinhole_pixels(pixels((200.0, 150.0), (260.0, 151.0)), camera(**coefficients))
    both = pixels((200.0, 150.0), (260.0, 151.0))
    assert has_pinhole_image(both, camera(**coefficients)).tolist() == [True, False]


@pytest.mark.parametrize(
    "lens",
    [
        camera(),
        camera("equidistant", skew_px=5.0),
        camera(k1=-0.12, k2=0.03, k3=-0.002, p1=0.004, p2=-0.003),
    ],
    ids=["pinhole", "fish-eye", "distortion"],
)
def test_projecting_the_undistorted_image_gives_the_pixels_back(lens: Camera) -> None:
    given = pixels((120.0, 180.0), (200.0, 150.0), (250.3, 93.9), (290.0, 200.0))
    rays = np.column_stack([pinhole_image(given, lens), np.ones(len(given))])
    back = lens.to_pixels(projection_of(lens).project(rays)[0])
    np.testing.assert_allclose(back, given, atol=1e-9)
