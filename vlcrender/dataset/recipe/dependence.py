"""What the parts of a frame depend on: cells of a sweep whose recipes agree in it share them."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from vlcrender.dataset.recipe.recipe import Recipe

MAX_RECIPES = 1024
"""Recipes that are kept; the one used longest ago is dropped first."""
NOT_IN_FILES: dict[str, Any] = {
    **dict.fromkeys(
        ("name", "description", "licence", "accelerometer", "gyroscope", "demodulation", "map", "bound", "split"), True
    ),
    "belief": {"accelerometer", "stated_factor"},
}
"""Keys of a recipe without effect on the files of a frame: they act on tables alone."""
NOT_IN_VIEWS: dict[str, Any] = {
    **NOT_IN_FILES,
    **dict.fromkeys(("exposure_s", "exposure", "added_noise", "expected", "processed", "files", "sensor"), True),
}
"""Keys of a recipe without effect on expected images a second. Of the sensor, its spectral response has one; the
exposure time has one where the camera moves."""


@dataclass(frozen=True)
class Seen:
    """What the views of a recipe depend on beside the scene: recipes with the same views are equal here."""

    key: str
    recipe: Recipe = field(compare=False, repr=False)


@dataclass(frozen=True)
class KeyedRecipe:
    """A recipe with the keys of what it shares with others."""

    recipe: Recipe
    seen: Seen
    files_key: str
    """Text of all that the files of a frame depend on beside the scene and the frame's number."""


def view_key(recipe: Recipe) -> str:
    """Text of all that expected images a second depend on beside the scene."""
    excluded = {key: value for key, value in NOT_IN_VIEWS.items() if key != "exposure_s" or recipe.motion is None}
    return recipe.model_dump_json(exclude=excluded) + recipe.sensor.spectral_response


@lru_cache(maxsize=MAX_RECIPES)
def keyed_recipe(recipe_json: str) -> KeyedRecipe:
    """A recipe from its JSON, with its keys."""
    recipe = Recipe.model_validate_json(recipe_json)
    return KeyedRecipe(recipe, Seen(view_key(recipe), recipe), recipe.model_dump_json(exclude=NOT_IN_FILES))
