"""Files of photographs: pictures, calibrations, LED maps; what they say, and what is refused."""

import json
import re
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from estimator.errors import InputError
from estimator.io.shutter import GLOBAL
from estimator.photo.calibration import Calibration, calibration_of_film, read_calibration, simple_calibration
from estimator.photo.led_table import read_led_table, read_spots
from estimator.photo.pictures import read_picture
from estimator.photo.yaml_subset import YamlError, parse_yaml

K = [[1000.0, 0.0, 639.5], [0.0, 1001.0, 479.5], [0.0, 0.0, 1.0]]
ROS = """image_width: 1280
image_height: 960
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [1000, 0, 639.5, 0, 1001, 479.5, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{coefficients}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [{coefficients}]
  distortion_model: {model}
  intrinsics: [1000.0, 1001.0, 639.5, 479.5]
  resolution: [1280, 960]
  rostopic: /cam0/image_raw
"""


def ros(tmp_path: Path, coefficients: str, model: str = "plumb_bob") -> Path:
    path = tmp_path / "camera.yaml"
    path.write_text(ROS.format(model=model, count=coefficients.count(",") + 1, coefficients=coefficients))
    return path


def kalibr(tmp_path: Path, coefficients: str, model: str) -> Path:
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR.format(model=model, coefficients=coefficients))
    return path


def opencv(tmp_path: Path, coefficients: list[float]) -> Path:
    path = tmp_path / "opencv.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Thu 26 Nov 2026")
    storage.write("image_width", 1280)
    storage.write("image_height", 960)
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([coefficients]))
    storage.release()
    return path


def npz(tmp_path: Path, coefficients: list[float]) -> Path:
    path = tmp_path / "camera.npz"
    np.savez(path, mtx=np.array(K), dist=np.array([coefficients]))
    return path


FIVE = "0.1, -0.2, 0.001, -0.002, 0.05"


@pytest.mark.parametrize("kind", ["ros", "kalibr", "opencv", "npz"])
def test_calibrations_of_four_programs_say_the_same(tmp_path: Path, kind: str) -> None:
    """OpenCV's pixel (0, 0) has its centre at 0, the format's at 0.5. Kalibr has no k3."""
    numbers = [float(part) for part in FIVE.split(",")]
    paths = {
        "ros": lambda: ros(tmp_path, FIVE),
        "kalibr": lambda: kalibr(tmp_path, FIVE.rpartition(",")[0], "radtan"),
        "opencv": lambda: opencv(tmp_path, numbers),
        "npz": lambda: npz(tmp_path, numbers),
    }
    found = read_calibration(paths[kind]())
    assert pytest.approx(np.array(K) + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]) == found.K
    assert found.size_px == (None if kind == "npz" else (1280, 960))
    assert found.distortion is not None
    assert found.distortion.model_dump() == {
        "k1": 0.1,
        "k2": -0.2,
        "p1": 0.001,
        "p2": -0.002,
        "k3": 0.0 if kind == "kalibr" else 0.05,
    }
    camera = found.for_size(1280, 960).camera(GLOBAL, None, None)
    assert camera.matrix() == pytest.approx(found.K)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_coefficients_beyond_the_fifth_are_held_if_they_are_zero_and_named_if_not(tmp_path: Path, count: int) -> None:
    numbers = [0.1, -0.2, 0.001, -0.002] + [0.0] * (count - 4)
    found = read_calibration(npz(tmp_path, numbers))
    assert found.distortion is not None
    assert found.distortion.k1 == 0.1
    if count > 5:
        name = {8: "k6", 12: "s4", 14: "tau_y"}[count]
        with pytest.raises(InputError, match=f"{name} = 0.3: the format's lens"):
            read_calibration(npz(tmp_path, [*numbers[:-1], 0.3]))


@pytest.mark.parametrize("count", [1, 3, 6, 15])
def test_another_number_of_coefficients_is_refused(tmp_path: Path, count: int) -> None:
    with pytest.raises(InputError, match="allowed: 4, 5, 8, 12, 14"):
        read_calibration(npz(tmp_path, [0.1] * count))


def test_a_fish_eye_is_equidistant_or_refused(tmp_path: Path) -> None:
    assert read_calibration(kalibr(tmp_path, "0, 0, 0, 0", "equidistant")).projection == "equidistant"
    with pytest.raises(InputError, match=r"k2 = 0.01: .*all of k1 to k4 have to be 0"):
        read_calibration(kalibr(tmp_path, "0, 0.01, 0, 0", "equidistant"))
    with pytest.raises(InputError, match="distortion_model 'fov' is unknown"):
        read_calibration(kalibr(tmp_path, "0.9", "fov"))


def test_a_picture_of_another_size_rescales_k_and_says_so(tmp_path: Path) -> None:
    found = read_calibration(ros(tmp_path, FIVE)).for_size(2560, 1920)
    # The middle of the picture, 640 px from the border, is at 1280 px in one of twice the size.
    assert pytest.approx(np.array([[2000, 0, 1280], [0, 2002, 960], [0, 0, 1]])) == found.K
    assert "rescaled by 2" in found.remarks[0]


@pytest.mark.parametrize(
    ("size", "message"), [((960, 1280), "turned by 90 degrees"), ((1280, 720), "of another shape")]
)
def test_a_picture_of_another_shape_is_refused(tmp_path: Path, size: tuple[int, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_calibration(ros(tmp_path, FIVE)).for_size(*size)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\n", "no camera matrix"),
        ("K: [1, 2]\n", "needed [[fx, skew, cx]"),
        ("K: [1, 0, 0, 0, 1, 0, 0, 0, x]\n", "K: needed numbers"),
        ("camera_model: omni\nK: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n", "camera_model 'omni' cannot be held"),
        ("- 1\n", "no keys"),
        ("K: [1, 2\n", "a bracket is not closed"),
        ("just words\n", "line 1: needed KEY: VALUE"),
    ],
)
def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)):
        read_calibration(path)


def test_a_focal_length_of_film_is_by_the_diagonal() -> None:
    """A picture of film's own shape: 36 mm are its width."""
    found = calibration_of_film(36.0, (3600, 2400))
    assert found.K[0, 0] == pytest.approx(3600)
    camera = found.camera(GLOBAL, 2.0, None)
    assert camera.uncertainty is not None
    assert camera.uncertainty.device_sigma == (0.03,)
    # 3600 px are the 18 mm that the lens is said to have: 5 um each.
    known = found.camera(GLOBAL, 2.0, 18.0)
    assert known.pixel_pitch_um == pytest.approx(5.0)
    assert known.image_distance_mm == pytest.approx(18.0)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a: 1\nb: 2.5\nc: x y\nd:\n", {"a": 1, "b": 2.5, "c": "x y", "d": None}),
        ("a: [1, [2, 3],\n  4]  # more\n", {"a": [1, [2, 3], 4]}),
        ("a:\n- 1\n- b: 2\n  c: 3\nd: {e: 1, f: [x]}\n", {"a": [1, {"b": 2, "c": 3}], "d": {"e": 1, "f": ["x"]}}),
        ("a:\n  - - 1\n    - 2\n  - [3]\n", {"a": [[1, 2], [3]]}),
        (
            "%YAML:1.0\n---\na: !!opencv-matrix\n   rows: 1\n   data: [ 1., -2e-3 ]\n",
            {"a": {"rows": 1, "data": [1.0, -2e-3]}},
        ),
        ("a: '# no'\nb: true\n", {"a": "# no", "b": True}),
        ("", None),
    ],
)
def test_the_subset_of_yaml(text: str, value: object) -> None:
    assert parse_yaml(text) == value


@pytest.mark.parametrize("text", ["a: &x 1\n", "a: |\n  text\n", "a: 1\n   b: 2\n", "a: [1 2] 3\n", "\ta: 1\n"])
def test_other_yaml_is_refused(text: str) -> None:
    with pytest.raises(YamlError):
        parse_yaml(text)


def test_a_map_may_have_any_unit_and_names(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    path.write_text("Name;X (cm);Y_cm;height;Hz;radius\nlobby;-35.5;36;246;2000;5\nhall;1;2;246;;5\n")
    table = read_led_table(path)
    assert table.unit == "cm"
    with pytest.raises(InputError, match="the columns are in cm, but --units says m"):
        read_led_table(path, "m")
    assert [(entry.label, entry.position, entry.frequency_hz) for entry in table.entries] == [
        ("lobby", (-35.5, 36.0, 246.0), 2000.0),
        ("hall", (1.0, 2.0, 246.0), None),
    ]
    led = table.leds("x")[0]
    assert led.position_m == pytest.approx((0.355, 0.36, 2.46))
    assert led.half_width_m == pytest.approx(0.05)
    assert table.leds("y")[0].position_m == pytest.approx((-0.355, -0.36, 2.46))


def test_a_map_in_json_says_its_unit(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    leds = [{"id": 7, "position": [1, 2, 3], "shape": "square", "side": 4}, {"x": 0, "y": 0, "z": 3, "frequency": 2e3}]
    path.write_text(json.dumps({"units": "in", "leds": leds}))
    table = read_led_table(path)
    assert table.unit == "in"
    assert [table.label(k) for k in (0, 1)] == ["7", "2000"]
    made = table.leds("none")
    assert made[0].half_width_m == pytest.approx(2 * 0.0254)
    assert not made[1].has_size


def test_a_map_in_json_may_have_its_leds_by_name(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    path.write_text(json.dumps({"a": {"position_cm": [1, 2, 3], "frequency_hz": 2000}, "b": {"x": 1, "y": 1, "z": 3}}))
    table = read_led_table(path)
    assert [(entry.label, entry.position) for entry in table.entries] == [("a", (1, 2, 3)), ("b", (1, 1, 3))]
    assert table.unit == "cm"
    path.write_text(json.dumps({"units": "mm", "a": [1, 2, 3]}))
    assert read_led_table(path).leds("none")[0].position_m == pytest.approx((1e-3, 2e-3, 3e-3))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1,2\n", "LED 0: no z"),
        ("x_cm,y_m,z_m\n1,2,3\n", "columns in cm and m; needed one unit"),
        ("x,y,z\n1,2,high\n", "z 'high' is not a number"),
        ("x,y,z,f,hz\n1,2,3,4,5\n", "f and hz are the same"),
        ("id,x,y,z\na,1,2,3\na,1,2,4\n", "id a is there twice"),
        ("x,y,z,shape\n1,2,3,star\n", "shape 'star'; allowed: disc, square"),
        ("x,y,z,radius\n1,2,3,0\n", "radius 0 has to be more than 0"),
        ("x,y,z\n", "no LED"),
        ("x,y,z\n1e9,0,0\n", "beyond 1e+06 m"),
    ],
)
def test_a_wrong_map_names_the_row_and_what_is_needed(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "map.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)):
        read_led_table(path)


def test_spots_by_hand_name_leds_of_the_map(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("id,x,y,z\na,1,2,3\nb,1,3,3\n")
    table = read_led_table(tmp_path / "map.csv")
    path = tmp_path / "spots.csv"
    path.write_text("led,u,v\nb,10.5,20\na,1,2\n")
    assert read_spots(path, table) == [(1, 10.5, 20.0), (0, 1.0, 2.0)]
    path.write_text("led,u,v\nc,10.5,20\n")
    with pytest.raises(InputError, match="LED 'c' is not in the map; allowed: a, b"):
        read_spots(path, table)
    path.write_text("led,u,v\na,1,1\na,2,2\n")
    with pytest.raises(InputError, match="an LED is there twice"):
        read_spots(path, table)


@pytest.mark.parametrize(("suffix", "bits"), [(".png", 8), (".png", 16), (".tif", 8), (".tif", 16), (".jpg", 8)])
@pytest.mark.parametrize("tone", ["srgb", "linear", "gamma"])
def test_pictures_are_linear_light(tmp_path: Path, suffix: str, bits: int, tone: str) -> None:
    """A JPEG's block of one grey is off by a code of 256; 16 bits by one of 65536."""
    path, largest = tmp_path / f"grey{suffix}", 2**bits - 1
    codes = np.full((64, 48), round(0.5 * largest), dtype=np.uint8 if bits == 8 else np.uint16)
    codes[:8, :8] = largest
    cv2.imwrite(str(path), codes)
    picture = read_picture(path, tone)  # type: ignore[arg-type]
    # sRGB, IEC 61966-2-1.
    expected = {"srgb": ((0.5 + 0.055) / 1.055) ** 2.4, "linear": 0.5, "gamma": 0.5**2.2}[tone]
    assert picture.linear[40, 30] == pytest.approx(expected, abs=2.5 / 255)
    assert (picture.width_px, picture.height_px, picture.bits) == (48, 64, bits)
    assert picture.clipped[:6, :6].all()
    assert not picture.clipped[20:].any()


def test_a_picture_s_codes_are_those_of_srgb(tmp_path: Path) -> None:
    """From the codes of a file to light and back, over both branches of the curve: float32, 1e-6 of 255, ten times."""
    codes = np.tile(np.arange(256, dtype=np.uint8), (8, 1))
    cv2.imwrite(str(tmp_path / "steps.png"), codes)
    np.testing.assert_allclose(read_picture(tmp_path / "steps.png", "srgb").coded, codes, atol=2.5e-3)


def test_a_saturated_colour_counts_as_saturated_and_grey_is_luminance(tmp_path: Path) -> None:
    codes = np.zeros((8, 8, 4), np.uint8)
    codes[..., 2], codes[..., 3] = 255, 7
    cv2.imwrite(str(tmp_path / "red.png"), codes)
    picture = read_picture(tmp_path / "red.png")
    assert picture.clipped.all()
    assert picture.linear == pytest.approx(0.2126)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_is_read_and_turns_the_picture_if_asked(tmp_path: Path, orientation: int) -> None:
    """Pillow's own transposition is the reference."""
    path = tmp_path / "turned.png"
    stored = np.arange(24, dtype=np.uint8).reshape(4, 6) * 10
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.Model] = "Lumia 1020"
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.ExposureTime] = 1 / 8000
    details[ExifTags.Base.FocalLengthIn35mmFilm] = 27
    Image.fromarray(stored).save(path, exif=exif)
    as_stored = read_picture(path, "linear")
    assert as_stored.linear * 255 == pytest.approx(stored)
    assert as_stored.exif.exposure_s == pytest.approx(1 / 8000)
    assert as_stored.exif.focal_length_35mm == 27
    assert as_stored.exif.camera == "Lumia 1020"
    from PIL import ImageOps

    with Image.open(path) as image:
        upright = np.asarray(ImageOps.exif_transpose(image))
    assert read_picture(path, "linear", "upright").linear * 255 == pytest.approx(upright)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("none.jpg", None, "No such file"),
        ("text.jpg", b"hello", "not a readable picture"),
        ("empty.png", b"", "not a readable picture"),
    ],
)
def test_a_file_that_is_no_picture_is_refused(tmp_path: Path, name: str, data: bytes | None, message: str) -> None:
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message):
        read_picture(tmp_path / name)


def test_a_raw_file_without_rawpy_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)
    (tmp_path / "raw.dng").write_bytes(b"II*\0")
    with pytest.raises(InputError, match=r"need the package rawpy \(pip install vlcrender\[photo\]\)"):
        read_picture(tmp_path / "raw.dng")


def test_a_raw_file_is_developed_without_a_curve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for rawpy, which the tests do not install: it checks what it is asked for."""

    class Raw:
        def __enter__(self) -> "Raw":
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def postprocess(self, **asked: object) -> np.ndarray:
            assert asked == {"gamma": (1, 1), "no_auto_bright": True, "output_bps": 16, "user_flip": 0}
            return np.full((4, 6, 3), 32768, np.uint16)

    stand_in = ModuleType("rawpy")
    stand_in.imread = lambda path: Raw()  # type: ignore[attr-defined]
    stand_in.LibRawError = RuntimeError  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rawpy", stand_in)
    (tmp_path / "raw.dng").write_bytes(b"II*\0")
    assert read_picture(tmp_path / "raw.dng").linear == pytest.approx(0.5, abs=1e-4)


def test_a_calibration_without_a_size_is_taken_as_of_the_picture(tmp_path: Path) -> None:
    found = read_calibration(npz(tmp_path, [0.0] * 5))
    assert isinstance(found, Calibration)
    assert found.distortion is None
    sized = found.for_size(1280, 960)
    assert sized.size_px == (1280, 960)
    assert "states no size" in sized.remarks[0]


def test_a_focal_length_alone_is_a_pinhole_about_the_middle_of_the_picture() -> None:
    K = simple_calibration(1500.0, (800, 600), "by hand").K
    assert K.tolist() == [[1500.0, 0.0, 400.0], [0.0, 1500.0, 300.0], [0.0, 0.0, 1.0]]
