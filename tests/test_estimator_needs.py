"""Needs of each variant, as stated: the number of LEDs suffices and is needed, and so is the accelerometer."""

from dataclasses import replace

import numpy as np
import pytest
from estimator_synthetic import grid, view_of, write_dataset

from estimator.errors import EstimationFailure
from estimator.io.dataset import read_dataset, read_frame
from estimator.io.device import DeviceFrame
from estimator.methods.catalogue import OWN

VIEW = view_of((3.5, 3.6, 3.5), 3.0, 30, -20, size=(800, 600, 2500.0))
GENERAL = [
    name
    for name, variant in OWN.items()
    if name != "huynh2016-as-printed"  # whose brightest pixels and printed equations may fail any frame
    and variant.needs is not None
    and variant.needs.faces in ("any", "disc")
    and not {"second camera", "fish-eye lens"} & set(variant.needs.sensors)
]


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> dict[int, DeviceFrame]:
    """Frames of one to five discs, by their number."""
    frames = {}
    leds_m = np.vstack([grid(2, 2, 0.5, (3.5, 3.6, 3.5))[[0, 1, 2, 3]], [[3.6, 3.5, 3.5]]])
    for count in range(1, 6):
        folder = tmp_path_factory.mktemp("since") / f"of-{count}"
        dataset = read_dataset(write_dataset(folder, [VIEW], leds_m[:count], 0.03))
        frames[count] = read_frame(dataset, dataset.frames[0])
    return frames


def test_every_variant_states_its_needs() -> None:
    assert all(variant.needs is not None for variant in OWN.values())
    assert {"v-p4l", "nakazawa2013", "rahman2011", "kim", "huynh2016-as-printed"} == OWN.keys() - set(GENERAL)


@pytest.mark.parametrize("name", GENERAL)
def test_the_stated_number_of_leds_suffices_and_one_less_does_not(few: dict[int, DeviceFrame], name: str) -> None:
    needs = OWN[name].needs
    assert needs is not None
    assert np.isfinite(OWN[name].estimate(few[needs.leds]).position_m).all()
    if needs.leds > 1:
        with pytest.raises(EstimationFailure):
            OWN[name].estimate(few[needs.leds - 1])


@pytest.mark.parametrize("name", GENERAL)
def test_an_accelerometer_is_needed_where_it_is_stated(few: dict[int, DeviceFrame], name: str) -> None:
    needs = OWN[name].needs
    assert needs is not None
    frame = replace(few[needs.leds], accelerometer=None, accelerometer_m_s2=None)
    if "accelerometer" in needs.sensors:
        with pytest.raises(EstimationFailure):
            OWN[name].estimate(frame)
    else:
        assert np.isfinite(OWN[name].estimate(frame).position_m).all()
