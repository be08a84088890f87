"""Processed pictures: tone curve, colours, and noise that no longer follows the sensor's law."""

from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, SMALL
from PIL import Image
from test_bayer import QE

from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.sensor.isp import Processed
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

NEUTRAL = (1.0, 1.0, 1.0)
SENSOR = Sensor(bits=12, full_well_e=4095.0)


def test_the_curve_at_points_of_the_standard() -> None:
    """IEC 61966-2-1: 12.92 x up to 0.0031308, where it meets the power; 0.21404 of the light is half of the scale."""
    numbers = np.array([[0, 8, 12, 13, 876, 877, 4095]], dtype=np.uint32)  # 8 of 4095 by 12.92 are 6.4 of 255
    assert Processed().develop(numbers, SENSOR, NEUTRAL).tolist() == [[0, 6, 10, 10, 127, 128, 255]]
    half = np.array([[891, 892]], dtype=np.uint32)  # 4095 * 0.5**2.2 = 891.2
    assert Processed(curve="gamma").develop(half, SENSOR, NEUTRAL).tolist() == [[127, 128]]


def test_black_level_is_black_and_a_full_well_white() -> None:
    sensor = Sensor(bits=14, full_well_e=5000.0, gain_e_per_dn=2.0, black_level_dn=100)
    picture = Processed().develop(np.array([[0, 100, 2600, 9000]], dtype=np.uint32), sensor, NEUTRAL)
    assert picture.tolist() == [[0, 0, 255, 255]]


@pytest.mark.parametrize("mosaic", ["rggb", "bggr", "grbg", "gbrg"])
def test_colours_come_out_of_the_mosaic(mosaic: str) -> None:
    """An even colour stays even; balanced by its own ratios it is grey."""
    sensor = Sensor(full_well_e=4095.0, mosaic=mosaic, quantum_efficiency=QE)
    of_letter = {"r": 1000, "g": 2000, "b": 500}
    tile = np.array([of_letter[letter] for letter in mosaic], dtype=np.uint32).reshape(2, 2)
    image = np.tile(tile, (20, 20))
    inside = np.s_[4:-4, 4:-4]  # the border mirrors
    plain = Processed(curve="gamma", gamma=1.0).develop(image, sensor, NEUTRAL)[inside]
    for channel, value in enumerate((1000, 2000, 500)):
        assert np.abs(plain[..., channel].astype(int) - round(255 * value / 4095)).max() <= 1
    grey = Processed().develop(image, sensor, (2.0, 1.0, 4.0))[inside]
    assert np.ptp(grey.reshape(-1, 3), axis=1).max() <= 1


def law_holds(first: np.ndarray, second: np.ndarray) -> bool:
    """Variance of the difference = sum of the means, the Skellam law; 6 sigma by Var(s^2) = (v + 2 v^2) / n."""
    a, b = first.astype(float), second.astype(float)
    v = a.mean() + b.mean()
    # The means, too, are estimates: v has variance v / n.
    return abs((a - b).var(ddof=1) - v) < 6 * np.sqrt((2 * v + 2 * v**2) / a.size)


@pytest.mark.parametrize("mean", [50.0, 400.0, 2500.0])
@pytest.mark.parametrize("processed", [Processed(), Processed(format="png"), Processed(curve="gamma", quality=60)])
def test_the_skellam_law_holds_on_raw_and_not_on_processed(mean: float, processed: Processed, tmp_path: Path) -> None:
    means = np.full((256, 384), mean, dtype=np.float32)
    raw = [expose(SENSOR, means, key, exposure_s=0.0) for key in ("first", "second")]
    assert law_holds(*raw)
    pictures = []
    for number, image in enumerate(raw):
        path = tmp_path / f"{number}{processed.suffix}"
        processed.write(path, processed.develop(image, SENSOR, NEUTRAL))
        pictures.append(np.asarray(Image.open(path)))
    assert not law_holds(*pictures)
    # Nor when 8 bits are scaled to electrons at the same mean: the curve and JPEG changed more than the scale.
    scale = mean / np.mean(pictures)
    assert not law_holds(pictures[0] * scale, pictures[1] * scale)


def test_a_recipe_with_processed_writes_pictures(tmp_path: Path) -> None:
    table = QE.model_dump(mode="json", exclude_none=True)
    assigned = ", ".join(f"{key} = {value}" for key, value in table.items())
    mosaic = ["sensor.mosaic=rggb", f"sensor.quantum_efficiency={{ {assigned} }}"]
    # Exposed until the brightest pixel has 3 900 of 4 095 numbers.
    metered = ["exposure.kind=peak", "exposure.share_of_saturation=0.65", "exposure.max_s=1.0"]
    base = [*(a for a in SMALL if not a.startswith("exposure_s")), *metered, "poses.count=1", "processed={}"]
    for name, more, mode in (("grey", [], "L"), ("colour", mosaic, "RGB")):
        plan = load_plan(ROOT / "datasets/quickstart.toml", [*base, *more])
        generate(plan, tmp_path / name)
        with Image.open(tmp_path / name / "processed/000000.jpg") as picture:
            assert (picture.mode, picture.size, picture.format) == (mode, (400, 300), "JPEG")
            pixels = np.asarray(picture)
        assert pixels.max() > 200
    # The LEDs' light is white. Their edges are fringed, where demosaicing overshoots by tens of percent and is cut off
    # at black and white; all their light together is not, while unbalanced red, green and blue would be 2 : 3 : 1.
    light = (pixels.astype(float) / 255) ** 2.2
    led_light = light[light.max(axis=2) > 0.2].sum(axis=0)
    assert np.ptp(led_light) < 0.1 * led_light.mean()
