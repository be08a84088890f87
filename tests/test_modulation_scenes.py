"""What the LEDs of a scene transmit: clocks, panels, what is refused, the entry in dataset.json, flicker."""

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import vlcrender as vr
from vlcrender.config.toml_model import check, read_toml
from vlcrender.core.warn_once import warn_once
from vlcrender.dataset.format.downlink_entry import CodeEntry, PacketEntry, ToneEntry, downlink_entry
from vlcrender.dataset.run.generate import _warn_of_flicker
from vlcrender.modulation import packet
from vlcrender.modulation.codes import code_book
from vlcrender.modulation.flicker import (
    flicker_of,
    flicker_warning,
)
from vlcrender.modulation.keys import KEYS_OF, Downlink
from vlcrender.modulation.transmission import led_waves, nominal_waves
from vlcrender.report.show_command import print_flicker
from vlcrender.scene.loader import build_scene
from vlcrender.scene.schema import SceneSettings

# scenes


def office(**downlink: Any) -> vr.Scene:
    """The office whose panels have this downlink."""
    tree = read_toml(ROOT / "scenes/office.toml")
    return scene_of({**tree, "panels": [{**tree["panels"][0], "downlink": downlink}]})


def table1_of(*downlinks: dict[str, Any] | None) -> vr.Scene:
    """The four LEDs of Table 1 with these downlinks; None for steady light."""
    tree = read_toml(ROOT / "scenes/table1.toml")
    leds = [
        {**led, **({} if own is None else {"downlink": own})} for led, own in zip(tree["led"], downlinks, strict=True)
    ]
    return scene_of({**tree, "led": leds})


def scene_of(tree: dict[str, Any]) -> vr.Scene:
    return build_scene(check(tree, SceneSettings, "scene"), "scene", ROOT / "scenes")


@pytest.mark.parametrize("send", KEYS_OF)
def test_every_led_keeps_its_mean_luminance(send: str) -> None:
    scene, steady = office(send=send), vr.load_scene("office")
    assert scene.leds.luminances_cd_m2.tolist() == steady.leds.luminances_cd_m2.tolist()
    waves = led_waves(scene.leds.transmitters, seed=5)
    assert sorted(waves) == ([] if send == "steady" else scene.leds.ids.tolist())
    for wave in list(waves.values())[:60]:
        assert wave.mean(0.123, wave.period_s) == pytest.approx(1.0, abs=1e-12)


def test_clocks_are_of_panels_and_of_the_seed() -> None:
    scene = office(send="code", clock_error=1e-3)
    waves = led_waves(scene.leds.transmitters, seed=5)
    clocks = np.array([waves[led].clock_error for led in range(1225)]).reshape(49, 25)
    phases = np.array([waves[led].start_phase for led in range(1225)]).reshape(49, 25)
    for numbers in (clocks, phases):
        assert (numbers == numbers[:, :1]).all()
        assert len(np.unique(numbers[:, 0])) == 49
    # chi-square of 49 normal numbers: 49 +- 5 sqrt(98)
    assert abs((clocks[:, 0] ** 2).sum() / 1e-6 - 49) < 5 * math.sqrt(98)
    assert led_waves(scene.leds.transmitters, seed=5) == waves
    other = led_waves(scene.leds.transmitters, seed=6)
    building = led_waves(scene.leds.transmitters, seed=5, map_number=1)
    for changed in (other, building):
        assert [wave.bits for wave in changed.values()] == [wave.bits for wave in waves.values()]
        assert not any(changed[led].clock_error == waves[led].clock_error for led in waves)
        assert not any(changed[led].start_phase == waves[led].start_phase for led in waves)


def test_lamps_on_the_mains_have_one_clock() -> None:
    mains = {"send": "mains", "depth": 0.2, "frequency_hz": 60.0}
    waves = led_waves(table1_of(mains, mains, {"send": "pwm"}, None).leds.transmitters, seed=1)
    assert waves[1] == waves[2]
    assert 1 / waves[1].nominal_period_s == pytest.approx(120.0)
    assert waves[3].clock_error != waves[1].clock_error
    assert 4 not in waves


def test_packets_of_a_panel_differ_by_their_delays() -> None:
    scene = office(send="packet")
    waves = led_waves(scene.leds.transmitters, seed=2)
    first = scene.leds.transmitters[8]
    delays = packet.delays_chips(25)
    base = waves[first.led_ids[7]]
    assert delays[7] == 0
    for led, delay in zip(first.led_ids, delays, strict=True):
        wave = waves[led]
        assert packet.decode_chips(wave.bits or "") == (1500, 1500, 3450)
        times = np.linspace(0, 0.01, 50)
        late = wave.mean(times + delay * 50e-6 / (1 + wave.clock_error), 40e-6)
        assert late == pytest.approx(base.mean(times, 40e-6), abs=1e-9)
    common = led_waves(office(send="packet", delays="common").leds.transmitters, seed=2)
    assert {common[led].start_phase for led in first.led_ids} == {base.start_phase}


def test_tones_count_up_over_the_scene_and_wrap_at_7_khz() -> None:
    waves = nominal_waves(office(send="tone").leds.transmitters)
    tones = np.array([1 / waves[led].period_s for led in range(1225)])
    assert tones == pytest.approx(1500 + 200 * (np.arange(1225) % 28))
    own = {"send": "tone", "frequency_hz": 1234.0}
    counted = {"send": "tone", "first_hz": 2000.0, "step_hz": 500.0}
    waves = nominal_waves(table1_of(counted, own, counted, counted).leds.transmitters)
    assert [round(1 / waves[led].period_s) for led in (1, 2, 3, 4)] == [2000, 1234, 2500, 3000]


def test_codes_are_of_one_book_in_the_order_of_ids() -> None:
    tree = read_toml(ROOT / "scenes/table1.toml")
    leds = [{**tree["led"][i], "downlink": {"send": "code"}} for i in (2, 0, 3, 1)]
    waves = nominal_waves(scene_of({**tree, "led": leds}).leds.transmitters)
    assert tuple(waves[led].bits for led in (1, 2, 3, 4)) == code_book(4, 32)


BAD_DOWNLINKS = [
    ({"send": "tone", "chip_us": 25.0}, r'chip_us: is no key of send = "tone", which has duty, depth'),
    ({"send": "code", "duty": 0.3}, r'duty: is no key of send = "code"'),
    ({"send": "code", "delays": "common"}, r'delays: is no key of send = "code"'),
    ({"send": "packet", "code_length": 32}, r'code_length: is no key of send = "packet"'),
    ({"send": "steady", "depth": 0.5}, r'depth: is no key of send = "steady", which has no further key'),
    ({"send": "mains", "duty": 0.5}, r'duty: is no key of send = "mains"'),
    ({"send": "pwm", "first_hz": 2000.0}, r'first_hz: is no key of send = "pwm"'),
    ({"send": "tone", "frequency_hz": 2000.0}, r"downlink\.frequency_hz: is the tone of a single LED"),
    ({"send": "morse"}, r"send = \"morse\": .*'code'"),
    ({"chip_us": 0.0}, r"chip_us = 0\.0"),
    ({"code_length": 33}, r"code_length = 33: .*multiple of 2"),
    ({"depth": 0.0}, r"depth = 0\.0: .*greater than 0"),
    ({"chip_s": 25e-6}, r"unknown key panels\[0\]\.downlink\.chip_s; did you mean chip_us\?"),
    (
        {"code_length": 16},
        r"^scene: panels\[0\]\.downlink\.code_length = 16: there are \d+ codes of 16 chips for 1225 LEDs; take more$",
    ),
]


@pytest.mark.parametrize(("downlink", "message"), BAD_DOWNLINKS, ids=[str(row[0]) for row in BAD_DOWNLINKS])
def test_what_leds_cannot_transmit_is_refused_in_one_line(downlink: dict[str, Any], message: str) -> None:
    with pytest.raises(vr.InputError, match=message) as refusal:
        office(**downlink)
    assert "\n" not in str(refusal.value)


def test_frequency_and_first_tone_are_not_both_given() -> None:
    with pytest.raises(vr.InputError, match=r"frequency_hz: stands in place of first_hz"):
        check({"send": "tone", "frequency_hz": 2000.0, "first_hz": 1500.0}, Downlink, "scene")


def test_a_room_beyond_the_coordinates_of_packets_is_refused() -> None:
    tree = read_toml(ROOT / "scenes/office.toml")
    tree["room"]["size_m"] = [12.0, 7.0, 3.5]
    panels = {**tree["panels"][0], "columns": 9, "downlink": {"send": "packet"}}
    wide = r"^scene: panels\[0\]\.downlink\.send = \"packet\": the centre \(8\.5, 0\.5, 3\.45\) m .* 0 to 8\.191 m"
    with pytest.raises(vr.InputError, match=wide):
        scene_of({**tree, "panels": [panels]})
    assert len(scene_of({**tree, "panels": [{**panels, "columns": 8}]}).leds) == 1400


def test_a_panel_of_more_leds_than_delays_is_refused() -> None:
    tree = read_toml(ROOT / "scenes/office.toml")
    leds = {**tree["panels"][0]["leds"], "columns": 13, "rows": 10, "pitch_m": [0.04, 0.05]}
    panels = {**tree["panels"][0], "columns": 1, "rows": 1, "leds": leds, "downlink": {"send": "packet"}}
    with pytest.raises(vr.InputError, match=r"delays: 130 LEDs a panel need 130 delays.*\"common\""):
        scene_of({**tree, "panels": [panels]})
    scene_of({**tree, "panels": [{**panels, "downlink": {"send": "packet", "delays": "common"}}]})


# dataset.json


def test_the_entry_of_codes_has_each_panels_leds() -> None:
    scene = office(send="code", chip_us=40.0, depth=0.6)
    entry = downlink_entry(scene.leds, "pixels")
    assert entry is not None
    assert (entry.demodulation, len(entry.transmitters)) == ("pixels", 49)
    waves = nominal_waves(scene.leds.transmitters)
    for transmitter, own in zip(scene.leds.transmitters, entry.transmitters, strict=True):
        assert isinstance(own, CodeEntry)
        assert own.leds == transmitter.led_ids
        assert own.codes == tuple(waves[led].bits for led in own.leds)
        assert (own.chip_us, own.depth, own.clock_error) == (40.0, 0.6, 1e-4)


def test_the_entry_of_packets_is_one_for_panels_alike_and_tells_no_place() -> None:
    scene = office(send="packet")
    entry = downlink_entry(scene.leds)
    assert entry is not None
    (own,) = entry.transmitters
    assert isinstance(own, PacketEntry)
    assert own.led.model_dump() == {"shape": "disc", "radius_m": 0.01}
    for transmitter in scene.leds.transmitters:
        places = np.searchsorted(scene.leds.ids, transmitter.led_ids)
        offsets = scene.leds.centers_m[places, :2] - np.array(transmitter.center_m[:2])
        assert np.array(own.offsets_m) == pytest.approx(offsets, abs=1e-9)
    assert own.delays_chips == packet.delays_chips(25)
    assert (own.preamble, own.polynomial, own.coordinate_bits) == ("00011011000111", 15717, 13)


def test_the_entry_of_tones_and_of_waves_that_identify_nothing() -> None:
    entry = downlink_entry(table1_of({"send": "tone"}, {"send": "pwm"}, {"send": "tone"}, None).leds)
    assert entry is not None
    assert all(isinstance(own, ToneEntry) for own in entry.transmitters)
    assert [(own.leds, own.frequencies_hz) for own in entry.transmitters if isinstance(own, ToneEntry)] == [
        ((1,), (1500.0,)),
        ((3,), (1700.0,)),
    ]
    dimmed = table1_of({"send": "mains"}, {"send": "pwm"}, {"send": "steady"}, None)
    assert downlink_entry(dimmed.leds) is None
    assert downlink_entry(vr.load_scene("office").leds) is None


# flicker of scenes


@pytest.mark.parametrize(
    ("downlink", "exceeded", "warned"),
    [
        ({"send": "code"}, (0, 0), None),
        ({"send": "packet"}, (0, 0), None),
        ({"send": "tone"}, (0, None), None),
        ({"send": "pwm"}, (1225, 1225), r"127 % at 1000 Hz, where 80 % is allowed; raise frequency_hz"),
        ({"send": "mains", "depth": 0.08}, (0, 1225), None),
        ({"send": "mains", "depth": 0.09}, (1225, 1225), r"up to 1\.12 times: 9 % at 100 Hz.*; lower depth"),
        ({"send": "packet", "chip_us": 125.0}, (None, 1225), r"at 63\.49 Hz, .* shorten chip_us"),
    ],
    ids=str,
)
def test_flicker_of_a_scene(
    downlink: dict[str, Any], exceeded: tuple[int | None, int | None], warned: str | None
) -> None:
    (found,) = flicker_of(office(**downlink).leds.transmitters)
    assert (found.send, found.leds) == (downlink["send"], 1225)
    for expected, count in zip(exceeded, (found.low_risk_exceeded, found.no_effect_exceeded), strict=True):
        assert expected is None or count == expected
    warning = flicker_warning([found])
    if warned is None:
        assert warning is None
    else:
        assert warning is not None
        assert warning.startswith("panels[0].downlink: ")
        assert re.search(warned, warning)
    assert flicker_of(vr.load_scene("office").leds.transmitters) == ()


@pytest.mark.parametrize("name", ["office_codes", "office_packets"])
def test_packaged_scenes_flicker_without_observable_effect(name: str) -> None:
    (found,) = flicker_of(vr.load_scene(name).leds.transmitters)
    assert (found.leds, found.no_effect_exceeded) == (1225, 0)
    assert 0 < found.worst.no_effect.share < 1


def test_show_prints_the_flicker_and_warns(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    mains = {"send": "mains", "depth": 0.3}
    print_flicker(table1_of(mains, mains, None, {"send": "code"}))
    rows = [re.split(r"\s{2,}", line.strip()) for line in capsys.readouterr().out.splitlines()[3:]]
    assert rows[:2] == [
        ["mains", "low risk", "2", "30 %", "100 Hz", "8 %", "3.75", "2"],
        ["mains", "no effect", "2", "30 %", "100 Hz", "3.33 %", "9.01", "2"],
    ]
    assert [row[0] for row in rows] == ["mains", "mains", "code", "code"]
    (record,) = caplog.records
    assert record.getMessage().startswith("led[0].downlink: 2 of 2 LEDs flicker beyond the low risk of IEEE 1789")
    print_flicker(vr.load_scene("office"))
    assert capsys.readouterr().out == ""


def test_generate_warns_once_of_flicker(caplog: pytest.LogCaptureFixture) -> None:
    plan = vr.load_recipe("table1")
    dim = {"send": "pwm", "frequency_hz": 500.0, "duty": 0.2}
    for scene, count in ((plan.scene, 0), (table1_of(dim, None, None, dim), 1)):
        warn_once.cache_clear()
        caplog.clear()
        for _ in range(2):
            _warn_of_flicker(replace(plan, scene=scene))
        assert len(caplog.records) == count
    assert "table1.toml: led[0].downlink: 2 of 2 LEDs flicker" in caplog.records[0].getMessage()
