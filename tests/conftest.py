"""Shared fixtures: the two scenes, a camera of a hundredth of the pixels, and small datasets made once."""

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

from vlcrender.camera.intrinsics import Camera
from vlcrender.scene.loader import Scene, load_scene

os.environ.setdefault("VLCRENDER_CACHE", tempfile.mkdtemp(prefix="vlcrender-tests-"))
# No bake of an earlier run is taken, and processes that tests start share this one's.

ROOT = Path(__file__).parent.parent
SMALL = (
    *("camera.width_px=400", "camera.height_px=300", "camera.pixel_pitch_um=12.0"),
    *("exposure_s=1.6e-6", "poses.border_px=4.0"),
)
"""The quickstart camera with a hundredth of the pixels and the same electrons in each."""


@pytest.fixture(scope="session")
def table1() -> Scene:
    return load_scene(ROOT / "scenes/table1.toml")


@pytest.fixture(scope="session")
def office() -> Scene:
    return load_scene(ROOT / "scenes/office.toml")


@pytest.fixture(scope="session")
def small_camera() -> Camera:
    return Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.Generator(np.random.Philox(20161118))
