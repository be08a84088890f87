"""The data sheet's page: the numbers along its axes."""

import numpy as np
import pytest

from vlcrender.emva1288.page import _steps as steps


@pytest.mark.parametrize("end", [1.0, 1.999, 2.0, 4.9, 5.0, 5.1, 9.99, 10.0, 5.9, 34.0, 50.0, 700.0, 1e6, 0.03])
def test_five_to_ten_round_numbers_divide_an_axis(end: float) -> None:
    found = steps(end)
    assert 5 <= len(found) <= 10
    step = found[1] / 10.0 ** np.floor(np.log10(found[1] * 1.001))
    assert np.round(step, 9) in (1, 2, 5)
