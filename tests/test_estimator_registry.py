"""Variants from outside the package: the document's own example, and everything that can be wrong with one."""

import os
import re
import signal
import sys
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import HANG_S, ROOT, copy_of, started, wait_until

from estimator.cli import main
from estimator.methods.catalogue import OWN, PUBLISHED_SINCE, VARIANTS
from estimator.methods.registry import GROUP, Registry

DOCUMENT = Path(__file__).parent.parent / "docs/own_variant.md"

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Put a package of one module on the path, as pip would: the module, and its metadata beside it."""

    def package(name: str, source: str, entries: Mapping[str, str]) -> None:
        site = tmp_path / f"site-{name}"
        metadata = site / f"{name}-0.1.dist-info"
        metadata.mkdir(parents=True)
        (site / f"{name}.py").write_text(source)
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
        lines = [f"{key} = {value}" for key, value in entries.items()]
        (metadata / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines, ""]))
        monkeypatch.syspath_prepend(str(site))
        monkeypatch.delitem(sys.modules, name, raising=False)

    return package


def block(language: str) -> str:
    """The document's code of this language."""
    (code,) = re.findall(rf"```{language}\n(.*?)```", DOCUMENT.read_text(), flags=re.DOTALL)
    return str(code)


def test_the_document_s_example_runs_and_is_good(
    install: Install, synthetic_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As pnp in the tests of variants: some 0.02 px of 1500, widened by the pattern's narrowness and tilt."""
    code, project = block("python"), tomllib.loads(block("toml"))
    assert len(code.strip().splitlines()) < 20
    install(project["project"]["name"], code, project["project"]["entry-points"][GROUP])
    assert main(["variants"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [*OWN, "turned"]
    assert lines[-1].endswith("scale the height. (external: turned 0.1)")
    assert "external" not in "".join(lines[:-1])
    assert [line.split()[0] for line in lines if line.endswith(" (where named)")] == list(PUBLISHED_SINCE)
    folder = copy_of(synthetic_set, tmp_path / "set")
    assert main(["run", str(folder), "--variant", "turned"]) == 0
    found = pq.read_table(folder / "estimates/turned.parquet")["position_m"].to_pylist()
    truth = pq.read_table(folder / "truth.parquet")["position_m"].to_pylist()
    assert max(np.linalg.norm(np.subtract(found, truth), axis=1)) < 0.02
    assert main(["run", str(folder), "--variant", "pnp"]) == 0
    assert main(["compare", str(folder), "turned", "pnp"]) == 0
    assert "A = turned, B = pnp" in capsys.readouterr().out


GOOD = "def f(frame):\n    raise SystemExit(3)\n"
BAD_PLUGINS: dict[str, tuple[str, dict[str, str], str]] = {
    "import error": ("import nowhere", {"x": "bad:f"}, "cannot be loaded (ModuleNotFoundError: No module named 'nowhe"),
    "exits": ("import sys; sys.exit('bye\\nnow')", {"x": "bad:f"}, "cannot be loaded (SystemExit: bye)"),
    "syntax": ("def f(:", {"x": "bad:f"}, "cannot be loaded (SyntaxError: "),
    "no such name": (GOOD, {"x": "bad:g"}, "cannot be loaded (AttributeError: "),
    "no object": (GOOD, {"x": "nothing at all"}, "cannot be loaded ("),
    "a number": ("f = 3", {"x": "bad:f"}, "is a int, needed a function or a Variant"),
    "a class": ("class f: pass", {"x": "bad:f"}, "is a type, needed a function or a Variant"),
    "other name": (
        "from estimator.methods.variant import Variant\nf = Variant('y', '', print)",
        {"x": "bad:f"},
        "is a Variant of another name, 'y'",
    ),
    "name taken": (GOOD, {"pnp": "bad:f"}, "variant 'pnp' of bad 0.1 (bad:f): not used, the estimator has a variant"),
    "a path": (GOOD, {"../x": "bad:f"}, "not used, the name may hold A-Z"),
    "options": (GOOD, {"x:y": "bad:f"}, "not used, the name may hold A-Z"),
}


@pytest.mark.parametrize("case", BAD_PLUGINS)
def test_a_bad_plugin_is_one_line_and_the_others_run(
    install: Install, synthetic_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    source, entries, words = BAD_PLUGINS[case]
    install("bad", source, entries)
    install("fine", '"""Fine."""\n\ndef f(frame):\n    """Says nothing.\n\n    At length."""\n', {"fine": "fine:f"})
    assert main(["variants"]) == 0
    output = capsys.readouterr()
    assert [line.split()[0] for line in output.out.splitlines()] == [*OWN, "fine"]
    assert "Says nothing. (external: fine 0.1)" in output.out
    assert output.err.count("\n") == 1
    assert output.err.startswith("estimator: warning: variant ")
    assert words in output.err
    (name,) = entries
    folder = copy_of(synthetic_set, tmp_path / "set")
    assert main(["run", str(folder), "--variant", name]) == (0 if name in OWN else 2)
    output = capsys.readouterr()
    assert output.err.count("\n") == 1


def test_a_composition_is_taken_with_its_own_summary(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    source = "from estimator.methods.variant import Variant\nv = Variant('mine', 'Two\\nlines', print)"
    install("composed", source, {"mine": "composed:v"})
    assert main(["variants"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].split(maxsplit=1)[1] == "Two lines (external: composed 0.1)"


def test_a_name_registered_twice_is_not_used(install: Install) -> None:
    install("one", GOOD, {"x": "one:f"})
    install("two", GOOD, {"x": "two:f"})
    variants, problems = Registry.read().all()
    assert [variant.name for variant in variants] == list(VARIANTS)
    (problem,) = problems
    assert "'x': not used, registered more than once, as " in problem


CRASHES = {
    "crashed (IndexError)": "    return frame.spots[10**6]",
    "crashed (SystemExit)": "    raise SystemExit(3)",
    "crashed (RecursionError)": "    return f(frame)",
    "crashed (MemoryError)": "    raise MemoryError",
    "crashed (ValueError)": "    frame.parts[0].image_dn[0, 0] = 0",  # images are read-only
    "returned no Estimate": "    return [1.0, 2.0, 3.0]",
}


@pytest.mark.parametrize("workers", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_a_crash_on_a_frame_is_a_failed_frame_and_the_run_goes_on(
    install: Install, synthetic_set: Path, tmp_path: Path, workers: str
) -> None:
    source = "".join(f"def f{k}(frame):\n{body}\n" for k, body in enumerate(CRASHES.values())).replace(" f(", " f2(")
    install("crashing", source, {f"crash{k}": f"crashing:f{k}" for k in range(len(CRASHES))})
    folder = copy_of(synthetic_set, tmp_path / "set")
    assert main(["run", str(folder), "--workers", workers]) == 0
    for k, why in enumerate(CRASHES):
        rows = pq.read_table(folder / f"estimates/crash{k}.parquet").to_pylist()
        assert [row["reason"] for row in rows] == [f"variant: {why}"] * 3
    assert pq.read_table(folder / "estimates/pnp.parquet")["status"].to_pylist() == ["ok"] * 3


@pytest.mark.slow
def test_a_worker_that_dies_is_one_line_and_nothing_is_written(
    install: Install, synthetic_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    install("deadly", "import os\n\ndef f(frame):\n    os._exit(5)\n", {"deadly": "deadly:f"})
    folder = copy_of(synthetic_set, tmp_path / "set")
    assert main(["run", str(folder), "--workers", "2", "--variant", "deadly"]) == 2
    assert "a worker process died" in capsys.readouterr().err.splitlines()[-1]
    assert not (folder / "estimates").exists()


def test_nothing_is_imported_that_is_not_asked_for(install: Install, synthetic_set: Path, tmp_path: Path) -> None:
    install("slow", "raise AssertionError('imported')", {"slow": "slow:f"})
    assert main(["run", str(copy_of(synthetic_set, tmp_path / "set")), "--variant", "pnp"]) == 0
    assert "slow" not in sys.modules


@pytest.mark.slow
def test_an_interrupt_leaves_nothing_half_done(install: Install, synthetic_set: Path, tmp_path: Path) -> None:
    """The whole process group gets SIGINT, as from a terminal, while a worker is within its first frame.

    The variant announces its first frame and goes on once the interrupt has been sent: the parent waits for the frames
    that are being estimated.
    """
    begun, sent = tmp_path / "begun", tmp_path / "sent"
    source = (
        "import pathlib, time\n\ndef f(frame):\n"
        f"    pathlib.Path({str(begun)!r}).touch()\n"
        f"    while not pathlib.Path({str(sent)!r}).exists():\n"
        "        time.sleep(0.01)\n"
    )
    install("waiting", source, {"waiting": "waiting:f"})
    folder = copy_of(synthetic_set, tmp_path / "set")
    paths = os.pathsep.join([str(tmp_path / "site-waiting"), str(ROOT), os.environ.get("PYTHONPATH", "")])
    arguments = ("run", str(folder), "--variant", "waiting", "--workers", "2")
    process = started("estimator", *arguments, environment={**os.environ, "PYTHONPATH": paths})
    try:
        wait_until(begun.exists, process)
        os.killpg(process.pid, signal.SIGINT)
        sent.touch()
        output, _ = process.communicate(timeout=HANG_S)
    finally:
        process.kill()
    assert process.returncode == 130, output
    assert output.splitlines()[-1] == "estimator: interrupted"
    assert "Traceback" not in output
    assert not (folder / "estimates").exists()
