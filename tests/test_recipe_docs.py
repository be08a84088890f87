"""Every key of a recipe that this package's sensor and dataset floors define has a description."""

import pytest
from pydantic import BaseModel

from vlcrender.dataset.recipe.added_noise import AddedNoise
from vlcrender.dataset.recipe.auto_exposure import NoiseLevelMetering, PeakMetering
from vlcrender.dataset.recipe.motion import Motion
from vlcrender.dataset.recipe.pose_sampling import AimedPoses, GridPoses, ListedPoses, PoseEntry, TiltGridPoses
from vlcrender.dataset.recipe.recipe import RecipeFile
from vlcrender.dataset.recipe.sweep import SweepTable
from vlcrender.sensor.accelerometer import Imu, TiltError
from vlcrender.sensor.isp import Processed
from vlcrender.sensor.quantum_efficiency import QuantumEfficiency
from vlcrender.sensor.sensor import Sensor

MODELS: tuple[type[BaseModel], ...] = (
    *(RecipeFile, SweepTable, AddedNoise, Sensor, QuantumEfficiency, TiltError, Imu, Processed, Motion),
    *(AimedPoses, TiltGridPoses, ListedPoses, PoseEntry, GridPoses, PeakMetering, NoiseLevelMetering),
)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_key_has_a_description(model: type[BaseModel]) -> None:
    assert [key for key, field in model.model_fields.items() if not field.description] == []
