"""Progress on stderr: one line that is repainted on a terminal, plain lines at growing intervals in a log or pipe."""

import sys
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as Bars

from vlcrender.core.process import progress_console
from vlcrender.dataset.run.progress import FRAMES_STAGE, Pace, Progress


class ProgressDisplay:
    """Shows the reports of `generate` for a dataset of a name and some frames. Nothing appears before the first one."""

    def __init__(self, name: str, frames: int, console: Console | None = None) -> None:
        """console: by default stderr."""
        self._name = name
        self._console = console or progress_console()
        self._pace = Pace()
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}"),
        )
        self._bars = Bars(*columns, console=self._console)
        self._light = self._bars.add_task("light", total=1.0, visible=False, state="")
        self._frames = self._bars.add_task(name, total=frames, state="")

    def __enter__(self) -> Self:
        """Show nothing yet."""
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the last line as it is."""
        if self._console.is_terminal:
            self._bars.stop()

    def show(self, progress: Progress) -> None:
        """Show a report."""
        state = ""
        if progress.stage == FRAMES_STAGE:
            self._pace.add(progress)
            state = self._pace.text(progress)
        if self._console.is_terminal:
            self._paint(progress, state)
        elif self._pace.line_is_due(progress):
            done = f"{100 * progress.done / progress.total:.0f} %"
            if progress.stage == FRAMES_STAGE:
                done = f"{progress.done:.0f} of {progress.total:.0f} frames" + (f", {state}" if state else "")
            else:
                done = f"{progress.stage}, {done}"
            print(f"{self._name}: {done}", file=sys.stderr, flush=True)

    def _paint(self, progress: Progress, state: str) -> None:
        self._bars.start()  # not before the first report: a refusal is one line
        if progress.stage == FRAMES_STAGE:
            self._bars.update(self._frames, completed=progress.done, total=progress.total, state=state)
        else:
            share = progress.done / progress.total
            self._bars.update(self._light, description=progress.stage, completed=share, visible=share < 1)
