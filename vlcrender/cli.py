"""The command line of vlcrender: a client of the Python API.

An error is one line. The exit code is 2 for bad input, 130 if interrupted. Each command imports the modules it needs,
so that `--help` loads neither Mitsuba nor SciPy.
"""

import json
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

from vlcrender.core.arguments import Whole
from vlcrender.core.process import INTERRUPTED, ending_at_second_interrupt, prepare_streams
from vlcrender.errors import InputError
from vlcrender.report.report_command import report
from vlcrender.report.show_command import show

if TYPE_CHECKING:
    from vlcrender.dataset.recipe.plan import Plan
    from vlcrender.dataset.world.error_budget import ErrorBudget
    from vlcrender.emva1288.datasheet import Datasheet


def _version() -> str:
    from vlcrender import __version__

    return __version__


app = App(
    name="vlcrender",
    help="Render what a tilted camera sees of ceiling LED panels, with ground truth.",
    version=_version,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
)
"""Floor and desk."""


@app.command
def generate(
    recipe: str,
    /,
    *,
    out: Path,
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None,
    scale: Whole = 1,
    scale_mode: Literal["binned", "same-photons"] = "binned",
    workers: Whole = 1,
    scheduler: str | None = None,
    withhold_truth: Path | None = None,
    dry_run: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Generate the dataset of a recipe, or one for each cell of its sweep; an interrupted run is continued.

    Parameters
    ----------
    recipe
        Recipe file (TOML), or the name of a recipe that comes with vlcrender, such as quickstart.
    out
        Folder of the dataset; new, empty, or an unfinished run of the same recipe.
    set_
        key=value that replaces a value of the recipe, e.g. camera.f_number=2.8, or with scene. before its key one of
        the scene, e.g. scene.ambient.illuminance_lux=800. An item of a list has its number or name. May be repeated.
    scale
        Bin N x N pixels into one, for previews; N has to divide the camera's width and height.
    scale_mode
        Whether larger pixels keep all photons (full well and gain grow with them), or as many as the small ones had
        (the exposure is shorter).
    workers
        Processes that make frames.
    scheduler
        Address of a dask scheduler whose workers see the same folder.
    withhold_truth
        Key file, made if missing, with which the truth of the test frames is sealed, or that of all frames without
        [split] (docs/benchmark.md). Keep it; `vlcrender release` needs it.
    dry_run
        Print what would be made, and estimates of time and size from a few frames; write nothing in the folder.
    """
    from vlcrender import api
    from vlcrender.dataset.run.progress_display import ProgressDisplay

    if workers < 1:
        raise InputError(f"--workers {workers}: has to be 1 or more")
    plan = api.load_recipe(recipe, set_, scale=scale, scale_mode=scale_mode)
    if dry_run:
        if withhold_truth is not None:
            from vlcrender.dataset.world.withheld import check_withholdable

            check_withholdable(plan)
        _dry_run(plan, workers, out)
        return
    with ProgressDisplay(plan.recipe.name, plan.frame_count) as display:
        made = api.generate(
            plan, out, workers=workers, scheduler=scheduler, progress=display.show, withhold_truth=withhold_truth
        )
    cells = "" if plan.cells is None else f"{len(plan.cells)} cells, "
    print(f"{out}: {cells}{plan.frame_count} frames{'' if made else ' (was already complete and intact)'}")
    if made and plan.cells is None:
        from vlcrender.dataset.format.files import read_dataset_file
        from vlcrender.dataset.format.summary import summary_lines

        if (summary := read_dataset_file(out).summary) is not None:
            print(*summary_lines(summary), sep="\n")


def _dry_run(plan: "Plan", workers: int, out: Path) -> None:
    """Print what a plan would make in a folder."""
    from vlcrender.dataset.run.dry_run import dry_run
    from vlcrender.dataset.run.progress import Progress
    from vlcrender.dataset.run.progress_display import ProgressDisplay

    with ProgressDisplay(plan.recipe.name, plan.frame_count) as display:
        found = dry_run(plan, workers, lambda stage, share: display.show(Progress(stage, share, 1.0)))
    print(f"{plan.recipe.name}: dry run, nothing is written in {out}", *found.lines(), sep="\n")


app.command(report)


@app.command
def verify(
    directory: Path,
    /,
    *,
    repair: Annotated[bool, Parameter(negative=())] = False,
    scene_folder: Path | None = None,
    workers: Whole = 1,
) -> None:
    """Check that a dataset, or each cell of a sweep, is complete and intact; the exit code is 0 only then.

    Parameters
    ----------
    directory
        Folder of the dataset or sweep.
    repair
        Make files that are missing or damaged again, of the recipe, scene and seed in dataset.json, and check then.
        A file is replaced only by one with the digest that the manifest has.
    scene_folder
        With --repair: folder of the scene file, where the scene has textures or furniture.
    workers
        With --repair: processes that make frames.
    """
    from vlcrender import api
    from vlcrender.dataset.format.files import read_dataset_file, read_sweep_file
    from vlcrender.dataset.recipe.sweep import SWEEP_FILE

    if (directory / SWEEP_FILE).is_file():
        content, unchecked = f"{len(read_sweep_file(directory).cells)} cells", ""
    else:
        dataset = read_dataset_file(directory)
        content, unchecked = f"{dataset.frame_count} frames", ""
        if dataset.withheld is not None:
            told = len(dataset.withheld.frames_with_truth(dataset.frame_count))
            unchecked = f" (not checked: the withheld truth of {dataset.frame_count - told} frames)"
    if repair:
        for line in api.repair(directory, scene_folder=scene_folder, workers=workers):
            print(f"{directory}: {line}")
    found = api.verify(directory)
    for problem in found:
        _complain(problem)
    if found:
        sys.exit(2)
    print(f"{directory}: {content}, all there and intact{unchecked}")


@app.command
def release(directory: Path, key_file: Path, /) -> None:
    """Write the withheld truth of a dataset again; anybody can then score it.

    Parameters
    ----------
    directory
        Folder of a dataset that `vlcrender generate --withhold-truth` made.
    key_file
        Its key file.
    """
    from vlcrender import api

    api.release(directory, key_file)
    print(f"{directory}: has its truth")


@app.command
def export(directory: Path, /, *, to: str, out: Path) -> None:
    """Export a dataset to the format of another tool; docs/exporting.md has the conventions of each.

    Parameters
    ----------
    directory
        Folder of a complete dataset.
    to
        png16, csv, tum, opencv-yaml, kalibr, colmap, nerfstudio, bop, webdataset, rosbag2, croissant or card.
    out
        Folder to write, new or empty; a file for croissant (.json) and card (.md).
    """
    from vlcrender import api

    count = api.export_dataset(directory, to, out)
    print(f"{out}: {to} of {count} frames")


app.command(show)


@app.command
def datasheet(
    sensor: str,
    /,
    *,
    out: Path | None = None,
    wavelength_nm: float = 530.0,
    side_px: Whole = 512,
    json_: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Measure a sensor by photon transfer on its own frames (EMVA 1288); print measured values beside the set ones.

    Parameters
    ----------
    sensor
        Name of a preset, a TOML file with a [sensor] table, such as a recipe, or the name of a recipe that comes with
        vlcrender.
    out
        HTML page to write, with plots; by default the sensor's name with -datasheet.html in the current folder.
    wavelength_nm
        Wavelength of the light.
    side_px
        Rows and columns of the frames; with twice as many the tolerances are half as large.
    json_
        Print JSON instead of a table.
    """
    from dataclasses import asdict

    from rich.console import Console

    from vlcrender.config.packaged import find_file, packaged_names
    from vlcrender.config.presets import presets
    from vlcrender.emva1288.datasheet import load_sensor, make_datasheet
    from vlcrender.emva1288.page import page

    if not 32 <= side_px <= 4096:
        raise InputError(f"--side-px {side_px}: has to be from 32 to 4096")
    if not 200 <= wavelength_nm <= 1200:
        raise InputError(f"--wavelength-nm {wavelength_nm:g}: has to be from 200 to 1200")
    if sensor not in presets("sensors") and sensor in packaged_names("recipe"):
        sensor = str(find_file("recipe", sensor))
    name, settings = load_sensor(sensor)
    path = out or Path(f"{name}-datasheet.html")
    if not path.parent.is_dir():
        raise InputError(f"--out {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder; give the name of a file")
    with Console(stderr=True).status("measuring") as status:
        sheet = make_datasheet(
            name, settings, wavelength_nm, side_px, lambda frames: status.update(f"measuring: {frames} frames")
        )
    if json_:
        rows = {row.key: {k: v for k, v in asdict(row).items() if k != "key"} for row in sheet.rows}
        print(json.dumps({"sensor": name, "conditions": sheet.conditions, "rows": rows}, indent=2, ensure_ascii=False))
    else:
        _print_datasheet(name, sheet)
    path.write_text(page(sheet), encoding="utf-8")  # last: if it cannot be written, the measurement has been shown
    if not json_:
        print(f"{path}: written")


def _print_datasheet(name: str, sheet: "Datasheet") -> None:
    from vlcrender.emva1288.datasheet import cells
    from vlcrender.report.terminal import print_table

    rows = []
    for row in sheet.rows:
        set_text, measured, tolerance, verdict = cells(row)
        rows.append((row.key, row.name, verdict, set_text, measured, tolerance and f"± {tolerance}", row.unit))
    title = f"{name}: {'; '.join(sheet.conditions)}"
    print_table(title, ("", "", "", "set", "measured", "tolerance", ""), rows, left=3)


@app.command
def budget(
    recipe: str,
    /,
    *,
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None,
    scale: Whole = 1,
    scale_mode: Literal["binned", "same-photons"] = "binned",
    poses: Whole = 40,
    camera: str = "main",
    bound: bool = True,
    plot: Path | None = None,
    json_: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Print what each thing that a device does not know contributes to the error of its position, the largest first.

    Parameters
    ----------
    recipe
        Recipe file (TOML), or the name of a recipe that comes with vlcrender. Its [belief] says what a device does not
        know; --set belief.preset=calibrated gives it one.
    set_
        key=value that replaces a value of the recipe, e.g. belief.camera.focal_percent=0.02. May be repeated.
    scale
        Bin N x N pixels into one, as `generate` does.
    scale_mode
        As of `generate`.
    poses
        Number of poses of the recipe, evenly spread, of which the root mean square is taken.
    camera
        Name of a camera of the rig.
    bound
        Compute the Cramér-Rao bound of the pixels too; it takes most of the time.
    plot
        Chart to write: a .png, .svg or .pdf file.
    json_
        Print JSON instead of a table.
    """

    from rich.console import Console

    from vlcrender import api

    if plot is not None:
        if plot.suffix.lower() not in (".png", ".svg", ".pdf"):
            raise InputError(f"--plot {plot}: has to end in .png, .svg or .pdf")
        if not plot.parent.is_dir():
            raise InputError(f"--plot {plot}: there is no folder {plot.parent}")
    plan = api.load_recipe(recipe, set_, scale=scale, scale_mode=scale_mode)
    with Console(stderr=True).status("poses") as status:
        found = api.budget(
            plan,
            poses=poses,
            camera=camera,
            bound=bound,
            progress=lambda done, total: status.update(f"poses: {done} of {total}"),
        )
    if json_:
        print(json.dumps(found.record(), indent=2, ensure_ascii=False))
    else:
        _print_budget(found)
    if plot is not None:
        from vlcrender.dataset.world.budget_plot import draw_budget

        draw_budget(found, plot)
        if not json_:
            print(f"{plot}: written")


def _mm(length_mm: float) -> str:
    return "< 0.001" if length_mm < 0.001 else f"{length_mm:.3g}"


def _print_budget(found: "ErrorBudget") -> None:
    from vlcrender.report.terminal import print_table

    variance = found.total.total_mm**2
    rows: list[tuple[str, ...]] = []
    for row in found.rows:
        own = [_mm(x) for x in (row.share.horizontal_mm, row.share.vertical_mm, row.share.total_mm)]
        share = f"{100 * row.share.total_mm**2 / variance:.1f} %"
        exact = "" if row.exact_mm is None else _mm(row.exact_mm)
        rows.append((row.name, row.sigma, *own, share, exact, _mm(row.trusting.total_mm)))
    rows.append(())
    for name, sums, trusting in (
        ("all", found.total, _mm(found.trusting_total.total_mm)),
        ("bound", found.bound, ""),
    ):
        if sums is not None:
            own = [_mm(x) for x in (sums.horizontal_mm, sums.vertical_mm, sums.total_mm)]
            rows.append((name, "", *own, "", "", trusting))
    print_table(
        f"{found.recipe}, camera {found.camera}: error of the position, mm, rms over {found.poses} poses "
        f"(median {found.median_leds:g} LEDs of {found.median_luminaires:g} luminaires)",
        ("unknown", "sigma", "horizontal", "vertical", "in space", "share", "if exact", "trusting"),
        rows,
        left=2,
    )
    print("if exact: the error in space without that unknown. trusting: an estimator that takes lens and map as exact.")
    if found.undetermined:
        print(f"{found.undetermined} further poses do not determine a position and are left out")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line, by default with the arguments of this process; exit unless the code is 0."""
    prepare_streams()
    try:
        with ending_at_second_interrupt(), _log_on_stderr():
            app(arguments, exit_on_error=False, print_error=False)
        sys.stdout.flush()
    except (CycloptsError, InputError) as error:
        _complain(str(error))
        sys.exit(2)
    except BrokenPipeError:
        # The reader has closed our output (`| head`): end quietly; keep Python from flushing into the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        _complain(f"{error.filename or 'file system'}: {error.strerror or error}")
        sys.exit(2)
    except KeyboardInterrupt:
        _complain("interrupted; run the same command again to go on")
        sys.exit(INTERRUPTED)
    except Exception as error:
        # A fault of this program: one line, without a traceback.
        _complain(f"internal error, please report it: {type(error).__name__}: {error}")
        sys.exit(1)


class _LineHandler(logging.Handler):
    """Writes a log record as one line on the current stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record."""
        _complain(record.getMessage())


@contextmanager
def _log_on_stderr() -> Iterator[None]:
    """Show warnings on stderr, also those of other packages."""
    handler = _LineHandler(logging.WARNING)
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)


def _complain(message: str) -> None:
    with suppress(BrokenPipeError):
        print("vlcrender:", " ".join(message.split()), file=sys.stderr)
