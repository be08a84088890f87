"""Make the picture of docs/downlink.md: python docs/make_downlink_picture.py

Part of an exposed frame of each of the recipes `downlink_codes` and `downlink`, and the lines of one LED beside the
chips that it sent.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

import vlcrender as vr
from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.modulation.exposure import LineGains, MeanWave
from vlcrender.modulation.transmission import led_waves
from vlcrender.modulation.wave import Wave
from vlcrender.rendering.expected_image import ExpectedRegion, LedPatch
from vlcrender.rendering.renderer import Renderer
from vlcrender.sensor.signal_chain import expose

Floats = NDArray[np.float64]
OUT = Path(__file__).parent / "pictures"
POSE = Pose((3.45, 3.5, 0.55), tilt_x_deg=3.0, tilt_y_deg=-4.0, yaw_deg=20.0)
PART_PX = 800
RECIPES = ("downlink_codes", "downlink")


@dataclass(frozen=True)
class Shot:
    """An exposed frame and what is behind it."""

    plan: vr.Plan
    waves: dict[int, Wave]
    start_s: float
    region: ExpectedRegion
    electrons: Floats
    """Of each pixel, (height, width)."""


def taken(recipe: str) -> Shot:
    """A full frame by a recipe's camera from POSE."""
    plan = vr.load_recipe(recipe)
    camera, sensor, leds = plan.recipe.camera, plan.recipe.sensor, plan.scene.leds
    exposure_s = plan.recipe.exposure_s or 0.0
    (region,) = Renderer(plan.scene).expected_image(PosedCamera(camera, POSE), room_apart=True).parts
    waves, start_s = led_waves(leds.transmitters, plan.recipe.seed), plan.recipe.start_s(0, True)
    starts_s = start_s + camera.line_starts_s()
    flux = dict(zip(leds.ids.tolist(), (leds.luminances_cd_m2 * leds.areas_m2).tolist(), strict=True))
    room_gain = MeanWave.of(waves, flux).mean(starts_s, exposure_s)
    mean = region.expected_electrons(exposure_s, LineGains(waves, starts_s, exposure_s), room_gain)
    dn = expose(sensor, mean, "picture", exposure_s=exposure_s)
    electrons = (dn.astype(np.float64) - sensor.black_level_dn) * sensor.gain_at_iso_e_per_dn
    return Shot(plan, waves, start_s, region, electrons)


def nearest(shot: Shot) -> LedPatch:
    """The LED nearest the middle of the frame."""
    height, width = shot.electrons.shape
    return min(shot.region.patches, key=lambda p: np.hypot(p.center_px[0] - width / 2, p.center_px[1] - height / 2))


def draw_lines(axes: Axes, shot: Shot) -> None:
    """Draw the light of one LED line by line over its mean in time, and the chips that it sent."""
    patch, camera = nearest(shot), shot.plan.recipe.camera
    exposure_s = shot.plan.recipe.exposure_s or 0.0
    rows, columns = shot.region.roi.slices(patch.roi)
    background = shot.region.background_e_per_s[rows, columns] * exposure_s
    steady = (patch.electrons_per_s * exposure_s).sum(axis=1)
    lit = steady > 0.1 * steady.max()
    light = (shot.electrons[rows, columns] - background).sum(axis=1)[lit] / steady[lit]
    lines = np.arange(patch.row, patch.row + len(steady))[lit]
    starts_s = lines * camera.shutter.row_time_s
    wave = shot.waves[patch.led_id]
    times_s = np.linspace(starts_s[0], starts_s[-1] + exposure_s, 4000)
    chips = np.array([float(bit) for bit in wave.bits or ""])
    sent = 2 * chips[np.floor(wave.phase(shot.start_s + times_s) * len(chips)).astype(int)]
    axes.fill_between(1e3 * times_s, sent, step="mid", color="#cfe3f2", linewidth=0, label="chips sent")
    axes.plot(1e3 * starts_s + 5e2 * exposure_s, light, ".", color="#d55e00", markersize=5, label="lines of the image")
    grid_s = times_s[times_s <= starts_s[-1]]
    gains = wave.mean(shot.start_s + grid_s, exposure_s)
    axes.plot(1e3 * grid_s + 5e2 * exposure_s, gains, color="#0072b2", linewidth=1, label="mean over an exposure")
    axes.set(xlabel="time after the start of the frame, ms", ylabel="light over its mean in time", ylim=(-0.1, 2.6))
    axes.set_title(f"LED {patch.led_id}: {len(lines)} lines", fontsize=10)
    axes.legend(fontsize=8, loc="upper right", ncols=3)


def main() -> None:
    """Render both recipes and write the picture."""
    figure = Figure(figsize=(15, 8.4), layout="constrained")
    panels = figure.subplots(2, 2, width_ratios=(1, 2))
    for (left, right), recipe in zip(panels, RECIPES, strict=True):
        shot = taken(recipe)
        u, v = nearest(shot).center_px
        height, width = shot.electrons.shape
        column, row = int(np.clip(u - 200, 0, width - PART_PX)), int(np.clip(v - 75, 0, height - PART_PX))
        part = shot.electrons[row : row + PART_PX, column : column + PART_PX]
        left.imshow(np.clip(part / 1500.0, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
        left.set_title(f"{recipe}: {PART_PX} x {PART_PX} px of a frame", fontsize=10)
        left.set_axis_off()
        draw_lines(right, shot)
    OUT.mkdir(exist_ok=True)
    figure.savefig(OUT / "downlink.png", dpi=90)


if __name__ == "__main__":
    main()
