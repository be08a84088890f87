"""Expected images: signs, closed-form brightness, agreement with Mitsuba's path integrator, determinism."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import ROOT

from vlcrender.camera import psf
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.config.toml_model import check, read_toml
from vlcrender.errors import InputError
from vlcrender.rendering.expected_image import ExpectedImage
from vlcrender.rendering.path_traced import reference_cd_m2
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, build_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.radiometry import Silicon, electron_rate_per_cd_m2


@pytest.fixture(scope="module")
def renderer(table1: Scene) -> Renderer:
    return Renderer(table1)


@pytest.fixture(scope="module")
def office_renderer(office: Scene) -> Renderer:
    return Renderer(office)


def centroid(mean: ExpectedImage, led_id: int) -> np.ndarray:
    """(u, v) of the light of one LED in the image."""
    patch = next(p for p in mean.patches if p.led_id == led_id)
    rows, columns = patch.electrons_per_s.shape
    weight = patch.electrons_per_s.sum(dtype=float)
    u = (patch.electrons_per_s.sum(axis=0) * (patch.column + 0.5 + np.arange(columns))).sum() / weight
    v = (patch.electrons_per_s.sum(axis=1) * (patch.row + 0.5 + np.arange(rows))).sum() / weight
    return np.array([u, v])


LED_2 = (0.3, 1.9)
"""LED 2 of Table 1, far enough from its neighbours to be alone in the image."""


@pytest.mark.parametrize(
    ("pose", "direction"),
    [
        (Pose((LED_2[0] - 0.05, LED_2[1], 0.5)), (1, 0)),  # LED towards +x of the camera: +u
        (Pose((LED_2[0], LED_2[1] - 0.05, 0.5)), (0, 1)),  # towards +y: +v
        (Pose((*LED_2, 0.5), tilt_x_deg=1.0), (0, 1)),  # tilt_x raised: +v
        (Pose((*LED_2, 0.5), tilt_y_deg=1.0), (-1, 0)),  # tilt_y raised: -u
    ],
    ids=["x", "y", "tilt_x", "tilt_y"],
)
def test_the_led_image_moves_as_documented(
    renderer: Renderer, small_camera: Camera, pose: Pose, direction: tuple[int, int]
) -> None:
    image = renderer.expected_image(PosedCamera(small_camera, pose)).expected_electrons(1e-4)
    row, column = np.unravel_index(np.argmax(image), image.shape)
    shift = np.array([column + 0.5 - 200, row + 0.5 - 150])
    assert shift @ direction > 10
    assert abs(shift @ (direction[1], direction[0])) < 10


def test_background_and_leds_share_one_projection(office_renderer: Renderer, small_camera: Camera) -> None:
    """Rays of the surfaces and projection of the LEDs agree: a panel's vertex is imaged where it projects."""
    pose = Pose((3.15, 3.1, 1.0), tilt_x_deg=-4.0, tilt_y_deg=3.0, yaw_deg=20.0)
    image = office_renderer.background_cd_m2(PosedCamera(small_camera, pose))
    inverse = np.linalg.inv(small_camera.matrix)
    panel = next(s for s in office_renderer.scene.surfaces if s.name == "panel 24 underside")
    vertices = PosedCamera(small_camera, pose).project(
        np.stack([panel.corner_m + a * panel.edge_u_m + b * panel.edge_v_m for a in (0, 1) for b in (0, 1)])
    )
    inside = [c for c in vertices if 5 < c[0] < 395 and 5 < c[1] < 295]
    assert inside, "choose another pose: no vertex in the image"
    middle = vertices.mean(axis=0)
    for vertex in inside:
        outward = (vertex - middle) / np.linalg.norm(vertex - middle)
        values = []
        for pixel in (vertex - 2.5 * outward, vertex + 2.5 * outward):
            x, y, _ = inverse @ [*pixel, 1]
            values.append(image[int(pixel[1]), int(pixel[0])] * (1 + x * x + y * y) ** 2)
        # the panel, rho E / pi: 400 lux around it and some 45 lux, evenly, by reflection from the floor
        panel_cd_m2 = 0.7 * (400 + 45) / np.pi
        assert values[0] == pytest.approx(panel_cd_m2, rel=0.04)
        assert values[1] != pytest.approx(panel_cd_m2, rel=0.08)  # the ceiling beside it reflects 0.8


def test_a_covered_pixel_has_the_leds_luminance(renderer: Renderer) -> None:
    camera = Camera()
    mean = renderer.expected_image(PosedCamera(camera, Pose((*LED_2, 0.5))))
    expected = mean.expected_electrons(2.5e-4)
    per_cd = 2.5e-4 * electron_rate_per_cd_m2(camera, "LED-B3", Silicon())
    # 8000 cd/m2 of its own and 0.5 * 400 / pi reflected, on the axis; the LEDs' light adds less than 1 lux: 2e-5
    assert expected[1500, 2000] == pytest.approx(per_cd * (8000 + 0.5 * 400 / np.pi), rel=4e-5)


def test_the_ceiling_dims_with_cos4_off_the_axis(renderer: Renderer) -> None:
    camera = Camera()
    image = renderer.background_cd_m2(PosedCamera(camera, Pose((3.5, 3.5, 0.5))))
    tan2 = ((1999.5) ** 2 + (1499.5) ** 2) / 15000**2
    # 400 lux everywhere, and the four LEDs' reflected light, which is below 0.3 lux: 8e-4
    assert image[0, 0] == pytest.approx(0.8 * 400 / np.pi / (1 + tan2) ** 2, rel=1e-3)
    assert image[1500, 2000] == pytest.approx(0.8 * 400 / np.pi, rel=1e-3)


def test_centroid_of_a_level_led_is_its_projection(renderer: Renderer) -> None:
    camera = Camera()
    pose = Pose((0.35, 1.8, 0.5))
    mean = renderer.expected_image(PosedCamera(camera, pose))
    expected = PosedCamera(camera, pose).project(np.array([0.3, 1.9, 3.5]))
    # cos^4 tilts the disc's brightness: d(cos^4)/du * r^2/4 = 4 * 500/15000^2 * 60^2/4 = 0.008 px at 500 px off axis
    assert np.abs(centroid(mean, 2) - expected).max() < 0.01


SMALL_VIEW = {"width_px": 120, "height_px": 90, "pixel_pitch_um": 40.0}
STRAIGHT = Pose((3.5, 3.2, 0.5), 5, 10, 30)
VIEWS = {
    "skewed, off centre": (Camera(**SMALL_VIEW, principal_point_px=(50.0, 52.0), skew_px=40.0), STRAIGHT),
    "tilted": (Camera(**SMALL_VIEW), Pose((1.0, 3.0, 1.2), 40, -30, 170)),
    "wide and distorted, with walls": (
        Camera(**{**SMALL_VIEW, "pixel_pitch_um": 130.0}, distortion={"k1": -0.2, "p1": 0.01}),
        Pose((1.3, 1.3, 1.2), 25, -20, 0),
    ),
    "glazing": (Camera(**{**SMALL_VIEW, "pixel_pitch_um": 130.0}), Pose((3.0, 3.5, 1.2), 0, -72, 0)),
    "defocused": (Camera(**SMALL_VIEW, focus_distance_m="infinity", f_number=1.0), STRAIGHT),
    "fish-eye": (
        Camera(**{**SMALL_VIEW, "pixel_pitch_um": 300.0}, projection="equidistant"),
        Pose((2.6, 3.1, 1.0), 10, 5, 30),
    ),
}


@pytest.fixture(scope="module")
def daylight() -> Renderer:
    """The office with a glazing in the wall x = 0 and daylight that counts; a quarter of the usual paths."""
    tree = read_toml(ROOT / "scenes/office.toml")
    glazing = {"wall": "x=0", "corner_m": [1.5, 0.9], "size_m": [4.0, 2.0], "luminance_cd_m2": 300.0}
    changed = {**tree, "glazing": [glazing], "bake": {"paths": 256}}
    return Renderer(build_scene(check(changed, SceneSettings, "daylight"), "daylight"))


@pytest.mark.slow
@pytest.mark.parametrize("name", VIEWS)
def test_agrees_with_mitsubas_path_integrator(name: str, office_renderer: Renderer, daylight: Renderer) -> None:
    camera, pose = VIEWS[name]
    renderer = daylight if name == "glazing" else office_renderer
    samples = 64
    reference, variance = reference_cd_m2(renderer.scene, PosedCamera(camera, pose), samples)
    rate = electron_rate_per_cd_m2(camera, "LED-B3", Silicon())
    u, v = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    mean = renderer.expected_image(PosedCamera(camera, pose))
    ours = mean.expected_electrons(1.0) / rate / relative_illumination(camera, u, v)
    lit = np.zeros(ours.shape, dtype=bool)
    for patch in (*mean.patches, *mean.parts[0].reflections):
        lit[mean.parts[0].roi.slices(patch.roi)] |= patch.electrons_per_s > 0
    assert lit.any(), "an LED has to be in the image"
    assert (reference[lit] > 300).any()

    # 1. LEDs. A pixel of a share p of luminance L, sampled n times: variance p (1 - p) (L - b)^2 / n. The sample
    # variance is useless where hardly a sample hit (p << 1/n), so the brightest LED bounds it: |ours - b| L_max / n.
    # 1 cd/m2 is for the lightmap's own error and the 8 x 8 grid at edges, 1.3 % of a step of at most 110.
    dark = np.median(reference)
    bound = np.maximum(variance, np.abs(ours - dark) * 16000 / samples) + 1.0 + (0.013 * 110) ** 2
    z = (ours - reference)[lit] / np.sqrt(bound[lit])
    # family-wise over some hundred to some thousand pixels; binomial tails are longer than normal ones
    assert np.abs(z).max() < 6
    assert abs(z.mean()) < 5 / np.sqrt(len(z))

    # 2. The room, in blocks of 10 x 10 pixels without LED light: their means differ by the reference's noise, the
    # lightmap's (0.7 lux of 440: 0.15 %, or twice that with a quarter of its paths, all of a block alike) and
    # interpolation between vertices 0.25 m apart (0.3 %).
    of_lightmap = np.hypot(0.0015 if name != "glazing" else 0.003, 0.003)
    blocks = [np.s_[r : r + 10, c : c + 10] for r in range(0, 90, 10) for c in range(0, 120, 10)]
    means = np.array(
        [[ours[b].mean(), reference[b].mean(), variance[b].mean() / 100] for b in blocks if not lit[b].any()]
    )
    assert len(means) > 5
    z = (means[:, 0] - means[:, 1]) / np.sqrt(means[:, 2] + (of_lightmap * means[:, 1]) ** 2)
    # 8 batches: Student's t with 7 degrees of freedom, of which one in 10 000 is beyond 7.9 where noise rules
    assert np.abs(z).max() < 7.9
    noise = np.sqrt(means[:, 2].mean() / len(means))
    assert abs((means[:, 0] - means[:, 1]).mean()) < 5 * noise + of_lightmap * means[:, 1].mean()


@pytest.mark.slow
def test_narrow_defocus_agrees_with_mitsuba_and_needs_split_pixels(
    office_renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error that blurring whole pixels would add: its share in the split result, by least squares, is 0."""
    # D f_i / (z pitch) = 8.2 mm * 18 mm / (2.95 m * 40 um) = 1.25 px
    camera, samples = Camera(**SMALL_VIEW, focus_distance_m="infinity"), 64
    reference, variance = reference_cd_m2(office_renderer.scene, PosedCamera(camera, STRAIGHT), samples)
    rate = electron_rate_per_cd_m2(camera, "LED-B3", Silicon())
    u, v = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    per_cd = rate * relative_illumination(camera, u, v)
    mean = office_renderer.expected_image(PosedCamera(camera, STRAIGHT))
    ours = mean.expected_electrons(1.0) / per_cd
    monkeypatch.setattr(psf, "MAX_PARTS", 1)
    whole_pixels = office_renderer.expected_image(PosedCamera(camera, STRAIGHT)).expected_electrons(1.0) / per_cd
    lit = np.zeros(ours.shape, dtype=bool)
    for patch in mean.patches:
        lit[mean.parts[0].roi.slices(patch.roi)] |= patch.electrons_per_s > 0
    added = (whole_pixels - ours)[lit]
    assert np.abs(added).max() > 0.02 * 16000
    # the bounds of each pixel's variance are those of `test_agrees_with_mitsubas_path_integrator`
    bound = np.maximum(variance, np.abs(ours - np.median(reference)) * 16000 / samples)[lit] + 1.0 + (0.013 * 110) ** 2
    sigma = (added**2 / bound).sum() ** -0.5
    share = (added * (ours - reference)[lit] / bound).sum() * sigma**2
    print(f"{share:.3f} +- {sigma:.3f} of what whole pixels would add")
    assert sigma < 0.15  # all of it would be seen
    assert abs(share) < 4 * sigma


def test_two_renderers_agree_to_the_bit(office_renderer: Renderer, office: Scene, small_camera: Camera) -> None:
    pose = Pose((3.5, 3.2, 0.5), 25, 10, 30)
    first = office_renderer.expected_image(PosedCamera(small_camera, pose)).expected_electrons(1e-3)
    second = Renderer(office).expected_image(PosedCamera(small_camera, pose)).expected_electrons(1e-3)
    assert first.tobytes() == second.tobytes()


@pytest.mark.slow
def test_another_thread_renders_the_same_bits(office_renderer: Renderer) -> None:
    """Dr.Jit's flags apply to one thread, and workers of a cluster render in other threads."""
    posed = PosedCamera(Camera(), Pose((1.5, 2.0, 1.2), 40.0, 35.0, 110.0))
    with ThreadPoolExecutor(1) as pool:
        there = pool.submit(office_renderer.background_cd_m2, posed).result()
    assert there.tobytes() == office_renderer.background_cd_m2(posed).tobytes()


def test_gains_scale_single_leds(renderer: Renderer) -> None:
    camera = Camera()
    mean = renderer.expected_image(PosedCamera(camera, Pose((*LED_2, 0.5))))
    off = mean.expected_electrons(1e-3, gains={2: 0.0})
    assert np.array_equal(off, mean.parts[0].background_e_per_s * np.float32(1e-3))
    half = mean.expected_electrons(1e-3, gains={2: 0.5})
    full = mean.expected_electrons(1e-3)
    assert np.allclose(half - off, (full - off) / 2, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("position", [(-0.1, 1.0, 1.0), (1.0, 7.0, 1.0), (1.0, 1.0, 3.6), (1.0, 1.0, 0.0)])
def test_a_camera_outside_the_room_is_refused(renderer: Renderer, position: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="not inside the room"):
        renderer.expected_image(PosedCamera(Camera(), Pose(position)))


def test_a_fish_eye_is_sharp_at_its_focus_distance_whatever_the_depth(table1: Scene) -> None:
    """LED 2 stands 60 deg off the axis, 2 m away, at a depth of 1 m: focused at 2 m it is sharp, at 1 m it is not."""
    pose = Pose((LED_2[0] + 2.0 * np.sin(np.radians(60)), LED_2[1], 3.5 - 1.0))
    lens = {"width_px": 3300, "height_px": 100, "pixel_pitch_um": 2.0, "focal_length_mm": 3.0, "f_number": 0.5}
    fish_eye = Camera(**lens, projection="equidistant")
    renderer = Renderer(table1)
    sharp, at_2_m, at_1_m = (
        next(p for p in renderer.expected_image(PosedCamera(camera, pose)).patches if p.led_id == 2).electrons_per_s
        for camera in (fish_eye, *(fish_eye.model_copy(update={"focus_distance_m": m}) for m in (2.0, 1.0)))
    )
    # Focused at 2 m the sensor is 0.15 % farther from the lens: the image is that much larger, 0.02 px, which may bring
    # it into one more row or column. Focused at 1 m a point is a disc of 6 mm * 3 mm * (1/1 - 1/2) / 2 um = 4.5 px.
    assert np.abs(np.subtract(at_2_m.shape, sharp.shape)).max() <= 1
    assert at_2_m.max() == pytest.approx(sharp.max(), rel=5e-3)
    assert np.subtract(at_1_m.shape, sharp.shape).min() >= 4


def test_the_reference_has_no_diffraction(table1: Scene) -> None:
    with pytest.raises(InputError, match="psf"):
        reference_cd_m2(table1, PosedCamera(Camera(psf="diffraction"), Pose((1, 1, 1))), 8)
