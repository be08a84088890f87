"""Items of docs/paper.md: what of Huynh & Yoo 2016 is reproduced, by which sets and tables.

Titles and findings stand in docs/paper/templates/text.toml.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass

import paper_extras as extras
import paper_figures as figures
from paper_figures import BARE, BARE_CENTROID, CENTROID, PAPER, Tables
from paper_sets import PAGE, Extra, PaperSet, View

DENOISERS = tuple(
    f"huynh2016:denoise={one}{spot}"
    for spot in (",spot=brightest", "")
    for one in ("none", "corrected", "box", "anscombe")
)
PLAIN = (PAPER, BARE, CENTROID, BARE_CENTROID, "gravity-fit", "ml")
SINCE = ("gopa", "eca-rssr", "r-p3p", "v-p4l", "v-pca", "circle-centre", "lc-vlp")
RIVALS = ("yoshino2008", "nakazawa2013", "rahman2011", "kim")
TABLE3 = (PAPER, CENTROID, *RIVALS, *SINCE, "pnp", "up2p", "gravity-fit", "ml")
ROOMY = {"poses.count": 334}
"""A thousand poses of three seeds."""
FIG6 = {"poses.count": 84}
"""Four levels of three seeds: a thousand frames a resolution."""
TABLE1 = {"poses.columns": 350, "poses.rows": 350, "files.frames_per_file": 1000}
FIG7 = {"poses.tilt_x_deg": [0.0, 60.0, 7], "poses.tilt_y_deg": [0.0, 60.0, 7], "poses.per_cell": 7}
PIXELS = {"camera.width_px": 4000, "camera.height_px": 3000, "camera.pixel_pitch_um": 1.2, "regions.kind": "leds"}
LIGHT = {**PIXELS, **ROOMY, "exposure_s": 160e-6}
TILTS = ("tilt_x_deg", "tilt_y_deg")
TEN_CM = ((0.1, "paper"),)


@dataclass(frozen=True)
class Item:
    """An item of the page. `figures` derives single figures from the kept tables; `finding` is a sentence with them."""

    name: str
    sets: tuple[PaperSet, ...]
    views: tuple[View, ...]
    figures: Callable[[Tables], dict[str, float]]
    extra: Extra | None = None

    @property
    def text(self) -> dict[str, str]:
        """`title`, what the `paper` says, and `finding`."""
        texts: dict[str, dict[str, str]] = tomllib.loads((PAGE / "templates" / "text.toml").read_text())
        return texts[self.name]


def _table2_views() -> tuple[View, ...]:
    attitudes = {"level": ("[0.0, 0.0]", "level camera"), "tilted": ("[40.0, 40.0]", "40 deg on both axes")}
    paper = ((4.56e-7, "paper, 2 deg"),)
    return tuple(
        View(name, title, "table2", ("error_deg",), {"tilt": tilt}, lines=paper, bound=True, log=("y",))
        for name, (tilt, title) in attitudes.items()
    )


def _fig9_views() -> tuple[View, ...]:
    readings = {
        "photon": "photon noise",
        "peak": "relative to the peak",
        "variance": "relative to the image's variance",
    }
    views = []
    for reading, title in readings.items():
        for size, radius_m, width in (("fits", 0.01, "11 px"), ("wide", 0.04, "43 px")):
            where: dict[str, float | str] = {"radius_m": radius_m}
            if reading != "photon":
                where["relative_to"] = "peak" if reading == "peak" else "image-variance"
            of = "fig9_photon" if reading == "photon" else "fig9_added"
            views.append(View(f"{reading}-{size}", f"{title}, LED images of {width}", of, ("level_db",), where))
    return tuple(views)


def _fig6_view(name: str, title: str) -> tuple[View, ...]:
    return (View("errors", title, name, ("width_px",), bound=True, log=("x", "y"), lines=TEN_CM),)


def _table3_views(name: str) -> tuple[View, ...]:
    return tuple(
        View(camera, f"camera `{camera}`", name, ("tilt", "level_db"), {"camera": camera})
        for camera in ("main", "fisheye")
    )


def _fig7_views() -> tuple[View, ...]:
    exact, half = {"error_deg": 0.0}, {"error_deg": 0.5}
    edges = {"tilt_deg": [0.0, 15.0, 30.0, 45.0, 60.0, 76.0]}
    all_title = "all, by the angle off the zenith, 0.5 deg"
    return (
        View("paper", "brightest pixel, exact accelerometer", "fig7", TILTS, exact, (PAPER,)),
        View("half-degree", "brightest pixel, 0.5 deg of accelerometer error", "fig7", TILTS, half, (PAPER,)),
        View("centroid", "centroids, exact accelerometer", "fig7", TILTS, exact, (CENTROID,)),
        View("all", all_title, "fig7", ("tilt_deg",), half, bins=edges, bound=True, log=("y",), lines=TEN_CM),
    )


def _light_view(name: str, title: str, key: str) -> tuple[View, ...]:
    return (View("errors", title, name, (key,), bound=True, log=("y",), lines=TEN_CM),)


def _table1_view() -> tuple[View, ...]:
    title = "errors, LED regions on the sensor or beyond"
    return (View("errors", title, "table1", ("set",), bound=True, lines=TEN_CM),)


def _open_views() -> tuple[View, ...]:
    bins = {"yaw_deg": [-180.0, -90.0, 0.0, 90.0, 180.0]}
    size = "LED size, photon noise of -9 dB"
    return (
        View("size", size, "led_size", ("radius_m",), log=("x", "y"), lines=TEN_CM),
        View("aim", "least distance of LEDs from the image's border, 0.5 deg", "aim", ("border_px",)),
        View("yaw", "yaw, 0.5 deg", "aim", ("yaw_deg",), {"border_px": 20.0}, bins=bins),
    )


FIG9 = (*DENOISERS, "gravity-fit", "ml")
ITEMS = {
    item.name: item
    for item in (
        Item(
            "table2",
            (PaperSet("table2", (CENTROID, PAPER, "gravity-fit", "ml"), ROOMY),),
            _table2_views(),
            figures.table2,
            extras.tilt_theory,
        ),
        Item(
            "fig9",
            (PaperSet("fig9_photon", FIG9, ROOMY), PaperSet("fig9_added", FIG9, ROOMY)),
            _fig9_views(),
            figures.fig9,
        ),
        Item(
            "fig6",
            (PaperSet("fig6_photon", PLAIN, FIG6),),
            _fig6_view("fig6_photon", "photon noise of 0 to -9 dB"),
            figures.fig6,
        ),
        Item(
            "table1",
            (PaperSet("table1", (*PLAIN, "huynh2016-as-printed", "yoshino2008"), TABLE1),),
            _table1_view(),
            figures.table1,
            extras.coverage,
        ),
        *(
            Item(name, (PaperSet(of, TABLE3, {"poses.count": 84}),), _table3_views(of), figures.table3)
            for name, of in (("table3", "table3_ideal"), ("table3_calibrated", "table3_calibrated"))
        ),
        Item("fig7", (PaperSet("fig7", PLAIN, FIG7),), _fig7_views(), figures.fig7, extras.tilt_coverage),
        Item("fig8", (PaperSet("fig8", (), {"repeats": 100}),), (), figures.extra_only, extras.noise_histogram),
        Item("fig5", (PaperSet("fig5", (), {}),), (), figures.extra_only, extras.profile),
        Item(
            "luminance",
            (PaperSet("luminance", PLAIN, LIGHT),),
            _light_view("luminance", "luminance, one exposure time", "luminance_cd_m2"),
            figures.spread("errors"),
        ),
        Item(
            "ambient",
            (PaperSet("ambient", PLAIN, LIGHT),),
            _light_view("ambient", "ambient light", "illuminance_lux"),
            figures.spread("errors"),
        ),
        Item(
            "fig6_peak",
            (PaperSet("fig6_peak", PLAIN, FIG6),),
            _fig6_view("fig6_peak", "added noise of 0 to -9 dB relative to the peak"),
            figures.fig6,
        ),
        Item(
            "open",
            (PaperSet("led_size", PLAIN, ROOMY), PaperSet("aim", (CENTROID, PAPER, "gravity-fit"), ROOMY)),
            _open_views(),
            figures.open,
        ),
    )
}
