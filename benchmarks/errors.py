"""Errors of the renderer as shares of the shot noise's variance, at a peak of 4 000 electrons."""

from pathlib import Path

import numpy as np

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.core.backend import dr
from vlcrender.core.planar_shapes import Disc
from vlcrender.light.lightmap import Lightmap, bake, illuminance_at
from vlcrender.rendering import background as background_module
from vlcrender.rendering.led_coverage import LedFace, coverage_of_led
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, load_scene

PEAK_E = 4000.0
POSES = [
    Pose((3.15, 3.1, 0.6), tilt_x_deg=6.0, tilt_y_deg=-8.0, yaw_deg=20.0),
    Pose((5.2, 1.0, 1.6), 57.0, 54.0, 139.0),
    Pose((1.5, 2.0, 1.2), 40.0, 35.0, 110.0),
]
FINER = 8
POINTS = 3000
PATHS = 4096


def interpolation(scene: Scene, light: Lightmap, per_cd: float) -> tuple[float, float, float]:
    """Interpolated illuminance against the illuminance of random points, over all surfaces of the room.

    The worst point's and the mean share of the shot noise's variance, less the Monte Carlo noise; and the relative
    error of the mean light of LEDs on the ceiling.
    """
    rng, mesh = np.random.default_rng(1), light.mesh
    corners = mesh.vertices_m[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    # half of the points on the ceiling, where other surfaces are nearest
    ceiling = mesh.owners == [surface.name for surface in scene.surfaces].index("ceiling")
    areas[ceiling] *= areas[~ceiling].sum() / areas[ceiling].sum()
    picked = rng.choice(len(mesh.faces), POINTS, p=areas / areas.sum())
    shares = rng.dirichlet((1.0, 1.0, 1.0), POINTS)  # even over a triangle
    vertices = mesh.faces[picked]
    points = np.einsum("ni,nij->nj", shares, corners[picked])
    there = illuminance_at(scene, mesh, points, mesh.normals[vertices[:, 0]], PATHS)
    ours = (shares * light.led_lux[vertices]).sum(axis=1)
    error = ours - there.led_lux
    sigma = np.hypot(there.sigma_lux, np.sqrt(((shares * light.sigma_lux[vertices]) ** 2).sum(axis=1)))
    e_per_lux = per_cd * mesh.albedo[vertices[:, 0]] / np.pi
    share_per_lux2 = e_per_lux / (there.led_lux + scene.settings.ambient.illuminance_lux)
    worst = share_per_lux2 * np.maximum(np.abs(error) - 3 * sigma, 0.0) ** 2
    mean = share_per_lux2 * (error**2 - sigma**2)
    above = ceiling[picked]
    relative = ours[above].mean() / there.led_lux[above].mean() - 1
    return float(worst.max()), float(mean[~above].mean() / 2 + mean[above].mean() / 2), float(relative)


def main() -> None:
    """Measure and print."""
    scene = load_scene(Path(__file__).parent.parent / "scenes/office.toml")
    light = bake(scene)
    renderer, camera = Renderer(scene, light), Camera()
    per_cd = PEAK_E / scene.leds.luminances_cd_m2.max()

    # Lightmap: an error of the illuminance is an error of the image, the same over a texel.
    cd_m2 = light.led_cd_m2() + light.ambient_cd_m2()
    error_e = per_cd * light.albedo * light.sigma_lux / np.pi
    print(f"lightmap, Monte Carlo alone, worst vertex                     {(error_e**2 / (per_cd * cd_m2)).max():8.4%}")
    worst, mean, relative = interpolation(scene, light, per_cd)
    print(f"lightmap, interpolation beyond 3 sigma, worst of {POINTS} points     {worst:8.4%}")
    print(f"lightmap, interpolation, mean over all surfaces               {mean:8.4%}")
    print(f"light of LEDs on the ceiling, interpolated / there - 1        {relative:+8.2%}")

    # Where surfaces meet: the 8 x 8 grid against 32 x 32.
    worst = 0.0
    for posed in (PosedCamera(camera, pose) for pose in POSES):
        coarse = per_cd * renderer.background_cd_m2(posed).astype(float)
        background_module.EDGE_GRID, kept = 32, background_module.EDGE_GRID
        fine = per_cd * renderer.background_cd_m2(posed).astype(float)
        background_module.EDGE_GRID = kept
        worst = max(worst, float(((coarse - fine) ** 2 / fine).max()))
    print(f"edges between surfaces, worst pixel of {len(POSES)} images               {worst:8.4%}")

    # LED edges: coverage against the mean of 8 x 8 exact coverages of pixels an eighth as wide.
    fine_camera = Camera(
        width_px=camera.width_px, height_px=camera.height_px, pixel_pitch_um=camera.pixel_pitch_um / FINER
    )
    worst, pixels = 0.0, 0
    for posed in (PosedCamera(camera, pose) for pose in POSES):
        for i in scene.leds.spheres.candidates(posed):
            face = LedFace(scene.leds.centers_m[i], Disc(float(scene.leds.half_widths_m[i])))
            image = coverage_of_led(posed, face)
            if image is None or image.visible_fraction < 1:
                continue
            rows, columns = image.coverage.shape
            u, v = camera.center_px
            shifted = fine_camera.model_copy(
                update={
                    "principal_point_px": (FINER * (u - image.roi.column), FINER * (v - image.roi.row)),
                    "width_px": FINER * columns,
                    "height_px": FINER * rows,
                }
            )
            fine_image = coverage_of_led(PosedCamera(shifted, posed.pose), face)
            assert fine_image is not None
            whole = np.zeros((FINER * rows, FINER * columns))
            whole[Roi(0, 0, *whole.shape).slices(fine_image.roi)] = fine_image.coverage
            mean = whole.reshape(rows, FINER, columns, FINER).mean(axis=(1, 3))
            edge = (mean > 0) & (mean < 1)
            light_e = PEAK_E * mean[edge] + per_cd * cd_m2.min()
            worst = max(worst, float(((PEAK_E * (image.coverage - mean)[edge]) ** 2 / light_e).max()))
            pixels += int(edge.sum())
    print(f"LED edges, worst of {pixels} pixels                               {worst:8.4%}")
    dr.sync_thread()


if __name__ == "__main__":
    main()
