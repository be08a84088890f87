"""Single figures of the items of docs/paper.md, from their kept tables."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from paper_sets import BOUND

PAPER = "huynh2016:spot=brightest"
"""The paper's method, its misprints corrected: Algorithm 1, brightest pixel."""
BARE = "huynh2016:denoise=none,spot=brightest"
CENTROID = "huynh2016"
BARE_CENTROID = "huynh2016:denoise=none"
REDUCED = "huynh2016:denoise=corrected,spot=brightest"
"""PAPER with its default written out, as in the sets of all denoisers."""
REDUCED_CENTROID = "huynh2016:denoise=corrected"

Figures = Mapping[str, float]
Kept = Mapping[str, Any]


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


def table2(t: Tables) -> dict[str, float]:
    """Errors of 2 deg."""
    return {
        **t.extra,
        "level": t.value("level", CENTROID, 2.0),
        "tilted": t.value("tilted", CENTROID, 2.0),
        "fit": t.value("level", "gravity-fit", 2.0),
        "ml": t.value("level", "ml", 2.0),
    }


def fig6(t: Tables) -> dict[str, float]:
    """Ends of the paper's curve, and of others."""
    low, middle, high = (t.value("errors", PAPER, width) for width in (200.0, 2000.0, 4000.0))
    ends = {"low": low, "high": high, "fall": low / high, "rest": middle / high}
    return ends | {"ml": t.value("errors", "ml", 4000.0), "centroid": t.value("errors", CENTROID, 4000.0)}


def fig9(t: Tables) -> dict[str, float]:
    """0 dB, and over -9 dB; of `ml` and the fit -9 dB alone, where both answer."""
    found = {}
    for reading in ("photon", "peak", "variance"):
        for size in ("fits", "wide"):
            view = f"{reading}-{size}"
            bare, paper = ([t.value(view, one, level) for level in (0.0, -9.0)] for one in (BARE, REDUCED))
            name = f"{reading}_{size}"
            found |= {f"{name}_bare": bare[0], f"{name}_paper": paper[0], f"{name}_gain": bare[0] / paper[0]}
            found |= {f"{name}_bare_growth": bare[0] / bare[1], f"{name}_paper_growth": paper[0] / paper[1]}
            found[f"{name}_centroid"] = t.value(view, REDUCED_CENTROID, 0.0)
            found[f"{name}_bare_rate"] = t.value(view, BARE, 0.0, statistic="success_rate")
            found[f"{name}_paper_rate"] = t.value(view, REDUCED, 0.0, statistic="success_rate")
            found |= {f"{name}_{one}": t.value(view, of, -9.0) for one, of in (("ml", "ml"), ("fit", "gravity-fit"))}
    return found


def fig7(t: Tables) -> dict[str, float]:
    """The worst tilts."""
    exact, tilted = t.values("paper", PAPER), t.values("half-degree", PAPER)
    return {
        **t.extra,
        "worst": max(exact),
        "worst_half": max(tilted),
        "below": sum(value < 0.1 for value in exact) / len(exact),
        "worst_centroid": max(t.values("centroid", CENTROID)),
    }


def table1(t: Tables) -> dict[str, float]:
    """Errors, and coverage."""
    names = {PAPER: "paper", CENTROID: "centroid", "huynh2016-as-printed": "printed", "ml": "ml", BOUND: "bound"}
    (at,) = {tuple(row["x"]) for row in t.views["errors"]["rows"]}
    found = {name: t.value("errors", variant, *at) for variant, name in names.items()}
    return {**t.extra, **found, "answered": t.value("errors", PAPER, *at, statistic="success_rate")}


def table3(t: Tables) -> dict[str, float]:
    """The paper's rows, level: with little noise, and what much noise makes of it."""
    found = {"nakazawa": t.value("fisheye", "nakazawa2013", "[0.0, 0.0]", -35.0)}
    names = {PAPER: "paper", "yoshino2008": "yoshino", "rahman2011": "rahman", "kim": "kim", "ml": "ml"}
    for variant, name in names.items():
        quiet, noisy = (t.value("main", variant, "[0.0, 0.0]", db) for db in (-35.0, -9.0))
        found |= {name: quiet, f"{name}_growth": noisy / quiet}
    return found


def spread(view: str) -> Callable[[Tables], dict[str, float]]:
    """Largest mean over the smallest of a view."""

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


def open(t: Tables) -> dict[str, float]:
    """Largest over smallest."""
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


def extra_only(t: Tables) -> dict[str, float]:
    """Figures of the further measurement alone."""
    return dict(t.extra)
