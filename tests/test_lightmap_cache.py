"""Bakes on disk: kept, written whole or not at all, and told apart by every setting that changes their light."""

import dataclasses
import errno
import pwd
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from platformdirs import user_cache_dir
from test_lightmap import MIRROR, lamp, scene_of

from vlcrender.core.warn_once import warn_once
from vlcrender.light import bake_cache, lightmap
from vlcrender.light.bake_cache import BakedIlluminance
from vlcrender.light.lightmap import bake
from vlcrender.scene.loader import Scene
from vlcrender.scene.sources import point_sources


def test_a_bake_is_kept_and_loaded_again(tmp_path: Path) -> None:
    scene = scene_of(led=[lamp()], bake={"texel_m": 1.0, "paths": 64})
    stages: list[str] = []
    first = bake(scene, tmp_path, lambda stage, share: stages.append(stage))
    assert "reflected light of LEDs" in stages
    stages.clear()
    again = bake(scene, tmp_path, lambda stage, share: stages.append(stage))
    assert not stages
    assert again.led_lux.tobytes() == first.led_lux.tobytes()
    # a file cut short by a crash: baked again, the same
    (kept,) = tmp_path.glob("*.npz")
    kept.write_bytes(kept.read_bytes()[:100])
    assert bake(scene, tmp_path).led_lux.tobytes() == first.led_lux.tobytes()
    # another scene has a bake of its own
    bake(scene_of(led=[lamp(luminance_cd_m2=5000.0)], bake={"texel_m": 1.0, "paths": 64}), tmp_path)
    assert len(list(tmp_path.glob("*.npz"))) == 2


@pytest.fixture
def no_bakes_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bake_cache, "_in_memory", {})
    warn_once.cache_clear()


def without_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user without $HOME and without an entry in the password database, as in some containers."""

    def no_entry(uid: int) -> None:
        raise KeyError(uid)

    for name in ("VLCRENDER_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", no_entry)


@pytest.mark.slow
@pytest.mark.usefixtures("no_bakes_in_memory")
@pytest.mark.parametrize("case", ["a file in the folder's place", "no home"])
def test_a_bake_that_cannot_be_written_is_kept_in_memory_with_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, case: str
) -> None:
    scene = scene_of(led=[lamp()], bake={"texel_m": 1.0, "paths": 8})
    written = bake(scene, tmp_path / "writable")
    assert not caplog.records
    if case == "no home":
        without_home(monkeypatch)
        assert bake_cache.cache_folder() is None
    else:
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("VLCRENDER_CACHE", str(tmp_path / "file"))
    stages: list[str] = []
    first = bake(scene, progress=lambda stage, share: stages.append(stage))
    assert stages
    assert first.led_lux.tobytes() == written.led_lux.tobytes()
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert "cannot keep bakes" in record.getMessage()
    assert "\n" not in record.getMessage()
    stages.clear()
    assert bake(scene, progress=lambda stage, share: stages.append(stage)).led_lux.tobytes() == first.led_lux.tobytes()
    assert not stages
    assert len(caplog.records) == 1


@pytest.mark.usefixtures("no_bakes_in_memory")
def test_a_full_disk_leaves_no_part_of_a_bake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*arguments: object, **arrays: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    bake(scene_of(led=[lamp()], bake={"texel_m": 1.0, "paths": 8}), tmp_path)
    assert not list(tmp_path.iterdir())
    assert "No space left on device" in caplog.text


@pytest.mark.usefixtures("no_bakes_in_memory")
@pytest.mark.parametrize(
    "error", [OSError(errno.EROFS, "Read-only file system"), MemoryError("no memory"), ValueError("x")]
)
def test_a_bake_that_is_done_is_never_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, error: Exception
) -> None:
    def fail(self: Path, *arguments: object, **options: object) -> None:
        raise error

    baked = BakedIlluminance(*np.ones((3, 5)))
    monkeypatch.setattr(Path, "open", fail)
    bake_cache.store("key", baked, tmp_path)
    assert bake_cache.load("key", 5, tmp_path) is baked
    (record,) = caplog.records
    assert f"{tmp_path}: cannot keep bakes" in record.getMessage()


@pytest.mark.usefixtures("no_bakes_in_memory")
@pytest.mark.parametrize("values", [np.full(5, np.nan), np.full(5, -1.0), np.ones(4), np.ones(5, dtype=np.float32)])
def test_a_damaged_bake_is_baked_again_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, values: np.ndarray
) -> None:
    """Numbers that no bake has, with a right checksum; then no file of NumPy's; then a folder in the file's place."""
    np.savez_compressed(tmp_path / "key.npz", led_lux=np.ones(5), daylight_lux=np.ones(5), sigma_lux=values)
    assert bake_cache.load("key", 5, tmp_path) is None
    (tmp_path / "key.npz").write_bytes(b"PK\x03\x04" + bytes(50))
    assert bake_cache.load("key", 5, tmp_path) is None
    (record,) = caplog.records
    assert "key.npz: cannot be read (damaged by a crash or a disk); the light is baked again" in record.getMessage()
    (tmp_path / "other.npz").mkdir()
    assert bake_cache.load("other", 5, tmp_path) is None
    assert bake_cache.load("missing", 5, tmp_path) is None
    assert len(caplog.records) == 2
    baked = BakedIlluminance(*np.ones((3, 5)))
    bake_cache.store("key", baked, tmp_path)
    assert bake_cache.load("key", 5, tmp_path) is not None


@pytest.mark.skipif(sys.platform != "linux", reason="XDG folders")
@pytest.mark.parametrize("value", ["", " ", "cache", "./cache", "../cache"])
def test_no_bake_is_written_below_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    """A relative XDG_CACHE_HOME is invalid, by the XDG base directory specification."""
    monkeypatch.delenv("VLCRENDER_CACHE")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", value)
    assert bake_cache.cache_folder() == tmp_path / ".cache/vlcrender"
    monkeypatch.setenv("HOME", "home")
    folder = bake_cache.cache_folder()
    assert folder is None or folder.is_absolute()


def test_the_cache_folder_is_the_chosen_one_else_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("VLCRENDER_CACHE", str(tmp_path / "own"))
    assert bake_cache.cache_folder() == tmp_path / "own"
    monkeypatch.delenv("VLCRENDER_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert bake_cache.cache_folder() == Path(user_cache_dir("vlcrender", appauthor=False))
    if sys.platform == "linux":
        assert bake_cache.cache_folder() == tmp_path / "vlcrender"


@pytest.mark.usefixtures("no_bakes_in_memory")
def test_a_bake_with_any_wrong_byte_is_no_bake(tmp_path: Path) -> None:
    """A disk or a power cut may leave anything: with a byte inverted, the file is the bake, to the bit, or none."""
    baked = BakedIlluminance(*np.linspace(0.1, 1e4, 30).reshape(3, 10) ** 2)
    bake_cache.store("key", baked, tmp_path)
    file = tmp_path / "key.npz"
    content = file.read_bytes()
    refused = 0
    for place in range(0, len(content), 3):
        file.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        loaded = bake_cache.load("key", 10, tmp_path)
        refused += loaded is None
        assert loaded is None or all(
            np.array_equal(getattr(loaded, field.name), getattr(baked, field.name))
            for field in dataclasses.fields(BakedIlluminance)
        )
    # at least the numbers, of 8 bytes each, which hardly compress
    assert refused > 0.5 * 3 * 10 * 8 / 3


@pytest.mark.usefixtures("no_bakes_in_memory")
def test_an_interrupted_write_leaves_the_earlier_bake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bake is written beside its place and renamed: a reader in another process finds a whole bake at any time."""
    earlier, later = (BakedIlluminance(*np.full((3, 5), lux)) for lux in (1.0, 2.0))
    bake_cache.store("key", earlier, tmp_path)

    def killed(out: IO[bytes], **arrays: np.ndarray) -> None:
        out.write(b"PK")
        out.flush()
        found = bake_cache.load("key", 5, tmp_path)
        assert found is not None
        assert found.led_lux.tolist() == [1.0] * 5
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", killed)
        with pytest.raises(KeyboardInterrupt):
            bake_cache.store("key", later, tmp_path)
    for expected in (earlier, later):
        found = bake_cache.load("key", 5, tmp_path)
        assert found is not None
        assert found.led_lux.tolist() == expected.led_lux.tolist()
        bake_cache.store("key", later, tmp_path)


@pytest.fixture
def key_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[Scene], str]:
    """The name of a scene's bake in the cache, without baking."""
    keys: list[str] = []

    def load(key: str, count: int, folder: Path | None) -> BakedIlluminance:
        keys.append(key)
        return BakedIlluminance(*np.zeros((3, count)))

    monkeypatch.setattr(lightmap, "load", load)

    def key(scene: Scene) -> str:
        bake(scene)
        return keys[-1]

    return key


DIFFUSE_PANEL = {
    "columns": 1,
    "rows": 1,
    "first_center_m": [3.0, 3.0, 3.3],
    "pitch_m": [1.0, 1.0],
    "size_m": [0.6, 0.6, 0.1],
    "reflectance": 0.7,
    "diffuser": {"distance_m": 0.05, "transmittance": 0.5},
    "leds": {
        **{"columns": 2, "rows": 2, "pitch_m": [0.2, 0.2], "radius_m": 0.01, "first_id": 10},
        **{"luminance_cd_m2": [5000.0, 6000.0], "luminance_seed": 0, "half_power_deg": 60.0},
    },
}
LIT_ROOM: dict[str, Any] = {
    "led": [lamp()],
    "panels": [DIFFUSE_PANEL],
    "glazing": [{**MIRROR, "refractive_index": 1.52}],
    "furniture": [{"file": "board.obj", "position_m": [1.0, 1.0, 1.0], "yaw_deg": 0.0, "reflectance": 0.3}],
    "room": {"size_m": [7.0, 7.0, 3.5], "reflectance": {"floor": 0.2, "ceiling": 0.8, "walls": 0.5}},
    "ambient": {"illuminance_lux": 400.0, "spectrum": "LED-B3"},
    "bake": {"texel_m": 1.0, "paths": 64},
}


def changed(tree: Any, path: str, value: object) -> Any:
    """A copy of a tree with the value at a dotted path replaced."""
    first, _, rest = path.partition(".")
    key: Any = int(first) if first.isdecimal() else first
    new = changed(tree[key], rest, value) if rest else value
    return [new if i == key else item for i, item in enumerate(tree)] if isinstance(tree, list) else {**tree, key: new}


def lit_room(folder: Path, path: str = "led.0.id", value: object = 1) -> Scene:
    (folder / "board.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return scene_of(folder, **changed(LIT_ROOM, path, value))


CHANGES: dict[str, object] = {
    "led.0.position_m": [3.5, 3.4, 3.5],
    "led.0.radius_m": 0.011,
    "led.0.luminance_cd_m2": 9999.0,
    "led.0.half_power_deg": 59.0,
    "panels.0.leds.half_power_deg": 59.0,
    "panels.0.leds.luminance_seed": 1,
    "panels.0.diffuser.distance_m": 0.06,
    "panels.0.diffuser.transmittance": 0.6,
    "panels.0.reflectance": 0.6,
    "panels.0.first_center_m": [3.0, 3.1, 3.3],
    "glazing.0.wall": "x=max",
    "glazing.0.corner_m": [3.1, 0.5],
    "glazing.0.size_m": [1.1, 2.5],
    "glazing.0.luminance_cd_m2": 1.0,
    "glazing.0.refractive_index": 1.53,
    "furniture.0.position_m": [1.0, 1.0, 1.1],
    "furniture.0.yaw_deg": 1.0,
    "furniture.0.reflectance": 0.4,
    "room.size_m": [7.0, 7.0, 3.6],
    "room.reflectance.floor": 0.3,
    "room.reflectance.ceiling": 0.7,
    "room.reflectance.walls": 0.4,
    "bake.texel_m": 0.9,
    "bake.paths": 72,
}
"""Settings that change the light of LIT_ROOM that is baked."""


def test_a_bake_is_another_one_with_every_setting_that_changes_its_light(
    tmp_path: Path, key_of: Callable[[Scene], str]
) -> None:
    key = key_of(lit_room(tmp_path))
    assert [path for path, value in CHANGES.items() if key_of(lit_room(tmp_path, path, value)) == key] == []
    others = {"led.0.id": 2, "ambient.illuminance_lux": 300.0, "ambient.spectrum": "LED-B1"}
    assert [path for path, value in others.items() if key_of(lit_room(tmp_path, path, value)) != key] == []


def test_a_bake_is_another_one_with_another_mitsuba_or_cache_version(
    tmp_path: Path, key_of: Callable[[Scene], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = lit_room(tmp_path)
    keys = {key_of(scene)}
    monkeypatch.setattr(lightmap, "CACHE_VERSION", lightmap.CACHE_VERSION + 1)
    keys.add(key_of(scene))
    monkeypatch.setattr(lightmap.mi, "__version__", "0.0")
    keys.add(key_of(scene))
    assert len(keys) == 3


def test_bare_leds_and_leds_behind_a_diffuser_keep_their_own_intensities(tmp_path: Path) -> None:
    """I = L A of the bare LED whose id comes after the panel's, and the transmitted light of each of the panel's.

    Half the intensity at 45 deg is the order ln 2 / ln sqrt(2) = 2; a diffuser is Lambertian, of order 1.
    """
    scene = lit_room(tmp_path, "led.0", lamp(id=99, half_power_deg=45.0))
    sources = point_sources(scene.leds)
    assert scene.leds.ids.tolist() == [10, 11, 12, 13, 99]
    assert sources.centers_m[0].tolist() == [3.5, 3.5, 3.5]
    assert sources.intensities_cd[0] == pytest.approx(10000 * np.pi * 0.01**2, rel=1e-12)
    assert sources.orders == pytest.approx([2.0] + 16 * [1.0], rel=1e-12)
    behind = sources.intensities_cd[1:].reshape(4, 4).sum(axis=1) / scene.leds.luminances_cd_m2[:4]
    assert behind == pytest.approx(np.full(4, behind[0]), rel=1e-9)  # the panel is symmetric
