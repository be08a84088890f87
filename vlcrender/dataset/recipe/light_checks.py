"""Checks of a recipe against what the LEDs of its scene transmit."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from vlcrender.dataset.recipe.auto_exposure import PeakMetering
from vlcrender.errors import InputError
from vlcrender.modulation.transmission import nominal_waves
from vlcrender.modulation.wave import TwoLevelWave, Wave
from vlcrender.rendering.electron_rates import ElectronRates
from vlcrender.scene.loader import Scene
from vlcrender.sensor.radiometry import detectors

if TYPE_CHECKING:
    from vlcrender.dataset.recipe.recipe import Recipe

PHASES = 257
"""Phases of a wave at which its mean over an exposure is compared."""
NEAR_MULTIPLE = 0.02
"""Part of a period: shots whose starts are a whole number of periods and less than this apart show the same chips."""


def check_light(recipe: "Recipe", scene: Scene, source: str, scale: int = 1) -> None:
    """Raise InputError, which starts with `source`, where a recipe asks for what the light of its scene cannot do.

    recipe: as scaled by `scale`.
    """
    downlinks = [t.downlink for t in scene.leds.transmitters if t.downlink is not None and t.downlink.identifies]
    if recipe.demodulation == "pixels" and not downlinks:
        raise InputError(
            f'{source}: demodulation = "pixels": no LED of scene {scene.name!r} transmits what identifies it; give '
            'panels or LEDs a downlink with send = "code", "packet" or "tone", or set demodulation = "given"'
        )
    if recipe.map == "sent":
        others = sorted({downlink.send for downlink in downlinks if downlink.send != "packet"})
        if others:
            raise InputError(
                f'{source}: map = "sent": LEDs of scene {scene.name!r} send "{others[0]}", which tells no position; '
                'have all send "packet", or set map = "given"'
            )
    waves = nominal_waves(scene.leds.transmitters)
    if recipe.bound and waves and any(mounted.camera.glare is not None for mounted in recipe.cameras):
        raise InputError(
            f"{source}: bound = true: is not computed for a lens with glare where light is modulated; remove bound or "
            "[camera.glare]"
        )
    row_us = 1e6 * max(mounted.camera.shutter.row_time_s for mounted in recipe.cameras)
    shortest_us = 1e6 * min((_shortest_level_s(wave) for wave in waves.values()), default=np.inf)
    if scale > 1 and shortest_us < row_us:
        raise InputError(
            f"{source}: --scale {scale}: a binned line takes {row_us:g} us, and the shortest level of the LEDs' waves "
            f"{shortest_us:g} us: stripes would vanish; choose a smaller --scale, or longer chips or periods"
        )


def light_warnings(recipe: "Recipe", scene: Scene) -> Iterator[str]:
    """A line for each likely mistake: lit LEDs that saturate the sensor, and bursts that repeat the same phase."""
    waves = nominal_waves(scene.leds.transmitters)
    if not waves:
        return
    saturation_e = recipe.sensor.saturation_e
    luminances = dict(zip(scene.leds.ids.tolist(), scene.leds.luminances_cd_m2.tolist(), strict=True))
    if recipe.exposure_s is not None:
        rate = max(ElectronRates.of(scene, recipe.camera, d).led for d in detectors(recipe.sensor))
        electrons = max(rate * luminances[led] * _peak(wave, recipe.exposure_s) for led, wave in waves.items())
        electrons *= recipe.exposure_s
        if electrons > saturation_e:
            yield (
                f"exposure_s = {recipe.exposure_s:g}: the brightest LED, when lit, gives a pixel {electrons:.0f} "
                f"electrons, and {saturation_e:.0f} saturate it; shorten the exposure to keep its stripes"
            )
    elif isinstance(recipe.exposure, PeakMetering):
        share = recipe.exposure.share_of_saturation
        lit = max(float(wave.levels.max()) if isinstance(wave, TwoLevelWave) else 1.0 for wave in waves.values())
        if share * lit > 1:
            yield (
                f"exposure.share_of_saturation = {share:g}: metering counts the mean of the light, and lit LEDs have "
                f"up to {lit:.3g} times as much; choose at most {1 / lit:.2g} to keep their stripes"
            )
    if recipe.burst is not None and recipe.burst.frames > 1:
        frame_s = 1 / recipe.burst.frame_rate_hz
        for period_s in sorted({w.nominal_period_s for w in waves.values() if w.bits is not None}):
            periods = frame_s / period_s
            if abs(periods - round(periods)) < NEAR_MULTIPLE:
                yield (
                    f"burst.frame_rate_hz = {recipe.burst.frame_rate_hz:g}: a frame takes {periods:.3f} periods of "
                    f"{period_s * 1e3:g} ms of the LEDs' waves, so that each frame of a burst shows the same chips; "
                    "choose another rate"
                )


def _shortest_level_s(wave: Wave) -> float:
    """The shortest time for which a wave keeps its level; half a period of a wave without levels."""
    if isinstance(wave, TwoLevelWave):
        return wave.nominal_period_s * min(wave.lengths) / sum(wave.lengths)
    return wave.nominal_period_s / 2


def _peak(wave: Wave, exposure_s: float) -> float:
    """Largest mean of a wave over an exposure."""
    starts_s = np.linspace(0.0, wave.period_s, PHASES)
    return float(wave.mean(starts_s, exposure_s).max())
