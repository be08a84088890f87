"""Calibrations of OpenCV, ROS, Kalibr and COLMAP in recipes: the same images as OpenCV's, or a refusal that says why.

Both packages read tests/calibrations; they share no code.
"""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import ROOT
from input_files import mutated, read_or_refused

import vlcrender as vr
from estimator.photo.calibration import read_calibration as read_by_estimator
from vlcrender.camera.calibration import read_calibration
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.errors import InputError

FILES = ROOT / "tests/calibrations"
QUICKSTART = (ROOT / "datasets/quickstart.toml").read_text()
K = np.array([[1000.25, 0.0, 639.5], [0.0, 1001.5, 470.125], [0.0, 0.0, 1.0]])
"""Of the files, with OpenCV's pixels: the first one's centre is (0, 0)."""
FIVE = [-0.02, 0.004, 0.001, -0.0015, 0.0005]
"""k1, k2, p1, p2, k3 of the files."""
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
NAMES = {"kalibr_camchain.yaml": "cam0", "colmap_cameras.txt": "1"}
"""The camera in files of several."""


def recipe_at(folder: Path, camera: str, rest: str = "") -> Path:
    """The quickstart recipe with another [camera], in a folder."""
    text = re.sub(r"(?s)\n\[camera\].*?(?=\n\[)", "\n", QUICKSTART)
    path = folder / "recipe.toml"
    path.write_text(text.replace('scene = "../scenes/', f'scene = "{ROOT}/scenes/') + f"\n[camera]\n{camera}\n{rest}")
    return path


def points(rng: np.random.Generator) -> np.ndarray:
    """Points in camera axes whose images are on the sensor."""
    return np.column_stack([rng.uniform(-0.55, 0.55, 200), rng.uniform(-0.4, 0.4, 200), np.ones(200)]) * 2.5


@pytest.fixture(params=["opencv.yml", "ros1_camera_info.yaml", "ros2_camera_info.yaml", "kalibr_camchain.yaml", "npz"])
def file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A calibration that both packages read."""
    if request.param != "npz":
        return FILES / request.param
    np.savez(tmp_path / "camera.npz", mtx=K, dist=np.array([FIVE]), image_size=(1280, 960))
    return tmp_path / "camera.npz"


def test_images_are_opencvs_moved_by_half_a_pixel(file: Path, rng: np.random.Generator) -> None:
    """cv2.projectPoints with the numbers of the file; rounding of a pixel number is some 1e-12."""
    camera = vr.Camera.calibrated(file, 3.0, NAMES.get(file.name), f_number=1.8)
    coefficients = FIVE[:4] if file.name.startswith("kalibr") else FIVE
    seen = points(rng)
    expected, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), K, np.array(coefficients))
    assert np.abs(camera.image_of_points(seen) - (expected[:, 0] + 0.5)).max() < 1e-9
    assert (camera.width_px, camera.height_px, camera.f_number) == (1280, 960, 1.8)


def test_both_packages_read_the_same(file: Path) -> None:
    ours, theirs = read_calibration(file, NAMES.get(file.name)), read_by_estimator(file)
    assert [[ours.fx, ours.skew, ours.cx], [0, ours.fy, ours.cy], [0, 0, 1]] == theirs.K.tolist() == (K + HALF).tolist()
    assert (ours.size_px, ours.projection) == (theirs.size_px, theirs.projection)
    assert theirs.distortion is not None
    assert ours.distortion == theirs.distortion.model_dump()


def test_colmaps_pixels_are_ours(rng: np.random.Generator) -> None:
    """COLMAP's images start at their corner: its (640, 470.625) is OpenCV's (639.5, 470.125)."""
    camera = vr.Camera.calibrated(FILES / "colmap_cameras.txt", 3.0, "1")
    assert camera.matrix == pytest.approx(K + HALF, rel=1e-14)
    assert camera.distortion is not None
    assert [getattr(camera.distortion, name) for name in ("k1", "k2", "p1", "p2", "k3")] == FIVE
    simple = vr.Camera.calibrated(FILES / "colmap_cameras.txt", 3.0, "2")
    assert simple.distortion is not None
    assert (simple.distortion.k1, simple.distortion.k2, simple.focal_xy_px) == (-0.02, 0.0, (1000.0, 1000.0))


@pytest.mark.parametrize(("name", "which"), [("kalibr_camchain.yaml", "cam1"), ("colmap_cameras.txt", "3")])
def test_a_fish_eye_without_coefficients_is_equidistant(name: str, which: str, rng: np.random.Generator) -> None:
    """cv2.fisheye with zeros: theta_d = theta."""
    camera = vr.Camera.calibrated(FILES / name, 3.0, which)
    assert camera.projection == "equidistant"
    seen = points(rng)
    K_fish = np.array([[400.0, 0, 639.5], [0, 401.0, 479.5], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(seen[:, None], np.zeros(3), np.zeros(3), K_fish, np.zeros(4))
    assert np.abs(camera.image_of_points(seen) - (expected[:, 0] + 0.5)).max() < 1e-9


def test_a_recipe_has_the_calibrations_camera(tmp_path: Path) -> None:
    """Also focused at a distance, where the image distance, not the focal length, is the scale; and binned."""
    text = (FILES / "opencv.yml").read_text()
    (tmp_path / "mine.yml").write_text(text)
    keys = 'calibration = "mine.yml"\npixel_pitch_um = 3.0\nfocus_distance_m = 1.5\nf_number = 2.0'
    camera = load_plan(recipe_at(tmp_path, keys)).recipe.camera
    assert camera.matrix == pytest.approx(K + HALF, rel=1e-14)
    # 1000.875 px of 3 um are 3.002625 mm = f_i; 1/f = 1/f_i + 1/s.
    assert camera.focal_length_mm == pytest.approx(1 / (1 / 3.002625 + 1 / 1500), rel=1e-14)
    # Binning moves no point of the image: K shrinks alike.
    binned = load_plan(recipe_at(tmp_path, keys), scale=4).recipe.camera
    assert binned.matrix[:2] == pytest.approx((K + HALF)[:2] / 4, rel=1e-14)
    # Its content is the recipe's: the resolved recipe needs no file.
    assert "mine.yml" not in load_plan(recipe_at(tmp_path, keys)).recipe.model_dump_json()


def test_assignments_override_a_calibration_and_it_overrides_presets(tmp_path: Path) -> None:
    path = recipe_at(tmp_path, f'preset = "phone-wide"\ncalibration = "{FILES}/opencv.yml"')
    made = load_plan(path).recipe.camera
    assert made.matrix == pytest.approx(K + HALF, rel=1e-14)
    assert (made.f_number, made.psf, made.width_px) == (1.8, "diffraction", 1280)
    changed = load_plan(path, ["camera.distortion.k1=-0.03", "camera.pixel_pitch_um=2.4"]).recipe.camera
    assert changed.distortion is not None
    assert (changed.distortion.k1, changed.distortion.k2) == (-0.03, 0.004)
    assert changed.matrix == pytest.approx(K + HALF, rel=1e-14)
    other = load_plan(path, [f"camera.calibration={FILES}/colmap_cameras.txt", "camera.calibration_camera=3"])
    assert other.recipe.camera.projection == "equidistant"
    assert other.recipe.camera.distortion is None


def test_a_camera_of_a_rig_has_its_own(tmp_path: Path) -> None:
    rig = '[[rig]]\nname = "left"\noffset_m = [0.1, 0, 0]\n[rig.camera]\npixel_pitch_um = 3.0\n'
    rig += f'calibration = "{FILES}/kalibr_camchain.yaml"\ncalibration_camera = "cam1"\n'
    recipe = load_plan(recipe_at(tmp_path, "pixel_pitch_um = 1.2", rig)).recipe
    assert recipe.cameras[1].camera.projection == "equidistant"
    assert recipe.cameras[0].camera.projection == "perspective"


REFUSALS: dict[str, tuple[str, str]] = {
    "pitch": (f'calibration = "{FILES}/opencv.yml"', "is in pixels; give pixel_pitch_um"),
    "twice": (
        f'calibration = "{FILES}/opencv.yml"\npixel_pitch_um = 3.0\nfocal_length_mm = 4.0',
        "camera.focal_length_mm: the calibration '.*' states it; remove either",
    ),
    "missing": (
        'calibration = "no.yml"\npixel_pitch_um = 3.0',
        "calibration: .*no.yml: cannot be read: No such file",
    ),
    "which": (
        f'calibration = "{FILES}/kalibr_camchain.yaml"\npixel_pitch_um = 3.0',
        "has several cameras; calibration_camera may be cam0, cam1",
    ),
    "none": (
        f'calibration = "{FILES}/colmap_cameras.txt"\ncalibration_camera = "9"\npixel_pitch_um = 3.0',
        "has no camera '9'; calibration_camera may be 1, 2, 3, 4",
    ),
    "rational": (
        f'calibration = "{FILES}/colmap_cameras.txt"\ncalibration_camera = "4"\npixel_pitch_um = 3.0',
        "line 7: k4 = 0.3: of these coefficients a recipe's lens has k1, k2, k3, p1, p2 alone",
    ),
    "text": ("calibration = 3\npixel_pitch_um = 3.0", "has to be the path of a file"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_recipe_is_refused_with_the_key(tmp_path: Path, case: str) -> None:
    camera, message = REFUSALS[case]
    with pytest.raises(InputError, match=message) as refused:
        load_plan(recipe_at(tmp_path, camera))
    assert str(refused.value).startswith(f"{tmp_path}/recipe.toml: camera.")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_coefficients_of_opencv_are_held_or_named(tmp_path: Path, count: int) -> None:
    path = tmp_path / "camera.npz"
    numbers = [*FIVE, *[0.0] * 9][:count]
    np.savez(path, K=K, D=numbers, image_size=(1280, 960))
    assert read_calibration(path).distortion == dict(
        k1=-0.02, k2=0.004, p1=0.001, p2=-0.0015, k3=0.0 if count == 4 else 0.0005
    )
    if count > 5:
        np.savez(path, K=K, D=[*numbers[:-1], 0.3])
        with pytest.raises(InputError, match=f"{ {8: 'k6', 12: 's4', 14: 'tau_y'}[count] } = 0.3: of these"):
            read_calibration(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\n", "has no camera matrix"),
        ("K: [1, 2]\n", r"has to be \[\[fx, skew, cx\]"),
        ("K: [1, 0, 0, 0, 1, 0, 0, 0, x]\n", "K: has to be numbers"),
        ("K: [.inf, 0, 0, 0, 1, 0, 0, 0, 1]\n", "K: has to be numbers"),
        ("K: [1e999, 0, 0, 0, 1, 0, 0, 0, 1]\n", "finite numbers"),
        ("K: [1, 1, 0, 0]\nD: [1, 2, 3]\n", "D: 3 coefficients; allowed: 0, 4, 5, 8, 12, 14"),
        ("camera_model: omni\nK: [1, 1, 0, 0]\n", "camera_model 'omni': a recipe's lens cannot hold it"),
        ("distortion_model: fov\nK: [1, 1, 0, 0]\n", "distortion_model 'fov': a recipe's lens cannot hold it"),
        ("fisheye_model: 1\nK: [1, 1, 0, 0]\nD: [0, 0.1, 0, 0]\n", "k2 = 0.1: of these .* fish-eye lens has none"),
        ("width: 10.5\nheight: 3\nK: [1, 1, 0, 0]\n", "has to be width and height, whole pixels"),
        ("a: &x [1]\nK: [*x, *x]\n", "aliases"),
        ("K: [1, 2\n", "line 1: cannot be read as YAML: expected ',' or ']'"),
        ("- 1\n", "it has no keys"),
        ("", "it has no keys"),
        ("a: " + "[" * 3000, "more than 20 brackets in brackets"),
    ],
)
def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        read_calibration(path)
    assert str(refused.value).startswith(str(path))
    assert "\n" not in str(refused.value)


def test_a_calibration_without_a_size_needs_it_beside(tmp_path: Path) -> None:
    np.savez(tmp_path / "camera.npz", mtx=K)
    keys = 'calibration = "camera.npz"\npixel_pitch_um = 3.0'
    with pytest.raises(InputError, match="states no size; give width_px and height_px beside it"):
        load_plan(recipe_at(tmp_path, keys))
    camera = load_plan(recipe_at(tmp_path, f"{keys}\nwidth_px = 1280\nheight_px = 960")).recipe.camera
    assert (camera.width_px, camera.height_px, camera.center_px) == (1280, 960, (640.0, 470.625))


@pytest.mark.parametrize("name", [*sorted(path.name for path in FILES.iterdir()), "camera.npz"])
def test_a_damaged_file_is_read_or_refused(tmp_path: Path, name: str) -> None:
    """Seeded mutations: no other exception, and nothing that is not a finite calibration."""
    rng = np.random.default_rng(len(name))
    if name == "camera.npz":
        np.savez(tmp_path / name, mtx=K, dist=np.array([FIVE]))
        data = (tmp_path / name).read_bytes()
    else:
        data = (FILES / name).read_bytes()
    path, refused = tmp_path / name, 0
    for _ in range(60):
        path.write_bytes(mutated(data, rng))
        found = read_or_refused(path, lambda: read_calibration(path, NAMES.get(name)))
        refused += found is None
        if found is not None:
            assert np.isfinite([found.fx, found.fy, found.cx, found.cy, found.skew]).all()
            assert found.fx > 0
            assert found.fy > 0
    assert refused > 0
