"""The page of a set: what differs between the true and the told map."""

from pathlib import Path
from types import SimpleNamespace

from vlcrender.report.contents import Contents


def test_the_difference_of_maps_is_in_millimetres() -> None:
    """Two LEDs, off by 2 and 4 mm along x, and by 3 mm upwards. Of the four numbers along x and y two are 0."""
    told = [SimpleNamespace(id=number, position_m=(1.0, 1.0, 3.0)) for number in (4, 7)]
    built = [SimpleNamespace(led=led, position_m=(x_m, 1.0, 3.003)) for led, x_m in ((4, 1.002), (7, 1.004), (9, 5.0))]
    dataset = SimpleNamespace(led_map=told, cameras={})
    contents = Contents(Path(), dataset, [], [], [], built, "")  # type: ignore[arg-type]
    # sqrt((4 + 16) / 4) = 2.236; LED 9 is not on the told map
    assert contents.told_and_true() == [("LEDs, x and y", "2.24 mm", "4 mm"), ("LEDs, height", "3 mm", "3 mm")]
