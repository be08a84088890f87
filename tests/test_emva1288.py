"""The package emva1288, an implementation by others, measures our frames and finds the gain and dark noise we set.

It was written for NumPy 1: `asfarray`, which NumPy 2 dropped, is put back for it, and nothing else is changed. It reads
a descriptor and 16-bit images from files, as it would those of a real camera.
"""

from pathlib import Path

import numpy as np
import pytest
from emva1288.process.data import Data1288
from emva1288.process.loader import LoadImageData
from emva1288.process.parser import ParseEmvaDescriptorFile
from emva1288.process.results import Results1288
from PIL import Image

from vlcrender.emva1288.datasheet import bench
from vlcrender.sensor.sensor import Sensor

SIDE = 320
PIXELS = SIDE**2
EXPOSURE_NS = 10_000_000
EFFICIENCY = 0.6
SENSOR = Sensor(
    bits=12,
    gain_e_per_dn=2.0,
    full_well_e=7000.0,
    black_level_dn=100,
    noise="full",
    read_noise_e=6.0,
    dsnu_e=3.0,
    prnu=0.01,
)
PHOTONS = np.linspace(500, 12_500, 25)
"""The well is full at 11 700."""
SIGMAS = 4.0


def results(sensor: Sensor, folder: Path) -> Results1288:
    """Flat and dark pairs, and a stack of each for the spatial part that it insists on, through its own reader."""
    shoot = bench(sensor, EFFICIENCY, SIDE)
    lines = ["v 3.1", f"n {sensor.bits} {SIDE} {SIDE}"]

    def take(photons: float, count: int) -> None:
        lines.append(f"b {EXPOSURE_NS} {photons}" if photons else f"d {EXPOSURE_NS}")
        for _ in range(count):
            name = f"{len(lines)}.png"
            image = shoot(photons, EXPOSURE_NS * 1e-9, 0.0).astype(np.uint16)
            Image.fromarray(image).save(folder / name, compress_level=0)
            lines.append(f"i {name}")

    for photons in (0.0, *PHOTONS):
        take(float(photons), 2)
    for photons in (0.0, 6000.0):
        take(photons, 4)
    (folder / "descriptor.txt").write_text("\n".join(lines) + "\n")
    parsed = ParseEmvaDescriptorFile(str(folder / "descriptor.txt"), loglevel=30)
    loaded = LoadImageData(parsed.images, loglevel=30)
    return Results1288(Data1288(loaded.data, loglevel=30).data, loglevel=30)


def slope_errors(found: Results1288) -> tuple[float, float]:
    """Standard error of K, ours and its own.

    K = sum x y / sum x^2 with y_i a difference of variances of PIXELS pairs: Var(s^2) = (2 s^4 + K^3 x / 2) / PIXELS,
    the dark one in all y_i alike. Its own: from how the points scatter about the line it fitted.
    """
    used = slice(found.index_sensitivity_min, found.index_sensitivity_max + 1)
    x = (found.temporal["u_y"] - found.temporal["u_ydark"])[used]
    s2, dark = found.temporal["s2_y"][used], found.temporal["s2_ydark"][0]
    variances = (2 * s2**2 + found.K**3 * x / 2) / PIXELS
    ours = np.sqrt(x**2 @ variances + x.sum() ** 2 * 2 * dark**2 / PIXELS) / (x @ x)
    residuals = s2 - dark - found.K * x
    own = np.sqrt(residuals @ residuals / (len(x) - 1) / (x @ x))
    return float(ours), float(own)


@pytest.fixture(autouse=True)
def numpy_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(np, "asfarray", lambda values: np.asarray(values, dtype=float), raising=False)


@pytest.mark.slow
def test_emva1288_finds_our_gain_and_dark_noise(tmp_path: Path) -> None:
    found = results(SENSOR, tmp_path)
    gain = 1 / SENSOR.gain_at_iso_e_per_dn
    ours, own = slope_errors(found)
    assert ours < 0.002 * gain  # a gain 1.5 % off is found out, by three standard errors and more
    assert abs(found.K - gain) < SIGMAS * ours
    assert abs(found.K - gain) < SIGMAS * own
    # sigma_d^2 = (s^2_dark - 1/12) / K^2, of PIXELS pairs, and the gain's error
    dark = found.sigma_y_dark**2
    error = np.hypot(np.sqrt(2 / PIXELS) * dark / (2 * found.sigma_d * found.K**2), found.sigma_d * ours / found.K)
    assert error < 0.01 * SENSOR.dark_noise_e
    assert abs(found.sigma_d - SENSOR.dark_noise_e) < SIGMAS * error
    # R is exact to its means' noise; pixels' mean response is off by prnu / sqrt(PIXELS), 5e-5
    assert abs(found.QE / 100 - EFFICIENCY) < SIGMAS * EFFICIENCY * ours / gain


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"gain_e_per_dn": 2.03}, {"read_noise_e": 0.0}, {"read_noise_e": 6.3}])
def test_emva1288_tells_another_sensor_from_ours(tmp_path: Path, change: dict[str, float]) -> None:
    """The tolerances above are tight enough to see a gain 1.5 % off, and read noise 5 % more or none."""
    found = results(SENSOR.model_copy(update=change), tmp_path)
    ours, _ = slope_errors(found)
    error = np.hypot(np.sqrt(2 / PIXELS) * 9.1 / (2 * 6.0 * 0.25), 6.0 * ours / 0.5)
    gain_off = abs(found.K - 0.5) > SIGMAS * ours
    noise_off = abs(found.sigma_d - SENSOR.dark_noise_e) > SIGMAS * error
    assert gain_off if "gain_e_per_dn" in change else noise_off
