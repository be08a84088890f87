"""The rivals of Table 3 on rendered frames of the cameras they need: the recipes of datasets/, at fewer pixels."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL

from estimator.evaluate.batch import estimate_dataset
from estimator.io.dataset import read_dataset
from estimator.io.estimates import EstimateRow
from estimator.methods.catalogue import VARIANTS
from vlcrender.dataset.generate import generate
from vlcrender.dataset.plan import load_plan

STEREO = (*SMALL, "regions.margin_px=8", "poses.count=2", "accelerometer.error_deg=0")
FISH_EYE = (
    *("camera.width_px=800", "camera.height_px=600", "camera.pixel_pitch_um=6.0", "exposure_s=6.4e-6"),
    *("poses.border_px=4", "poses.count=2"),
)


def made(directory: Path, recipe: str, assignments: Sequence[str]) -> Path:
    generate(load_plan(ROOT / "datasets" / recipe, assignments), directory)
    return directory


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("rivals") / "stereo", "stereo.toml", STEREO)


@pytest.fixture(scope="module")
def tilted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tilts = ("poses.tilt_x_deg=[3, 3]", "poses.tilt_y_deg=[0, 20]")
    return made(tmp_path_factory.mktemp("rivals") / "tilted", "stereo.toml", (*STEREO, *tilts))


@pytest.fixture(scope="module")
def fish_eye(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("rivals") / "fish-eye", "fisheye.toml", FISH_EYE)


def rows(folder: Path, name: str) -> tuple[EstimateRow, ...]:
    return estimate_dataset(read_dataset(folder), [VARIANTS[name]], on_frame=lambda: None)[name]


def errors_m(folder: Path, name: str) -> list[float]:
    truth = pq.read_table(folder / "truth.parquet").to_pylist()
    found = rows(folder, name)
    assert all(row.status == "ok" for row in found), [row.reason for row in found]
    return [
        float(np.linalg.norm(np.subtract(a.position_m, b["position_m"]))) for a, b in zip(found, truth, strict=True)
    ]


@pytest.mark.slow
def test_a_fish_eye_is_located(fish_eye: Path) -> None:
    """LEDs of 4 px radius and 3000 e: centroids to 0.02 px of 286 px to the image distance, 0.1 mm at 2 m.

    The fall of light by cos^4 pulls the centroid of a disc of radius r at depth z inwards by r^2 / z^2, which puts the
    camera r^2 / z too low, 0.5 to 1 mm; the ellipse adds as much.
    """
    assert max(errors_m(fish_eye, "nakazawa2013")) < 3e-3


@pytest.mark.slow
def test_two_level_cameras_are_located(stereo: Path) -> None:
    """0.02 px of some 60 px of disparity: 1 mm of range; across, times distance over pattern, 2.6 m / 0.25 m, over
    the root of a dozen LEDs: 3 mm, of which the worst of four frames may be thrice.
    """
    assert len(rows(stereo, "rahman2011")) == 4
    assert max(errors_m(stereo, "rahman2011")) < 10e-3
    assert max(errors_m(stereo, "kim")) < 3e-3


@pytest.mark.slow
def test_ranges_by_disparity_do_not_depend_on_tilt_and_vectors_are_refused(tilted: Path) -> None:
    assert max(errors_m(tilted, "rahman2011")) < 15e-3
    tilts = pq.read_table(tilted / "truth.parquet", columns=["tilt_y_deg"])["tilt_y_deg"].to_pylist()
    refused = [
        row.reason == "leveling: the camera is tilted, and the method assumes it parallel to the ceiling"
        for row in rows(tilted, "kim")
    ]
    assert refused == [abs(tilt) > 5 for tilt in tilts]
    assert any(refused)


@pytest.mark.slow
def test_each_refuses_the_other_s_camera(stereo: Path, fish_eye: Path) -> None:
    assert {row.reason for row in rows(fish_eye, "yoshino2008")} == {"camera: has a fish-eye lens, needed a normal one"}
    assert {row.reason for row in rows(stereo, "nakazawa2013")} == {"camera: has a normal lens, needed a fish-eye"}
    assert {row.reason for row in rows(fish_eye, "kim")} == {"stereo: no second camera took this shot"}
    assert max(errors_m(stereo, "yoshino2008")) < 10e-3
