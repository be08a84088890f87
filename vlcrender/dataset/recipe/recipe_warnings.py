"""Warnings of what is odd in a recipe: lenses, and pixels that do not fit the full well of their sensor's preset."""

from functools import cache

from vlcrender.config.presets import preset, presets
from vlcrender.dataset.recipe.recipe import Recipe

MIN_VIEW_DEG, MAX_PERSPECTIVE_DEG = 2.0, 140.0
"""Angles of view beyond which a lens is odd: the widest perspective lenses of phones have 120 deg."""
SENSOR_KEYS = ("full_well_e", "prnu", "read_noise_e")
"""Keys by which a sensor is taken to be that of a preset."""


def recipe_warnings(recipe: Recipe) -> tuple[str, ...]:
    """What is odd in a recipe, one line each; the recipe as written, not `scaled`."""
    warnings = []
    for mounted in recipe.cameras:
        camera = mounted.camera
        across, _ = camera.view_angles_deg()
        if across < MIN_VIEW_DEG or (camera.projection == "perspective" and across > MAX_PERSPECTIVE_DEG):
            warnings.append(
                f"camera {mounted.name!r} sees {across:.3g} deg across: a lens of {camera.focal_length_mm:g} mm on "
                f"{camera.width_px} pixels of {camera.pixel_pitch_um:g} um; is focal_length_mm right?"
            )
    if recipe.sensor.noise != "full":  # simpler sensors are ideals of any size
        return tuple(warnings)
    for name, pitch_um, values in _sensors():
        if values == tuple(getattr(recipe.sensor, key) for key in SENSOR_KEYS):
            warnings += [
                f"camera {mounted.name!r} has pixels of {mounted.camera.pixel_pitch_um:g} um, but the full well, "
                f"{recipe.sensor.full_well_e:g} electrons, of preset {name!r} with {pitch_um:g} um; is "
                "sensor.full_well_e right?"
                for mounted in recipe.cameras
                if mounted.camera.pixel_pitch_um != pitch_um
            ]
    return tuple(warnings)


@cache
def _sensors() -> tuple[tuple[str, float, tuple[float, ...]], ...]:
    """Presets of sensors that state a pixel pitch: name, pitch in um, and the values of SENSOR_KEYS."""
    trees = {name: preset("sensors", name) for name in presets("sensors")}
    return tuple(
        (name, tree["camera"]["pixel_pitch_um"], tuple(tree["sensor"].get(key, 0.0) for key in SENSOR_KEYS))
        for name, tree in trees.items()
        if "pixel_pitch_um" in tree.get("camera", {})
    )
