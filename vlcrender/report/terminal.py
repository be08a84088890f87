"""Tables on the terminal: no boxes, and no figure is ever cut off."""

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table


def print_table(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> None:
    """Print a table whose first `left` columns are words, and the others figures.

    An empty row is drawn as a line. A table that is wider than the terminal is printed at its own width.
    """
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for column, header in enumerate(headers):
        table.add_column(header, justify="left" if column < left else "right", no_wrap=True)
    for row in rows:
        if row:
            table.add_row(*map(escape, row))
        else:
            table.add_section()
    console = Console(highlight=False)
    own = Console(width=10_000).measure(table).maximum
    console.print(escape(title))
    Console(width=max(console.width, own), highlight=False).print(table)
