"""Recipes: what a recipe leaves out."""

from conftest import ROOT

from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.sensor.accelerometer import TiltError


def test_a_recipe_asks_for_everything_beyond_frames() -> None:
    """Expected images, processed pictures, bounds, repeats, regions, motion and a rig come where they are asked for."""
    recipe = load_plan(ROOT / "datasets/quickstart.toml").recipe
    assert (recipe.expected, recipe.bound, recipe.repeats, recipe.rig) == (False, False, 1, ())
    assert recipe.processed is recipe.regions is recipe.motion is recipe.exposure is None
    assert recipe.accelerometer == TiltError(error_deg=0.1)
    assert recipe.frame_count == 8


def test_frames_are_counted_by_pose_shot_and_camera() -> None:
    """3 poses, 2 shots of each, 2 cameras: the camera varies fastest."""
    rig = "rig=[{ name = 'left', offset_m = [-0.1, 0.0, 0.0] }]"
    recipe = load_plan(ROOT / "datasets/quickstart.toml", ["poses.count=3", "repeats=2", rig]).recipe
    assert recipe.frame_count == 12
    places = [(pose, 2 * pose + repeat, camera) for pose in range(3) for repeat in range(2) for camera in range(2)]
    assert [recipe.place_of_frame(frame) for frame in range(12)] == places
