"""Absorption of intrinsic silicon at 300 K.

Source: M. A. Green, Self-consistent optical parameters of intrinsic silicon at 300 K including temperature
coefficients, Solar Energy Materials and Solar Cells 92 (2008) 1305: the tabulated absorption coefficient.
"""

import numpy as np
from numpy.typing import NDArray

FIRST_NM, STEP_NM = 250.0, 10.0
ABSORPTION_PER_CM = (
    *(1.84e6, 1.97e6, 2.18e6, 2.37e6, 2.29e6, 1.77e6, 1.46e6, 1.3e6, 1.18e6, 1.1e6),  # 250 nm
    *(1.06e6, 1.04e6, 7.37e5, 3.13e5, 1.43e5, 93000.0, 69500.0, 52700.0, 40200.0, 30700.0),  # 350 nm
    *(24100.0, 19500.0, 16600.0, 14400.0, 12600.0, 11100.0, 9700.0, 8800.0, 7850.0, 7050.0),  # 450 nm
    *(6390.0, 5780.0, 5320.0, 4880.0, 4490.0, 4175.0, 3800.0, 3520.0, 3280.0, 3030.0),  # 550 nm
    *(2790.0, 2570.0, 2390.0, 2200.0, 2040.0, 1890.0, 1780.0, 1680.0, 1540.0, 1420.0),  # 650 nm
    *(1310.0, 1190.0, 1100.0, 1030.0, 928.0, 850.0, 775.0, 707.0, 647.0, 590.0),  # 750 nm
    *(534.0, 479.0, 431.0, 383.0, 343.0, 303.0, 271.0, 240.0, 209.0, 183.0),  # 850 nm
    *(156.0, 134.0, 113.0, 96.0, 79.0, 64.0, 51.1, 39.9, 30.2, 22.6),  # 950 nm
    *(16.3, 11.1, 8.0, 6.2, 4.7, 3.5, 2.7, 2.0, 1.5, 1.0),  # 1050 nm
    *(0.68, 0.42, 0.22, 0.065, 0.036, 0.022, 0.013, 8.2e-3, 4.7e-3, 2.4e-3),  # 1150 nm
    *(1.0e-3, 3.6e-4, 2.0e-4, 1.2e-4, 7.1e-5, 4.5e-5, 2.7e-5, 1.6e-5, 8.0e-6, 3.5e-6),  # 1250 nm
    *(1.7e-6, 9.5e-7, 6.0e-7, 3.8e-7, 2.3e-7, 1.4e-7, 8.5e-8, 5.0e-8, 2.5e-8, 1.8e-8),  # 1350 nm
    *(1.2e-8,),  # 1450 nm
)
"""Absorption coefficient at 250, 260, ... 1450 nm, 1/cm."""


def silicon_absorption_per_m(wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Absorption coefficient of silicon at 300 K, 1/m, same shape as the wavelengths.

    Between the tabulated wavelengths its logarithm is linear. Outside 250 to 1450 nm it is that of the nearest end:
    any photodiode absorbs everything below 250 nm and nothing above 1450 nm.
    """
    table_nm = FIRST_NM + STEP_NM * np.arange(len(ABSORPTION_PER_CM))
    per_m: NDArray[np.float64] = 100.0 * np.exp(np.interp(wavelengths_nm, table_nm, np.log(ABSORPTION_PER_CM)))
    return per_m
