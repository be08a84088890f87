"""What options cost: CPU time of whole frames (rays, noise, EXR, preview) over that of a plain frame, and peak memory.

    python benchmarks/options.py [REPEATS]

Frames of the office, 4000 x 3000. CPU time of all threads, alternately in one process. The peak memory of each option
is that of a process of its own, above that of a process that makes a frame of 100 x 75 pixels.
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from target import Targets, alternating_s, ratio

from vlcrender.dataset.format.files import EXPECTED, FRAMES, PREVIEWS
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.frame_job import Job, make_frame

ROOT = Path(__file__).parent.parent
QUICKSTART, REGIONS = ROOT / "datasets/quickstart.toml", ROOT / "datasets/office200.toml"
DIFFUSER = ("[panels.leds]", "[panels.diffuser]\ndistance_m = 0.04\ntransmittance = 0.6\n\n[panels.leds]")
MOTION = ["motion.angular_velocity_deg_s=[5.0, 3.0, 0.0]", "exposure_s=1e-3"]
PIXELS = 4000 * 3000
SMALL = ["camera.width_px=100", "camera.height_px=75", "camera.pixel_pitch_um=48.0"]
OPTIONS: dict[str, tuple[list[str], float | None, float]] = {
    "defocus": (["camera.focus_distance_m=1.0"], 2.0, 60.0),
    "diffraction with bound": (["camera.psf=diffraction", "bound=true"], 3.0, 120.0),
    "diffuser": (["scene=office_diffuser.toml"], 2.5, 80.0),
    "diffuser with bound": (["scene=office_diffuser.toml", "bound=true"], None, 120.0),
    "1 ms of motion": (MOTION, 2.0, 35.0),
}
"""Overrides of the recipe; what is wanted of CPU time over the plain frame's, if anything, and of peak memory, bytes a
pixel."""


def frame_of(folder: Path, recipe: Path, overrides: list[str]) -> Callable[[int], object]:
    """A function that makes a frame by its number, in files of a folder of its own."""
    here = Path(tempfile.mkdtemp(dir=folder))
    for name in (FRAMES, EXPECTED, PREVIEWS):
        (here / name).mkdir()
    text = (ROOT / "scenes/office.toml").read_text()
    (folder / "office_diffuser.toml").write_text(text.replace(*DIFFUSER))
    overrides = [text.replace("scene=", f"scene={folder}/") for text in overrides]
    plan = load_plan(recipe, ["poses.count=8", *overrides])
    settings = plan.scene.settings.model_dump_json()
    return partial(make_frame, Job(plan.recipe.model_dump_json(), settings, str(plan.scene.folder), str(here)))


def peak_bytes(folder: Path, overrides: list[str]) -> int:
    """Peak memory of a process that makes one frame.

    To be called before this process makes any: Linux counts its own peak as that of the processes it starts.
    """
    command = [sys.executable, __file__, "--peak", str(folder), *overrides]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main() -> None:
    """Measure and print."""
    if sys.argv[1:2] == ["--peak"]:
        frame_of(Path(sys.argv[2]), QUICKSTART, sys.argv[3:])(0)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
        return
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    targets = Targets()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plain = frame_of(folder, QUICKSTART, [])
        small = peak_bytes(folder, SMALL)
        memory = {"plain": ([], 35.0)} | {option: (one[0], one[2]) for option, one in OPTIONS.items()}
        for option, (overrides, bytes_a_pixel) in memory.items():
            used = (peak_bytes(folder, overrides) - small) / PIXELS
            targets.at_most(f"{option}: peak bytes a pixel", used, bytes_a_pixel)
        for option, (overrides, most, _) in OPTIONS.items():
            other = frame_of(folder, QUICKSTART, overrides)
            seconds = alternating_s([partial(other, 0), partial(plain, 0)], repeats, time.process_time)
            name = f"{option} / plain frame"
            if most is None:
                targets.beside(name, ratio(*seconds))
            else:
                targets.at_most(name, ratio(*seconds), most)
        on, off = (frame_of(folder, REGIONS, [f"bound={word}"]) for word in ("true", "false"))
        works = [lambda make=make: [make(number) for number in range(8)] for make in (on, off)]
        seconds = alternating_s(works, repeats, time.process_time)
        targets.at_most("LED regions with bound / without", ratio(*seconds), 1.5)
    targets.finish()


if __name__ == "__main__":
    main()
