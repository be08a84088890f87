"""Panels: which LED each image is, by the packet that its panel sends."""

from dataclasses import dataclass

import numpy as np
import pytest
from downlink_signals import (
    EXPOSURE_S,
    PACKETS,
    Sent,
    led_image,
    packet_chips,
)
from test_estimator_device import CAMERA
from test_estimator_receiver import FORM

from estimator.io.camera import Camera
from estimator.receiver.packets import decode_packet
from estimator.receiver.panels import _laid as laid
from estimator.receiver.panels import find_groups, same_images
from estimator.receiver.signal import LedImage


@dataclass(frozen=True)
class View:
    """A level camera below a panel, turned by `yaw_deg`: what the receiver needs of a frame."""

    camera: Camera
    accelerometer_m_s2: tuple[float, float, float] = (0.0, 0.0, 9.8)


def view() -> View:
    K = ((15000.0, 0.0, 2000.0), (0.0, 15000.0, 1500.0), (0.0, 0.0, 1.0))
    return View(CAMERA.model_copy(update={"width_px": 4000, "height_px": 3000, "K": K}))


def panel_images(
    generator: np.random.Generator,
    seen: list[int],
    yaw_deg: float = 30.0,
    height_m: float = 2.5,
    later_s: float = 0.0,
    phase: float = 17.3,
    chips: str | None = None,
) -> list[LedImage]:
    """Images of some LEDs of a panel above a level camera, turned about its axis."""
    chips = packet_chips(3500, 2500, 3450) if chips is None else chips
    turn = np.exp(-1j * np.radians(yaw_deg))
    scale = 15000 / height_m
    images = []
    for index in seen:
        at = complex(*PACKETS.offsets_m[index]) * turn * scale
        late = Sent(chips, 50e-6 / (1 + 1e-4), phase - PACKETS.delays_chips[index])
        radius = 0.01 * scale
        centre = (2000 + at.real, 1500 + at.imag)
        images.append(led_image(late, generator, centre, (radius, radius), start_s=3.0 + later_s))
    return images


@pytest.mark.slow
@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, 137.0, 260.0])
@pytest.mark.parametrize("seen", [list(range(25)), [0, 1, 2, 5, 6, 7, 10, 11, 12, 17]], ids=["whole", "corner"])
def test_a_panel_tells_its_centre_and_which_led_each_image_is(seen: list[int], yaw_deg: float) -> None:
    """Two frames of a burst; the images in another order in each, as a detector gives them."""
    generator = np.random.default_rng(12)
    orders = [generator.permutation(seen).tolist() for _ in range(2)]
    images = [
        panel_images(generator, order, yaw_deg, later_s=later)
        for order, later in zip(orders, (0.0, 1 / 30), strict=True)
    ]
    (group,) = find_groups([view(), view()], images, PACKETS)  # type: ignore[list-item]
    members = [
        [order[number] for order, number in zip(orders, member.numbers, strict=True)] for member in group.members
    ]
    assert all(first == second for first, second in members)
    true = [first for first, _ in members]
    assert any(hypothesis.tolist() == true for hypothesis in group.hypotheses)
    signals = [[images[frame][n].signal for frame, n in enumerate(member.numbers)] for member in group.members]
    match = decode_packet(signals, group.hypotheses, PACKETS)
    assert match is not None
    assert match.clear
    assert FORM.coordinates(match.data) == (3500, 2500, 3450)
    assert match.indices.tolist() == true
    # Before the clock is refined: an error of CLOCK_STEP_CHIPS / 2 is a tenth of a bright line's level in each rise.
    assert match.explained > 0.95
    for wave, of_member in zip(match.waves, signals, strict=True):
        assert min(one.correlation(wave.gains(one.start_s, EXPOSURE_S)) for one in of_member) > 0.98


def test_images_that_could_be_laid_in_two_ways_are_not_told_apart() -> None:
    """Of one LED nothing but its phase is seen, and that is unknown: whatever its index, a packet fits as well."""
    generator = np.random.default_rng(13)
    images = [panel_images(generator, [7], later_s=later) for later in np.arange(8) * 0.001]
    signals = [[of_frame[0].signal for of_frame in images]]
    match = decode_packet(signals, [np.array([index]) for index in range(25)], PACKETS)
    assert match is not None
    assert FORM.coordinates(match.data) == (3500, 2500, 3450)
    assert match.misfit_ratio == pytest.approx(1, abs=0.2)
    assert not match.clear


def test_random_chips_are_no_packet() -> None:
    generator = np.random.default_rng(14)
    for _ in range(5):
        chips = "".join(map(str, generator.permutation(np.arange(126) % 2)))
        images = panel_images(generator, list(range(25)), chips=chips)
        (group,) = find_groups([view()], [images], PACKETS)  # type: ignore[list-item]
        signals = [[images[member.numbers[0]].signal] for member in group.members]
        assert decode_packet(signals, group.hypotheses, PACKETS) is None


def test_two_panels_are_two_groups_and_a_lamp_beside_them_a_third() -> None:
    generator = np.random.default_rng(15)
    first = panel_images(generator, [3, 4, 8, 9], yaw_deg=0.0)
    second = [LedImage(image.u_px - 3000, image.v_px, image.moments_px2, image.signal) for image in first]
    lone = LedImage(2000.0, 2900.0, first[0].moments_px2, first[0].signal)
    groups = find_groups([view()], [[*first, *second, lone]], PACKETS)  # type: ignore[list-item]
    assert sorted(len(group.members) for group in groups) == [1, 4, 4]
    # A square of four has 16 places in a square of 25, each turned four ways.
    assert [len(group.hypotheses) for group in groups if len(group.members) == 4] == [64, 64]


@pytest.mark.parametrize("doubled", [0, 1, 2])
def test_no_led_has_two_images(doubled: int) -> None:
    """Three LEDs in a row, and beside the image of one of them a second one: the LED of index 0 is one like the others.

    The first two images are known; the third, and the fourth beside one of the three, are laid.
    """
    offsets = np.array([[0.0, 0.0], [0.2, 0.0], [0.4, 0.0]])
    once = laid(offsets, offsets, (1, 2), (1, 2), 0.05)
    assert once is not None
    assert once.tolist() == [0, 1, 2]
    assert laid(np.vstack([offsets, offsets[doubled] + [0.0, 0.01]]), offsets, (1, 2), (1, 2), 0.05) is None


def test_images_of_a_burst_are_followed_as_they_move() -> None:
    """All move by 40 px; one leaves, one comes, and the detector numbers them anew."""
    generator = np.random.default_rng(16)
    first = panel_images(generator, [0, 1, 2, 3])
    moved = [LedImage(one.u_px + 40, one.v_px - 10, one.moments_px2, one.signal) for one in first]
    new = LedImage(500.0, 400.0, first[0].moments_px2, first[0].signal)
    tracks = same_images([first, [new, moved[3], moved[1], moved[0]]])
    assert sorted(tracks) == [((0, 0), (1, 3)), ((0, 1), (1, 2)), ((0, 2),), ((0, 3), (1, 1)), ((1, 0),)]
    assert same_images([]) == ()
