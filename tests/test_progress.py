"""Rate, time left, and lines of a log."""

import io
import itertools

import pytest
from rich.console import Console

from vlcrender.dataset.run.progress import FIRST_LINE_S, MAX_INTERVAL_S, Pace, Progress, duration_text
from vlcrender.dataset.run.progress_display import ProgressDisplay


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def frames(done: float, total: float = 1000.0) -> Progress:
    return Progress("frames", done, total)


def test_the_rate_counts_frames_of_this_run_alone() -> None:
    """600 frames are resumed and then one is made in each 2 s: 0.5 a second, 390 left take 780 s."""
    clock = Clock()
    pace = Pace(clock)
    pace.add(frames(600))
    assert pace.rate_hz is None
    assert pace.text(frames(600)) == ""
    for done in range(601, 611):
        clock.now_s += 2.0
        pace.add(frames(done))
    assert pace.rate_hz == pytest.approx(0.5)
    assert pace.text(frames(610)) == "2 s a frame, 13 min left"


def test_the_rate_follows_a_change() -> None:
    clock = Clock()
    pace = Pace(clock)
    for done in range(1000):
        clock.now_s += 1.0 if done < 500 else 0.1
        pace.add(frames(done))
    assert pace.rate_hz == pytest.approx(10.0)


def test_lines_of_a_log_come_at_growing_intervals_and_at_the_end() -> None:
    clock = Clock()
    pace = Pace(clock)
    at_s = []
    total = 20_000
    for second in range(1, total + 1):
        clock.now_s = float(second)
        if pace.line_is_due(frames(second, total)):
            at_s.append(second)
    assert at_s[0] == FIRST_LINE_S
    assert at_s[-1] == total
    steps = [later - before for before, later in itertools.pairwise(at_s)]
    assert steps[:-1] == sorted(steps[:-1])
    assert max(steps) == MAX_INTERVAL_S
    assert len(at_s) < 50


def test_a_short_run_has_no_lines() -> None:
    clock = Clock()
    pace = Pace(clock)
    clock.now_s = FIRST_LINE_S / 2
    assert not pace.line_is_due(frames(1000))


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0, "0 s"), (0.523, "0.52 s"), (99.4, "99 s"), (99.6, "1.7 min"), (5970.0, "1.7 h"), (86400.0 * 3, "3 days")],
)
def test_durations_have_two_digits(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


def test_a_pipe_gets_plain_lines(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("vlcrender.dataset.run.progress.FIRST_LINE_S", 0.0)
    with ProgressDisplay("set", 10, Console(file=io.StringIO())) as display:
        display.show(Progress("reflected light", 0.5, 1.0))
        display.show(frames(10, 10))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "set: reflected light, 50 %"
    assert lines[1].startswith("set: 10 of 10 frames, done in ")
    assert not {"\x1b", "\r"} & set("".join(lines))


def test_a_terminal_gets_one_line_that_is_repainted() -> None:
    shown = io.StringIO()
    with ProgressDisplay("set", 3, Console(file=shown, force_terminal=True, width=80)) as display:
        display.show(frames(0, 3))
        display.show(frames(1, 3))
        display.show(frames(2, 3))
        display.show(frames(3, 3))
    text = shown.getvalue()
    assert "3/3" in text
    assert "done in" in text
    assert text.count("\n") <= 1  # the end of the line that stays
