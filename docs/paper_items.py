"""Items of docs/paper.md: what of Huynh & Yoo 2016 is reproduced, by which sets, tables and single figures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import paper_extras as extras
from paper_sets import BOUND, Extra, PaperSet, View

PAPER = "huynh2016:spot=brightest"
"""The paper's method, its misprints corrected: Algorithm 1, brightest pixel."""
BARE = "huynh2016:denoise=none,spot=brightest"
CENTROID = "huynh2016"
BARE_CENTROID = "huynh2016:denoise=none"
DENOISERS = tuple(
    f"huynh2016:denoise={one}{spot}"
    for spot in (",spot=brightest", "")
    for one in ("none", "corrected", "box", "anscombe")
)
PLAIN = (PAPER, BARE, CENTROID, BARE_CENTROID, "gravity-fit", "ml")
SINCE = ("gopa", "eca-rssr", "r-p3p", "v-p4l", "v-pca", "circle-centre", "lc-vlp")
TABLE3 = (
    PAPER,
    CENTROID,
    "yoshino2008",
    "nakazawa2013",
    "rahman2011",
    "kim",
    *SINCE,
    "pnp",
    "up2p",
    "gravity-fit",
    "ml",
)
ROOMY = {"poses.count": 334}
"""A thousand poses of three seeds."""
PUBLISHED_SIZE = {
    "camera.width_px": 4000,
    "camera.height_px": 3000,
    "camera.pixel_pitch_um": 1.2,
    "regions.kind": "leds",
    **ROOMY,
}

Figures = Mapping[str, float]
Kept = Mapping[str, Any]


@dataclass(frozen=True)
class Item:
    """An item of the page. `figures` derives single figures from the kept tables; `finding` is a sentence with them."""

    name: str
    title: str
    paper: str
    sets: tuple[PaperSet, ...]
    views: tuple[View, ...]
    figures: Callable[["Tables"], dict[str, float]]
    finding: str
    extra: Extra | None = None


@dataclass(frozen=True)
class Tables:
    """Kept tables of an item by name, and the figures of its further measurement."""

    views: Mapping[str, Kept]
    extra: Figures

    def rows(self, view: str, group: str) -> list[Kept]:
        """Rows of a group."""
        return [row for row in self.views[view]["rows"] if row["group"] == group]

    def value(self, view: str, group: str, *x: float | str, statistic: str = "mean") -> float:
        """A statistic of a row; NaN where there is none."""
        found = [row[statistic][0] for row in self.rows(view, group) if tuple(row["x"]) == x]
        return float("nan") if not found or found[0] is None else float(found[0])

    def values(self, view: str, group: str, statistic: str = "mean") -> list[float]:
        """A statistic of all rows of a group that have it."""
        return [row[statistic][0] for row in self.rows(view, group) if row[statistic][0] is not None]


def _table2(t: Tables) -> dict[str, float]:
    return {
        **t.extra,
        "level": t.value("level", CENTROID, 2.0),
        "tilted": t.value("tilted", CENTROID, 2.0),
        "fit": t.value("level", "gravity-fit", 2.0),
        "ml": t.value("level", "ml", 2.0),
    }


def _fig6(t: Tables) -> dict[str, float]:
    found = {}
    for reading in ("photon", "peak"):
        low, middle, high = (t.value(reading, PAPER, width) for width in (200.0, 2000.0, 4000.0))
        found |= {f"{reading}_low": low, f"{reading}_high": high}
        found |= {f"{reading}_fall": low / high, f"{reading}_rest": middle / high}
        found[f"{reading}_ml"] = t.value(reading, "ml", 4000.0)
        found[f"{reading}_centroid"] = t.value(reading, CENTROID, 4000.0)
    return found


def _fig9(t: Tables) -> dict[str, float]:
    found = {}
    for reading in ("photon", "peak", "variance"):
        for size in ("fits", "wide"):
            view = f"{reading}-{size}"
            bare, paper = ([t.value(view, one, level) for level in (0.0, -9.0)] for one in (BARE, PAPER))
            name = f"{reading}_{size}"
            found |= {f"{name}_bare": bare[0], f"{name}_paper": paper[0], f"{name}_gain": bare[0] / paper[0]}
            found |= {f"{name}_bare_growth": bare[0] / bare[1], f"{name}_paper_growth": paper[0] / paper[1]}
            found[f"{name}_centroid"] = t.value(view, CENTROID, 0.0)
            found[f"{name}_bare_rate"] = t.value(view, BARE, 0.0, statistic="success_rate")
            found[f"{name}_paper_rate"] = t.value(view, PAPER, 0.0, statistic="success_rate")
    return found


def _fig7(t: Tables) -> dict[str, float]:
    exact, tilted = t.values("paper", PAPER), t.values("half-degree", PAPER)
    return {
        **t.extra,
        "worst": max(exact),
        "worst_half": max(tilted),
        "below": sum(value < 0.1 for value in exact) / len(exact),
        "worst_centroid": max(t.values("centroid", CENTROID)),
    }


def _table1(t: Tables) -> dict[str, float]:
    one = {name: t.value("errors", name, "table1") for name in (PAPER, CENTROID, "huynh2016-as-printed", "ml", BOUND)}
    rates = {"answered": t.value("errors", PAPER, "table1", statistic="success_rate")}
    names = ("paper", "centroid", "printed", "ml", "bound")
    return {**t.extra, **dict(zip(names, one.values(), strict=True)), **rates}


def _table3(t: Tables) -> dict[str, float]:
    found = {}
    names = {PAPER: "paper", "yoshino2008": "yoshino", "rahman2011": "rahman", "kim": "kim", "ml": "ml"}
    for level in ("ideal", "calibrated"):
        for variant, name in names.items():
            quiet, noisy = (t.value(f"{level}-main", variant, "[0.0, 0.0]", db) for db in (-35.0, -9.0))
            found |= {f"{level}_{name}": quiet, f"{level}_{name}_growth": noisy / quiet}
        found[f"{level}_nakazawa"] = t.value(f"{level}-fisheye", "nakazawa2013", "[0.0, 0.0]", -35.0)
    return found


def _spread(view: str) -> Callable[[Tables], dict[str, float]]:
    def figures(t: Tables) -> dict[str, float]:
        of_paper, of_centroid = t.values(view, PAPER), t.values(view, CENTROID)
        rates = t.values(view, PAPER, "success_rate")
        return {
            "paper_spread": max(of_paper) / min(of_paper),
            "centroid_spread": max(of_centroid) / min(of_centroid),
            "rate": min(rates),
            "paper_first": of_paper[0],
            "paper_last": of_paper[-1],
            "ml_spread": max(t.values(view, "ml")) / min(t.values(view, "ml")),
        }

    return figures


def _open(t: Tables) -> dict[str, float]:
    sizes, bare = t.values("size", PAPER), t.values("size", BARE)
    near, far = (t.value("aim", CENTROID, border) for border in (700.0, 20.0))
    yaws = t.values("yaw", CENTROID)
    return {
        "small": sizes[0],
        "large": sizes[-1],
        "size_spread": max(sizes) / min(sizes),
        "bare_spread": max(bare) / min(bare),
        "aim": far / near,
        "yaw": max(yaws) / min(yaws),
    }


def _extra_only(t: Tables) -> dict[str, float]:
    return dict(t.extra)


def _fig9_views() -> tuple[View, ...]:
    views = []
    for reading, title in (
        ("photon", "photon noise"),
        ("peak", "relative to the peak"),
        ("variance", "relative to the image's variance"),
    ):
        for size, radius_m, width in (("fits", 0.01, "11 px"), ("wide", 0.04, "43 px")):
            where: dict[str, float | str] = {"radius_m": radius_m}
            if reading != "photon":
                where["relative_to"] = "peak" if reading == "peak" else "image-variance"
            of = "fig9_photon" if reading == "photon" else "fig9_added"
            views.append(View(f"{reading}-{size}", f"{title}, LED images of {width}", of, ("level_db",), where))
    return tuple(views)


FIG6 = {"poses.count": 84}
"""Four levels of three seeds: a thousand frames a resolution."""
ITEMS = {
    item.name: item
    for item in (
        Item(
            "table2",
            "Table 2: error of the accelerometer",
            "2 deg of error cost 4.56e-7 m, 0.1 deg 8.46e-11 m.",
            (PaperSet("table2", (CENTROID, PAPER, "gravity-fit", "ml"), ROOMY),),
            tuple(
                View(
                    name,
                    title,
                    "table2",
                    ("error_deg",),
                    {"tilt": tilt},
                    lines=((4.56e-7, "paper, 2 deg"),),
                    bound=True,
                    log=("y",),
                )
                for name, title, tilt in (
                    ("level", "level camera", "[0.0, 0.0]"),
                    ("tilted", "40 deg on both axes", "[40.0, 40.0]"),
                )
            ),
            _table2,
            "An error of 2 deg on each axis costs {level:m} level and {tilted:m} at 40 deg on both axes, in place of the "
            "paper's 0.456 um; first order in the angle predicts the root mean square within {theory_worst:%}. The fits, "
            "which weigh the accelerometer against the image, lose {fit:m} (`gravity-fit`) and {ml:m} (`ml`).",
            extras.tilt_theory,
        ),
        Item(
            "fig9",
            "Fig. 9: noise and its reduction",
            "Without reduction the error rises dramatically with the noise; with reduction it is stable at all levels.",
            (
                PaperSet("fig9_photon", (*DENOISERS, "gravity-fit", "ml"), PUBLISHED_SIZE),
                PaperSet("fig9_added", (*DENOISERS, "gravity-fit", "ml"), PUBLISHED_SIZE),
            ),
            _fig9_views(),
            _fig9,
            "At 0 dB relative to the peak, with LED images that fit the box, reduction takes the brightest pixel's mean "
            "error from {peak_fits_bare:m} to {peak_fits_paper:m}; with images of 43 px from {peak_wide_bare:m} to "
            "{peak_wide_paper:m}. Relative to the image's variance it goes from {variance_fits_bare:m} to "
            "{variance_fits_paper:m}, with photon noise from {photon_fits_bare:m} to {photon_fits_paper:m}. Centroids after "
            "reduction have {peak_fits_centroid:m}, {peak_wide_centroid:m}, {variance_fits_centroid:m} and "
            "{photon_fits_centroid:m}.",
        ),
        Item(
            "fig6",
            "Fig. 6: resolution",
            "The error falls with the resolution, and little beyond 2000 x 1500.",
            (PaperSet("fig6_photon", PLAIN, FIG6), PaperSet("fig6_peak", PLAIN, FIG6)),
            tuple(
                View(
                    reading,
                    title,
                    f"fig6_{reading}",
                    ("width_px",),
                    bound=True,
                    log=("x", "y"),
                    lines=((0.1, "paper, Table 3"),),
                )
                for reading, title in (
                    ("photon", "photon noise of 0 to -9 dB"),
                    ("peak", "added noise of 0 to -9 dB relative to the peak"),
                )
            ),
            _fig6,
            "With photon noise the brightest pixel's mean error goes from {photon_low:m} at 200 x 150 to {photon_high:m} at "
            "4000 x 3000 (relative to the peak: {peak_low:m} to {peak_high:m}), that of centroids ends at "
            "{photon_centroid:m}, and that of `ml` at {photon_ml:m}.",
        ),
        Item(
            "table1",
            "Table 1: the four LEDs and the 350 x 350 poses",
            "122 500 level poses, all used; the method's accuracy is 10 cm (Table 3).",
            (
                PaperSet(
                    "table1",
                    (*PLAIN, "huynh2016-as-printed", "yoshino2008"),
                    {"poses.columns": 350, "poses.rows": 350, "files.frames_per_file": 1000},
                ),
            ),
            (
                View(
                    "errors",
                    "errors, LED regions on the sensor or beyond",
                    "table1",
                    ("set",),
                    bound=True,
                    lines=((0.1, "paper"),),
                ),
            ),
            _table1,
            "Of the 122 500 poses {seen_x:%} have the four LEDs in view with the sensor's long side along x, and "
            "{seen_y:%} with it along y; a panel layout that covers the room has {office:%}. Were the sensor large enough, "
            "the mean error would be {paper:m} by the brightest pixel and {centroid:m} by centroids, with the bound at "
            "{bound:m}.",
            extras.coverage,
        ),
        Item(
            "table3",
            "Table 3: the methods side by side",
            "Yoshino 7 cm, Nakazawa 10 cm, Rahman 15 cm, Kim 85 cm, Huynh & Yoo 10 cm.",
            tuple(PaperSet(f"table3_{level}", TABLE3, {"poses.count": 84}) for level in ("ideal", "calibrated")),
            tuple(
                View(
                    f"{level}-{camera}",
                    f"{level}, camera `{camera}`",
                    f"table3_{level}",
                    ("tilt", "level_db"),
                    {"camera": camera},
                    shown="mean",
                )
                for level in ("ideal", "calibrated")
                for camera in ("main", "fisheye")
            ),
            _table3,
            "Level and with little noise, exact knowledge gives {ideal_paper:m} for the paper's method, {ideal_yoshino:m} "
            "for Yoshino's, {ideal_rahman:m} for Rahman's, {ideal_kim:m} for Kim's and {ideal_ml:m} for `ml`; with a "
            "calibrated camera and a surveyed map {calibrated_paper:m}, {calibrated_yoshino:m}, {calibrated_rahman:m}, "
            "{calibrated_kim:m} and {calibrated_ml:m}.",
        ),
        Item(
            "fig7",
            "Fig. 7: tilt",
            "The mean error is below 0.1 m at every tilt of 0 to 60 deg on both axes.",
            (
                PaperSet(
                    "fig7",
                    PLAIN,
                    {"poses.tilt_x_deg": [0.0, 60.0, 7], "poses.tilt_y_deg": [0.0, 60.0, 7], "poses.per_cell": 7},
                ),
            ),
            (
                View(
                    "paper",
                    "brightest pixel, exact accelerometer",
                    "fig7",
                    ("tilt_x_deg", "tilt_y_deg"),
                    {"error_deg": 0.0},
                    (PAPER,),
                ),
                View(
                    "half-degree",
                    "brightest pixel, 0.5 deg of accelerometer error",
                    "fig7",
                    ("tilt_x_deg", "tilt_y_deg"),
                    {"error_deg": 0.5},
                    (PAPER,),
                ),
                View(
                    "centroid",
                    "centroids, exact accelerometer",
                    "fig7",
                    ("tilt_x_deg", "tilt_y_deg"),
                    {"error_deg": 0.0},
                    (CENTROID,),
                ),
                View(
                    "all",
                    "all, by the angle off the zenith, 0.5 deg",
                    "fig7",
                    ("tilt_deg",),
                    {"error_deg": 0.5},
                    bins={"tilt_deg": [0, 15, 30, 45, 60, 76]},
                    bound=True,
                    log=("y",),
                    lines=((0.1, "paper"),),
                ),
            ),
            _fig7,
            "With an exact accelerometer the brightest pixel's mean error is below 0.1 m at {below:%} of the tilts, at most "
            "{worst:m}; with 0.5 deg of error it reaches {worst_half:m}. By centroids it is at most {worst_centroid:m}. "
            "Unless the camera is aimed, {share_60:%} of the positions have four LEDs in view at 60 deg on both axes.",
            extras.tilt_coverage,
        ),
        Item(
            "fig8",
            "Fig. 8: histogram of the noise",
            "The 120 differences of a pixel and its neighbours give the parameters of a Skellam distribution.",
            (PaperSet("fig8", (), {"repeats": 100}),),
            (),
            _extra_only,
            "In an LED image the variance of the 120 differences is {centre:.2f} of a Skellam distribution's, because all "
            "of them share one pixel; on the ceiling it is {ceiling:.2f}, and at an LED's edge {edge:.0f}, which is no noise.",
            extras.noise_histogram,
        ),
        Item(
            "fig5",
            "Fig. 5: an LED's image",
            "The intensity of an LED image is bell-shaped.",
            (PaperSet("fig5", (), {}),),
            (),
            _extra_only,
            "The image of a disc in focus is flat: {flat:%} of the pixels above half of the maximum are within 5 % of it. Of a "
            "bell (a normal distribution in two dimensions) {bell:%} are.",
            extras.profile,
        ),
        Item(
            "luminance",
            "Luminance of 4 000 to 16 000 cd/m2",
            "The error changes very little with the luminance.",
            (PaperSet("luminance", PLAIN, PUBLISHED_SIZE | {"exposure_s": 160e-6}),),
            (
                View(
                    "errors",
                    "luminance, one exposure time",
                    "luminance",
                    ("luminance_cd_m2",),
                    bound=True,
                    log=("y",),
                    lines=((0.1, "paper"),),
                ),
            ),
            _spread("errors"),
            "The largest mean error over the smallest is {paper_spread:.2f} for the brightest pixel, {centroid_spread:.2f} for "
            "centroids and {ml_spread:.2f} for `ml`.",
        ),
        Item(
            "ambient",
            "Ambient light of 0 to 2 000 lux",
            "At 400 lux LEDs stand out without difficulty; ambient light does not affect the accuracy.",
            (PaperSet("ambient", PLAIN, PUBLISHED_SIZE | {"exposure_s": 160e-6}),),
            (
                View(
                    "errors",
                    "ambient light",
                    "ambient",
                    ("illuminance_lux",),
                    bound=True,
                    log=("y",),
                    lines=((0.1, "paper"),),
                ),
            ),
            _spread("errors"),
            "At least {rate:%} of the frames are answered at each illuminance, and the largest mean error over the smallest is "
            "{paper_spread:.2f} for the brightest pixel, {centroid_spread:.2f} for centroids and {ml_spread:.2f} for `ml`.",
        ),
        Item(
            "open",
            "What the paper leaves open: LED size, aim, yaw",
            "Not said.",
            (PaperSet("led_size", PLAIN, ROOMY), PaperSet("aim", (CENTROID, PAPER, "gravity-fit"), ROOMY)),
            (
                View(
                    "size",
                    "LED size, photon noise of -9 dB",
                    "led_size",
                    ("radius_m",),
                    log=("x", "y"),
                    lines=((0.1, "paper"),),
                ),
                View("aim", "least distance of LEDs from the image's border, 0.5 deg", "aim", ("border_px",)),
                View(
                    "yaw",
                    "yaw, 0.5 deg",
                    "aim",
                    ("yaw_deg",),
                    {"border_px": 20.0},
                    bins={"yaw_deg": [-180, -90, 0, 90, 180]},
                ),
            ),
            _open,
            "The radius of an LED changes the paper's error by a factor of {size_spread:.0f} (from {small:m} at 0.5 mm to "
            "{large:m} at 2 cm), the aim by {aim:.2f} and the yaw by {yaw:.2f}.",
        ),
    )
}
