"""The commands `estimator variants | run | score | compare | report`. Errors are one line on stderr and exit code 2."""

import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

from cyclopts import App, CycloptsError, Parameter
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from estimator.errors import InputError
from estimator.evaluate.comparison import compare as compare_variants
from estimator.evaluate.score import Scores, read_or_score, score_dataset
from estimator.evaluate.score_table import (
    ERROR_HEADERS,
    ERROR_NOTE,
    LIMIT_HEADERS,
    LIMIT_NOTE,
    PAIR_HEADERS,
    PAIR_NOTE,
    error_cells,
    limit_cells,
    pair_cells,
)
from estimator.evaluate.workers import estimate_with_workers
from estimator.io.atomic import write_atomically
from estimator.io.dataset import read_dataset
from estimator.io.estimates import write_estimates
from estimator.report.report import page
from estimator.variants.registry import Registry

INTERNAL_ERROR = 1
USER_ERROR = 2
INTERRUPTED = 130

app = App(
    name="estimator",
    help="Estimate camera positions from images of ceiling LEDs, and judge the estimates.",
    version=lambda: version("vlcrender"),
    exit_on_error=False,
    print_error=False,
    suppress_keyboard_interrupt=False,
    result_action="return_value",
)


@app.command
def variants() -> None:
    """List the named pipelines, a line each; those of other packages say whose they are."""
    registry = Registry.read()
    usable, complaints = registry.all()
    width = max(len(variant.name) for variant in usable)
    for variant in usable:
        source = registry.source(variant.name)
        summary = " ".join(variant.summary.split())  # one of a plug-in may have several lines
        print(f"{variant.name:{width}}  {summary}{source and f' (external: {source})'}")
    _warn(complaints)


@app.command
def run(
    dataset: Path, /, *, variant: Annotated[list[str] | None, Parameter(negative=())] = None, workers: int = 1
) -> None:
    """Estimate every frame's position and write DATASET/estimates/VARIANT.parquet.

    Parameters
    ----------
    dataset
        Folder of a dataset.
    variant
        Pipeline to run, may be given several times; all of them when left out.
    workers
        Processes to share the frames among; the answers are the same for any number.
    """
    if workers < 1:
        raise InputError(f"--workers {workers}: is not 1 or more")
    names = _choose(variant)
    content = read_dataset(dataset)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("frames", total=len(content.frames))
        rows = estimate_with_workers(content, names, workers, on_frame=lambda: progress.advance(task))
    for name, of_variant in rows.items():
        path = write_estimates(dataset, name, of_variant)
        ok = sum(row.status == "ok" for row in of_variant)
        print(f"{name}: {ok} of {len(of_variant)} frames ok -> {path}")


@app.command
def score(dataset: Path, /, *, json: Annotated[bool, Parameter(negative=())] = False) -> None:
    """Compare all estimates with the truth, one row a variant, and write DATASET/scores.json.

    Parameters
    ----------
    dataset
        Folder of a dataset with estimates.
    json
        Print scores.json instead of a table.
    """
    scores = score_dataset(dataset)
    if json:
        print(scores.model_dump_json(indent=1))
    else:
        _print_scores(scores)


@app.command
def compare(dataset: Path, a: str, b: str, /, *, json: Annotated[bool, Parameter(negative=())] = False) -> None:
    """Compare two variants frame by frame, scoring the dataset where needed.

    Parameters
    ----------
    dataset
        Folder of a dataset with estimates.
    a
        A variant.
    b
        Another one.
    json
        Print JSON instead of a table.
    """
    if a == b:
        raise InputError(f"{a} and {b}: needed two different variants")
    scores = {of_variant.variant: of_variant for of_variant in read_or_score(dataset).variants}
    for name in (a, b):
        if name not in scores:
            raise InputError(f"{dataset / 'estimates'}: none of variant {name}; there are: {', '.join(scores)}")
    pair = compare_variants(scores[a], scores[b])
    if json:
        print(pair.model_dump_json(indent=1))
        return
    print(f"A = {a}, B = {b}")
    width = max(map(len, PAIR_HEADERS))
    for header, cell in zip(PAIR_HEADERS, pair_cells(pair), strict=True):
        print(f"{header:{width}}  {cell}")
    print(PAIR_NOTE)


@app.command
def report(*datasets: Annotated[Path, Parameter(required=True)], out: Path) -> None:
    """Write one self-contained HTML page about the datasets' scores, scoring them where needed.

    Parameters
    ----------
    datasets
        Folders of datasets with estimates.
    out
        The page to write.
    """
    if out.is_dir():
        raise InputError(f"--out {out}: is a folder, needed the name of a file")
    write_atomically(out, page([(folder, read_or_score(folder)) for folder in datasets]).encode())
    print(out)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; errors of the user's are one line on stderr, never a traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # A terminal without a micro sign gets a question mark, not an error.
            stream.reconfigure(errors="replace")
    try:
        app(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Who read our output has gone (`| head`): end quietly, and keep Python from flushing into the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (InputError, CycloptsError) as error:
        return _complain(str(error), USER_ERROR)
    except OSError as error:
        return _complain(f"{error.filename or 'output'}: {error.strerror or error}", USER_ERROR)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except Exception as error:
        # A fault of this program's own; still not a traceback for somebody who cannot use one.
        return _complain(f"internal error, please report it: {type(error).__name__}: {error}", INTERNAL_ERROR)
    return 0


def _complain(message: str, code: int) -> int:
    print("estimator:", " ".join(message.split()), file=sys.stderr)
    return code


def _choose(names: Sequence[str] | None) -> list[str]:
    """The variants named, once each; for None all that can be used, with a warning about each that cannot."""
    registry = Registry.read()
    if names is None:
        usable, complaints = registry.all()
        _warn(complaints)
    else:
        usable = [registry.named(name) for name in names]
    return list(dict.fromkeys(variant.name for variant in usable))


def _warn(complaints: Sequence[str]) -> None:
    for complaint in complaints:
        print("estimator: warning:", " ".join(complaint.split()), file=sys.stderr)


def _print_scores(scores: Scores) -> None:
    rows = [(of_variant.variant, error_cells(of_variant), limit_cells(of_variant)) for of_variant in scores.variants]
    errors = _table(f"{scores.dataset}: errors", ERROR_HEADERS, [(name, *cells) for name, cells, _ in rows])
    _print_table(errors, ERROR_NOTE)
    if any(of_variant.against_bound or of_variant.nees or of_variant.ambiguous for of_variant in scores.variants):
        title = "the bound, and what the variants say of themselves"
        limits = _table(title, LIMIT_HEADERS, [(name, *cells) for name, _, cells in rows])
        _print_table(limits, LIMIT_NOTE)
    for of_variant in scores.variants:
        for reason, count in of_variant.failures.items():
            print(f"{of_variant.variant}: {count} x {reason}")


def _table(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=escape(title), title_justify="left")
    table.add_column("variant", no_wrap=True)
    for header in headers:
        table.add_column(header, justify="right")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def _print_table(table: Table, note: str) -> None:
    console = Console()
    if not console.is_terminal:
        # Nothing has to be squeezed into a terminal's width.
        console = Console(width=Console(width=10_000).measure(table).maximum)
    console.print(table)
    console.print(note, markup=False, highlight=False)
