"""Direct light of many LEDs against the sum written out in NumPy; points that no LED can light are dark."""

import numpy as np
import pytest
from conftest import ROOT

from vlcrender.config.toml_model import check, read_toml
from vlcrender.light import direct_light
from vlcrender.light.direct_light import led_illuminance_lux
from vlcrender.light.lightmap import room_mesh
from vlcrender.light.mitsuba_room import mitsuba_scene
from vlcrender.scene.loader import build_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.scene.sources import point_sources

SIZE_M = np.array([7.0, 7.0, 3.5])
POINTS = 400


@pytest.mark.parametrize("pairs", [direct_light.MAX_PAIRS, 1000])
def test_the_sum_over_all_leds_in_an_empty_room(monkeypatch: pytest.MonkeyPatch, pairs: int) -> None:
    """Points inside the room, in all attitudes, many above LEDs. `pairs`: in one launch, or in many."""
    monkeypatch.setattr(direct_light, "MAX_PAIRS", pairs)
    rng = np.random.default_rng(4)
    leds = [
        {
            "id": number,
            "position_m": rng.uniform([0.5, 0.5, 1.0], [6.5, 6.5, 3.4]).tolist(),
            "radius_m": 1e-3,
            "luminance_cd_m2": float(rng.uniform(1e6, 1e7)),
            "half_power_deg": float(rng.uniform(10, 80)),
        }
        for number in range(60)
    ]
    scene = build_scene(check({**read_toml(ROOT / "scenes/table1.toml"), "led": leds}, SceneSettings, "box"), "box")
    mesh, sources = room_mesh(scene), point_sources(scene.leds)
    points = rng.uniform(0.1, SIZE_M - 0.1, (POINTS, 3))
    normals = rng.normal(size=(POINTS, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:50] = [0.0, 0.0, -1.0]
    shares = []
    blockers = mitsuba_scene(mesh, np.zeros(len(mesh.vertices_m)), (), daylight=False)
    lux = led_illuminance_lux(blockers, points, normals, sources, report=shares.append)

    expected = np.zeros(POINTS)
    for center, intensity, order in zip(sources.centers_m, sources.intensities_cd, sources.orders, strict=True):
        way = center - points
        distance = np.linalg.norm(way, axis=1)
        from_source, on_surface = way[:, 2] / distance, (way * normals).sum(axis=1) / distance
        seen = (from_source > 0) & (on_surface > 0)
        expected += np.where(seen, intensity * np.abs(from_source) ** order * on_surface / distance**2, 0.0)
    # 60 sums of double precision, each with some ten roundings and a power of an order up to 45: 1e3 * 2^-53
    assert lux == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert (lux[:50] == 0).all()
    assert 50 < np.count_nonzero(lux == 0) < POINTS / 2
    assert shares[-1] == 1.0
    assert len(shares) == 1 if pairs > 60 * POINTS else len(shares) > 10
