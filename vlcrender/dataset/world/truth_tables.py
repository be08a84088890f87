"""The tables of the truth of a dataset: truth.parquet, truth_devices.parquet and truth_map.parquet."""

from collections.abc import Iterable
from pathlib import Path

from vlcrender.dataset.format.rows import DeviceTruthRow, MapTruthRow, TruthRow
from vlcrender.dataset.format.tables import write_table
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.dataset.recipe.sweep import sweep_columns
from vlcrender.dataset.world.true_world import device_rows, map_rows

TRUTH, TRUTH_DEVICES, TRUTH_MAP = "truth.parquet", "truth_devices.parquet", "truth_map.parquet"
TRUTH_TABLES = (TRUTH, TRUTH_DEVICES, TRUTH_MAP)


def write_truth(plan: Plan, folder: Path, rows: Iterable[TruthRow]) -> list[str]:
    """Write the tables of the truth that a plan has into a folder, and return their names.

    rows: of truth.parquet, in order. Raises InputError where a table cannot be written.
    """
    recipe, names = plan.recipe, [TRUTH]
    write_table(folder / TRUTH, rows, TruthRow, sweep_columns(plan.values))
    if recipe.belief is not None:
        write_table(folder / TRUTH_DEVICES, device_rows(recipe), DeviceTruthRow)
        names.append(TRUTH_DEVICES)
    if recipe.belief is not None or recipe.map == "sent":
        write_table(folder / TRUTH_MAP, map_rows(recipe, plan.scene), MapTruthRow)
        names.append(TRUTH_MAP)
    return names
