"""Reflectance of glazing by Fresnel's equations."""

from typing import Any


def glazing_reflectance(cosine: Any, index: Any, sqrt: Any) -> Any:
    """Reflectance of thin glazing, 2 F / (1 + F) with Fresnel's F for unpolarised light at each of its two faces.

    cosine: cosine of the angle of incidence. index: refractive index. sqrt: square root of their type of array, NumPy's
    or Dr.Jit's.
    """
    inside = sqrt(1.0 - (1.0 - cosine * cosine) / (index * index))
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (inside - index * cosine) / (inside + index * cosine)
    face = (s * s + p * p) / 2.0
    return 2.0 * face / (1.0 + face)
