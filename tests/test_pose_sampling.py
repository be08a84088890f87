"""Poses of the frames: aimed poses span their ranges evenly and without correlation, and respect every limit."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from scipy import stats

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.config.toml_model import check, read_toml
from vlcrender.core.random_keys import stream
from vlcrender.dataset.recipe import pose_sampling
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.recipe.pose_sampling import (
    AimedPoses,
    GridPoses,
    ListedPoses,
    PoseEntry,
    TiltGridPoses,
    pose_of_frame,
)
from vlcrender.errors import InputError
from vlcrender.scene.loader import Scene, build_scene
from vlcrender.scene.schema import SceneSettings

COUNT = 200
CAMERA = Camera(width_px=400, height_px=300, pixel_pitch_um=60.0)
"""300 px a radian: 67 deg wide and 53 deg high."""
NARROW = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)
"""1500 px a radian: 15 deg wide and 11 deg high."""
OPEN = AimedPoses(
    kind="aimed",
    count=COUNT,
    tilt_x_deg=(-20.0, 20.0),
    tilt_y_deg=(-10.0, 30.0),
    height_m=(1.0, 2.0),
    min_leds=1,
    border_px=0.0,
)
"""Poses of `NARROW` below one LED in the middle of the ceiling: every draw is inside the room. Those where the LED's
rim, 8 px or less from its centre, is beyond the border are rejected."""


def scene_of(*positions_m: tuple[float, float, float], folder: Path = Path(), **tables: object) -> Scene:
    """A room of 7 x 7 x 3.5 m with these LEDs and other tables."""
    tree = read_toml(ROOT / "scenes/table1.toml")
    leds = [
        {"id": number, "position_m": list(position), "radius_m": 0.01, "luminance_cd_m2": 9000.0}
        for number, position in enumerate(positions_m)
    ]
    return build_scene(check({**tree, "led": leds, **tables}, SceneSettings, "poses"), "poses", folder)


def poses_of(
    settings: AimedPoses, scene: Scene, seed: int = 7, count: int | None = None, camera: Camera = NARROW
) -> list[Pose]:
    frames = range(settings.count if count is None else count)
    return [pose_of_frame(settings, frame, seed, camera, scene) for frame in frames]


@pytest.fixture(scope="module")
def central() -> Scene:
    return scene_of((3.5, 3.5, 3.5))


@pytest.fixture(scope="module")
def drawn(central: Scene) -> list[Pose]:
    return poses_of(OPEN, central)


def test_each_tilt_has_one_frame_in_each_of_its_strata(drawn: list[Pose]) -> None:
    """A range is cut into as many equal strata as there are frames; within its stratum a tilt is uniform."""
    for name, (low, high) in (("tilt_x_deg", OPEN.tilt_x_deg), ("tilt_y_deg", OPEN.tilt_y_deg)):
        places = (np.array([getattr(pose, name) for pose in drawn]) - low) / (high - low) * COUNT
        assert sorted(np.floor(places).astype(int)) == list(range(COUNT))
        # One in 10 000 true samples would fail.
        assert stats.kstest(places % 1, "uniform").pvalue > 1e-4


def test_the_tilts_are_shuffled_against_each_other_and_against_the_frames(drawn: list[Pose]) -> None:
    """A sample correlation of n independent pairs has the standard error 1 / sqrt(n - 1)."""
    columns = [[pose.tilt_x_deg for pose in drawn], [pose.tilt_y_deg for pose in drawn], list(range(COUNT))]
    correlations = np.corrcoef(columns)[np.triu_indices(3, 1)]
    assert np.abs(correlations).max() < 4 / math.sqrt(COUNT - 1)


def test_yaw_covers_the_circle_and_height_its_range(drawn: list[Pose]) -> None:
    """Uniform, where no draw is rejected; one in 10 000 true samples would fail each."""
    assert stats.kstest([(pose.yaw_deg + 180) / 360 for pose in drawn], "uniform").pvalue > 1e-4
    assert stats.kstest([pose.position_m[2] - 1.0 for pose in drawn], "uniform").pvalue > 1e-4


def test_the_image_of_the_target_is_anywhere_on_the_sensor(drawn: list[Pose], central: Scene) -> None:
    """Uniform in both directions and independent, but for the 8 px at the border: 3 % of the width at most."""
    u, v = np.array([PosedCamera(NARROW, pose).project(central.leds.centers_m[0]) for pose in drawn]).T
    # One in 10 000 true samples would fail each; 200 of them show a deviation of 16 %.
    assert stats.kstest(u / 400, "uniform").pvalue > 1e-4
    assert stats.kstest(v / 300, "uniform").pvalue > 1e-4
    assert abs(np.corrcoef(u, v)[0, 1]) < 4 / math.sqrt(COUNT - 1)


BOARD = "v 0 0 0\nv 3.6 0 0\nv 3.6 7 0\nv 0 7 0\nf 1 2 3\nf 1 3 4\n"
"""A board over half of the room and a little more."""


def test_leds_behind_furniture_do_not_count(tmp_path: Path) -> None:
    """Two LEDs, one above a board that hides it from nearly everywhere: rays to the other cross beside the board."""
    (tmp_path / "board.obj").write_text(BOARD)
    board = {"file": "board.obj", "position_m": [0.0, 0.0, 3.0]}
    places = ((2.5, 3.5, 3.5), (4.5, 3.5, 3.5))
    hidden = 0
    for scene in (scene_of(*places, folder=tmp_path, furniture=[board]), scene_of(*places)):
        for pose in poses_of(OPEN, scene, count=60, camera=CAMERA):
            posed = PosedCamera(CAMERA, pose)
            u, v = posed.project(scene.leds.centers_m).T
            camera_m = np.array(pose.position_m)
            share = (3.0 - camera_m[2]) / (scene.leds.centers_m[:, 2] - camera_m[2])
            crossing_m = camera_m[0] + share * (scene.leds.centers_m[:, 0] - camera_m[0])
            clear = (crossing_m > 3.6) & (u > 0) & (u < 400) & (v > 0) & (v < 300)
            if scene.settings.furniture:
                assert clear.any()
            else:
                hidden += not clear.any()
    assert hidden > 10  # without the board many poses see the other LED alone


def test_the_refusal_says_how_many_leds_the_best_pose_sees(
    tmp_path: Path, central: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_sampling, "TRIES", 200)
    (tmp_path / "board.obj").write_text(BOARD.replace("3.6", "7"))
    covered = scene_of(
        (3.5, 3.5, 3.5), folder=tmp_path, furniture=[{"file": "board.obj", "position_m": [0.0, 0.0, 3.0]}]
    )
    one = "sees 1 LEDs whole at tilts .*: the most that any pose sees is 0; lower min_leds"
    with pytest.raises(InputError, match=one):
        pose_of_frame(OPEN, 0, 7, CAMERA, covered)
    with pytest.raises(InputError, match=r"sees 2 LEDs whole .*: the most that any pose sees is 1; lower"):
        pose_of_frame(OPEN.model_copy(update={"min_leds": 2}), 0, 7, CAMERA, central)
    with pytest.raises(InputError, match="none is inside the room; lower min_leds"):
        pose_of_frame(OPEN.model_copy(update={"wall_distance_m": 3.6}), 0, 7, CAMERA, central)


def test_every_led_is_a_target() -> None:
    """Of three LEDs far apart each is the target of a third of the frames: binomial, 5 standard errors."""
    scene = scene_of((1.5, 3.5, 3.5), (3.5, 3.5, 3.5), (5.5, 3.5, 3.5))
    level = OPEN.model_copy(update={"tilt_x_deg": (0.0, 0.0), "tilt_y_deg": (0.0, 0.0)})
    x_m = np.array([pose.position_m[0] for pose in poses_of(level, scene)])
    for led_m in (1.5, 3.5, 5.5):
        share = float(np.mean(np.abs(x_m - led_m) < 0.5))  # 200 of 1500 px a radian, 2.5 m below: 0.33 m
        assert abs(share - 1 / 3) < 5 * math.sqrt(2 / 9 / COUNT)


def test_a_pose_depends_on_seed_and_frame_alone(drawn: list[Pose], central: Scene) -> None:
    assert pose_of_frame(OPEN, 150, 7, NARROW, central) == drawn[150]
    assert not set(drawn) & set(poses_of(OPEN, central, seed=8, count=20))


def test_the_poses_of_a_set_share_their_two_permutations(central: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pose costs the same in a set of any size: no work in proportion to `count` is done again."""
    drawn_keys = []

    def counted(*parts: int | str) -> np.random.Generator:
        drawn_keys.append(str(parts[-1]))
        return stream(*parts)

    monkeypatch.setattr(pose_sampling, "stream", counted)
    poses_of(OPEN, central, seed=991, count=10)
    assert drawn_keys.count("aim") == 10
    assert sorted(key for key in drawn_keys if "strata" in key) == ["tilt-x-strata", "tilt-y-strata"]


GRID = TiltGridPoses(
    kind="tilt-grid",
    tilt_x_deg=(-20.0, 20.0, 3),
    tilt_y_deg=(0.0, 30.0, 4),
    per_cell=2,
    height_m=(1.0, 2.0),
    min_leds=1,
    border_px=0.0,
)


def test_a_grid_of_tilts_has_each_pair_in_order(central: Scene) -> None:
    assert GRID.count == 24
    poses = [pose_of_frame(GRID, number, 7, NARROW, central) for number in range(GRID.count)]
    pairs = [(x, y) for x in (-20.0, 0.0, 20.0) for y in (0.0, 10.0, 20.0, 30.0) for _ in range(2)]
    assert [(pose.tilt_x_deg, pose.tilt_y_deg) for pose in poses] == pairs
    assert len({pose.position_m for pose in poses}) == 24


def test_poses_of_a_grid_are_aimed_by_the_same_rules(central: Scene) -> None:
    """A pose is that of a set of aimed poses whose tilts have no spread: target, height, yaw and place are its own."""
    for number in (0, 13, 23):
        x, y = GRID.tilts_deg(number)
        aimed = OPEN.model_copy(update={"tilt_x_deg": (x, x), "tilt_y_deg": (y, y)})
        assert pose_of_frame(GRID, number, 7, NARROW, central) == pose_of_frame(aimed, number, 7, NARROW, central)


def test_a_scaled_grid_keeps_its_border_in_the_image() -> None:
    table = (
        "{ kind = 'tilt-grid', tilt_x_deg = [0, 60, 7], tilt_y_deg = [5, 5, 1], per_cell = 3, height_m = [0.1, 1.8] }"
    )
    recipe = load_plan(ROOT / "datasets/quickstart.toml", [f"poses={table}"], scale=10).recipe
    assert isinstance(recipe.poses, TiltGridPoses)
    assert (recipe.poses.border_px, recipe.frame_count) == (2.0, 21)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tilt_x_deg": [10, 0, 3]}, "tilt_x_deg = [10.0, 0.0, 3]: the lower value comes first"),
        ({"tilt_y_deg": [0, 10, 1]}, "tilt_y_deg = [0.0, 10.0, 1]: a single value is lowest and highest"),
        ({"tilt_x_deg": [0, 86, 3]}, "tilt_x_deg[1] = 86: input should be less"),
        ({"height_m": [2, 1]}, "height_m = [2.0, 1.0]: the lower value comes first"),
    ],
)
def test_a_grid_that_is_impossible_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(InputError) as refusal:
        check({**GRID.model_dump(mode="json"), **change}, TiltGridPoses, "poses")
    assert words in str(refusal.value)


def test_positions_keep_the_distance_from_the_walls() -> None:
    """Aimed at an LED 0.5 m from two walls, from 2 m below at 30 deg: 1.15 m aside, in all directions of yaw."""
    settings = OPEN.model_copy(
        update={"tilt_x_deg": (30.0, 30.0), "tilt_y_deg": (0.0, 0.0), "height_m": (1.5, 1.5), "wall_distance_m": 0.4}
    )
    places = np.array([pose.position_m for pose in poses_of(settings, scene_of((0.5, 0.5, 3.5)), count=100)])
    assert places[:, :2].min() > 0.4
    # Allowed places span x from 0.4 to 1.65 m; of 100 some are in the lowest tenth.
    assert places[:, :2].min() < 0.4 + 0.1 * 1.25
    opposite = np.array([pose.position_m for pose in poses_of(settings, scene_of((6.5, 6.5, 3.5)), count=100)])
    assert 6.6 - 0.1 * 1.25 < opposite[:, :2].max() < 6.6


def test_enough_leds_are_whole_and_within_the_border() -> None:
    """Five LEDs 0.5 m apart, some 75 px in the image: aimed at an end of the row, only some yaws show three of them."""
    scene = scene_of(*((2.5 + 0.5 * k, 3.5, 3.5) for k in range(5)))
    settings = OPEN.model_copy(update={"min_leds": 3, "border_px": 60.0, "height_m": (1.0, 1.6)})
    for pose in poses_of(settings, scene, count=40, camera=CAMERA):
        u, v = PosedCamera(CAMERA, pose).project(scene.leds.centers_m).T
        inside = (u > 60) & (u < 340) & (v > 60) & (v < 240)
        assert inside.sum() >= 3


def test_no_pose_above_or_level_with_its_target_is_drawn(central: Scene) -> None:
    with pytest.raises(InputError, match=r"poses: frame 0: no position in 10000 tries sees 1 LEDs whole"):
        pose_of_frame(OPEN.model_copy(update={"height_m": (3.5, 3.6)}), 0, 7, CAMERA, central)


def test_a_grid_has_the_centres_of_equal_cells_with_x_fastest(central: Scene) -> None:
    grid = GridPoses(kind="grid", columns=4, rows=2, height_m=0.3, yaw_deg=15.0)
    poses = [pose_of_frame(grid, frame, 7, CAMERA, central) for frame in range(grid.count)]
    by_hand = [(x, y, 0.3) for y in (1.75, 5.25) for x in (0.875, 2.625, 4.375, 6.125)]
    assert [pose.position_m for pose in poses] == by_hand
    assert {(pose.tilt_x_deg, pose.tilt_y_deg, pose.yaw_deg) for pose in poses} == {(0.0, 0.0, 15.0)}


def test_listed_poses_are_taken_in_order(central: Scene) -> None:
    entries: list[dict[str, Any]] = [
        {"position_m": (1.0, 2.0, 0.5), "tilt_x_deg": 3.0, "tilt_y_deg": -4.0, "yaw_deg": 5.0},
        {"position_m": (2.0, 1.0, 0.5)},
    ]
    listed = ListedPoses(kind="list", pose=tuple(PoseEntry(**entry) for entry in entries))
    assert pose_of_frame(listed, 0, 7, CAMERA, central) == Pose((1.0, 2.0, 0.5), 3.0, -4.0, 5.0)
    assert pose_of_frame(listed, 1, 7, CAMERA, central) == Pose((2.0, 1.0, 0.5))


def test_the_same_seed_has_the_same_pose_in_every_version(central: Scene) -> None:
    """A pinned pose, to the rounding of sines: where it changes, so does every dataset; raise DATA_VERSION."""
    pose = pose_of_frame(OPEN, 3, 7, CAMERA, central)
    assert pose.position_m == pytest.approx((2.958660315288494, 2.4121514497586896, 1.9700496111767918), abs=1e-12)
    tilts = (pose.tilt_x_deg, pose.tilt_y_deg, pose.yaw_deg)
    assert tilts == pytest.approx((-15.550436353932266, -9.841290580591249, -58.22484129081519), abs=1e-12)
