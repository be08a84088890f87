"""EXR files of frames: pixels bit for bit, regions in their places, and one line for a file that cannot be used."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.dataset.exr import ExrPart, read_exr_parts, write_exr
from vlcrender.dataset.files import sha256_of
from vlcrender.errors import InputError

SENSOR = Roi(0, 0, 60, 80)


def test_expected_images_and_frames_keep_every_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    """float32 of all 24 bits over many magnitudes, and uint32 up to the largest."""
    floats = (rng.standard_normal((60, 80)) * 10.0 ** rng.integers(-20, 20, (60, 80))).astype(np.float32)
    numbers = rng.integers(0, 2**32, (60, 80), dtype=np.uint32)
    for name, image in (("expected", floats), ("frame", numbers)):
        path = tmp_path / f"{name}.exr"
        assert write_exr(path, [RegionImage(SENSOR, image)], SENSOR, {}) == sha256_of(path)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            read = file.channels()["Y"].pixels
        assert read.dtype == image.dtype
        assert read.tobytes() == image.tobytes()


def test_regions_are_parts_in_their_places(tmp_path: Path) -> None:
    """The pixels of each part, its region, beyond the sensor too, and the sensor."""
    regions = [Roi(-3, -2, 4, 5), Roi(10, 20, 2, 3), Roi(58, 70, 6, 20)]
    images = [
        RegionImage(roi, np.full((roi.rows, roi.columns), number, dtype=np.uint32))
        for number, roi in enumerate(regions)
    ]
    write_exr(tmp_path / "a.exr", images, SENSOR, {"expTime": 0.5})
    assert read_exr_parts(tmp_path / "a.exr") == [ExrPart(roi, SENSOR, np.dtype(np.uint32)) for roi in regions]
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert [part.header["name"] for part in file.parts] == ["region 0", "region 1", "region 2"]
        assert [np.unique(part.channels["Y"].pixels).tolist() for part in file.parts] == [[0], [1], [2]]
        assert {part.header["expTime"] for part in file.parts} == {0.5}


def test_a_file_that_is_no_exr_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "b.exr").write_bytes(b"years of work")
    with pytest.raises(InputError, match=r"b\.exr: cannot be read as an EXR with a channel Y"):
        read_exr_parts(tmp_path / "b.exr")
    with pytest.raises(InputError, match=r"c\.exr: cannot be written") as refusal:
        write_exr(tmp_path / "no/c.exr", [RegionImage(SENSOR, np.zeros((60, 80), dtype=np.uint32))], SENSOR, {})
    assert "\n" not in str(refusal.value)
