"""The command line of vlcrender. Errors are one line; the exit code is 2 for bad input, 130 when interrupted."""

import json
import os
import sys
from dataclasses import asdict
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, CycloptsError, Parameter
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from vlcrender import __version__
from vlcrender.camera.intrinsics import Camera
from vlcrender.dataset.files import read_dataset_file
from vlcrender.dataset.recipe import ScaleMode, load_plan
from vlcrender.errors import InputError
from vlcrender.scene.loader import load_scene
from vlcrender.scene.visibility import ENOUGH_LEDS, level_visibility, tilted_visibility

if TYPE_CHECKING:
    from vlcrender.dataset.progress import Progress as Report
    from vlcrender.emva1288.datasheet import Datasheet

app = App(
    name="vlcrender",
    help="Render what a tilted camera sees of ceiling LED panels, with ground truth.",
    version=__version__,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
)
HEIGHTS_M = (0.0, 0.75)
"""Floor and desk."""


@app.command
def generate(
    recipe: Path,
    /,
    *,
    out: Path,
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None,
    scale: int = 1,
    scale_mode: ScaleMode = "binned",
    workers: int = 1,
    scheduler: str | None = None,
) -> None:
    """Make the dataset of a recipe; goes on where an interrupted run stopped.

    Parameters
    ----------
    recipe
        Recipe file (TOML).
    out
        Folder of the dataset; new, empty, or an unfinished run of the same recipe.
    set_
        key=value that replaces a value of the recipe, e.g. camera.f_number=2.8. May be repeated.
    scale
        Make this many by this many pixels one, for quick looks; has to divide the camera's width and height.
    scale_mode
        Whether larger pixels keep all photons (full well and gain grow with them), or as many as the small ones had
        (the exposure is shorter).
    workers
        Processes that make frames.
    scheduler
        Address of a dask scheduler whose workers see the same folder.
    """
    if workers < 1:
        raise InputError(f"--workers {workers}: is not 1 or more")
    plan = load_plan(recipe, set_ or [], scale, scale_mode)
    from vlcrender.dataset.generate import generate as make  # starts Mitsuba: not before the recipe is known to be good

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("frames"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=Console(stderr=True))
    light = bar.add_task("light", total=1.0, visible=False)
    task = bar.add_task(plan.recipe.name, total=plan.recipe.frame_count)

    def draw(report: "Report") -> None:
        bar.start()  # not before the first report: a refusal is one line
        if report.stage == "frames":
            bar.update(task, completed=report.done, total=report.total)
        else:
            bar.update(light, description=report.stage, completed=report.done, visible=report.done < report.total)

    try:
        made = make(plan, out, workers, scheduler, draw)
    finally:
        bar.stop()
    print(f"{out}: {plan.recipe.frame_count} frames{'' if made else ' (was already complete and intact)'}")


@app.command
def verify(directory: Path, /) -> None:
    """Check that a dataset is complete and intact; the exit code is 0 only then.

    Parameters
    ----------
    directory
        Folder of the dataset.
    """
    from vlcrender.dataset.verify import verify as problems_of

    dataset = read_dataset_file(directory)
    found = problems_of(directory)
    for problem in found:
        _complain(problem)
    if found:
        sys.exit(2)
    print(f"{directory}: {dataset.frame_count} frames, all there and intact")


@app.command
def show(
    scene: Path, /, *, out: Path | None = None, reference: Annotated[bool, Parameter(negative=())] = False
) -> None:
    """Draw a room's plan and a camera's view of it; print what share of poses sees four LEDs or more.

    Parameters
    ----------
    scene
        Scene file (TOML).
    out
        PNG to write; the scene's name with .png in the current folder where not given.
    reference
        Have Mitsuba's own path integrator render the view: slow, coarse, noisy, and independent of the fast way.
    """
    loaded = load_scene(scene)
    path = out or Path(f"{scene.stem}.png")
    if path.suffix.lower() != ".png":
        raise InputError(f"--out {path}: has to end in .png")
    camera = Camera()
    across, down = camera.view_angles_deg()
    table = Table(
        title=f"{loaded.name}: poses that see {ENOUGH_LEDS} LEDs or more ({across:.2f} x {down:.2f} deg view)"
    )
    table.add_column("height, m", justify="right")
    table.add_column("attitude")
    table.add_column("poses", justify="right")
    table.add_column("see enough", justify="right")
    table.add_column("share", justify="right")
    for height in HEIGHTS_M:
        for coverage in (
            level_visibility(camera, loaded, height, 0.0),
            level_visibility(camera, loaded, height, 90.0),
            tilted_visibility(camera, loaded, height),
        ):
            share = f"{100 * coverage.share:.2f} %"
            table.add_row(f"{height:g}", coverage.attitude, str(coverage.poses), str(coverage.seen), share)
    from vlcrender.scene_plot import draw  # starts Mitsuba

    draw(loaded, camera, path, reference)
    Console(width=max(Console().width, 100)).print(table)
    print(f"{path}: written")


@app.command
def datasheet(
    sensor: str,
    /,
    *,
    out: Path | None = None,
    wavelength_nm: float = 530.0,
    side_px: int = 512,
    json_: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Measure a sensor by photon transfer on its own frames (EMVA 1288) and print what is found beside what was set.

    Parameters
    ----------
    sensor
        Name of a preset, or a TOML file with a [sensor] table; a recipe is one.
    out
        HTML page to write, with plots; the sensor's name with -datasheet.html in the current folder where not given.
    wavelength_nm
        Of the light.
    side_px
        Rows and columns of the frames; with twice as many the tolerances are half as large.
    json_
        Print JSON instead of a table.
    """
    from vlcrender.emva1288.datasheet import load_sensor, make_datasheet  # starts Mitsuba
    from vlcrender.emva1288.page import page

    if not 32 <= side_px <= 4096:
        raise InputError(f"--side-px {side_px}: is not 32 to 4096")
    if not 200 <= wavelength_nm <= 1200:
        raise InputError(f"--wavelength-nm {wavelength_nm:g}: is not 200 to 1200")
    name, settings = load_sensor(sensor)
    path = out or Path(f"{name}-datasheet.html")
    if not path.parent.is_dir():
        raise InputError(f"--out {path}: no such folder as {path.parent}")
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder; the name of a file is needed")
    with Console(stderr=True).status("measuring") as status:
        sheet = make_datasheet(
            name, settings, wavelength_nm, side_px, lambda frames: status.update(f"measuring: {frames} frames")
        )
    if json_:
        rows = {row.key: {k: v for k, v in asdict(row).items() if k != "key"} for row in sheet.rows}
        print(json.dumps({"sensor": name, "conditions": sheet.conditions, "rows": rows}, indent=2, ensure_ascii=False))
    else:
        _print_datasheet(name, sheet)
    path.write_text(page(sheet), encoding="utf-8")  # last: where it cannot be written, what was measured is shown
    if not json_:
        print(f"{path}: written")


def _print_datasheet(name: str, sheet: "Datasheet") -> None:
    from vlcrender.emva1288.datasheet import cells

    table = Table(title=f"{name}: {'; '.join(sheet.conditions)}")
    for heading in ("", "", "set", "measured", "tolerance", "", ""):
        table.add_column(heading, justify="right" if heading else "left")
    for row in sheet.rows:
        set_text, measured, tolerance, verdict = cells(row)
        table.add_row(row.key, row.name, set_text, measured, tolerance and f"± {tolerance}", row.unit, verdict)
    Console(width=max(Console().width, 100)).print(table)


def main() -> None:
    """Run the command line and exit."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without a degree sign gets a question mark, not an error
    try:
        app(exit_on_error=False, print_error=False)
        sys.stdout.flush()
    except (CycloptsError, InputError) as error:
        _complain(str(error))
        sys.exit(2)
    except BrokenPipeError:
        # Who read our output has gone (`| head`): end quietly, and keep Python from flushing into the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        _complain(f"{error.filename or 'file system'}: {error.strerror or error}")
        sys.exit(2)
    except KeyboardInterrupt:
        _complain("interrupted; run the same command again to go on")
        sys.exit(130)
    except Exception as error:
        # A fault of this program's own; still not a traceback for somebody who cannot use one.
        _complain(f"internal error, please report it: {type(error).__name__}: {error}")
        sys.exit(1)


def _complain(message: str) -> None:
    print("vlcrender:", " ".join(message.split()), file=sys.stderr)
