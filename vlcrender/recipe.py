"""A recipe: all that a dataset is made from. TOML in, checked model and scene out."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from vlcrender.camera import Camera
from vlcrender.errors import InputError
from vlcrender.inertial import Accelerometer
from vlcrender.poses import Poses
from vlcrender.scene import Scene, load_scene
from vlcrender.sensor import Sensor
from vlcrender.settings import Settings, check, override, read_toml


class Recipe(Settings):
    """A recipe file."""

    format: Literal["vlcrender-recipe"]
    version: Literal[1]
    name: Annotated[str, Field(min_length=1, max_length=100)]
    description: str = ""
    scene: str
    """Path of the scene file, from the recipe's folder."""
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    exposure_s: Annotated[float, Field(gt=0, le=100)]
    expected: bool = False
    """Whether the noise-free images are written too."""
    camera: Camera = Camera()
    sensor: Sensor = Sensor()
    accelerometer: Accelerometer = Accelerometer()
    poses: Poses


@dataclass(frozen=True)
class Plan:
    """A checked recipe with its scene."""

    recipe: Recipe
    scene: Scene


def load_plan(path: Path, assignments: Iterable[str] = ()) -> Plan:
    """Read a recipe, apply `key=value` assignments, read its scene. Raises InputError naming file, key and value."""
    assignments = list(assignments)
    source = f"{path} with --set" if assignments else str(path)
    recipe = check(override(read_toml(path), assignments), Recipe, source)
    scene_path = Path(path.parent / recipe.scene)
    if not scene_path.is_file():
        raise InputError(f"{source}: scene = {recipe.scene!r}: no such file from the recipe's folder")
    return Plan(recipe, load_scene(scene_path))
