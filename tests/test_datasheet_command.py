"""The command `vlcrender sensor`: its table, JSON, page and refusals."""

import json
import sys
from pathlib import Path

import pytest

from vlcrender.cli import main
from vlcrender.emva1288.datasheet import SIGMAS


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """The command's exit code, in this process: another would first start Mitsuba."""
    monkeypatch.setattr(sys, "argv", ["vlcrender", *arguments])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.mark.filterwarnings("ignore:Cyclopts application invoked")
def test_the_command_prints_a_table_or_json_and_writes_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "datasheet", "ideal", "--side-px", "64", "--json") == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows["K"]["set_value"] == 1.0
    assert abs(rows["K"]["measured"] - 1) <= rows["K"]["tolerance"] < SIGMAS * 0.008
    assert (tmp_path / "ideal-datasheet.html").read_text().startswith("<!doctype html>")
    (tmp_path / "clipped.toml").write_text('[sensor]\nnoise = "full"\nread_noise_e = 3.0\n')
    # a deviation is no error
    assert run(monkeypatch, "datasheet", "clipped.toml", "--side-px", "64", "--out", "page.html") == 0
    assert "OFF" in capsys.readouterr().out
    assert "clipped" in (tmp_path / "page.html").read_text()


@pytest.mark.filterwarnings("ignore:Cyclopts application invoked")
@pytest.mark.parametrize(
    ("arguments", "mention"),
    [
        (["blind.toml", "--wavelength-nm", "800"], "--wavelength-nm 800: quantum efficiency is 0 there"),
        (["ideal", "--wavelength-nm", "nan"], "--wavelength-nm nan"),
        # Below, air and lenses absorb; beyond, silicon has no efficiency: its band gap of 1.12 eV is at 1107 nm.
        (["ideal", "--wavelength-nm", "199.9"], "--wavelength-nm 199.9: has to be from 200 to 1200"),
        (["ideal", "--wavelength-nm", "1200.1"], "--wavelength-nm 1200.1: has to be from 200 to 1200"),
        (["ideal", "--side-px", "1"], "--side-px 1"),
        (["unknown"], "unknown"),
        (["ideal", "--out", "no/such/x.html"], "no/such"),
        ([], "SENSOR"),
    ],
)
def test_the_command_refuses_in_one_line(
    arguments: list[str],
    mention: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "blind.toml").write_text(
        "[sensor.quantum_efficiency]\nwavelengths_nm = [400, 700]\nvalues = [0.5, 0.5]\n"
    )
    assert run(monkeypatch, "datasheet", *arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert mention in lines[0]
