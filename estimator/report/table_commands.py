"""Commands `estimator table` and `estimator plot`.

Each loads the modules that it needs when it runs, as `estimator.cli` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import estimator
from estimator.errors import InputError

if TYPE_CHECKING:
    from estimator.evaluate.table import Bins, Table


def table(
    *datasets: Annotated[Path, Parameter(required=True)],
    x: Annotated[list[str] | None, Parameter(negative=())] = None,
    by: str = "variant",
    stat: str = "mean,median,p95",
    metric: str = "error_3d_m",
    bins: Annotated[list[str] | None, Parameter(negative=())] = None,
    variant: Annotated[list[str] | None, Parameter(negative=())] = None,
    csv: Path | None = None,
    json: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Print statistics of the errors by what was swept, or by any column of truth and scores, with 95 % intervals.

    Parameters
    ----------
    datasets
        Folders of datasets or sweeps with estimates; several are told apart by the column `set`.
    x
        Key of the rows: a swept name, or a column such as tilt_deg, distance_m, leds; may be given several times. One
        of more than 24 distinct numbers is binned.
    by
        Columns whose values make groups, such as variant,camera.
    stat
        Statistics: mean, rmse, median, pN, success_rate, median_of_all, pN_of_all, of_all (median and p95 of all
        frames, a failed one being infinite).
    metric
        Column of numbers: error_3d_m, horizontal_error_m, vertical_error_m (its size), nees, bound_m, time_s, ...
    bins
        Number of bins, or their edges (0,10,20), of every key or of one: tilt_deg=0,10,20. May be given several times.
    variant
        Variant to read; may be given several times. Default: all.
    csv
        File to write, CSV.
    json
        Print JSON instead of a table.
    """
    from estimator.evaluate.table_text import TABLE_NOTE, table_csv, table_json, table_text
    from estimator.io.atomic import write_atomically

    found = _table(datasets, x, by, stat, metric, bins, variant)
    if csv is not None:
        write_atomically(csv, table_csv(found).encode())
    print(table_json(found) if json else f"{table_text(found)}\n{TABLE_NOTE}")


def plot(
    *datasets: Annotated[Path, Parameter(required=True)],
    x: Annotated[list[str], Parameter(negative=())],
    out: Path,
    by: str = "variant",
    stat: str = "median",
    metric: str = "error_3d_m",
    bins: Annotated[list[str] | None, Parameter(negative=())] = None,
    variant: Annotated[list[str] | None, Parameter(negative=())] = None,
    log: str | None = None,
    line: Annotated[list[str] | None, Parameter(negative=())] = None,
) -> None:
    """Draw one statistic of `estimator table` as SVG, and write the table beside it as CSV.

    One key: a line with the band of its intervals for each group. Two keys: a heat map for each group.

    Parameters
    ----------
    datasets
        Folders of datasets or sweeps with estimates.
    x
        Key, as of `estimator table`; twice for a heat map.
    out
        The SVG to write; the CSV has the same name and the suffix .csv.
    by
        Columns whose values make groups, such as variant,camera.
    stat
        One statistic, as of `estimator table`.
    metric
        Column of numbers.
    bins
        Bins of the keys, as of `estimator table`.
    variant
        Variant to read; may be given several times. Default: all.
    log
        Logarithmic axes: x, y, or value (colours of a heat map), such as x,y; none for no axis. Default: those whose
        values span a factor of 50.
    line
        Horizontal line, VALUE:LABEL; may be given several times.
    """
    from estimator.evaluate.table_text import table_csv
    from estimator.io.atomic import write_atomically
    from estimator.report.plot import plot as plot_of

    if out.suffix != ".svg":
        raise InputError(f"--out {out}: needed the name of an .svg file")
    found = _table(datasets, x, by, stat, metric, bins, variant)
    axes = None if log is None else () if log == "none" else log.split(",")
    picture = plot_of(found, axes, [_line(one) for one in line or ()])
    write_atomically(out, picture.encode())
    write_atomically(out.with_suffix(".csv"), table_csv(found).encode())
    print(f"{out} {out.with_suffix('.csv')}")


def _table(
    datasets: Sequence[Path],
    x: list[str] | None,
    by: str,
    stat: str,
    metric: str,
    bins: list[str] | None,
    variants: list[str] | None,
) -> Table:
    """The table of `estimator table` and `estimator plot`."""
    keys = [key for one in x or () for key in one.split(",")]
    of_keys: dict[str, Bins] = {}
    for one in bins or ():
        key, text = one.rsplit("=", 1) if "=" in one else ("", one)
        try:
            numbers = [float(number) for number in text.split(",")]
            edges: Bins = int(text) if len(numbers) == 1 else numbers
        except ValueError:
            raise InputError(f"--bins {one}: needed a number of bins, or edges such as 0,10,20") from None
        of_keys |= dict.fromkeys([key] if key else keys, edges)
    return estimator.table(datasets, keys, by.split(",") if by else (), stat.split(","), metric, of_keys, variants)


def _line(text: str) -> tuple[float, str]:
    """VALUE:LABEL of a horizontal line."""
    value, _, label = text.partition(":")
    try:
        return float(value), label
    except ValueError:
        raise InputError(f"--line {text}: needed VALUE:LABEL with a number") from None
