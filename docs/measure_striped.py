"""Sections of measure_downlink.py: centres of striped LED images, and tones of an LED image."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from measure import Measurement, figure, heading, row
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

import estimator as est
from estimator.camera.pose import Pose
from estimator.io.truth import WHOLE, read_truth
from estimator.receiver.signal import Signal
from estimator.receiver.tones import fit_tone
from estimator.solvers.observations import centroid_images
from estimator.spots.detect import detect
from estimator.spots.lamps import lamps_of, light_centre_px
from estimator.spots.led_light import Readout
from estimator.spots.striped import find_lamps

Floats = NDArray[np.float64]
SENSOR_PX = 12_000_000
READ_NOISE_E = 3.0
BACKGROUND_SHARE = 0.01
IMAGES = 200
SAMPLES = 10
CODE_CHIPS = 32
MAX_RUN = 4
DISC, ELLIPSE, SQUARE = (43.0, 43.0, 0.0), (29.0, 20.0, 0.6), (40.0, 40.0, 0.5)
"""Semi-axes, pixels, and rotation, radians: 86 px discs, 58 x 40 px ellipses, squares of 80 px a side."""
CASES: tuple[tuple[str, tuple[float, float, float], bool, tuple[float, float, float], float, float, float], ...] = (
    *(("86 px disc", DISC, False, (10, 40, 25), lit_e, 0.0, np.inf) for lit_e in (2000, 1000, 200, 60)),
    ("86 px disc, blur of 0.7 px", DISC, False, (10, 40, 25), 1000, 0.7, np.inf),
    ("86 px disc, blur of 2 px", DISC, False, (10, 40, 25), 1000, 2.0, np.inf),
    ("86 px disc, saturated at 2/3", DISC, False, (10, 40, 25), 3000, 0.0, 2000.0),
    *(("86 px disc", DISC, False, timing, 1000, 0.0, np.inf) for timing in ((10, 20, 25), (10, 40, 50), (20, 40, 50))),
    ("58 x 40 px ellipse", ELLIPSE, False, (10, 40, 25), 1000, 0.0, np.inf),
    ("80 px square, turned", SQUARE, True, (10, 40, 25), 1000, 0.0, np.inf),
    ("80 px square, sides across lines", (40.0, 40.0, 0.0), True, (10, 40, 25), 1000, 0.0, np.inf),
)
"""Name, shape, whether square, (line, exposure, chip) in microseconds, lit electrons, blur, full well."""
RENDERED_POSES = 20
TONE_TIMINGS = (((10.0, 40.0), 58), ((10.0, 40.0), 120), ((21.03, 60.0), 85))
TONES = 300
CUT_RADIUS_PX = 30.0
CUT_INSIDE_PX = (3.0, 9.0, 15.0, 24.0)
CUT_IMAGES = 100


def print_centres(measurement: Measurement) -> None:
    """Synthetic LED images, then those of rendered frames."""
    heading(
        "LED image", "line / exposure / chip, us", "lit, e", "one spot", "rms u", "rms v", "plain v", "steady v", "NEES"
    )
    for case in CASES:
        _print_case(*case)
    _print_rendered(measurement)


def _print_case(
    name: str,
    shape: tuple[float, float, float],
    square: bool,
    timing_us: tuple[float, float, float],
    lit_e: float,
    blur_px: float,
    full_e: float,
    images: int = IMAGES,
) -> None:
    rng = np.random.default_rng(1)
    line_us, exposure_us, chip_us = timing_us
    size = round((2.9 if square else 2.0) * max(shape[:2])) + 40
    single, off, plain, steady, nees = 0, [], [], [], []
    for _ in range(images):
        centre = size / 2 + rng.uniform(-0.5, 0.5, 2)
        covered = _coverage(size, centre, shape, square)
        if blur_px:
            covered = gaussian_filter1d(gaussian_filter1d(covered, blur_px, 0), blur_px, 1)
        gains = _gains(_code(rng), chip_us, np.arange(size) * line_us + 1e4 * rng.random(), exposure_us)
        image, clipped = _exposed(lit_e * covered * gains[:, None], lit_e, full_e, rng)
        readout = Readout(0, 0, image, image, clipped, READ_NOISE_E**2)
        found = find_lamps([readout], "rows", (MAX_RUN * chip_us + exposure_us) / line_us, SENSOR_PX, square)
        single += len(found) == 1
        if len(found) == 1:
            error = np.array([found[0].u_px, found[0].v_px]) - centre
            off.append(error)
            nees.append(error @ np.linalg.solve(found[0].covariance_px2, error))
        light = np.maximum(image - BACKGROUND_SHARE * lit_e, 0.0) * (covered > 0)
        plain.append(light.sum(axis=1) @ (np.arange(size) + 0.5) / light.sum() - centre[1])
        image, clipped = _exposed(lit_e * covered / 2, lit_e, full_e, rng)
        spot = detect([Readout(0, 0, image, image, clipped, READ_NOISE_E**2)], SENSOR_PX, 0, None, square)[0]
        steady.append(spot.v_px - centre[1])
    u, v = np.sqrt((np.array(off) ** 2).mean(axis=0))
    others = (f"{np.sqrt(np.mean(np.square(some))):.3f}" for some in (plain, steady))
    timing = " / ".join(f"{one:g}" for one in timing_us)
    row(name, timing, f"{lit_e:g}", f"{single} of {images}", f"{u:.4f}", f"{v:.4f}", *others, f"{np.mean(nees):.2f}")


def _exposed(
    expected_e: Floats, lit_e: float, full_e: float, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """An image with background, shot noise, read noise and saturation, and which pixels are saturated."""
    image = rng.poisson(expected_e + BACKGROUND_SHARE * lit_e) + rng.normal(0, READ_NOISE_E, expected_e.shape)
    clipped = np.minimum(image, full_e).astype(np.float32)
    return clipped, clipped >= full_e


def _coverage(size: int, centre: Floats, shape: tuple[float, float, float], square: bool) -> Floats:
    """Share of each pixel that an ellipse or rectangle covers, of SAMPLES^2 points a pixel; exact along axes."""
    a, b, angle = shape
    if square and angle == 0:
        pixels = np.arange(size)[:, None]
        inside = np.minimum(pixels + 1, centre + (a, b)) - np.maximum(pixels, centre - (a, b))
        u, v = np.clip(inside, 0, None).T
        return np.asarray(np.outer(v, u))
    fine = (np.arange(size * SAMPLES) + 0.5) / SAMPLES
    x, y = np.meshgrid(fine - centre[0], fine - centre[1])
    p, q = (np.cos(angle) * x + np.sin(angle) * y) / a, (np.cos(angle) * y - np.sin(angle) * x) / b
    inside = np.maximum(np.abs(p), np.abs(q)) <= 1 if square else p**2 + q**2 <= 1
    return np.asarray(inside.reshape(size, SAMPLES, size, SAMPLES).mean(axis=(1, 3)))


def _code(rng: np.random.Generator) -> Floats:
    """A balanced code with runs of MAX_RUN chips at most, around its end too."""
    while True:
        chips = rng.permutation(np.repeat([0.0, 1.0], CODE_CHIPS // 2))
        ends = np.flatnonzero(np.diff(np.tile(chips, 3)))
        if np.diff(ends).max() <= MAX_RUN:
            return chips


def _gains(chips: Floats, chip_us: float, starts_us: Floats, exposure_us: float) -> Floats:
    """Mean of the chips over each exposure, exact."""
    ends = np.concatenate([[0.0], np.cumsum(chips)])

    def integral(at_us: Floats) -> Floats:
        whole = np.floor(at_us / chip_us / len(chips))
        return np.asarray(
            whole * ends[-1] + np.interp(at_us / chip_us - whole * len(chips), np.arange(len(ends)), ends)
        )

    return (integral(starts_us + exposure_us) - integral(starts_us)) * chip_us / exposure_us


def _print_rendered(measurement: Measurement) -> None:
    """Frames of the recipe downlink_codes: whole LED images against the centroids by the true pose."""
    overrides = {"poses.count": RENDERED_POSES, "bound": False}
    folder = measurement.dataset(f"striped-{RENDERED_POSES}", "downlink_codes", overrides)
    dataset, whole, single, off, nees = est.read_dataset(folder), 0, 0, [], []
    for record, true in zip(dataset.frames, read_truth(folder / "truth.parquet", len(dataset.frames)), strict=True):
        frame = est.read_frame(dataset, record)
        pose = Pose(np.array(true.position_m), np.reshape(true.R_cam_world, (3, 3)))
        lamps = lamps_of(frame)
        places = np.array([(lamp.u_px, lamp.v_px) for lamp in lamps]).reshape(-1, 2)
        for seen in true.leds:
            if seen.visible_fraction < WHOLE:
                continue
            whole += 1
            led = frame.leds[seen.led]
            points_m = np.array([led.position_m])
            image, depth_m = centroid_images(pose, points_m, np.array([4 * led.mean_square_extent_m2]))
            expected = frame.camera.to_pixels(image)[0]
            radius_px = led.half_width_m / depth_m[0] / frame.camera.pixel_angle_rad
            near = np.flatnonzero(np.linalg.norm(places - expected, axis=1) < radius_px)
            if len(near) != 1:
                continue
            single += 1
            lamp = lamps[near[0]]
            error = light_centre_px(lamp, frame.camera) - expected
            off.append(error)
            nees.append(error @ np.linalg.solve(lamp.covariance_px2, error))
    figure("rendered frames; whole LED images", f"{len(dataset.frames)}; {whole}")
    figure("with one spot", f"{single}, {single / max(whole, 1):.4f}")
    u, v = np.sqrt((np.array(off) ** 2).mean(axis=0))
    figure("rms u, v against the true centroid, px; NEES (expected 2)", f"{u:.4f}, {v:.4f}; {np.mean(nees):.2f}")


def print_cut() -> None:
    """Centres of lamps of CUT_RADIUS_PX that the border cuts: uniform discs of 1 000 electrons, and lamps that fade to
    their rim, in codes of a picture with sRGB's curve.
    """
    heading("lamp", "border", "centre inside by", "found", "measured", "rms u", "rms v", "NEES (expected 2)")
    for faded in (False, True):
        for side in ("across the lines", "along the lines"):
            for inside_px in CUT_INSIDE_PX:
                _print_cut(faded, side, inside_px)


def _print_cut(faded: bool, side: str, inside_px: float) -> None:
    rng, size = np.random.default_rng([3, faded, round(inside_px)]), 4 * round(CUT_RADIUS_PX)
    found, off, nees = 0, [], []
    for _ in range(CUT_IMAGES):
        near, middle = inside_px + rng.uniform(-0.5, 0.5), size / 2 + rng.uniform(-0.5, 0.5)
        centre = np.array([middle, near] if side == "across the lines" else [near, middle])
        gains = _gains(np.array([1.0, 0.0]), 200.0, np.arange(size) * 25 + 1e4 * rng.random(), 60.0)
        if faded:
            x, y = np.meshgrid(np.arange(size) + 0.5 - centre[0], np.arange(size) + 0.5 - centre[1])
            light = 1.6 * np.exp(-3 * (x**2 + y**2) / CUT_RADIUS_PX**2) * gains[:, None]
            light = np.clip(light + 0.002 + 0.002 * rng.standard_normal(light.shape), 0, 1)
            coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
            image = np.rint(255 * coded).astype(np.float32)
            readout = Readout(0, 0, image, image, image >= 254, 2.0)
        else:
            covered = _coverage(size, centre, (CUT_RADIUS_PX, CUT_RADIUS_PX, 0.0), square=False)
            image, clipped = _exposed(500.0 * covered * gains[:, None], 1000.0, np.inf, rng)
            readout = Readout(0, 0, image, image, clipped, READ_NOISE_E**2)
        lamps = find_lamps([readout], "rows", 260 / 25, SENSOR_PX)
        found += len(lamps) == 1
        if len(lamps) == 1 and lamps[0].measured:
            error = np.array([lamps[0].u_px, lamps[0].v_px]) - centre
            off.append(error)
            nees.append(error @ np.linalg.solve(lamps[0].covariance_px2, error))
    first = ["faded" if faded else "disc", side, f"{inside_px:g} px", f"{found} of {CUT_IMAGES}", len(off)]
    if not off:
        row(*first, "", "", "")
        return
    u, v = np.sqrt((np.array(off) ** 2).mean(axis=0))
    row(*first, f"{u:.3f}", f"{v:.3f}", f"{np.mean(nees):.2f}")


def print_tones() -> None:
    """Frequencies of square waves, 1 500 to 6 000 Hz, in LED images of so many lines."""
    heading("line / exposure, us", "lines", "median error, Hz", "95 %", "within 100 Hz", "accepted")
    for (line_us, exposure_us), lines in TONE_TIMINGS:
        rng = np.random.default_rng(lines)
        off, accepted = [], 0
        for _ in range(TONES):
            frequency_hz = rng.uniform(1500, 6000)
            start_us = np.arange(lines) * line_us + 1e4 * rng.random()
            gains = _gains(np.array([1.0, 0.0]), 0.5e6 / frequency_hz, start_us, exposure_us)
            half = 0.5 * lines * np.sqrt(1 - np.linspace(-0.99, 0.99, lines) ** 2)
            electrons = 1000.0 * 2 * half
            level = rng.poisson(electrons * gains) / (2 * half) * (1 + 0.02 * rng.standard_normal(lines))
            variance = 1000.0 / (2 * half) + (0.02 * 1000.0) ** 2
            fit = fit_tone(Signal(1e-6 * start_us, 1e-6 * exposure_us, level, 1 / variance), (1000.0, 8000.0))
            if fit is not None and fit.clear:
                accepted += 1
                off.append(abs(fit.frequency_hz - frequency_hz))
        median, most = np.percentile(off, [50, 95])
        within = float((np.array(off) <= 100).mean())
        row(
            f"{line_us:g} / {exposure_us:g}",
            lines,
            f"{median:.0f}",
            f"{most:.0f}",
            f"{within:.3f}",
            f"{accepted} of {TONES}",
        )


def print_photograph(pictures: Sequence[Path], out: Path) -> None:
    """Lamps and positions of the real photograph, if it is there; the same with a wrong axis and a wrong map."""
    from estimator.errors import InputError
    from estimator.photo.session import PhotoRequest, run_photo

    for picture in pictures:
        if not picture.is_file():
            figure("photograph", f"{picture}: not there")
            continue
        maps = {
            "map": _luxapose_map(out / "map.csv", PHOTO_MAP),
            "two LEDs exchanged": _luxapose_map(
                out / "wrong.csv", {**PHOTO_MAP, 3000: PHOTO_MAP[3500], 3500: PHOTO_MAP[3000]}
            ),
            "x of the LEDs wrong by 10 cm": _luxapose_map(
                out / "wide.csv", {hz: (x + 10 * np.sign(x), y) for hz, (x, y) in PHOTO_MAP.items()}
            ),
        }
        for name, leds in maps.items():
            for readout in ("auto", "columns") if name == "map" else ("auto",):
                request = PhotoRequest(
                    images=[picture],
                    leds=leds,
                    units="cm",
                    focal_px=PHOTO_FOCAL_PX,
                    exposure="60us",
                    line_rate=PHOTO_LINE_RATE_HZ,
                    level=1.0,
                    readout=readout,  # type: ignore[arg-type]
                    truth=",".join(map(str, PHOTO_POSITION_CM)),
                    overlay=out / f"{picture.stem}_spots.png",
                )
                figure("photograph", f"{picture.name}, {name}, --readout {readout}")
                try:
                    run_photo(request, print, _print_markdown)
                except InputError as error:
                    figure("refused", error)


PHOTO_MAP = {
    2000: (-35.56, 36.83),
    2500: (35.56, 36.83),
    3000: (35.56, -36.83),
    3500: (-35.56, -36.83),
    4000: (0.0, 0.0),
}
"""LEDs of the photograph by frequency, cm; all 246 cm above the camera."""
PHOTO_HEIGHT_CM = 246.0
PHOTO_FOCAL_PX, PHOTO_LINE_RATE_HZ = 5620.0, 47540.0
PHOTO_POSITION_CM = (0.0, 1.27, 0.0)


def _luxapose_map(path: Path, places: dict[int, tuple[float, float]]) -> Path:
    rows = [f"{hz},{x},{y},{PHOTO_HEIGHT_CM},{hz}" for hz, (x, y) in places.items()]
    path.write_text("\n".join(["id,x,y,z,frequency_hz", *rows]) + "\n", encoding="utf-8")
    return path


def _print_markdown(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]], note: str) -> None:
    print(title)
    heading(*headers)
    for cells in rows:
        row(*cells)
    print(note)
