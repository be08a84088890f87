"""Tables on the terminal."""

from collections.abc import Callable, Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from estimator.evaluate import score_table as cells
from estimator.evaluate.score import Scores, VariantScore


def print_scores(scores: Scores) -> None:
    """Print the tables of a dataset's scores, and the failed frames by reason."""
    variants = scores.variants
    tables: list[tuple[str, Sequence[str], Callable[[VariantScore], tuple[str, ...]], str]]
    tables = [(f"{scores.dataset}: errors", cells.ERROR_HEADERS, cells.error_cells, cells.ERROR_NOTE)]
    if any(of_variant.against_bound or of_variant.nees or of_variant.ambiguous for of_variant in variants):
        title = "Cramér-Rao bound and covariance consistency"
        tables.append((title, cells.LIMIT_HEADERS, cells.limit_cells, cells.LIMIT_NOTE))
    if any(map(cells.has_groups, variants)):
        tables.append(("by device and map", cells.GROUP_HEADERS, cells.group_cells, cells.GROUP_NOTE))
    if any(of_variant.downlink for of_variant in variants):
        tables.append(("identities", cells.IDENTITY_HEADERS, cells.identity_cells, cells.IDENTITY_NOTE))
    if any(of_variant.failed for of_variant in variants):
        tables.append(("failed frames by good LEDs", cells.LOST_HEADERS, cells.lost_cells, cells.LOST_NOTE))
    for title, headers, of_variant, note in tables:
        rows = [(variant.variant, *of_variant(variant)) for variant in variants]
        print_table(title, ["variant", *headers], rows, note)
    for variant in variants:
        for reason, count in variant.failures.items():
            print(f"{variant.variant}: {count} x {reason}")


def print_table(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]], note: str) -> None:
    """Print a table and its note; on a terminal that is too narrow, some columns at a time."""
    console = Console()
    if not console.is_terminal:
        # A file or pipe has no width to fit into.
        whole = _table(title, headers, rows)
        console = Console(width=Console(width=10_000).measure(whole).maximum)
    for columns in fitting(headers, rows, console.width):
        part = [[row[column] for column in columns] for row in rows]
        console.print(_table(title, [headers[column] for column in columns], part))
        title = ""
    console.print(note, markup=False, highlight=False)


def fitting(headers: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[list[int]]:
    """Columns of each of the tables, no wider than `width` where possible, that together have all; all have the first.

    A header may wrap between its words, a cell does not. An interval stays beside the column that it belongs to.
    """
    border = 3
    sizes = [
        border + max([cell_len(row[column]) for row in rows] + [cell_len(word) for word in header.split()])
        for column, header in enumerate(headers)
    ]
    tables = [[0]]
    column = 1
    while column < len(headers):
        end = column + 1
        while end < len(headers) and headers[end].endswith("interval"):
            end += 1
        together = list(range(column, end))
        if len(tables[-1]) > 1 and 1 + sum(sizes[one] for one in [*tables[-1], *together]) > width:
            tables.append([0])
        tables[-1] += together
        column = end
    return tables


def _table(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=escape(title) if title else None, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False)
    for column, header in enumerate(headers):
        table.add_column(header, justify="right" if column else "left", no_wrap=column == 0)
    for row in rows:
        table.add_row(*map(escape, row))
    return table
