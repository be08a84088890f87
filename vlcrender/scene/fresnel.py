"""Glass: what a window pane mirrors."""

from typing import Any


def glazing_reflectance(cosine: Any, index: Any, sqrt: Any) -> Any:
    """Reflectance of a thin pane: Fresnel's F for unpolarised light at both faces, 2 F / (1 + F).

    `cosine` is that of the angle of incidence; NumPy or Dr.Jit arrays, with their square root.
    """
    inside = sqrt(1.0 - (1.0 - cosine * cosine) / (index * index))
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (inside - index * cosine) / (inside + index * cosine)
    face = (s * s + p * p) / 2.0
    return 2.0 * face / (1.0 + face)
