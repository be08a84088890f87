"""The command line: every mistake is one line that names it, and exit code 2.

Commands are called in this process, but for the console scripts themselves and for what a process inherits: its
encoding, its output, and arguments as bytes.
"""

import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL, Finished, copy_of, run

from vlcrender.cli import _log_on_stderr

RECIPE = str(ROOT / "datasets/quickstart.toml")
TABLE1 = str(ROOT / "scenes/table1.toml")
SETS = [part for assignment in SMALL for part in ("--set", assignment)]


Process = subprocess.CompletedProcess[str]


def script(program: str, *arguments: str | bytes, **options: object) -> Process:
    """Run an installed console script, as a user would."""
    command = [Path(sys.executable).parent / program, *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.run(command, cwd=ROOT, text=True, **{**pipes, **options})  # type: ignore[call-overload,no-any-return]


def assert_refused(result: Finished | Process, *mentions: str) -> None:
    assert result.returncode == 2, (result.stdout, result.stderr)
    lines = [line for line in result.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in result.stderr
    for mention in mentions:
        assert mention in lines[0], lines[0]


GENERATE_MISTAKES: dict[str, tuple[list[str], list[str]]] = {
    "unknown key": (["--set", "camera.iso=100"], ["unknown key camera.iso", "allowed:", "f_number"]),
    "wrong unit": (["--set", "camera.focal_length_m=0.018"], ["focal_length_m", "did you mean focal_length_mm"]),
    "negative exposure": (["--set", "exposure_s=-1"], ["exposure_s = -1", "greater than 0"]),
    "not a number": (["--set", "exposure_s=soon"], ["exposure_s", "soon", "number"]),
    "infinite": (["--set", "exposure_s=inf"], ["exposure_s"]),
    "bits": (["--set", "sensor.bits=9"], ["sensor.bits = 9", "8, 10, 12 or 14"]),
    "negative gain": (["--set", "sensor.gain_e_per_dn=-2"], ["sensor.gain_e_per_dn = -2"]),
    "noise": (["--set", "sensor.noise=gaussian"], ["sensor.noise", "gaussian", "shot"]),
    "no --set value": (["--set", "exposure_s"], ["--set exposure_s", "key=value"]),
    "range upside down": (["--set", "poses.tilt_x_deg=[60, 0]"], ["tilt_x_deg = [60", "lower value comes first"]),
    "tilt": (["--set", "poses.tilt_x_deg=[0, 89]"], ["poses.tilt_x_deg[1] = 89", "85"]),
    "kind of poses": (["--set", "poses.kind=spiral"], ["poses", "spiral", "aimed", "list"]),
    "no poses": (["--set", "poses.count=0"], ["poses.count = 0"]),
    "no such scene": (["--set", "scene=nowhere.toml"], ["nowhere.toml", "no such file"]),
    "seed": (["--set", "seed=-3"], ["seed = -3"]),
    "pixels": (["--set", "camera.width_px=4000.5"], ["camera.width_px = 4000.5"]),
    "principal point": (["--set", "camera.principal_point_px=[99999, 0]"], ["principal_point_px = [99999"]),
    "regions of a kind": (["--set", "regions.kind=panels"], ["regions", "panels", "leds"]),
    "regions without a kind": (["--set", "regions.overscan=true"], ["regions.kind is missing"]),
    "margin": (["--set", 'regions={ kind = "leds", margin_px = -1 }'], ["regions.margin_px = -1"]),
    "margin in mm": (["--set", 'regions={ kind = "leds", margin_mm = 1 }'], ["margin_mm", "did you mean margin_px"]),
    "motion": (
        ["--set", "motion.angular_velocity_rad_s=[0, 0, 1]"],
        ["angular_velocity_rad_s", "angular_velocity_deg_s"],
    ),
    "motion too fast": (["--set", "motion.linear_velocity_m_s=[999, 0, 0]", "--set", "exposure_s=1"], ["motion", "px"]),
    "rig of one name": (["--set", 'rig=[{ name = "main", offset_m = [0, 0, 0] }]'], ["rig", "'main'"]),
    "rig without a place": (["--set", 'rig=[{ name = "right" }]'], ["rig[0].offset_m is missing"]),
    "scale that does not divide": (["--scale", "7"], ["--scale 7", "400 x 300"]),
    "scale of zero": (["--scale", "0"], ["--scale 0", "1 or more"]),
    "scale mode": (["--scale", "10", "--scale-mode", "averaged"], ["--scale-mode", "averaged", "same-photons"]),
    "workers": (["--workers", "0"], ["--workers 0", "1 or more"]),
    "workers is a word": (["--workers", "many"], ["--workers", "many"]),
    "workers and a half": (["--workers", "1.5"], ["--workers", "1.5 is not a whole number"]),
    "scale with a point": (["--scale", "10.4"], ["--scale", "10.4 is not a whole number"]),
    "unknown option": (["--frobnicate"], ["--frobnicate"]),
    "overscan behind distortion": (
        ["--set", 'regions={kind="leds", overscan=true}', "--set", "camera.distortion.k1=-0.05"],
        ["regions.overscan = true", "distortion"],
    ),
    "unreachable": (["--set", "poses.min_leds=900"], ["frame 0", "900 LEDs", "lower min_leds"]),
}


@pytest.mark.parametrize("mistake", GENERATE_MISTAKES)
def test_generate_refuses(tmp_path: Path, mistake: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlcrender.dataset.recipe.pose_sampling.TRIES", 100)  # no more are needed to find no pose
    options, mentions = GENERATE_MISTAKES[mistake]
    assert_refused(run("vlcrender", "generate", RECIPE, "--out", str(tmp_path / "x"), *SETS, *options), *mentions)
    assert not (tmp_path / "x").exists()


def test_generate_refuses_files_that_are_not_recipes(tmp_path: Path) -> None:
    assert_refused(run("vlcrender", "generate", "no.toml", "--out", "x", cwd=tmp_path), "no.toml", "No such file")
    assert_refused(run("vlcrender", "generate", TABLE1, "--out", "x", cwd=tmp_path), "table1.toml", "format")
    (tmp_path / "binary.toml").write_bytes(bytes(range(256)))
    assert_refused(run("vlcrender", "generate", "binary.toml", "--out", "x", cwd=tmp_path), "binary.toml", "UTF-8")
    assert_refused(run("vlcrender", "generate", ".", "--out", "x", cwd=tmp_path), "directory")
    assert_refused(run("vlcrender", "generate", cwd=tmp_path), "RECIPE")


def test_generate_refuses_an_output_folder_below_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    out = str(tmp_path / "file" / "below")
    assert_refused(run("vlcrender", "generate", RECIPE, "--out", out, *SETS), str(tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder that has no others")
def test_generate_refuses_an_output_folder_that_the_system_does_not_make() -> None:
    out = "/proc/frames"
    assert_refused(run("vlcrender", "generate", RECIPE, "--out", out, *SETS), f"{out}: cannot be made: No such file")


def test_a_recipe_with_an_out_of_room_pose_is_refused(tmp_path: Path) -> None:
    text = Path(RECIPE).read_text()
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(
        text[: text.index("[poses]")].replace("../scenes", str(ROOT / "scenes"))
        + '[poses]\nkind = "list"\npose = [{ position_m = [1.0, 9.0, 1.0] }]\n'
    )
    assert_refused(
        run("vlcrender", "generate", str(recipe), "--out", str(tmp_path / "x")), "9.0", "not inside the room"
    )


def test_verify_accepts_an_intact_data_set_and_names_damage(rendered_set: Path, tmp_path: Path) -> None:
    assert run("vlcrender", "verify", str(rendered_set)).returncode == 0
    assert_refused(run("vlcrender", "verify", str(tmp_path)), str(tmp_path), "dataset.json")
    damaged = copy_of(rendered_set, tmp_path / "set")
    frame = damaged / "frames/000001.exr"
    frame.write_bytes(frame.read_bytes()[:5000])
    assert_refused(run("vlcrender", "verify", str(damaged)), "000001.exr", "SHA-256")
    (damaged / "dataset.json").write_text('{"format": "something else"}')
    assert_refused(run("vlcrender", "verify", str(damaged)), "dataset.json", "format")
    (damaged / "dataset.json").write_text("{" * 100_000)
    assert_refused(run("vlcrender", "verify", str(damaged)), "dataset.json", "JSON")


def test_show_refuses(tmp_path: Path) -> None:
    assert_refused(run("vlcrender", "show", "no.toml", cwd=tmp_path), "no.toml")
    assert_refused(run("vlcrender", "show", "office", "--frame", "1", cwd=tmp_path), "office: is a scene", "--frame")
    assert_refused(run("vlcrender", "show", RECIPE, "--frame", "8", cwd=tmp_path), "--frame 8", "frames 0 to 7")
    assert_refused(run("vlcrender", "show", "office", "table2", cwd=tmp_path), "table2: is neither", "recipes")
    assert_refused(run("vlcrender", "show", RECIPE, "--reference", cwd=tmp_path), "--reference: shows a scene alone")
    assert_refused(run("vlcrender", "show", TABLE1, "--out", "picture.jpg", cwd=tmp_path), "picture.jpg", ".png")
    assert_refused(run("vlcrender", "show", TABLE1, "--out", "no/such/x.png", cwd=tmp_path), "no/such")


def test_show_refuses_a_hall_whose_light_would_take_long(tmp_path: Path) -> None:
    """By hand: 700 x 700 x 12 m have 1 013 600 m2, at 0.25 m some 16 million points; 1 225 LEDs on 1e10 / 1 225 points
    need a texel of sqrt(1 013 600 * 1 225 / 1e10) = 0.352 m.
    """
    text = (ROOT / "scenes/office.toml").read_text()
    assert text.count("size_m = [7.0, 7.0, 3.5]") == 1
    (tmp_path / "hall.toml").write_text(text.replace("size_m = [7.0, 7.0, 3.5]", "size_m = [700.0, 700.0, 12.0]"))
    refused = run("vlcrender", "show", "hall.toml", cwd=tmp_path)
    assert_refused(refused, "hall.toml: bake.texel_m = 0.25: light of 1225 LEDs on 16 million points", "0.4 m or more")


def test_show_draws_a_frame_of_a_recipe_with_its_camera_in_any_scene(tmp_path: Path) -> None:
    """Coarse, to be quick. By hand: 4.8 x 3.6 mm at 14.4 mm, 2 atan(1/6) = 18.92 and 2 atan(1/8) = 14.25 deg."""
    small = ["--set", "camera.width_px=200", "--set", "camera.height_px=150", "--set", "camera.pixel_pitch_um=24"]
    changes = [*small, "--set", "camera.focal_length_mm=14.4", "--set", "poses.border_px=1"]
    result = run("vlcrender", "show", TABLE1, RECIPE, "--frame", "2", *changes, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "table1: poses" in result.stdout
    assert "by a view of 18.92 x 14.25 deg\n" in result.stdout
    assert re.search(r"frame 2 of 8: \d+ LEDs light 1 region\n", result.stdout)
    assert (tmp_path / "quickstart.png").read_bytes().startswith(b"\x89PNG")


def test_show_draws_and_counts(tmp_path: Path) -> None:
    result = run("vlcrender", "show", TABLE1, "--out", str(tmp_path / "table1.png"))
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "table1.png").read_bytes().startswith(b"\x89PNG")
    assert " 36 " in result.stdout  # of 122 500 level poses, as the errata say


def test_packaged_names_stand_for_files(tmp_path: Path) -> None:
    """In a folder that has no file of the name; a recipe's sensor may be measured by the recipe's name too."""
    refused = run("vlcrender", "generate", "quick", "--out", "x", cwd=tmp_path)
    assert_refused(refused, "quick: is neither a file nor one of the recipes there are", "quickstart", "table1")
    assert_refused(run("vlcrender", "show", "offic", cwd=tmp_path), "offic: is neither", "scenes", "office")
    small = [*SETS, "--set", "poses.count=1"]
    assert run("vlcrender", "generate", "quickstart", "--out", "set", *small, cwd=tmp_path).returncode == 0
    measured = run("vlcrender", "datasheet", "quickstart", "--side-px", "32", cwd=tmp_path)
    assert measured.returncode == 0, measured.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["quickstart-datasheet.html", "set"]


@pytest.mark.parametrize("program", ["vlcrender", "estimator"])
def test_console_scripts_end_with_the_command_s_exit_code(program: str) -> None:
    assert_refused(script(program, "estmate"), "estmate")
    version = script(program, "--version")
    assert (version.returncode, version.stdout.strip(), version.stderr) == (0, "0.1.0", "")


@pytest.mark.parametrize("program", ["vlcrender", "estimator"])
def test_help_is_no_error(program: str) -> None:
    helped = run(program, "--help")
    assert helped.returncode == 0
    assert "Usage" in helped.stdout


@pytest.mark.slow
def test_the_console_script_generates_a_data_set(tmp_path: Path) -> None:
    out = str(tmp_path / "set")
    made = script("vlcrender", "generate", RECIPE, "--out", out, *SETS, "--set", "poses.count=1")
    assert made.returncode == 0, made.stderr
    assert made.stdout.startswith(f"{out}: 1 frames\nLEDs a frame  ")
    verified = run("vlcrender", "verify", out)
    assert (verified.returncode, verified.stderr) == (0, "")


def test_the_whole_chain_on_small_frames_without_the_truth(rendered_set: Path, tmp_path: Path) -> None:
    """Estimates are the same with and without truth.parquet and provenance; scoring needs the truth and says so."""
    blind = copy_of(rendered_set, tmp_path / "blind")
    truth = (blind / "truth.parquet").read_bytes()
    (blind / "truth.parquet").unlink()
    tree = json.loads((blind / "dataset.json").read_text())
    tree["provenance"] = {}
    (blind / "dataset.json").write_text(json.dumps(tree))
    whole = copy_of(rendered_set, tmp_path / "whole")
    for directory in (blind, whole):
        result = run("estimator", "run", str(directory))
        assert result.returncode == 0, result.stderr
    for variant in ("huynh2016", "pnp"):
        tables = [pq.read_table(d / f"estimates/{variant}.parquet").drop_columns(["time_s"]) for d in (blind, whole)]
        assert tables[0].equals(tables[1])
        assert tables[0]["status"].to_pylist() == ["ok"] * 3
    assert_refused(run("estimator", "score", str(blind)), "truth.parquet")
    (blind / "truth.parquet").write_bytes(truth)
    assert run("estimator", "score", str(blind)).returncode == 0
    report = tmp_path / "report.html"
    assert run("estimator", "report", str(blind), "--out", str(report)).returncode == 0
    page = report.read_text()
    assert "huynh2016-as-printed" in page
    assert not [word for word in ('src="http', 'href="http', "url(http") if word in page], "the page has to stand alone"


@pytest.mark.slow
def test_a_terminal_without_degree_signs_gets_question_marks(tmp_path: Path) -> None:
    page = tmp_path / "ünï.html"
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    result = script("vlcrender", "datasheet", "ideal", "--side-px", "32", "--out", str(page), env=ascii_only)
    assert result.returncode == 0, result.stderr
    assert "25 ?C" in result.stdout
    assert page.exists()


def test_a_page_that_cannot_be_written_costs_no_measurement(tmp_path: Path) -> None:
    """A folder is refused before the measurement; a full disk is noticed after the results are printed."""
    assert_refused(run("vlcrender", "datasheet", "ideal", "--out", str(tmp_path)), f"--out {tmp_path}: is a folder")
    result = run("vlcrender", "datasheet", "ideal", "--side-px", "32", "--out", "/dev/full")
    assert_refused(result, "No space left")
    assert "system gain" in result.stdout


def test_messages_with_line_breaks_are_one_line(tmp_path: Path) -> None:
    for assignment in ('sensor.preset="a\\nb"', "a\nb=1"):
        refused = run("vlcrender", "generate", RECIPE, "--out", str(tmp_path / "x"), "--set", assignment)
        assert_refused(refused, "b")


@pytest.mark.slow
def test_warnings_of_any_package_are_lines_on_stderr_while_a_command_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """And no longer: a second command in the same process would show them twice."""
    with _log_on_stderr():
        logging.getLogger("another.package").warning("no cache:\n%s", "folder")
        logging.getLogger("another.package").info("not shown")
    logging.getLogger("another.package").warning("after")
    assert capsys.readouterr().err == "vlcrender: no cache: folder\n"


def test_a_folder_whose_name_is_not_utf_8_is_refused(tmp_path: Path) -> None:
    out = os.fsencode(tmp_path) + b"/x\xff"
    assert_refused(script("vlcrender", "generate", RECIPE, "--out", out, *SETS), "--out", "UTF-8")


@pytest.mark.slow
def test_a_closed_pipe_is_no_error(tmp_path: Path) -> None:
    page = str(tmp_path / "page.html")
    reading, writing = os.pipe()
    os.close(reading)
    result = script("vlcrender", "datasheet", "ideal", "--side-px", "32", "--json", "--out", page, stdout=writing)
    os.close(writing)
    assert (result.returncode, result.stderr) == (0, "")
