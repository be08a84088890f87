"""Command `estimator score`; it loads the modules that it needs when it runs, as `estimator.cli` does."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

import estimator
from estimator.errors import InputError

if TYPE_CHECKING:
    from estimator.evaluate.score import Scores

Flag = Annotated[bool, Parameter(negative=())]
ABOVE_LIMIT = 1
"""Exit code where a limit of --fail-above is exceeded."""


def score(
    dataset: Annotated[Path, Parameter(name="DATASET")],
    /,
    *bundles: Path,
    of: Annotated[Path | None, Parameter(name="--dataset")] = None,
    truth: Path | None = None,
    split: Literal["train", "validation", "test"] = "test",
    wide: Flag = False,
    plot: Flag = False,
    unit: str | None = None,
    json: Flag = False,
    csv: Flag = False,
    markdown: Flag = False,
    latex: Flag = False,
    quiet: Flag = False,
    fail_above: Annotated[list[str] | None, Parameter(negative=())] = None,
) -> int:
    """Compare all estimates with the truth, nearest variant first, and write DATASET/scores.json.

    Lengths have one unit. Median, 95 % and max are of all frames, a failed one being infinite; horizontal, vertical,
    RMSE and ms (the median time) are of the frames that succeeded. /bound is the root mean square of error over the
    frame's Cramér-Rao bound; NEES is 3 where the covariances that a variant states are right.

    Parameters
    ----------
    dataset
        Folder of a dataset with estimates, or of a sweep: each cell gets its scores.json, the table is of all cells. Or
        a bundle of estimates (.zip), of which no file is written.
    bundles
        Further bundles.
    of
        Folder of the dataset that bundles are of.
    truth
        Key file of a dataset whose truth is withheld, for bundles.
    split
        The frames that bundles are scored on, where the dataset has a split.
    wide
        All tables, as wide as they are: intervals, bounds, devices and maps, identities, failures by LEDs.
    plot
        Histograms of the errors below the table.
    unit
        Unit of all lengths: um, mm or m. Default: the largest in which the smallest median is 1 or more.
    json
        Print scores.json instead of a table; of a sweep, the table as JSON.
    csv
        Print all figures as CSV, lengths in metres.
    markdown
        Print the table with all columns in Markdown.
    latex
        Print the table with all columns as a LaTeX tabular.
    quiet
        Print no table.
    fail_above
        VARIANT:STATISTIC=LIMIT; may be given several times. Exit with 1, and say so, where a variant exceeds a limit:
        ml:median=1mm, ml:p95=2cm, max, rmse, or failures=3 (frames) or failures=5%.
    """
    from estimator.evaluate.threshold import Threshold
    from estimator.io.sweep import read_sweep
    from estimator.report.benchmark_commands import print_bundle_scores
    from estimator.report.score_lines import unit_named

    ways = [name for name, on in (("--json", json), ("--csv", csv), ("--markdown", markdown), ("--latex", latex)) if on]
    if len(ways) + wide > 1:
        raise InputError(f"{', '.join([*ways, *(['--wide'] if wide else [])])}: needed one of them at most")
    limits = [Threshold.of(text) for text in fail_above or ()]
    chosen = None if unit is None else unit_named(unit)
    if dataset.suffix == ".zip" or bundles or of is not None:
        if limits or plot or quiet or chosen or wide or set(ways) - {"--json"}:
            raise InputError(f"{dataset}: of bundles there is a table, or --json")
        print_bundle_scores([dataset, *bundles], of, truth, split, json)
        return 0
    if read_sweep(dataset) is not None:
        if limits or csv or markdown or latex or wide:
            raise InputError(f"{dataset}: is a sweep; --json, or `estimator table {dataset}`, or the score of one cell")
        _score_sweep(dataset, json, quiet)
        return 0
    scores = estimator.score(dataset)
    if not quiet:
        print(_text(dataset, scores, ways[0] if ways else "--wide" if wide else "", chosen, plot))
    exceeded = [text for limit in limits if (text := limit.exceeded_by(scores))]
    for text in exceeded:
        print(f"estimator: {text}", file=sys.stderr)
    return ABOVE_LIMIT if exceeded else 0


def _text(dataset: Path, scores: Scores, way: str, unit: str | None, plot: bool) -> str:
    from estimator.io.dataset import read_dataset
    from estimator.report.score_lines import about, score_csv, score_latex, score_lines, score_markdown
    from estimator.report.terminal import print_scores

    if way == "--wide":
        print_scores(scores)
        return ""
    if way == "--json":
        return scores.model_dump_json(indent=1)
    if way == "--csv":
        return score_csv(scores.summary_rows())
    if way == "--markdown":
        return score_markdown(scores, unit)
    if way == "--latex":
        return score_latex(scores, unit)
    width = shutil.get_terminal_size().columns  # of a pipe 80, or $COLUMNS
    plain = not (sys.stdout.encoding or "").lower().startswith("utf")
    return "\n".join(score_lines(scores, about(read_dataset(dataset)), width, unit, plot, plain))


def _score_sweep(folder: Path, json: bool, quiet: bool) -> None:
    from estimator.evaluate.table import table
    from estimator.evaluate.table_text import TABLE_NOTE, table_json, table_text
    from estimator.io.sweep import dataset_folders

    for cell in dataset_folders(folder):
        estimator.score(cell)
    of_sweep = table(folder, statistics=("success_rate", "of_all", "mean", "median", "p95"))
    if not quiet:
        print(table_json(of_sweep) if json else f"{table_text(of_sweep)}\n{TABLE_NOTE}")
