"""Commands `estimator submit` and `estimator leaderboard`, and scores of bundles.

Each loads the modules that it needs when it runs, as `estimator.cli` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from estimator.errors import InputError

if TYPE_CHECKING:
    from estimator.evaluate.submission import Entry
    from estimator.io.withheld import SplitName


def submit(
    dataset: Path,
    /,
    *,
    out: Path,
    name: str,
    author: str | None = None,
    variant: Annotated[list[str] | None, Parameter(negative=())] = None,
) -> None:
    """Bundle the estimates of a dataset as a submission to a benchmark.

    Parameters
    ----------
    dataset
        Folder of a dataset with estimates.
    out
        The bundle to write, a .zip file.
    name
        Name of the submission on the leaderboard.
    author
        Its authors.
    variant
        Variant to submit; may be given several times. Default: all with estimates.
    """
    from estimator.evaluate.submission import submit as write

    if out.suffix != ".zip":
        raise InputError(f"--out {out}: needed the name of a .zip file")
    description = write(dataset, out, name, author, variant or ())
    print(f"{out}: {', '.join(one.variant for one in description.estimates)}")


def leaderboard(
    *bundles: Annotated[Path, Parameter(required=True)],
    dataset: Path,
    out: Path,
    truth: Path | None = None,
    by: Literal["3d", "horizontal"] = "3d",
) -> None:
    """Write the leaderboard of a benchmark: the variants of all bundles by the third quartile of their errors.

    Parameters
    ----------
    bundles
        Bundles that `estimator submit` made.
    dataset
        Folder of the dataset.
    out
        The page to write, .html or .md.
    truth
        Key file of a dataset whose truth is withheld.
    by
        The error that ranks.
    """
    from estimator.evaluate.submission import score_bundles
    from estimator.io.atomic import write_atomically
    from estimator.io.dataset import read_dataset
    from estimator.report.leaderboard import html_page, markdown, places

    if out.suffix not in (".html", ".md"):
        raise InputError(f"--out {out}: needed the name of an .html or .md file")
    found = places(score_bundles(bundles, dataset, truth), by)
    page = html_page if out.suffix == ".html" else markdown
    write_atomically(out, page(read_dataset(dataset).name, found, by).encode())
    print(out)


def print_bundle_scores(
    bundles: Sequence[Path], dataset: Path | None, truth: Path | None, split: SplitName, json: bool
) -> None:
    """Print the scores of bundles, a row a variant, or as JSON."""
    from estimator.evaluate.score_table import ERROR_HEADERS, ERROR_NOTE, error_cells
    from estimator.evaluate.submission import score_bundles
    from estimator.report.terminal import print_table

    if dataset is None:
        raise InputError("--dataset: needed the folder of the dataset that the bundles are of")
    entries = score_bundles(bundles, dataset, truth, split)
    if json:
        print(_json(entries))
        return
    rows = [(f"{entry.name}: {entry.score.variant}", *error_cells(entry.score)) for entry in entries]
    print_table("Submissions", ("submission", *ERROR_HEADERS), rows, ERROR_NOTE)


def _json(entries: Sequence[Entry]) -> str:
    import json

    listed = [{"name": e.name, "author": e.author, **e.score.model_dump(mode="json")} for e in entries]
    return json.dumps(listed, indent=1, ensure_ascii=False)
