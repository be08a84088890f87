"""Tables of vlcrender on the terminal: every figure is printed whole at any width, and nothing but a line is drawn."""

import pytest

from vlcrender.report.terminal import print_table

ROWS = (
    ("tilted 0 to 60 deg on both axes", "0.75", "122500", "83.46 %"),
    (),
    ("[all]", "", "122506", "1.2e-07"),
)


@pytest.mark.parametrize("columns", [20, 40, 80, 120])
def test_no_figure_is_cut_off_and_no_box_is_drawn(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    print_table("poses [see] LEDs", ("attitude", "height, m", "poses", "share"), ROWS)
    printed = capsys.readouterr().out
    for row in ROWS:
        for cell in row:
            assert cell in printed
    assert "poses [see] LEDs" in " ".join(printed.split())
    assert not set(printed) & set("│┃┏┓└┘…")


def test_figures_stand_under_each_other(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    print_table(
        "lengths", ("what", "of", "m", "error"), [("room", "x", "7", "1.5"), (), ("all", "", "12", "0.25")], left=2
    )
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == [
        "lengths",
        "what   of    m   error",
        "──────────────────────",
        "room   x     7     1.5",
        "",
        "all         12    0.25",
    ]
