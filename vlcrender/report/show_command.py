"""Command `vlcrender show`; it loads the modules that it needs when it runs, as `vlcrender.cli` does."""

import json
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from vlcrender.core.arguments import Whole
from vlcrender.errors import InputError

if TYPE_CHECKING:
    from vlcrender.scene.loader import Scene

log = logging.getLogger(__name__)

MAX_PAIRS = 1e10
"""Pairs of an LED and a lit point up to which the light of a room is computed for a picture: a minute or two."""
HEIGHTS_M = (0.0, 0.75)
"""Heights of the poses that are counted: on the floor and on a table."""


def show(
    what: str,
    recipe: str | None = None,
    /,
    *,
    frame: Whole = 0,
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None,
    out: Path | None = None,
    reference: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Draw a room's floor plan and a view of it; print how many poses see four LEDs or more, and the flicker.

    Of a scene alone the view is that of a level camera on the floor, the default one. With a recipe it is a frame of
    the recipe as `generate` makes it, with the identities of its LEDs; the plan shows the poses.

    Parameters
    ----------
    what
        Scene or recipe file (TOML), or the name of one that comes with vlcrender, such as office or quickstart.
    recipe
        Recipe whose camera and poses are shown in the scene WHAT.
    frame
        Number of the recipe's frame.
    set_
        key=value that replaces a value of the recipe, as of `generate`. May be repeated.
    out
        PNG to write; by default the name of scene or recipe with .png in the current folder.
    reference
        Render the view of a scene alone with Mitsuba's own path integrator: slow, coarse, noisy, and independent.
    """
    from vlcrender.camera.intrinsics import Camera
    from vlcrender.config.packaged import find_file, is_recipe
    from vlcrender.dataset.recipe.plan import load_plan
    from vlcrender.dataset.run.progress import Progress
    from vlcrender.dataset.run.progress_display import ProgressDisplay
    from vlcrender.report.terminal import print_table
    from vlcrender.scene.loader import load_scene
    from vlcrender.scene.visibility import ENOUGH_LEDS, level_visibility, tilted_visibility

    shown = recipe or what
    path = out or Path(f"{Path(shown).stem}.png")
    if path.suffix.lower() != ".png":
        raise InputError(f"--out {path}: has to end in .png")
    if not path.parent.is_dir():
        raise InputError(f"--out {path}: there is no folder {path.parent}")
    plan = None
    if recipe is not None or is_recipe(what):
        assignments = list(set_ or ())
        if recipe is not None:
            load_scene(find_file("scene", what))  # a wrong scene is named as such
            assignments.append(f"scene={json.dumps(str(find_file('scene', what, Path.cwd()).resolve()))}")
        plan = load_plan(find_file("recipe", shown), assignments)
        if reference:
            raise InputError("--reference: shows a scene alone, without a recipe")
        loaded = plan.scene
        if not 0 <= frame < plan.recipe.frame_count:
            raise InputError(f"--frame {frame}: the recipe has the frames 0 to {plan.recipe.frame_count - 1}")
    elif set_ or frame:
        raise InputError(f"{what}: is a scene; --set and --frame need a recipe")
    else:
        loaded = load_scene(find_file("scene", what))
    _check_cost(loaded, shown)
    camera = Camera() if plan is None else plan.recipe.camera
    across, down = camera.view_angles_deg()
    rows = []
    for height in HEIGHTS_M:
        for visibility in (
            level_visibility(camera, loaded, height, 0.0),
            level_visibility(camera, loaded, height, 90.0),
            tilted_visibility(camera, loaded, height),
        ):
            share = f"{100 * visibility.share:.2f} %"
            rows.append((visibility.attitude, f"{height:g}", str(visibility.poses), str(visibility.seen), share))
    print_table(
        f"{loaded.name}: poses, not aimed, that see {ENOUGH_LEDS} LEDs or more "
        f"by a view of {across:.4g} x {down:.4g} deg",
        ("attitude", "height, m", "poses", "seeing", "share"),
        rows,
    )
    print_flicker(loaded)
    from vlcrender.light.lightmap import bake  # loads Mitsuba: after scene and recipe are known to be good

    with ProgressDisplay(loaded.name, 1) as bar:
        light = bake(loaded, progress=lambda stage, share: bar.show(Progress(stage, share, 1.0)))
    if plan is None:
        from vlcrender.rendering.scene_plot import draw

        draw(loaded, camera, path, reference, light)
    else:
        from vlcrender.dataset.run.recipe_plot import draw_frame

        print(draw_frame(plan, frame, path))
    print(f"{path}: written")


def _check_cost(scene: "Scene", source: str) -> None:
    """Raise InputError where the room's light would take much longer than a picture is worth."""
    x_m, y_m, z_m = scene.room_m.tolist()
    area_m2, leds, texel_m = 2 * (x_m * y_m + (x_m + y_m) * z_m), len(scene.leds), scene.settings.bake.texel_m
    if area_m2 / texel_m**2 * leds > MAX_PAIRS:
        enough_m = math.ceil(10 * math.sqrt(area_m2 * leds / MAX_PAIRS)) / 10
        raise InputError(
            f"{source}: bake.texel_m = {texel_m:g}: light of {leds} LEDs on {area_m2 / texel_m**2 / 1e6:.0f} million "
            f"points takes many minutes; {enough_m:g} m or more is drawn at once"
        )


def print_flicker(scene: "Scene") -> None:
    """Print how much the LEDs of a scene flicker, and warn where that exceeds low risk; nothing for steady light."""
    from vlcrender.modulation.flicker import flicker_of, flicker_warning
    from vlcrender.report.terminal import print_table

    found = flicker_of(scene.leds.transmitters)
    if not found:
        return
    rows = []
    for one in found:
        for name, line, beyond in (
            ("low risk", one.worst.low_risk, one.low_risk_exceeded),
            ("no effect", one.worst.no_effect, one.no_effect_exceeded),
        ):
            allowed = "any" if math.isinf(line.limit_percent) else f"{line.limit_percent:.3g} %"
            own = [f"{line.percent:.3g} %", f"{line.frequency_hz:.5g} Hz", allowed, f"{line.share:.2f}", str(beyond)]
            rows.append((one.send, name, str(one.leds), *own))
    print_table(
        f"{scene.name}: flicker against IEEE 1789, worst line of the spectra of all LEDs",
        ("sends", "limit", "LEDs", "modulation", "at", "allowed", "of limit", "LEDs beyond"),
        rows,
        left=2,
    )
    warning = flicker_warning(found)
    if warning is not None:
        log.warning("%s", warning)
