"""Make the picture of docs/sensor.md: python docs/make_noise_picture.py

Two exposures of one full-size office frame, raw and processed to JPEG as by a phone.
"""

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from scipy.stats import skellam

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import load_scene
from vlcrender.sensor.isp import Processed
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

ROOT = Path(__file__).parent.parent
POSE = Pose((3.5, 1.5, 0.3), tilt_x_deg=-50.0)
BLURRED = Camera(focus_distance_m="infinity")  # the rims of the LED images then contain every level
EXPOSURE_S = 160e-6
MEAN_E = 25.6
LEVELS_E = np.geomspace(20, 3500, 30)


def processed(image_dn: NDArray[np.uint32], sensor: Sensor) -> NDArray[np.float64]:
    """Pixels of a JPEG of quality 90, converted to electrons by the inverse of the sRGB curve."""
    how = Processed()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"frame{how.suffix}"
        how.write(path, how.develop(image_dn, sensor, (1.0, 1.0, 1.0)))
        toned = np.asarray(Image.open(path), dtype=np.float64) / 255
    linear = np.where(toned <= 0.04045, toned / 12.92, ((toned + 0.055) / 1.055) ** 2.4)
    return linear * (sensor.white_dn - sensor.black_level_dn)


def main() -> None:
    """Render, expose twice, and draw the distribution of the difference, and its variance over the mean."""
    sensor = Sensor()
    mean = Renderer(load_scene(ROOT / "scenes/office.toml")).expected_image(PosedCamera(BLURRED, POSE))
    expected = mean.expected_electrons(EXPOSURE_S)
    pair = [expose(sensor, expected, f"picture/{n}", exposure_s=EXPOSURE_S) for n in range(2)]
    raw = pair[0].astype(float) - pair[1]
    jpeg = np.subtract(*(processed(image, sensor) for image in pair))
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    near = np.abs(expected - MEAN_E) < 0.02 * MEAN_E
    k = np.arange(-35, 36)
    left.bar(
        k, [np.mean(raw[near] == d) for d in k], width=1.0, color="#9ecae9", label="raw, difference of two exposures"
    )
    left.plot(k, skellam.pmf(k, expected[near].mean(), expected[near].mean()), color="#0072b2", label="Skellam")
    counts, edges = np.histogram(jpeg[near], bins=60, range=(-35, 35), density=True)
    left.step(edges[:-1], counts, where="post", color="#d55e00", label="processed: sRGB curve, JPEG 90")
    left.set(title=f"pixels of {expected[near].mean():.1f} electrons", xlabel="difference, electrons", ylabel="share")
    left.legend(fontsize=8)
    for difference, colour, label in ((raw, "#0072b2", "raw"), (jpeg, "#d55e00", "processed")):
        bins = [np.abs(expected / level - 1) < 0.05 for level in LEVELS_E]
        full = [(expected[b].mean(), difference[b].var()) for b in bins if b.sum() > 300]
        right.plot(*np.transpose(full), "o", color=colour, label=label, markersize=4)
    right.plot(LEVELS_E, 2 * LEVELS_E, color="#0072b2", linewidth=0.8, label="Skellam: twice the mean")
    right.set(xscale="log", yscale="log", xlabel="mean, electrons", ylabel="variance of the difference, electrons^2")
    right.set_title("noise over light")
    right.legend(fontsize=8)
    figure.savefig(ROOT / "docs/pictures/noise.png", dpi=90)


if __name__ == "__main__":
    main()
