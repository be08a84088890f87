"""Checks of a plan before its first frame: poses, true cameras and LEDs, and furniture.

All poses of a small set are made, as its frames make them; of a large one a thousand of them, evenly spread, so that a
plan of a million poses is checked within seconds. Places of a grid or a list are cheap, and all are checked. An
impossible pose among the others stops the run at its frame: nothing else of the set is wrong then.
"""

from collections.abc import Callable
from functools import cache, partial
from itertools import product

import numpy as np

from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.pose_sampling import places_m
from vlcrender.dataset.run.frame_job import poses_of
from vlcrender.dataset.world.true_world import built_leds, device_of_pose, true_camera
from vlcrender.errors import InputError
from vlcrender.light.lightmap import room_mesh
from vlcrender.rendering.readout import RollingPoses
from vlcrender.rendering.renderer import check_inside

MAX_POSES = 1000
"""Poses that are made before the first frame."""
POSES_A_REPORT = 100


def check_possible(plan: Plan, report: Callable[[float], None] = lambda share: None) -> None:
    """Raise InputError where a pose, a true camera or LED, the furniture or the split of a plan is impossible.

    report: gets the share of the poses that are checked, from time to time.
    """
    _check_places(plan)
    mounted_of = cache(partial(true_camera, plan.recipe))
    shots = {0} if plan.recipe.motion is None else {0, plan.recipe.burst_frames - 1}
    numbers = poses_to_check(plan.recipe.pose_numbers)
    for done, pose_number in enumerate(numbers):
        for which, shot in product(range(len(plan.recipe.cameras)), shots):
            mounted = mounted_of(which, device_of_pose(plan.recipe, pose_number))
            *_, during = poses_of(plan.recipe, plan.scene, pose_number, mounted, shot)
            first, last = during.ends if isinstance(during, RollingPoses) else (during[0], during[-1])
            check_inside(plan.scene, first)
            check_inside(plan.scene, last)
        if (done + 1) % POSES_A_REPORT == 0:
            report((done + 1) / len(numbers))
    if plan.recipe.belief is not None:
        for map_number in range(plan.recipe.belief.maps):
            built_leds(plan.recipe, plan.scene, map_number)
    room_mesh(plan.scene)
    if plan.recipe.split is not None:
        plan.recipe.split.name_at((0.0, 0.0), plan.scene.room_m, plan.recipe.seed)


def poses_to_check(numbers: range) -> list[int]:
    """All of a few poses; of more, MAX_POSES evenly spread ones, the first and the last included."""
    if len(numbers) <= MAX_POSES:
        return list(numbers)
    return [numbers[place * (len(numbers) - 1) // (MAX_POSES - 1)] for place in range(MAX_POSES)]


def _check_places(plan: Plan) -> None:
    """Raise InputError for the first pose of a grid or a list that is not inside the room, whatever the number."""
    numbers = plan.recipe.pose_numbers
    places = places_m(plan.recipe.poses, plan.scene)
    if places is None:
        return
    places = places[numbers.start : numbers.stop]
    outside = np.flatnonzero(((places <= 0) | (places >= plan.scene.room_m)).any(axis=1))
    if outside.size:
        number = int(outside[0])
        raise InputError(
            f"poses: pose {numbers[number]}: camera position {places[number].tolist()} m is not inside the room of "
            f"{plan.scene.room_m.tolist()} m"
        )
