"""Sections of measure_downlink.py about the receiver: bit errors, identities by codes, panels by packets."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from math import sqrt
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from measure import Measurement, figure, heading, row
from measure_belief import copied
from numpy.typing import NDArray

import estimator as est
from estimator.evaluate.identities import IdentityClass, IdentityScore, score_identities
from estimator.io.dataset import Dataset
from estimator.io.downlink import Packets
from estimator.io.estimates import EstimateRow
from estimator.io.truth import WHOLE, read_true_map, read_truth
from estimator.receiver.bits import bit_error_rates, chip_levels
from estimator.receiver.packets import PacketFormat, decode_packet
from estimator.receiver.panels import find_groups
from estimator.receiver.receive import receive_frames
from estimator.receiver.signal import ChipWave, Signal, led_image, overlaps
from estimator.spots.lamps import lamps_of

Floats = NDArray[np.float64]
ROW_TIME_S = 10e-6
READ_NOISE_E = 3.0
PIXELS_A_LINE = 60
LINES_A_CHIP = 5
BITS = 10_000
SEED_OF_OFFICE200 = 200
GIVEN_FRAMES = 40
GIVEN_VARIANTS = ("gravity-fit", "up2p", "ml")
LEDS_OF_PANEL = 25
RANDOM_PANELS = 10_000
OFFICE200 = 200
FRESH_SEED = 77
"""Of other poses than those by which the thresholds of the receiver were chosen."""


def bit_errors() -> None:
    """Error rates of bits in Manchester code against theory; 3 standard deviations are those of a binomial number."""
    heading("exposure / chip", "e/px, lit", "bits", "wrong", "theory", "standard deviations off")
    for ratio in (0.4, 1.0, 1.3):
        for electrons in (0.2, 1.0, 2.0):
            total, wrong, expected, variance = _bit_errors(ratio, electrons)
            off = (wrong - expected) / sqrt(variance) if variance else 0.0
            row(ratio, electrons, total, f"{wrong / total:.4f}", f"{expected / total:.4f}", f"{off:+.1f}")


def _bit_errors(ratio: float, electrons: float) -> tuple[int, int, float, float]:
    """Bits, wrong ones, and the number and its variance by theory. Every third bit counts: neighbours share noise."""
    generator = np.random.default_rng([12, round(10 * ratio), round(10 * electrons)])
    lines, chip_s, read_e2 = 250, LINES_A_CHIP * ROW_TIME_S, PIXELS_A_LINE * READ_NOISE_E**2
    bright_e = np.full(lines, PIXELS_A_LINE * electrons)
    mean_e2 = bright_e / 2 + read_e2
    empty = Signal(np.arange(lines) * ROW_TIME_S, ratio * chip_s, np.zeros(lines), 1 / mean_e2)
    total = wrong = 0
    expected = variance = 0.0
    while total < BITS:
        bits = generator.integers(0, 2, 40)
        chips = np.column_stack([bits, 1 - bits]).ravel()
        phase = float(generator.random())
        shares = overlaps(empty, chip_s, phase)
        light_e = bright_e * (shares @ chips[: shares.shape[1]])
        level = (generator.poisson(light_e) + sqrt(read_e2) * generator.normal(size=lines)) / bright_e
        levels, _ = chip_levels(replace(empty, level=level), chip_s, phase)
        firsts = np.arange(4, shares.shape[1] - 5, 6)
        rates = bit_error_rates(shares, bright_e, mean_e2, light_e + read_e2, firsts)
        wrong += int(((levels[firsts] > levels[firsts + 1]) != (chips[firsts] == 1)).sum())
        total += len(firsts)
        expected += float(rates.sum())
        variance += float((rates * (1 - rates)).sum())
    return total, wrong, expected, variance


def received_rows(folder: Path, used: int | None = None) -> tuple[Dataset, list[EstimateRow]]:
    """A dataset, and a row a frame that holds the identities of its LED images and no position.

    Of each burst the first `used` frames are received, the others have no identities; None is all.
    """
    dataset = est.read_dataset(folder)
    rows = []
    for _, records in groupby(dataset.frames, lambda record: record.burst):
        every = list(records)
        some = every[:used]
        frames = [est.read_frame(dataset, record, with_other_cameras=False) for record in some]
        received = [frame.identities for frame in receive_frames(frames)]
        received += [()] * (len(every) - len(some))
        for record, found in zip(every, received, strict=True):
            row_of = EstimateRow(
                frame=record.frame,
                status="failed",
                reason="receive: no position wanted",
                position_m=None,
                ranges=(),
                time_s=0.0,
                identities=found,
            )
            rows.append(row_of)
    return dataset, rows


def _score(folder: Path, dataset: Dataset, rows: Sequence[EstimateRow]) -> IdentityScore:
    truth = read_truth(folder / "truth.parquet", len(rows))
    true_map = () if dataset.leds else read_true_map(folder / "truth_map.parquet")
    found = score_identities(rows, truth, dataset, true_map)
    if found is None:
        raise SystemExit(f"{folder}: no identities to decode")
    return found


def _print_classes(name: str, classes: Sequence[IdentityClass]) -> None:
    heading(name, "LED images", "right", "share", "wrong", "rejected", "missed")
    for one in classes:
        if one.leds:
            ends = f"{one.low:g} and more" if one.high is None else f"{one.low:g} to {one.high:g}"
            row(ends, one.leds, one.right, f"{one.right / one.leds:.3f}", one.wrong, one.rejected, one.missed)


def print_identities(folder: Path, per_frame: int = 4) -> None:
    """Identities of a dataset: totals, shares by lines, distance and tilt, and frames with enough of them."""
    dataset, rows = received_rows(folder)
    found = _score(folder, dataset, rows)
    figure("whole LED images", found.leds)
    figure("right", f"{found.right} ({found.right / found.leds:.3f})")
    long = [one for one in found.by_rows if one.low >= 60]
    figure("right, of those of 60 lines or more", f"{sum(o.right for o in long) / sum(o.leds for o in long):.3f}")
    figure("wrong; rejected; missed", f"{found.wrong}; {found.rejected}; {found.missed}")
    figure("wrong identities of other LED images", found.wrong_elsewhere)
    figure("bit errors of bits", f"{found.bit_errors} of {found.bits}")
    enough = [sum(one.led is not None for one in one_row.identities or ()) >= per_frame for one_row in rows]
    figure(f"frames with {per_frame} identities or more", f"{np.mean(enough):.3f} of {len(rows)}")
    _print_classes("lines", found.by_rows)
    _print_classes("distance, m", found.by_distance)
    _print_classes("angle off the zenith, deg", found.by_tilt)


def print_best_panels(folder: Path, used: int) -> None:
    """Bursts whose best panel was decoded by the first `used` frames: that with the most whole LED images."""
    dataset, rows = received_rows(folder, used)
    truth = read_truth(folder / "truth.parquet", len(rows))
    found = _score(folder, dataset, rows)
    decoded: Counter[bool] = Counter()
    for _, group in groupby(zip(dataset.frames, rows, truth, strict=True), lambda one: one[0].burst):
        (_, first, true), *_ = group
        panels: dict[int, list[tuple[float, float]]] = {}
        for led in true.leds:
            if led.visible_fraction >= WHOLE:
                panels.setdefault(led.led // LEDS_OF_PANEL, []).append((led.u_px, led.v_px))
        if panels:
            best = np.array(max(panels.values(), key=len))
            at = [(one.u_px, one.v_px) for one in first.identities or () if one.led is not None]
            near = [bool((np.hypot(*(best - place).T) < 30).any()) for place in at]
            decoded[any(near)] += 1
    figure("bursts whose best panel was decoded", f"{decoded[True] / decoded.total():.3f} of {decoded.total()}")
    figure("LED images right, wrong", f"{found.right}, {found.wrong + found.wrong_elsewhere}")


def print_false_packets(folder: Path, panels: int = RANDOM_PANELS) -> None:
    """Packets found where the LED images of a dataset's first frames of bursts show random balanced chips instead.

    Half of the panels repeat random chips, delayed as packets are; in the other half each LED repeats chips of its own.
    Lines, their noise and the grouping are those of the frames.
    """
    dataset = est.read_dataset(folder)
    generator = np.random.default_rng(13)
    groups = list(_groups(dataset))
    heading("random chips", "panels", "packets found")
    for common in (True, False):
        found = 0
        for number in range(panels // 2):
            group = groups[number % len(groups)]
            found += group.decoded(generator, common)
        row("of the panel" if common else "of each LED", panels // 2, found)


@dataclass(frozen=True)
class _Group:
    """LED images that may be of one panel: their signals, and the ways to lay them over it."""

    signals: tuple[Signal, ...]
    hypotheses: tuple[NDArray[np.int64], ...]
    packets: Packets

    def decoded(self, generator: np.random.Generator, common: bool) -> bool:
        """Whether random chips are taken as a packet."""
        form = PacketFormat(self.packets)
        balanced = np.arange(form.length) % 2
        error, phase = self.packets.clock_error * generator.normal(), form.length * generator.random()
        of_panel = generator.permutation(balanced)
        indices = self.hypotheses[int(generator.integers(len(self.hypotheses)))]
        images = []
        for signal, index in zip(self.signals, indices, strict=True):
            chips = of_panel if common else generator.permutation(balanced)
            late = phase - self.packets.delays_chips[index]
            wave = ChipWave(chips, self.packets.chip_us * 1e-6 / (1 + error), self.packets.depth, 0.0, late)
            mean = float(np.percentile(signal.level, 90)) / 2
            noise = generator.normal(size=len(signal)) / np.sqrt(signal.weight)
            images.append([replace(signal, level=mean * wave.gains(signal.start_s, signal.exposure_s) + noise)])
        return decode_packet(images, self.hypotheses, self.packets) is not None


def _groups(dataset: Dataset) -> Iterator[_Group]:
    """Groups that show as many chips as a packet has bits, in the first frame of each burst."""
    if dataset.downlink is None:
        return
    (packets,) = (one for one in dataset.downlink.transmitters if isinstance(one, Packets))
    for _, records in groupby(dataset.frames, lambda record: record.burst):
        frame = est.read_frame(dataset, next(records), with_other_cameras=False)
        images = [led_image(lamp, frame) for lamp in lamps_of(frame) if lamp.striped]
        for group in find_groups([frame], [images], packets):
            hypotheses = group.alike()[0]
            laid = np.flatnonzero(hypotheses[0] >= 0)
            signals = tuple(images[group.members[one].numbers[0]].signal for one in laid)
            chips = sum(float(np.ptp(one.start_s)) for one in signals) / (packets.chip_us * 1e-6)
            # A packet cannot be found in fewer chips: such groups would prove nothing.
            if chips >= PacketFormat(packets).bits:
                yield _Group(signals, tuple(one[laid] for one in hypotheses), packets)


def identities(measurement: Measurement) -> None:
    """Codes at 10/40/25 us over the poses of office200 and as many others, identified in single frames."""
    for name, seed in (("identities", SEED_OF_OFFICE200), ("identities-fresh", FRESH_SEED)):
        figure("seed of the poses", seed)
        changes = {"seed": seed, "poses.count": OFFICE200, "bound": False}
        print_identities(measurement.dataset(name, "downlink_codes", changes))


def given(measurement: Measurement) -> None:
    """Positions with identities decoded from pixels, and with the same frames' true identities handed over."""
    changes = {"seed": SEED_OF_OFFICE200, "poses.count": GIVEN_FRAMES, "bound": False}
    decoded = measurement.dataset("decoded", "downlink_codes", changes)
    handed = copied(decoded, "given")
    device = json.loads((handed / "dataset.json").read_text(encoding="utf-8"))
    device["downlink"]["demodulation"] = "given"
    (handed / "dataset.json").write_text(json.dumps(device), encoding="utf-8")
    table = pq.read_table(handed / "frames.parquet")
    place = table.schema.get_field_index("spots")
    spots = [
        [{key: led[key] for key in ("led", "u_px", "v_px")} for led in leds if led["visible_fraction"] >= WHOLE]
        for leds in pq.read_table(handed / "truth.parquet")["leds"].to_pylist()
    ]
    spots_of_frames = pa.array(spots, type=table.schema.field("spots").type)
    pq.write_table(table.set_column(place, table.schema.field("spots"), spots_of_frames), handed / "frames.parquet")
    heading("identities", "variant", "failed", "median", "RMSE (95 % interval)", "NEES (99 % interval)")
    for name, folder in (("decoded", decoded), ("given", handed)):
        est.run(folder, GIVEN_VARIANTS, measurement.workers)
        for score in est.score(folder).variants:
            if score.variant not in GIVEN_VARIANTS or score.error_3d is None or score.rmse_interval is None:
                continue
            ends = score.rmse_interval
            rmse = f"{1e6 * score.error_3d.rmse_m:.1f} um ({1e6 * ends.low_m:.1f} to {1e6 * ends.high_m:.1f})"
            nees = (
                "" if score.nees is None else f"{score.nees.mean:.2f} ({score.nees.low:.2f} to {score.nees.high:.2f})"
            )
            row(
                name,
                score.variant,
                f"{score.failed} of {score.frames}",
                f"{1e6 * score.error_3d.median_m:.1f} um",
                rmse,
                nees,
            )


def panels(measurement: Measurement) -> None:
    """Packets at 10/40/50 us over the poses of office200, two frames of a burst and one; no map."""
    changes = {"seed": SEED_OF_OFFICE200, "poses.count": OFFICE200, "bound": False}
    folder = measurement.dataset("panels", "downlink", changes)
    for frames in (1, 2):
        figure("frames of a burst that are used", frames)
        print_best_panels(folder, frames)
    print_false_packets(folder)
