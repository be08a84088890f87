"""Numbers of the page: three digits, one unit of length, thin spaces, no exponents. numbers.js writes them alike."""

import math
from collections.abc import Sequence

UNITS = {"µm": 1e-6, "mm": 1e-3, "m": 1.0}
THIN = "\u202f"
MAX_DECIMALS = 9


def three(value: float) -> str:
    """A number to three digits, in groups of three: `2.04`, `34 600`."""
    if value == 0:
        return "0"
    rounded = float(f"{value:.2e}")
    decade = math.floor(math.log10(abs(rounded)))
    if decade >= 2:
        return f"{rounded:,.0f}".replace(",", THIN)
    return f"{rounded:.{min(2 - decade, MAX_DECIMALS)}f}"


def brief(value: float) -> str:
    """A number to three digits without zeros at its end: `20`, `0.102`."""
    text = three(value)
    return text.rstrip("0").rstrip(".") if "." in text else text


def length(size_m: float) -> str:
    """A length in its own unit: `2.04 µm`."""
    fitting = [unit for unit, unit_m in UNITS.items() if abs(float(f"{size_m:.2e}")) >= unit_m]
    unit = fitting[-1] if fitting else "µm"
    return f"{three(size_m / UNITS[unit])}\u00a0{unit}"


def page_unit(medians_m: Sequence[float]) -> str:
    """The page's unit of length: the largest in which the smallest positive median is 1 or more."""
    smallest = min((size_m for size_m in medians_m if size_m > 0), default=1.0)
    return next((unit for unit in reversed(UNITS) if smallest >= UNITS[unit]), "µm")
