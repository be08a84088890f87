"""Chart of an error budget: a pair of bars for each unknown, lines for the whole error and for the bound."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from vlcrender.dataset.world.error_budget import ErrorBudget

BAR = 0.38
MIN_SHARE = 1e-4
"""Share of the whole error at which the logarithmic axis starts; bars of smaller contributions have no length."""


def draw_budget(budget: ErrorBudget, path: Path) -> None:
    """Write the chart; the format is that of the name's suffix, such as .svg or .png."""
    rows, total = budget.rows, budget.total
    figure = Figure(figsize=(9, 1.8 + 0.36 * len(rows)), layout="constrained")
    axes = figure.subplots()
    places = np.arange(len(rows))
    lowest_mm = MIN_SHARE * total.total_mm
    for offset, colour, name, lengths in (
        (-BAR / 2, "tab:blue", "horizontal", [row.share.horizontal_mm for row in rows]),
        (BAR / 2, "tab:orange", "vertical", [row.share.vertical_mm for row in rows]),
    ):
        axes.barh(places + offset, np.maximum(lengths, lowest_mm), BAR, color=colour, label=name)
    for colour, name, sums in (("tab:blue", "horizontal", "horizontal_mm"), ("tab:orange", "vertical", "vertical_mm")):
        axes.axvline(getattr(total, sums), color=colour, lw=1.2, label=f"all, {name}")
        if budget.bound is not None:
            axes.axvline(getattr(budget.bound, sums), color=colour, lw=1.2, ls=":", label=f"bound, {name}")
    axes.set_xscale("log")
    axes.set_xlim(lowest_mm, 2 * total.total_mm)
    axes.set_yticks(places, [f"{row.name}: {row.sigma}" if row.sigma else row.name for row in rows])
    axes.invert_yaxis()
    axes.grid(axis="x", color="0.9")
    axes.set_axisbelow(True)
    axes.set_xlabel("error of the position, mm")
    axes.set_title(f"{budget.recipe}, camera {budget.camera}: rms over {budget.poses} poses")
    axes.legend(loc="lower right", fontsize=8)
    figure.savefig(path, dpi=110)
