"""Reflectance of glazing by Fresnel's equations."""

from typing import Any


def glazing_reflectance(cosine: Any, index: Any, sqrt: Any) -> Any:
    """Reflectance of thin glazing for unpolarised light: the mean over both polarisations of 2 F / (1 + F).

    F is Fresnel's reflectance of each of its two faces; light that is reflected to and fro between them keeps its
    polarisation, so that the sum over all reflections comes before the mean.

    cosine: cosine of the angle of incidence. index: refractive index. sqrt: square root of their type of array, NumPy's
    or Dr.Jit's.
    """
    inside = sqrt(1.0 - (1.0 - cosine * cosine) / (index * index))
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (inside - index * cosine) / (inside + index * cosine)
    return s * s / (1.0 + s * s) + p * p / (1.0 + p * p)
