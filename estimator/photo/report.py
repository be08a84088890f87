"""Tables of what was found in a photograph: its lamps, and the answers of the variants."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.photo.led_table import LedTable
from estimator.photo.locate import Located
from estimator.photo.solve import COVERED_CHI2, Answer, covered

Floats = NDArray[np.float64]

LAMP_HEADERS = ("LED", "u px", "v px", "Hz", "sigma Hz", "off Hz", "share", "remark")
LAMP_NOTE = "Hz: frequency of the stripes; off: less that of the map; share: of the stripes' energy."
ANSWER_NOTE = (
    "Positions are in the map's own units and axes, with one standard deviation by the variant's covariance. "
    "px: root mean square of the residuals' coordinates."
)
TRUTH_NOTE = "off: estimate minus --truth; 95 %: whether the covariance covers it."


def lamp_rows(located: Located, table: LedTable) -> list[list[str]]:
    """Cells of each lamp, under LAMP_HEADERS."""
    led_at = {(u, v): led for led, u, v in located.solved.spots}
    rows = []
    for one in located.lamps:
        lamp, tone = one.lamp, one.tone
        led = led_at.get((lamp.u_px, lamp.v_px))
        nominal = None if led is None else table.frequencies_hz().get(led)
        remark = one.why_not()
        if led is not None and lamp.touches_border:
            remark = "cut by the border; centre by the visible part"
        elif led is None and not remark:
            remark = "left out" if lamp.measured else "cut by the border too much, left out"
        rows.append(
            [
                "" if led is None else table.label(led),
                f"{lamp.u_px:.1f}",
                f"{lamp.v_px:.1f}",
                "" if tone is None else f"{tone.frequency_hz:.0f}",
                "" if tone is None else f"{tone.sigma_hz:.0f}",
                "" if tone is None or nominal is None else f"{tone.frequency_hz - nominal:+.0f}",
                "" if tone is None else f"{tone.share:.2f}",
                remark,
            ]
        )
    return rows


def answer_headers(unit: str, with_truth: bool) -> list[str]:
    """Headers of `answer_rows`."""
    headers = ["variant", f"x {unit}", f"y {unit}", f"z {unit}", "sigma x", "sigma y", "sigma z", "px"]
    return [*headers, *(("off x", "off y", "off z", "95 %") if with_truth else ()), "remark"]


def answer_rows(answers: Sequence[Answer], truth: Floats | None = None) -> list[list[str]]:
    """Cells of each variant, under `answer_headers`."""
    rows = []
    for answer in answers:
        position, covariance = answer.position, answer.covariance
        cells = ["", "", ""] if position is None else [f"{value:.2f}" for value in position]
        cells += ["", "", ""] if covariance is None else [f"{value:.2f}" for value in np.sqrt(np.diag(covariance))]
        cells.append("" if answer.residuals_px is None else f"{answer.rms_px:.2f}")
        if truth is not None:
            cells += ["", "", ""] if position is None else [f"{value:+.2f}" for value in position - truth]
            chi2 = covered(answer, truth)
            cells.append("" if chi2 is None else "yes" if chi2 <= COVERED_CHI2 else "no")
        remark = answer.failure or ("another position fits nearly as well" if answer.ambiguous else "")
        rows.append([answer.variant, *cells, remark])
    return rows
