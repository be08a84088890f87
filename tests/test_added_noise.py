"""Noise levels in decibels: sigma by its four readings, the draws, and what truth and bound say of them."""

import math
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from conftest import ROOT, SMALL

import vlcrender as vr
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.format.rows import FrameRow, TruthRow
from vlcrender.dataset.format.tables import read_table
from vlcrender.dataset.recipe.added_noise import AddedNoise
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.recipe.recipe import Recipe, scaled
from vlcrender.errors import InputError
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import AddedDn, expose_regions, variance_e2

QUICKSTART = ROOT / "datasets/quickstart.toml"
ROI = Roi(0, 0, 400, 500)
N = ROI.pixels


def level(level_db: float, relative_to: str) -> AddedNoise:
    return AddedNoise.model_validate({"level_db": level_db, "relative_to": relative_to})


def sigma_dn(level_db: float, relative_to: str, image_e: object, **sensor: object) -> float:
    image = np.array(image_e, dtype=np.float32)
    found = level(level_db, relative_to).sigma_dn(Sensor.model_validate(sensor), [RegionImage(Roi(0, 0, 2, 2), image)])
    assert found is not None
    return found


def test_relative_to_the_peak_zero_and_minus_nine_db_are_1_and_0_355_of_it() -> None:
    """Power goes with the square of sigma: 10^(-9/20) = 0.3548. The peak is in digital numbers, saturated at most."""
    image = [[10.0, 20.0], [800.0, 40.0]]
    assert sigma_dn(0, "peak", image, gain_e_per_dn=2.0) == pytest.approx(400)
    assert sigma_dn(-9, "peak", image, gain_e_per_dn=2.0) / 400 == pytest.approx(0.355, abs=5e-4)
    assert sigma_dn(0, "peak", image, full_well_e=500.0, black_level_dn=7) == pytest.approx(500)


def test_relative_to_the_variance_or_to_full_scale() -> None:
    """Of 8 bits, a standard deviation of one digital number is 0.0039 of the range, and 9 dB less 0.0014."""
    image = [[0.0, 0.0], [8.0, 8.0]]  # standard deviation 4
    assert sigma_dn(-20, "image-variance", image, gain_e_per_dn=2.0) == pytest.approx(0.2)
    assert sigma_dn(0, "full-scale", image, bits=8, black_level_dn=15) == pytest.approx(240)
    one_dn_db = -20 * np.log10(255)
    shares = [sigma_dn(one_dn_db - less, "full-scale", image, bits=8) / 255 for less in (0, 9)]
    assert shares == pytest.approx([0.0039, 0.0014], abs=5e-5)


def test_a_photon_level_is_an_exposure_and_adds_nothing() -> None:
    """The same metering as `exposure.kind = "noise-level"`; at 1 e/DN photon noise alone is left."""
    assert level(-9, "photon").sigma_dn(Sensor(), []) is None
    assigned = ['added_noise={ level_db = -9, relative_to = "photon" }']
    recipe = load_plan(QUICKSTART, assigned).recipe
    other = load_plan(QUICKSTART, ["exposure.kind=noise-level", "exposure.level_db=-9"]).recipe
    assert recipe.exposure_s is recipe.exposure is None
    assert recipe.metering == other.metering
    assert scaled(recipe, 10, "binned").metering == scaled(other, 10, "binned").metering
    assert scaled(recipe, 10, "same-photons").metering == recipe.metering


@pytest.mark.parametrize("gain", [1.0, 2.0])
@pytest.mark.parametrize("noise", ["none", "shot", "full"])
@pytest.mark.parametrize("sigma", [0.7, 25.0])
def test_the_draws_have_the_variance_and_leave_the_sensors_noise(noise: str, gain: float, sigma: float) -> None:
    """The difference of a frame with and without added noise, before rounding, is normal with sigma.

    Rounding adds 1/12 DN^2 to the noisy frame: for sigma >= 0.7 its characteristic function exp(-2 pi^2 sigma^2) < 1e-4
    leaves it independent. Both differences share the rounding of the frame without: 1/12 DN^2 with read noise; of whole
    electrons at 2 e/DN half are off by a half, 1/8 DN^2; none at 1 e/DN, nor of the mean of 1000 e. Variance of a
    variance: 2 sigma^4 / n; of a mean: sigma^2 / n. Five standard errors.
    """
    read = {"read_noise_e": 3.0} if noise == "full" else {}
    sensor = Sensor.model_validate({"noise": noise, "gain_e_per_dn": gain, "black_level_dn": 500, **read})
    flat = [RegionImage(ROI, np.full((ROI.rows, ROI.columns), 1000.0, dtype=np.float32))]
    plain, noisy, again = (
        expose_regions(sensor, flat, "key", exposure_s=1e-3, added=added)[0].image.astype(float)
        for added in (None, AddedDn(sigma, "other"), AddedDn(sigma, "another"))
    )
    rounding = {"none": 0.0, "shot": 1 / 8 if gain == 2 else 0.0, "full": 1 / 12}[noise]
    variance = sigma**2 + 1 / 12 + rounding
    difference = (noisy - plain).ravel()
    assert abs(difference.var() - variance) < 5 * variance * np.sqrt(2 / N)
    assert abs(difference.mean()) < 5 * np.sqrt(variance / N)
    assert abs(np.corrcoef(difference, (again - plain).ravel())[0, 1] - rounding / variance) < 5 / np.sqrt(N)
    if noise != "none":
        own = np.corrcoef(difference, plain.ravel())[0, 1] + rounding / np.sqrt(variance * plain.var())
        assert abs(own) < 5 / np.sqrt(N)
    added_e2 = variance_e2(sensor, flat[0].image, 1e-3, sigma) - variance_e2(sensor, flat[0].image, 1e-3)
    # Of counts of electrons the variance has no rounding, but with added noise it has.
    assert added_e2 == pytest.approx(gain**2 * sigma**2 + (noise != "full" and gain == 1) / 12)


def test_a_region_has_the_noise_of_its_pixels() -> None:
    whole, part = Roi(-3, 0, 20, 30), Roi(4, 5, 6, 7)
    sensor, added = Sensor(noise="none", black_level_dn=100), AddedDn(9.0, "key")
    images = [RegionImage(roi, np.zeros((roi.rows, roi.columns), dtype=np.float32)) for roi in (whole, part)]
    of_whole, of_part = (expose_regions(sensor, [i], "k", exposure_s=1.0, added=added)[0].image for i in images)
    assert np.array_equal(of_whole[whole.slices(part)], of_part)


REGIONS = ("regions.kind=leds", "regions.margin_px=3")
SETS = {
    "peak": ("added_noise.level_db=-30", *REGIONS),
    "image-variance": ("added_noise.level_db=-10",),
    "full-scale": ("added_noise.level_db=-50",),
}


def test_a_set_whose_level_is_an_exposure_is_complete_and_valid(tmp_path: Path) -> None:
    """No noise is added, and none is missed."""
    small = [one for one in SMALL if not one.startswith("exposure_s")]
    plan = load_plan(QUICKSTART, [*small, "poses.count=1", 'added_noise={ level_db = -9, relative_to = "photon" }'])
    assert vr.generate(plan, tmp_path / "set")
    assert not vr.generate(plan, tmp_path / "set")  # nothing is left to do
    assert vr.verify(tmp_path / "set") == []


@pytest.mark.parametrize("relative_to", SETS)
def test_a_frame_has_the_noise_that_its_truth_states(relative_to: str, tmp_path: Path) -> None:
    """Noise-free but for it: 2 e/DN, no photon noise. Residuals are those of rounding and of normal numbers."""
    plan = load_plan(
        QUICKSTART,
        [
            *(
                *SMALL,
                "poses.count=1",
                "expected=true",
                'sensor={ noise="none", gain_e_per_dn=2.0, black_level_dn=900 }',
            ),
            *(f"added_noise.relative_to={relative_to}", *SETS[relative_to]),
        ],
    )
    vr.generate(plan, tmp_path / "set")
    assert vr.verify(tmp_path / "set") == []
    (truth,) = read_table(tmp_path / "set/truth.parquet", TruthRow)
    sigma = truth.added_noise_dn
    assert sigma is not None
    images = []
    for folder in ("frames", "expected"):
        with OpenEXR.File(str(tmp_path / f"set/{folder}/000000.exr"), separate_channels=True) as file:
            images.append(np.concatenate([part.channels["Y"].pixels.ravel().astype(float) for part in file.parts]))
    dn, signal = images[0], images[1] / 2
    size = {"peak": signal.max(), "image-variance": signal.std(), "full-scale": 4095 - 900}[relative_to]
    # expected images are stored in float32
    assert sigma == pytest.approx(10 ** (plan.recipe.added_noise.level_db / 20) * size, rel=1e-6)  # type: ignore[union-attr]
    noise = dn - 900 - signal
    assert signal.max() + 6 * sigma < 4095 - 900, "nothing is clipped"
    assert 6 * sigma < 900
    variance = sigma**2 + 1 / 12
    assert abs(noise.var() - variance) < 5 * variance * np.sqrt(2 / noise.size)
    (frame,) = read_table(tmp_path / "set/frames.parquet", FrameRow)
    assert "noise" not in " ".join(frame.model_dump()), "the device is not told"


def test_bound_and_budget_count_added_noise(tmp_path: Path) -> None:
    """Added noise of sigma DN at 2 e/DN counts like read noise of 2 sigma electrons."""
    shared = (*SMALL, "poses.count=1", "bound=true", *REGIONS)
    sensor = 'noise="full", gain_e_per_dn=2.0, full_well_e=8000.0'
    added = ("added_noise.relative_to=full-scale", f"added_noise.level_db={20 * math.log10(10 / 4095)!r}")
    plans = {
        "added": load_plan(QUICKSTART, [*shared, f"sensor={{ {sensor} }}", *added]),
        "read": load_plan(QUICKSTART, [*shared, f"sensor={{ {sensor}, read_noise_e=20.0 }}"]),
        "none": load_plan(QUICKSTART, [*shared, f"sensor={{ {sensor} }}"]),
    }
    bounds, budgets = [], []
    for name, plan in plans.items():
        vr.generate(plan, tmp_path / name)
        budgets.append(vr.budget(plan, bound=False).total.total_mm)
        (truth,) = read_table(tmp_path / name / "truth.parquet", TruthRow)
        assert truth.added_noise_dn == (pytest.approx(10.0) if name == "added" else None)
        assert truth.bound_m2 is not None
        bounds.append(np.array(truth.bound_m2))
    assert bounds[0] == pytest.approx(bounds[1], rel=1e-9)
    assert budgets[0] == pytest.approx(budgets[1], rel=1e-9)
    assert budgets[0] > 1.02 * budgets[2]
    assert np.trace(bounds[0].reshape(3, 3)) > 1.05 * np.trace(bounds[2].reshape(3, 3))


REFUSALS = {
    "added_noise.relative_to": ['added_noise={ level_db = 0, relative_to = "signal" }'],
    "needs full frames": ['added_noise={ level_db = 0, relative_to = "image-variance" }', "regions.kind=leds"],
    'relative_to = "photon" sets the exposure time': [
        'added_noise={ level_db = 0, relative_to = "photon" }',
        "exposure.kind=noise-level",
        "exposure.level_db=0",
    ],
    'with relative_to = "photon" at least -60': ['added_noise={ level_db = -70, relative_to = "photon" }'],
    "[motion] needs a fixed time; replace [added_noise]": [
        'added_noise={ level_db = 0, relative_to = "photon" }',
        "motion.linear_velocity_m_s=[1, 0, 0]",
    ],
}


@pytest.mark.parametrize("words", REFUSALS)
def test_a_level_that_is_impossible_is_refused_in_one_line(words: str) -> None:
    with pytest.raises(InputError) as refusal:
        load_plan(QUICKSTART, REFUSALS[words])
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_binned_pixels_have_less_of_it() -> None:
    """The mean of 100 independent numbers: a tenth of sigma, 20 dB less. With as many photons as before it stays."""
    recipe: Recipe = load_plan(QUICKSTART, ["added_noise={ level_db = -5, relative_to = 'peak' }"]).recipe
    for mode, level_db in (("binned", -25.0), ("same-photons", -5.0)):
        noise = scaled(recipe, 10, mode).added_noise  # type: ignore[arg-type]
        assert noise is not None
        assert noise.level_db == pytest.approx(level_db)


def test_readings_of_a_level_are_swept_with_their_own_exposures() -> None:
    """A photon level sets the time; the others keep the recipe's."""
    sweep = 'sweep=[{ key = "added_noise.relative_to", values = ["photon", "peak"] }]'
    plan = load_plan(QUICKSTART, ["added_noise.level_db=-9", sweep])
    assert plan.cells is not None
    photon, peak = (plan.cells.plan(number).recipe for number in range(2))
    assert photon.exposure_s is None
    assert peak.exposure_s == load_plan(QUICKSTART).recipe.exposure_s
