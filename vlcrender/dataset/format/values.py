"""Ranges and checks of the values of a dataset, by their numbers in the section Checks of datasets/FORMAT.md.

`estimator` has checks of its own for the same section; the two packages share no code.
"""

from collections.abc import Iterable, Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

MAX_NUMBER = 1e100
"""Check 3: the square of a number must not overflow."""
Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Positive = Annotated[float, Field(gt=0, le=MAX_NUMBER)]
NotNegative = Annotated[float, Field(ge=0, le=MAX_NUMBER)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
"""Numbers of frames, devices, LEDs: what 64 bits with a sign hold."""
Share = Annotated[float, Field(ge=0, le=1)]
Length = Annotated[float, Field(gt=0, le=1e6)]
"""Check 4: lengths of a camera, in the unit of their key."""
Sigma = Annotated[float, Field(ge=0, le=1e6)]
"""Check 4: standard deviations of a camera."""
Electrons = Annotated[float, Field(ge=1e-9, le=1e12)]
"""Check 6: gain and full well."""
Spread = Annotated[float, Field(ge=0, le=1e12)]
"""Check 6: noise, offsets and dark currents."""
TiltSigma = Annotated[float, Field(ge=0, le=180)]
"""Check 7, degrees."""
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
"""Check 8, metres."""
LedSize = Annotated[float, Field(ge=1e-6, le=1e3)]
"""Check 8, metres."""
MAX_ANGLE_DEG = 360.0
"""Check 12."""
MAX_VISIBLE = 1 + 1e-6
"""Check 12; a mean of shares exceeds 1 by its rounding."""

MAX_ROTATION_ERROR = 1e-9


def is_rotation(values: Sequence[float] | Sequence[Sequence[float]]) -> bool:
    """Whether nine numbers, row by row or as three rows, are a rotation matrix, to 1e-9 in each entry of R R^T."""
    matrix = np.array(values, dtype=np.float64).reshape(3, 3)
    error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(error <= MAX_ROTATION_ERROR and np.linalg.det(matrix) > 0)


Triple = tuple[Number, Number, Number]
Sigmas3 = tuple[NotNegative, NotNegative, NotNegative]
Matrix = tuple[Triple, Triple, Triple]


def _rotation(rows: Matrix) -> Matrix:
    if not is_rotation(rows):
        raise ValueError("has to be a rotation matrix (orthonormal to 1e-9, determinant +1)")
    return rows


Rotation = Annotated[Matrix, AfterValidator(_rotation)]
"""Check 5: three rows."""

MIN_VARIANCE = 1e-60
MAX_ASYMMETRY = 1e-6
MIN_EIGENVALUE = 1e-14


def is_covariance(values: Sequence[float]) -> bool:
    """Check 12: whether nine numbers, row by row, are a symmetric, positive definite matrix."""
    matrix = np.array(values, dtype=np.float64).reshape(3, 3)
    variances = np.diag(matrix)
    if variances.min() < MIN_VARIANCE:
        return False
    correlations = matrix / np.sqrt(np.outer(variances, variances))
    if np.abs(correlations - correlations.T).max() > MAX_ASYMMETRY:
        return False
    return bool(np.linalg.eigvalsh(correlations).min() >= MIN_EIGENVALUE)


def repeated(ids: Iterable[int]) -> int | None:
    """The first id that occurs twice; None if each occurs once."""
    seen: set[int] = set()
    for one in ids:
        if one in seen:
            return one
        seen.add(one)
    return None
