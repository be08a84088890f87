"""Measure the figures of docs/downlink.md.

    python docs/measure_downlink.py [SECTION ...]

Sections: `waves` (integrals of the waves against numerical ones), `codes` (parts of codes that are found twice),
`flicker` (modulation against IEEE 1789), `burst_cost` (time of a further frame of a burst), `bit_errors` (against
theory), `identities` (decoded from codes), `panels` (decoded from packets; packets found in random chips),
`motion` (positions by a rolling shutter in motion), `striped` (centres of striped LED images), `cut` (those that the
border cuts), `tones` (frequencies of LED images), `photograph` (a real one; its path is given by --photograph).
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time

import measure_motion
import measure_receiver
import measure_striped
import numpy as np
from measure import Measurement, heading, number, row
from numpy.typing import NDArray

import vlcrender as vr
from vlcrender.config.toml_model import check, read_toml
from vlcrender.dataset.recipe.timeline import Burst
from vlcrender.dataset.run.frame_job import Job, make_frame
from vlcrender.modulation.codes import code_book
from vlcrender.modulation.flicker import flicker_of
from vlcrender.modulation.keys import Downlink
from vlcrender.modulation.transmission import Transmitter, led_waves
from vlcrender.modulation.wave import Wave
from vlcrender.scene.loader import build_scene
from vlcrender.scene.schema import SceneSettings

Floats = NDArray[np.float64]
ROOT = Path(__file__).parent.parent
EXPOSURE_S = 40e-6
EXPOSURES = 40
POINTS = 1 << 22
"""Points of the midpoint rule. It is off by at most half a point's share of the step at each edge: 7e-7 for three edges
from 0 to 2."""
BURSTS = 8
FURTHER_FRAMES = 2
SENDERS: dict[str, dict[str, object]] = {
    "code": {"send": "code"},
    "code, depth 0.5": {"send": "code", "depth": 0.5},
    "packet": {"send": "packet"},
    "tone": {"send": "tone"},
    "pwm, duty 0.2": {"send": "pwm", "duty": 0.2},
    "mains, depth 0.3": {"send": "mains", "depth": 0.3},
}


@dataclass(frozen=True)
class Chosen:
    """What the command line asks for."""

    measurement: Measurement
    photographs: Sequence[Path] = ()


def waves(chosen: Chosen) -> None:
    """Row gains against a numerical integral of the wave's definition, and means over a period."""
    heading("wave", "largest difference", "largest |mean over a period - 1|")
    for name, table in SENDERS.items():
        downlink = check(table, Downlink, name)
        transmitter = Transmitter(0, "led[0]", downlink, (0,), (3.5, 2.5, 3.45))
        wave = led_waves([transmitter], seed=1)[0]
        starts = np.random.default_rng(1).uniform(0, 1, EXPOSURES)
        gains = wave.mean(starts, EXPOSURE_S)
        numerical = [_midpoint_mean(downlink, wave, start) for start in starts.tolist()]
        over_period = wave.mean(starts, wave.period_s)
        row(name, f"{np.abs(gains - numerical).max():.1e}", f"{np.abs(over_period - 1).max():.1e}")


def _midpoint_mean(downlink: Downlink, wave: Wave, start_s: float) -> float:
    times = start_s + (np.arange(POINTS) + 0.5) * (EXPOSURE_S / POINTS)
    periods = times * (1 + wave.clock_error) / wave.nominal_period_s + wave.start_phase
    return float(_defined(downlink, wave.bits, periods % 1.0).mean())


def _defined(downlink: Downlink, bits: str | None, phase: Floats) -> Floats:
    """The wave at each phase, as datasets/FORMAT.md defines it."""
    depth = downlink.modulation_depth
    if downlink.send == "mains":
        return np.asarray(1 + depth * np.cos(2 * np.pi * phase))
    share = downlink.lit_share
    if bits is None:
        is_lit = phase < share
    else:
        is_lit = np.array([bit == "1" for bit in bits])[np.floor(phase * len(bits)).astype(int)]
    lit = 1 / (share + (1 - share) * (1 - depth))
    return np.where(is_lit, lit, lit * (1 - depth))


def codes(chosen: Chosen) -> None:
    """How many parts of the codes of 1225 LEDs are found elsewhere in the book, or differ there in one chip alone."""
    book = np.array([[int(chip) for chip in code] for code in code_book(1225, 32)])
    places = (np.arange(32)[:, None] + np.arange(32)) % 32
    heading("chips", "found twice", "found twice but for one chip")
    for chips in (8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28):
        parts = book[:, places[:, :chips]].reshape(-1, chips) @ (1 << np.arange(chips))
        found, counts = np.unique(parts, return_counts=True)
        twice = counts[np.searchsorted(found, parts)] > 1
        near = twice.copy()
        for place in range(chips):
            near |= np.isin(parts ^ (1 << place), found)
        row(chips, f"{twice.mean():.2%}", f"{near.mean():.2%}")


def flicker(chosen: Chosen) -> None:
    """The office's LEDs: worst line of a spectrum against the limits of IEEE 1789."""
    tree = read_toml(ROOT / "scenes/office.toml")
    heading("sends", "limit", "modulation", "at", "of the limit", "LEDs beyond")
    more: dict[str, dict[str, object]] = {
        "code, 50 us chips": {"chip_us": 50.0},
        "packet, 125 us chips": {"send": "packet", "chip_us": 125.0},
    }
    for name, table in {**SENDERS, **more}.items():
        panels = [{**tree["panels"][0], "downlink": table}]
        scene = build_scene(check({**tree, "panels": panels}, SceneSettings, name), name)
        (found,) = flicker_of(scene.leds.transmitters)
        for limit, line, beyond in (
            ("low risk", found.worst.low_risk, found.low_risk_exceeded),
            ("no effect", found.worst.no_effect, found.no_effect_exceeded),
        ):
            own = [f"{number(line.percent)} %", f"{number(line.frequency_hz, 4)} Hz", f"{line.share:.2f}"]
            row(name, limit, *own, f"{beyond} of {found.leds}")


def burst_cost(chosen: Chosen) -> None:
    """CPU time (wall time) of a further frame of a burst over that of the first; recipe downlink_codes, no bound."""
    plan = vr.load_recipe("downlink_codes")
    burst = Burst(frames=1 + FURTHER_FRAMES, frame_rate_hz=30.0)
    heading("what is read out", "bursts", "first frame", "a further frame", "ratio (smallest to largest); wall")
    for name, regions in (("full frame", None), ("regions of LEDs", plan.recipe.regions)):
        recipe = plan.recipe.model_copy(update={"burst": burst, "bound": False, "regions": regions})
        with TemporaryDirectory(dir=chosen.measurement.out) as folder:
            for part in ("frames", "previews"):
                (Path(folder) / part).mkdir()
            settings = plan.scene.settings.model_dump_json()
            job = Job(recipe.model_dump_json(), settings, str(plan.scene.folder), folder)
            seconds = np.zeros((1 + BURSTS, burst.frames, 2))
            for number in np.ndindex(seconds.shape[:2]):
                start = process_time(), perf_counter()
                make_frame(job, number[0] * burst.frames + number[1])
                seconds[number] = np.subtract((process_time(), perf_counter()), start)
        first, further = seconds[1:, 0], seconds[1:, 1:].mean(axis=1)  # the first burst compiles kernels
        ratios = further / first
        cpu, wall = np.median(ratios, axis=0)
        own = [f"{np.median(some[:, 0]):.2f} s" for some in (first, further)]
        ends = f"{ratios[:, 0].min():.2f} to {ratios[:, 0].max():.2f}"
        row(name, BURSTS, *own, f"{cpu:.2f} ({ends}); {wall:.2f}")


def motion(chosen: Chosen) -> None:
    """Rolling shutter of 10 us a row in motion: ignored, with a gyroscope of 0.3 deg/s, and with the rate estimated."""
    measure_motion.projected()
    measure_motion.rendered(chosen.measurement)


def bit_errors(chosen: Chosen) -> None:
    """Bit errors in Manchester code against theory."""
    measure_receiver.bit_errors()


def identities(chosen: Chosen) -> None:
    """Codes at 10/40/25 us over the poses of office200 and as many others, identified in single frames."""
    measure_receiver.identities(chosen.measurement)


def given(chosen: Chosen) -> None:
    """Positions with decoded identities against given ones, on the same frames."""
    measure_receiver.given(chosen.measurement)


def panels(chosen: Chosen) -> None:
    """Packets at 10/40/50 us over the poses of office200, by one frame of a burst and by two; no map."""
    measure_receiver.panels(chosen.measurement)


def striped(chosen: Chosen) -> None:
    """Centres of striped LED images, px: by edges, by a plain centroid, and of the same images without stripes."""
    measure_striped.print_centres(chosen.measurement)


def cut(chosen: Chosen) -> None:
    """Centres of lamps that the border of the picture cuts, px."""
    measure_striped.print_cut()


def tones(chosen: Chosen) -> None:
    """Frequencies of tones in an LED image."""
    measure_striped.print_tones()


def photograph(chosen: Chosen) -> None:
    """A real photograph of five modulated LEDs (Luxapose), as given by --photograph; and refusals."""
    measure_striped.print_photograph(chosen.photographs, chosen.measurement.out)


SECTIONS: dict[str, Callable[[Chosen], None]] = {
    section.__name__: section
    for section in (
        waves,
        codes,
        flicker,
        burst_cost,
        bit_errors,
        identities,
        given,
        panels,
        motion,
        striped,
        cut,
        tones,
        photograph,
    )
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the sections that are named, by default all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {', '.join(SECTIONS)}; default: all")
    parser.add_argument("--out", type=Path, default=Path("out/measure"), help="folder of the datasets")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--photograph", type=Path, action="append", default=[], help="may be repeated")
    asked = parser.parse_args(arguments)
    unknown = [name for name in asked.sections if name not in SECTIONS]
    if unknown:
        parser.error(f"SECTION {unknown[0]}: unknown; allowed: {', '.join(SECTIONS)}")
    asked.out.mkdir(parents=True, exist_ok=True)
    chosen = Chosen(Measurement(asked.out, asked.workers), asked.photograph)
    for name in asked.sections or SECTIONS:
        print(f"\n## {name}: {SECTIONS[name].__doc__}", flush=True)
        SECTIONS[name](chosen)


if __name__ == "__main__":
    main()
