"""Command line of the estimator, a thin client of the package.

Errors are one line on stderr and exit code 2. A command loads the modules that it needs when it runs, so that
`estimator --help` loads neither OpenCV nor SciPy.
"""

from __future__ import annotations

import logging
import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

import estimator
from estimator.errors import InputError
from estimator.io.arguments import Whole
from estimator.io.process import INTERRUPTED, ending_at_second_interrupt, prepare_streams, progress_console
from estimator.report.benchmark_commands import leaderboard, submit
from estimator.report.score_commands import score
from estimator.report.table_commands import plot, table

if TYPE_CHECKING:
    from estimator.io.estimates import EstimateRow

INTERNAL_ERROR = 1
NO_ANSWER = 1
USER_ERROR = 2

app = App(
    name="estimator",
    help="Estimate camera positions from images of ceiling LEDs, and judge the estimates.",
    version=lambda: estimator.__version__,
    exit_on_error=False,
    print_error=False,
    suppress_keyboard_interrupt=False,
    result_action="return_value",
)


@app.command
def variants() -> None:
    """List the variants, a line each, with the package of those that other packages register."""
    from estimator.methods.catalogue import OWN, PUBLISHED_SINCE
    from estimator.methods.registry import Registry

    registry, plugins = Registry.read(), [one for one in estimator.variants() if one.name not in OWN]
    usable = [*OWN.values(), *plugins]
    width = max(len(variant.name) for variant in usable)
    for variant in usable:
        source = registry.source(variant.name)
        remark = " (where named)" if variant.name in PUBLISHED_SINCE else source and f" (external: {source})"
        summary = " ".join(variant.summary.split())  # a plug-in's may have several lines
        print(f"{variant.name:{width}}  {summary}{remark}")


@app.command
def run(
    dataset: Path,
    /,
    *,
    variant: Annotated[list[str] | None, Parameter(negative=())] = None,
    workers: Whole = 1,
    centroid_sigma: float | None = None,
    out: Path | None = None,
) -> int:
    """Estimate every frame's position and write DATASET/estimates/VARIANT.parquet.

    Exits with 1 where a variant that --variant names answered no frame.

    Parameters
    ----------
    dataset
        Folder of a dataset, or of a sweep, whose cells are estimated one after another by the same processes.
    variant
        Variant to run; may be given several times. Default: all that `estimator variants` does not mark "where named".
    workers
        Number of processes; the estimates do not depend on it.
    centroid_sigma
        Standard deviation of each coordinate of a centroid, pixels, beside that by the pixels' noise: the size of the
        errors of camera, map and image that the device does not state. The variants that fit centroids then have the
        name NAME:centroid-sigma=PIXELS; the others do not change.
    out
        Folder for the estimates, in place of DATASET, which is then only read; `score`, `report` and the other commands
        take it as they take a dataset.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from estimator.evaluate.process import prepare_process
    from estimator.evaluate.run import write_run
    from estimator.io.estimates import estimates_path
    from estimator.io.sweep import read_sweep

    if workers < 1:
        raise InputError(f"--workers {workers}: is not 1 or more")
    prepare_process()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=progress_console())
    task = bar.add_task("frames", total=None)
    answers: dict[str, _Answers] = {}

    def count(name: str, some: Sequence[EstimateRow]) -> None:
        answers.setdefault(name, _Answers()).add(some)

    with ExitStack() as stack:

        def draw(done: int, total: int) -> None:
            if done == 0:
                stack.enter_context(bar)  # not before the dataset is read: an error is one line
            bar.update(task, completed=done, total=total)

        write_run(dataset, count, _with_centroid_sigma(variant, centroid_sigma), workers, draw, out)
    home = dataset if out is None else out
    for name, of_variant in answers.items():
        sweep = read_sweep(dataset)
        where = estimates_path(home, name) if sweep is None else f"the {len(sweep.cells)} cells of {home}"
        print(f"{name}: {of_variant.ok} of {of_variant.frames} frames ok -> {where}")
    for of_variant in answers.values():
        if of_variant.unread:
            raise InputError(
                f"{dataset}: {of_variant.unread} of {of_variant.frames} frames could not be read; "
                f"{of_variant.first_unread}"
            )
    silent = [name for name, of_variant in answers.items() if not of_variant.ok]
    if variant is None or not silent:
        return 0
    for name in silent:
        reasons = answers[name].reasons.most_common(1)
        print(f"estimator: {name} answered no frame: {reasons[0][0] if reasons else 'there is none'}", file=sys.stderr)
    return NO_ANSWER


@dataclass
class _Answers:
    """Counts of a variant's frames: all, `ok`, of no readable image, and failed by reason."""

    frames: int = 0
    ok: int = 0
    unread: int = 0
    first_unread: str = ""
    """The first frame that could not be read, and why."""
    reasons: Counter[str] = field(default_factory=Counter)

    def add(self, rows: Sequence[EstimateRow]) -> None:
        """Count some rows."""
        for row in rows:
            self.frames += 1
            self.ok += row.status == "ok"
            if row.reason.startswith("read: "):
                self.unread += 1
                self.first_unread = self.first_unread or f"frame {row.frame}: {row.reason.removeprefix('read: ')}"
            elif row.reason:
                self.reasons[row.reason] += 1


def _with_centroid_sigma(names: list[str] | None, sigma_px: float | None) -> list[str] | None:
    """Names of variants, those that fit centroids with the option; None for all variants if there is no option."""
    from estimator.methods.centroid_sigma import OPTION
    from estimator.methods.gravity_fit import GRAVITY_FIT
    from estimator.methods.up2p import UP2P

    if sigma_px is None:
        return names
    able = (GRAVITY_FIT.name, UP2P.name)
    chosen = [one.name for one in estimator.variants()] if names is None else names
    if not set(able) & set(chosen):
        raise InputError(f"--centroid-sigma: none of the variants uses it; those that do: {', '.join(able)}")
    return [f"{name}:{OPTION}={sigma_px:.10f}".rstrip("0").rstrip(".") if name in able else name for name in chosen]


app.command(score)
app.command(table)
app.command(plot)
app.command(submit)
app.command(leaderboard)


@app.command
def compare(dataset: Path, a: str, b: str, /, *, json: Annotated[bool, Parameter(negative=())] = False) -> None:
    """Compare two variants frame by frame, scoring the dataset if needed.

    Parameters
    ----------
    dataset
        Folder of a dataset with estimates.
    a
        A variant.
    b
        Another variant.
    json
        Print JSON instead of a table.
    """
    from estimator.evaluate.comparison import compare as compare_variants
    from estimator.evaluate.score_table import PAIR_HEADERS, PAIR_NOTE, pair_cells
    from estimator.evaluate.scores_file import read_or_score

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
    """Write one self-contained HTML page of the datasets' scores, scoring them if needed.

    Parameters
    ----------
    datasets
        Folders of datasets with estimates.
    out
        The page to write.
    """
    from estimator.evaluate.scores_file import read_or_score
    from estimator.io.atomic import write_atomically
    from estimator.report.report import page

    if out.is_dir():
        raise InputError(f"--out {out}: is a folder, needed the name of a file")
    write_atomically(out, page([(folder, read_or_score(folder)) for folder in datasets]).encode())
    print(out)


@app.command
def levels(*datasets: Annotated[Path, Parameter(required=True)], out: Path) -> None:
    """Plot every variant's RMSE against the bound of each dataset, scoring them if needed, as SVG.

    The datasets are levels of difficulty, such as the accuracy of the map. The plot also says how many frames failed.

    Parameters
    ----------
    datasets
        Folders of datasets with estimates, whose recipes have `bound = true`.
    out
        The SVG to write.
    """
    from estimator.evaluate.levels import LEVEL_NOTE, level_cells, levels_of
    from estimator.evaluate.scores_file import read_or_score
    from estimator.io.atomic import write_atomically
    from estimator.report.levels import level_picture
    from estimator.report.terminal import print_table

    if out.is_dir():
        raise InputError(f"--out {out}: is a folder, needed the name of a file")
    found = levels_of([(folder, read_or_score(folder)) for folder in datasets])
    headers, rows = level_cells(found)
    write_atomically(out, level_picture(found).encode())
    print_table("RMSE by level", headers, rows, LEVEL_NOTE)
    print(out)


@app.command
def photo(
    *images: Annotated[Path, Parameter(required=True)],
    leds: Path,
    camera: Path | None = None,
    units: Literal["m", "cm", "mm", "in", "ft"] | None = None,
    mirror: Literal["auto", "x", "y", "none"] = "auto",
    exposure: str | None = None,
    focal_px: float | None = None,
    tone: Literal["srgb", "linear", "gamma"] = "srgb",
    orientation: Literal["stored", "upright"] = "stored",
    readout: Literal["auto", "rows", "columns"] = "auto",
    line_rate: float | None = None,
    spots: Path | None = None,
    gravity: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    tilt: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    level: float | None = None,
    attitude_sigma: float | None = None,
    centroid_sigma: float | None = None,
    truth: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    overlay: Path | None = None,
    save: Path | None = None,
) -> None:
    """Locate the camera of photographs of modulated LEDs, and draw what was found.

    Parameters
    ----------
    images
        Pictures: JPEG, PNG, TIFF, or DNG (with rawpy).
    leds
        LED map, CSV or JSON: x, y, z of each LED, and if known id, frequency_hz, radius or side.
    camera
        Calibration: YAML by OpenCV, ROS (camera_info) or Kalibr, or a NumPy .npz. Without one, --focal-px or EXIF.
    units
        Unit of the map. Default: the file's, by its columns' names (x_cm) or units, or m.
    mirror
        Axis of the map to reverse where its axes are left-handed; auto finds out.
    exposure
        Exposure time: seconds, 1/8000, 60us or 0.06ms. Default: EXIF's.
    focal_px
        Focal length in pixels of the picture, in place of a calibration.
    tone
        Curve by which the file stores light; gamma is 2.2.
    orientation
        Pixels as stored, or turned upright by EXIF's orientation. A calibration is of stored pixels.
    readout
        What the lines of the rolling shutter are; auto finds out.
    line_rate
        Lines that the sensor reads a second: identities come from the LEDs' tones.
    spots
        Identities by hand, CSV or JSON: led, u_px, v_px of each, near the lamp.
    gravity
        x,y,z: direction up in the picture's axes (right, down, forward), as an accelerometer reads it.
    tilt
        tilt_x,tilt_y of the camera, degrees.
    level
        The camera looked straight up, with this standard deviation of each tilt, degrees.
    attitude_sigma
        Standard deviation of each tilt with --gravity or --tilt, degrees. Default: 1.
    centroid_sigma
        Standard deviation of each coordinate of a centroid beside its noise, pixels. Default: by the residuals.
    truth
        x,y,z: true position in the map's units, to print the errors.
    overlay
        The overlay to write, PNG, or a folder for several pictures. Default: IMAGE_spots.png in the current folder.
    save
        Folder of a dataset to write (datasets/FORMAT.md).
    """
    from estimator.photo.session import PhotoRequest, run_photo
    from estimator.report.terminal import print_table

    request = PhotoRequest(
        images=images,
        leds=leds,
        camera=camera,
        units=units,
        mirror=mirror,
        exposure=exposure,
        focal_px=focal_px,
        tone=tone,
        orientation=orientation,
        readout=readout,
        line_rate=line_rate,
        spots=spots,
        gravity=gravity,
        tilt=tilt,
        level=level,
        attitude_sigma=attitude_sigma,
        centroid_sigma=centroid_sigma,
        truth=truth,
        overlay=overlay,
        save=save,
    )
    run_photo(request, print, print_table)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; an error is one line on stderr, without a traceback."""
    prepare_streams()
    try:
        with ending_at_second_interrupt(), _log_on_stderr():
            code = app(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of the output has exited (`| head`): end without a message, and do not flush into the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (InputError, CycloptsError) as error:
        return _complain(str(error), USER_ERROR)
    except OSError as error:
        return _complain(f"{error.filename or 'output'}: {error.strerror or error}", USER_ERROR)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except Exception as error:
        # A defect of this program: report it in one line as well.
        return _complain(f"internal error, please report it: {type(error).__name__}: {error}", INTERNAL_ERROR)
    return code if isinstance(code, int) else 0


def _complain(message: str, code: int) -> int:
    with suppress(BrokenPipeError):
        print("estimator:", " ".join(message.split()), file=sys.stderr)
    return code


class _LineHandler(logging.Handler):
    """Writes a log record as one line on the current stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record."""
        with suppress(BrokenPipeError):
            print(f"estimator: {record.levelname.lower()}:", " ".join(record.getMessage().split()), file=sys.stderr)


@contextmanager
def _log_on_stderr() -> Iterator[None]:
    """Show the package's warnings on stderr."""
    handler = _LineHandler(logging.WARNING)
    logger = logging.getLogger("estimator")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
