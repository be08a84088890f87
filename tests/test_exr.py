"""EXR files of frames: regions at their place, every bit kept, and no partial file left behind."""

import hashlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.roi import Roi
from vlcrender.dataset.format.exr import exr_attributes, read_exr_parts, write_exr
from vlcrender.errors import InputError

SENSOR = Roi(0, 0, 300, 400)
REGIONS = (Roi(20, 30, 4, 7), Roi(-5, 390, 6, 15))
"""Rows, columns and their numbers all differ; the second extends beyond two edges of the sensor."""


def images(rng: np.random.Generator) -> list[tuple[Roi, np.ndarray]]:
    """Numbers of all 32 bits, as a lossy compression or a float would not keep."""
    return [(roi, rng.integers(0, 2**32, (roi.rows, roi.columns), dtype=np.uint32)) for roi in REGIONS]


def test_regions_come_back_at_their_place_bit_for_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    """As OpenEXR itself reads them: first and last pixel, (column, row) each; row 0 of the array is the top."""
    path, written = tmp_path / "000000.exr", images(rng)
    digest = write_exr(path, written, SENSOR, {"expTime": 0.25})
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest()
    assert list(tmp_path.iterdir()) == [path]
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert [part.name() for part in file.parts] == ["region 0", "region 1"]
        for part, (_, image) in zip(file.parts, written, strict=True):
            assert list(part.channels) == ["Y"]
            np.testing.assert_array_equal(part.channels["Y"].pixels, image)
            assert part.header["compression"] == OpenEXR.ZIP_COMPRESSION
            assert part.header["expTime"] == 0.25
        boxes = [np.array(part.header["dataWindow"]).tolist() for part in file.parts]
        assert boxes == [[[30, 20], [36, 23]], [[390, -5], [404, 0]]]
        assert [np.array(p.header["displayWindow"]).tolist() for p in file.parts] == [[[0, 0], [399, 299]]] * 2
    found = [(p.name, p.roi, p.sensor, p.dtype, p.image.shape) for p in read_exr_parts(path)]
    assert found == [(f"region {n}", r, SENSOR, np.uint32, (r.rows, r.columns)) for n, r in enumerate(REGIONS)]


def test_a_single_image_has_a_part_without_a_name(tmp_path: Path) -> None:
    """Programs that know EXR of one part read it; expected images are floats."""
    write_exr(tmp_path / "0.exr", [(SENSOR, np.zeros((300, 400), np.float32))], SENSOR, {})
    with OpenEXR.File(str(tmp_path / "0.exr")) as file:
        assert [part.header.get("name", "") for part in file.parts] == [""]
        assert file.header()["compression"] == OpenEXR.PIZ_COMPRESSION
        assert list(file.channels()) == ["Y"]
    (part,) = read_exr_parts(tmp_path / "0.exr")
    assert (part.name, part.roi, part.sensor, part.dtype) == ("", SENSOR, SENSOR, np.float32)


def test_a_full_disk_leaves_the_old_file_and_no_partial_one(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "000000.exr"
    path.write_bytes(b"old")

    class FullDisk:
        def __init__(self, parts: object) -> None: ...

        def write(self, name: str) -> None:
            Path(name).write_bytes(b"half")
            raise RuntimeError("Cannot write\n   image file. (No space left on device)")

    monkeypatch.setattr(OpenEXR, "File", FullDisk)
    with pytest.raises(InputError) as refusal:
        write_exr(path, images(rng), SENSOR, {})
    assert str(refusal.value) == f"{path}: cannot be written: Cannot write image file. (No space left on device)"
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_attributes_of_a_camera_by_hand() -> None:
    """400 x 300 pixels of 12 um: 4.8 x 3.6 mm. The two own attributes are text."""
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=12.0, f_number=2.8, focal_length_mm=6.0)
    found = exr_attributes(camera, "left", 1e-3, 7)
    np.testing.assert_allclose(found.pop("sensorOverallDimensions"), [4.8, 3.6], rtol=1e-6)
    assert found == {
        "expTime": 1e-3,
        "aperture": 2.8,
        "nominalFocalLength": 6.0,
        "sensorPhotositePitch": 12.0,
        "vlcrender:frame": "7",
        "vlcrender:camera": "left",
    }


def test_a_file_without_the_channel_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "0.exr"
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": np.zeros((2, 2), np.float32)}) as file:
        file.write(str(path))
    for damage in (path.read_bytes(), b"no EXR"):
        path.write_bytes(damage)
        with pytest.raises(InputError, match=r"0\.exr: cannot be read as an EXR with a channel Y"):
            read_exr_parts(path)


def test_expected_images_and_frames_keep_every_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    """float32 of all 24 bits over many magnitudes, and uint32 up to the largest."""
    sensor = Roi(0, 0, 60, 80)
    floats = (rng.standard_normal((60, 80)) * 10.0 ** rng.integers(-20, 20, (60, 80))).astype(np.float32)
    numbers = rng.integers(0, 2**32, (60, 80), dtype=np.uint32)
    for name, image in (("expected", floats), ("frame", numbers)):
        path = tmp_path / f"{name}.exr"
        assert write_exr(path, [(sensor, image)], sensor, {}) == hashlib.sha256(path.read_bytes()).hexdigest()
        with OpenEXR.File(str(path), separate_channels=True) as file:
            read = file.channels()["Y"].pixels
        assert read.dtype == image.dtype
        assert read.tobytes() == image.tobytes()
