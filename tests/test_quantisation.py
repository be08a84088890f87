"""Rounding against the noise before it: the law by a normal distribution's sum, the limit, and `generate`'s warning."""

import math

import numpy as np
import pytest
from conftest import ROOT
from scipy import stats

from vlcrender.core.warn_once import warn_once
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run import generate as generate_module
from vlcrender.light.lightmap import bake
from vlcrender.sensor.quantisation import MIN_NOISE_STEPS, noise_steps
from vlcrender.sensor.sensor import Sensor


def worst_bias(steps: float) -> float:
    """Largest error of the mean of rounded normal numbers, digital numbers, by summing their probabilities."""
    means, levels = np.linspace(0, 1, 201)[:, None], np.arange(-20, 22)[None, :]
    shares = stats.norm.cdf((levels + 0.5 - means) / steps) - stats.norm.cdf((levels - 0.5 - means) / steps)
    return float(np.abs((shares * levels).sum(axis=1) - means[:, 0]).max())


def test_the_limit_is_a_tenth_of_the_noise_that_rounding_adds() -> None:
    """Terms left out are exp(-8 pi^2 s^2) / (2 pi), below 1e-4 at the limit."""
    law = math.exp(-2 * (math.pi * MIN_NOISE_STEPS) ** 2) / math.pi
    assert worst_bias(MIN_NOISE_STEPS) == pytest.approx(law, abs=1e-4)
    assert worst_bias(MIN_NOISE_STEPS) < 0.1 / math.sqrt(12) < worst_bias(MIN_NOISE_STEPS - 0.005)


def test_noise_in_digital_numbers_by_hand() -> None:
    full = Sensor(
        noise="full", gain_e_per_dn=4.0, read_noise_e=3.0, adc_noise_dn=1.0, dsnu_e=2.0, dark_current_e_s=20.0
    )
    # 50 e of light, 0.5 s * 20 e/s in the dark, 3^2, (1 * 4)^2 and 2^2
    assert noise_steps(full, 50.0, 0.5) == pytest.approx(math.sqrt(50 + 10 + 9 + 16 + 4) / 4, rel=1e-12)
    assert noise_steps(Sensor(noise="shot", gain_e_per_dn=16.0), 4.0, 0.5) == pytest.approx(2 / 16, rel=1e-12)
    assert noise_steps(Sensor(noise="shot"), 4.0, 0.5) == math.inf  # counts are not rounded
    assert noise_steps(Sensor(noise="none", gain_e_per_dn=16.0), 4.0, 0.5) == math.inf


@pytest.mark.parametrize(
    ("scale", "assignments", "coarse"), [(1, (), False), (4, (), True), (4, ("sensor.iso=400",), False)]
)
def test_a_phones_ten_bits_are_too_few_at_scale_4(
    caplog: pytest.LogCaptureFixture, scale: int, assignments: tuple[str, ...], coarse: bool
) -> None:
    """At scale 4 a step is 81.6 e; background of 384 e, read noise and fixed patterns have some 23 e: 0.28 of it."""
    warn_once.cache_clear()
    plan = load_plan(ROOT / "datasets/office200.toml", assignments, scale)
    for _ in range(2):
        generate_module._warn_of_coarse_steps(plan, bake(plan.scene))
    assert len(caplog.records) == coarse
    assert ("a digital number is 81.6 electrons, and the noise of the background 0.2" in caplog.text) == coarse
