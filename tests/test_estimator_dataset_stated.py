"""What a dataset states about its own errors is read, and wrong statements are refused."""

import copy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_estimator_dataset import change_json, change_rows, refused

from estimator.io.dataset import read_dataset, read_frame


@pytest.fixture(scope="module")
def good(synthetic_set: Path) -> Path:
    return synthetic_set


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "copy"))


STATED_CAMERA = {
    "parameters": ["cx_px", "cy_px", "focal", "aspect", "k1", "p1", "p2"],
    "device_sigma": [5.0, 6.0, 1e-3, 1e-4, 0.01, 2e-4, 3e-4],
    "shot_sigma": [3.0, 3.5, 3e-4, 0.0, 0.0, 0.0, 0.0],
    "offset_sigma_m": 2e-4,
    "rotation_sigma_deg": 0.05,
}
STATED_LUMINAIRE = {
    **{"id": 3, "position_m": [1.0, 2.0, 3.5]},
    **{"sigma_m": [0.003, 0.004, 0.005], "sigma_rotation_deg": [0.2, 0.3, 0.4]},
}
STATED_LED = {"luminaire": 3, "sigma_m": [3e-4, 4e-4, 5e-4], "radius_sigma_m": 2e-4, "gradient_sigma": 0.05}


def state_all(content: dict[str, Any]) -> None:
    """State how well everything is known."""
    content["cameras"]["main"]["uncertainty"] = copy.deepcopy(STATED_CAMERA)
    content["luminaires"] = [copy.deepcopy(STATED_LUMINAIRE)]
    content["led_map"][0].update(copy.deepcopy(STATED_LED))
    content["map_datum"] = {"sigma_m": [0.001, 0.002, 0.003], "scale_sigma_ppm": 20.0}
    content["accelerometer"].update({"error_deg": 0.5, "device_error_deg": 0.3, "shot_error_deg": 0.4})


def test_stated_uncertainties_are_read(folder: Path) -> None:
    """Each value by itself, none equal to another; parameters of the camera in an order of their own."""
    change_json(folder, state_all)
    change_rows(folder, lambda rows: [row.update(device=7 + row["frame"]) for row in rows])
    dataset = read_dataset(folder)
    frame = read_frame(dataset, 1)
    assert frame.device == 8
    stated = frame.camera.uncertainty
    assert stated is not None
    np.testing.assert_array_equal(stated.device_sigmas(), [1e-3, 1e-4, 5.0, 6.0, 0.01, 2e-4, 3e-4])
    np.testing.assert_array_equal(stated.shot_sigmas(), [3e-4, 0.0, 3.0, 3.5, 0.0, 0.0, 0.0])
    assert (stated.offset_sigma_m, stated.rotation_sigma_deg) == (2e-4, 0.05)
    assert frame.luminaires[3].sigma_m == (0.003, 0.004, 0.005)
    assert frame.luminaires[3].sigma_rotation_deg == (0.2, 0.3, 0.4)
    led, other = frame.leds[10], frame.leds[11]
    assert (led.luminaire, led.sigma_m, led.gradient_sigma) == (3, (3e-4, 4e-4, 5e-4), 0.05)
    assert led.size_sigma_m == 2e-4
    assert (other.luminaire, other.sigma_m, other.gradient_sigma, other.size_sigma_m) == (None, None, None, None)
    assert frame.map_datum is not None
    assert (frame.map_datum.sigma_m, frame.map_datum.scale_sigma_ppm) == ((0.001, 0.002, 0.003), 20.0)
    assert (frame.accelerometer.device_error_deg, frame.accelerometer.shot_error_deg) == (0.3, 0.4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param(
            lambda c: c["cameras"]["main"]["uncertainty"]["shot_sigma"].pop(),
            "uncertainty: Value error, device_sigma and shot_sigma need one number for each of parameters",
            id="a sigma too few",
        ),
        pytest.param(
            lambda c: c["cameras"]["main"]["uncertainty"]["parameters"].__setitem__(0, "cy_px"),
            "parameters have to be unique",
            id="a parameter twice",
        ),
        pytest.param(
            lambda c: c["cameras"]["main"]["uncertainty"]["device_sigma"].__setitem__(2, -1.0),
            "cameras.main.uncertainty.device_sigma.2: Input should be greater than or equal to 0",
            id="a negative sigma",
        ),
        pytest.param(
            lambda c: c["cameras"]["main"].update(projection="equidistant"),
            'sigmas of k1, p1 and p2 have to be 0 with projection "equidistant"',
            id="distortion of a fish-eye",
        ),
        pytest.param(
            lambda c: c["luminaires"].append(STATED_LUMINAIRE), "luminaire ids have to be unique", id="one id twice"
        ),
        pytest.param(
            lambda c: c["led_map"][1].update(luminaire=4),
            "LED 11 names luminaire 4, which is not in luminaires",
            id="an unknown luminaire",
        ),
        pytest.param(
            lambda c: c["led_map"][0].update(sigma_m=[1e-3, 1e-3]), "led_map.0.sigma_m.2: Field required", id="a pair"
        ),
        pytest.param(
            lambda c: c["accelerometer"].update(shot_error_deg=-0.1), "accelerometer.shot_error_deg", id="accelerometer"
        ),
    ],
)
def test_a_wrong_statement_is_refused_by_name(
    folder: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    def both(content: dict[str, Any]) -> None:
        state_all(content)
        change(content)

    change_json(folder, both)
    assert message in refused(folder)
