"""Physically correct images of ceiling LED panels as a tilted camera sees them, with ground truth.

    import vlcrender as vr

    scene = vr.load_scene("office")
    camera = vr.Camera(width_px=1000, height_px=750, pixel_pitch_um=4.8)
    pose = vr.Pose((3.15, 3.10, 0.60), tilt_x_deg=6, tilt_y_deg=-8)
    mean = vr.render(scene, camera, pose)
    raw = vr.expose(mean, vr.Sensor.preset("phone-1.2um"), exposure_s=160e-6, seed=1)

Names are imported when they are first used, so that `import vlcrender` loads neither Mitsuba nor SciPy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vlcrender.api import (
        ExpectedFrame,
        RawFrame,
        RawRegion,
        budget,
        export_dataset,
        expose,
        generate,
        load_recipe,
        load_scene,
        release,
        render,
        repair,
        verify,
    )
    from vlcrender.camera.intrinsics import Camera, Pose
    from vlcrender.camera.posed_camera import PosedCamera
    from vlcrender.camera.roi import LedRegions, Roi
    from vlcrender.dataset.recipe.plan import Plan
    from vlcrender.dataset.recipe.recipe import Recipe
    from vlcrender.dataset.run.progress import Progress
    from vlcrender.dataset.world.error_budget import BudgetRow, ErrorBudget
    from vlcrender.errors import InputError
    from vlcrender.rendering.expected_image import ExpectedImage
    from vlcrender.scene.loader import Scene
    from vlcrender.sensor.accelerometer import Imu, TiltError
    from vlcrender.sensor.sensor import Sensor

    __version__: str

_MODULES = {
    "load_scene": "vlcrender.api",
    "load_recipe": "vlcrender.api",
    "render": "vlcrender.api",
    "expose": "vlcrender.api",
    "export_dataset": "vlcrender.api",
    "generate": "vlcrender.api",
    "budget": "vlcrender.api",
    "verify": "vlcrender.api",
    "release": "vlcrender.api",
    "repair": "vlcrender.api",
    "ExpectedFrame": "vlcrender.api",
    "RawFrame": "vlcrender.api",
    "RawRegion": "vlcrender.api",
    "BudgetRow": "vlcrender.dataset.world.error_budget",
    "ErrorBudget": "vlcrender.dataset.world.error_budget",
    "Progress": "vlcrender.dataset.run.progress",
    "Scene": "vlcrender.scene.loader",
    "Recipe": "vlcrender.dataset.recipe.recipe",
    "Plan": "vlcrender.dataset.recipe.plan",
    "Camera": "vlcrender.camera.intrinsics",
    "Pose": "vlcrender.camera.intrinsics",
    "PosedCamera": "vlcrender.camera.posed_camera",
    "LedRegions": "vlcrender.camera.roi",
    "Roi": "vlcrender.camera.roi",
    "Sensor": "vlcrender.sensor.sensor",
    "TiltError": "vlcrender.sensor.accelerometer",
    "Imu": "vlcrender.sensor.accelerometer",
    "ExpectedImage": "vlcrender.rendering.expected_image",
    "InputError": "vlcrender.errors",
}
"""Public name -> module that defines it."""

__all__ = [
    "BudgetRow",
    "Camera",
    "ErrorBudget",
    "ExpectedFrame",
    "ExpectedImage",
    "Imu",
    "InputError",
    "LedRegions",
    "Plan",
    "Pose",
    "PosedCamera",
    "Progress",
    "RawFrame",
    "RawRegion",
    "Recipe",
    "Roi",
    "Scene",
    "Sensor",
    "TiltError",
    "__version__",
    "budget",
    "export_dataset",
    "expose",
    "generate",
    "load_recipe",
    "load_scene",
    "release",
    "render",
    "repair",
    "verify",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("vlcrender")
    elif name in _MODULES:
        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module 'vlcrender' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
