"""The commands `estimator variants | run | score | report`. Errors are one line on stderr and exit code 2."""

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

from estimator.batch import estimate_dataset
from estimator.dataset import read_dataset
from estimator.errors import InputError
from estimator.estimates import write_estimates
from estimator.files import write_atomically
from estimator.pipeline import Variant
from estimator.report import page
from estimator.score import TABLE_HEADERS, Scores, read_or_score, score_dataset, table_cells
from estimator.variants import VARIANTS

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
    """List the named pipelines, a line each."""
    width = max(len(name) for name in VARIANTS)
    for variant in VARIANTS.values():
        print(f"{variant.name:{width}}  {variant.summary}")


@app.command
def run(dataset: Path, /, *, variant: Annotated[list[str] | None, Parameter(negative=())] = None) -> None:
    """Estimate every frame's position and write DATASET/estimates/VARIANT.parquet.

    Parameters
    ----------
    dataset
        Folder of a dataset.
    variant
        Pipeline to run, may be given several times; all of them when left out.
    """
    chosen = _choose(variant)
    content = read_dataset(dataset)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("frames", total=len(content.frames))
        rows = estimate_dataset(content, chosen, on_frame=lambda: progress.advance(task))
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


def _choose(names: Sequence[str] | None) -> list[Variant]:
    """The variants named, once each; all for None."""
    if names is None:
        return list(VARIANTS.values())
    for name in names:
        if name not in VARIANTS:
            raise InputError(f"--variant {name}: unknown; allowed: {', '.join(VARIANTS)}")
    return [VARIANTS[name] for name in dict.fromkeys(names)]


def _print_scores(scores: Scores) -> None:
    # Where the output is no terminal, nothing has to be squeezed into its width.
    console = Console() if sys.stdout.isatty() else Console(width=150)
    table = Table(title=escape(f"{scores.dataset}: errors of the frames that succeeded"), title_justify="left")
    table.add_column("variant", no_wrap=True)
    for header in TABLE_HEADERS:
        table.add_column(header, justify="right")
    for of_variant in scores.variants:
        table.add_row(escape(of_variant.variant), *table_cells(of_variant))
    console.print(table)
    for of_variant in scores.variants:
        for reason, count in of_variant.failures.items():
            console.print(f"{of_variant.variant}: {count} x {reason}", markup=False, highlight=False)
