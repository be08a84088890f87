"""Levels: scores of several datasets side by side, ordered by their bounds."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimator.errors import InputError
from estimator.evaluate.score import Scores, VariantScore
from estimator.evaluate.score_table import length_text
from estimator.evaluate.statistics import root_mean_square

LEVEL_NOTE = (
    "Level: a dataset, with the root mean square of the Cramér-Rao bound over all frames that have one. RMSE of the 3D "
    "error over the frames that succeeded, and how many failed."
)


@dataclass(frozen=True, eq=False)
class Level:
    """A dataset: its name, root mean square of its bound over all frames that have one, and its variants' scores."""

    name: str
    bound_rms_m: float
    variants: dict[str, VariantScore]

    def rmse_m(self, variant: str) -> float | None:
        """RMSE of a variant over the frames that succeeded; None without one, and for a variant without estimates."""
        of_variant = self.variants.get(variant)
        return None if of_variant is None or of_variant.error_3d is None else of_variant.error_3d.rmse_m


def levels_of(datasets: Sequence[tuple[Path, Scores]]) -> list[Level]:
    """Levels of datasets given as folder and scores, easiest first; raises InputError for one without a bound."""
    found = []
    for folder, scores in datasets:
        rows = scores.variants[0].rows if scores.variants else ()
        bounds_m = [row.bound_m for row in rows if row.bound_m is not None]
        if not bounds_m or not (bound_rms_m := float(root_mean_square(np.array(bounds_m)))) > 0:
            raise InputError(f"{folder}: no frame has a bound; generate the dataset with bound = true in its recipe")
        found.append(Level(scores.dataset, bound_rms_m, {one.variant: one for one in scores.variants}))
    return sorted(found, key=lambda level: level.bound_rms_m)


def variants_of(levels: Sequence[Level]) -> list[str]:
    """Names of all variants of the levels, each once."""
    return list(dict.fromkeys(name for level in levels for name in level.variants))


def level_cells(levels: Sequence[Level]) -> tuple[list[str], list[list[str]]]:
    """Headers and rows of the table of levels: variants down, levels across, `12.3 mm, 2 failed` in the cells."""
    headers = ["variant", *(f"{level.name} ({length_text(level.bound_rms_m)})" for level in levels)]
    rows = []
    for variant in variants_of(levels):
        cells = []
        for level in levels:
            of_variant = level.variants.get(variant)
            lost = "" if of_variant is None or not of_variant.failed else f", {of_variant.failed} failed"
            cells.append(f"{length_text(level.rmse_m(variant))}{lost}")
        rows.append([variant, *cells])
    return headers, rows
