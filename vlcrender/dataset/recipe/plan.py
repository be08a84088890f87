"""Plans: recipe files with assignments, presets and sweeps resolved, and their scenes. TOML in, checked models out."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vlcrender.camera.calibration import with_calibrations
from vlcrender.config.packaged import find_file
from vlcrender.config.presets import resolved
from vlcrender.config.toml_model import check, read_toml
from vlcrender.dataset.recipe.light_checks import check_light
from vlcrender.dataset.recipe.pose_file import with_pose_file
from vlcrender.dataset.recipe.recipe import Recipe, ScaleMode, scaled
from vlcrender.dataset.recipe.recipe_warnings import recipe_warnings
from vlcrender.dataset.recipe.sweep import Cell, Sweep, SweepTables, Value
from vlcrender.errors import InputError
from vlcrender.scene.loader import Scene, load_scene


@dataclass(frozen=True)
class Plan:
    """A resolved recipe with its scene. Of a recipe with [[sweep]]: the first cell, with all cells in `cells`."""

    recipe: Recipe
    scene: Scene
    values: Mapping[str, Value] = field(default_factory=dict)
    """Values of a cell of a sweep, by name."""
    cells: "PlannedCells | None" = None
    """The cells of a sweep; None without [[sweep]], and in a cell's own plan."""
    warnings: tuple[str, ...] = ()
    """What is odd in the recipe."""

    presets: Mapping[str, str] = field(default_factory=dict)
    """Name of the preset of each table that names one; other keys of the recipe may replace its values."""

    @property
    def frame_count(self) -> int:
        """Number of frames, of all cells together."""
        return self.recipe.frame_count if self.cells is None else sum(self.cells.frame_counts)


@dataclass(frozen=True)
class PlannedCells:
    """The cells of a sweep; each was checked, and makes its plan when it is asked for."""

    sweep: Sweep
    frame_counts: tuple[int, ...]
    source: "RecipeSource"

    def __len__(self) -> int:
        """Number of cells."""
        return len(self.frame_counts)

    def plan(self, number: int) -> Plan:
        """The plan of a cell. Cells with the same scene share it."""
        return self.source.plan(self.sweep.cell(number))


MAX_SCENES = 8
"""Scenes of a sweep's cells that are kept; the one made first is dropped first."""


@dataclass(frozen=True, eq=False)
class RecipeSource:
    """A recipe file with assignments, of which plans are made."""

    path: Path
    tree: Mapping[str, Any]
    assignments: tuple[str, ...]
    scale: int
    scale_mode: ScaleMode
    _scenes: dict[tuple[Path, tuple[str, ...]], Scene] = field(default_factory=dict)

    def __str__(self) -> str:
        """The file, in messages."""
        return f"{self.path} with --set" if self.assignments else str(self.path)

    def tree_with(self, swept: Sequence[str] = (), how: str = "--set ") -> tuple[dict[str, Any], dict[str, str]]:
        """The recipe's tree with presets, assignments (of a cell too) and files inserted, and the presets' names.

        `how`: as in `override`.
        """
        assignments = [a for a in (*self.assignments, *swept) if not a.lstrip().startswith("scene.")]
        source = f"{self}" if not swept else how.removesuffix(": ")
        tree = dict(self.tree)
        keys = {assignment.partition("=")[0].partition(".")[0].strip() for assignment in assignments}
        for way, other in (("exposure", "exposure_s"), ("exposure_s", "exposure")):
            if way in keys and other not in keys:
                tree.pop(other, None)  # the assigned way to expose replaces the recipe's
        tree, names = resolved(tree, assignments, source, how)
        tree = with_calibrations(tree, self.tree, assignments, self.path.parent, source)
        tree = with_pose_file(tree, self.path.parent, source)
        noise = tree.get("added_noise")
        if "added_noise" in keys and isinstance(noise, dict) and noise.get("relative_to") == "photon":
            for way in {"exposure", "exposure_s"} - keys:
                tree.pop(way, None)
        return tree, names

    def plan(self, cell: Cell | None = None) -> Plan:
        """The plan of the recipe, or of a cell of its sweep. Raises InputError that names file, key and value."""
        source, how = (f"{self}", "--set ") if cell is None else (f"{self}: {cell}", f"{self}: {cell}: ")
        swept = () if cell is None else cell.assignments
        tree, names = self.tree_with(swept, how)
        tree.pop("sweep", None)
        recipe = check(tree, Recipe, source)
        try:
            scene_path = find_file("scene", recipe.scene, self.path.parent)
        except InputError as error:
            raise InputError(f"{source}: scene = {error}") from None
        if not scene_path.is_file():
            raise InputError(f"{source}: scene = {recipe.scene!r}: no such file, relative to the recipe's folder")
        own = [a.strip().removeprefix("scene.") for a in (*self.assignments, *swept) if a.lstrip().startswith("scene.")]
        scene = self._scenes.get(key := (scene_path, tuple(own)))
        if scene is None:
            of_cell = "" if cell is None else f"{source}: "
            scene = load_scene(scene_path, own, f"{of_cell}{scene_path}", f"{how}scene.")
            self._scenes[key] = scene
            while len(self._scenes) > MAX_SCENES:
                del self._scenes[next(iter(self._scenes))]
        warnings = recipe_warnings(recipe)
        recipe = scaled(recipe, self.scale, self.scale_mode)
        check_light(recipe, scene, source, self.scale)
        return Plan(recipe, scene, {} if cell is None else cell.values, presets=names, warnings=warnings)


def load_plan(path: Path, assignments: Iterable[str] = (), scale: int = 1, scale_mode: ScaleMode = "binned") -> Plan:
    """Read a recipe, insert presets and `key=value` assignments, apply `scaled`, and read the scene.

    A key `scene.KEY` is one of the scene file. Every cell of a sweep is checked. Raises InputError that names file, key
    and value.
    """
    source = RecipeSource(path, read_toml(path), tuple(assignments), scale, scale_mode)
    tree, _ = source.tree_with()
    if not tree.get("sweep"):
        return source.plan()
    tables = check({"sweep": tree["sweep"]}, SweepTables, str(source)).sweep
    try:
        sweep = Sweep(tables, tree["seed"] if isinstance(tree.get("seed"), int) else 0, None)
        if any(table.uniform is not None for table in tables):
            numbers = [source.plan(cell).recipe.pose_numbers for cell in sweep]
            if any(own != numbers[0] for own in numbers):
                raise InputError(
                    "sweep: the number of poses is swept, and uniform makes each pose a cell; remove either"
                )
            sweep = Sweep(tables, sweep.seed, numbers[0])
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(str(source)) else f"{source}: {message}") from None
    counts = tuple(source.plan(cell).recipe.frame_count for cell in sweep)
    cells = PlannedCells(sweep, counts, source)
    return replace(cells.plan(0), cells=cells)
