"""TOML into models: assignments, and refusals that name the key, the value and what is allowed."""

import copy
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, model_validator

from vlcrender.config.toml_model import RENAMED_KEYS, Settings, check, key_error, override, read_toml, toml_text
from vlcrender.errors import InputError


class Disc(Settings):
    shape: Literal["disc"]
    radius_m: float


class Square(Settings):
    shape: Literal["square"]
    side_m: Annotated[float, Field(gt=0)]


class Lens(Settings):
    f_number: float = 2.0
    focus_m: float | None = None
    count: int = 1
    on: bool = False

    @model_validator(mode="after")
    def _odd(self) -> "Lens":
        if self.count == 13:
            raise key_error("count", "is 13; give any other number")
        return self


class Room(Settings):
    name: str
    lens: Lens = Lens()
    led: tuple[Annotated[Disc | Square, Field(discriminator="shape")], ...] = ()
    size_m: tuple[float, float] = (1.0, 2.0)


def refusal(tree: dict[str, Any]) -> str:
    with pytest.raises(InputError) as error:
        check(tree, Room, "here")
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_whole_number_is_a_float_and_nothing_else_is_converted() -> None:
    room = check({"name": "x", "lens": {"f_number": 2}, "size_m": [3, 4.5]}, Room, "here")
    assert (room.lens.f_number, room.size_m) == (2.0, (3.0, 4.5))
    assert isinstance(room.lens.f_number, float)
    for key, value, shown in (
        ("f_number", "2.8", '"2.8"'),
        ("on", 1, "1"),
        ("count", 2.5, "2.5"),
        ("focus_m", True, "true"),
    ):
        assert refusal({"name": "x", "lens": {key: value}}).startswith(f"here: lens.{key} = {shown}: ")
    assert refusal({"name": 3}).startswith("here: name = 3: ")
    assert refusal({"name": "x", "lens": {"f_number": float("nan")}}).startswith("here: lens.f_number = NaN: ")


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "missing": ({}, "key name is missing"),
    "missing in an array": (
        {"name": "x", "led": [{"shape": "disc", "radius_m": 1.0}, {"shape": "square"}]},
        "key led[1].side_m is missing",
    ),
    "another unit": (
        {"name": "x", "lens": {"focus_mm": 5.0}},
        "unknown key lens.focus_mm; did you mean focus_m? allowed: count, f_number, focus_m, on",
    ),
    "a slip": (
        {"name": "x", "lens": {"f_numbr": 5.0}},
        "unknown key lens.f_numbr; did you mean f_number? allowed: count, f_number, focus_m, on",
    ),
    "nothing near": (
        {"name": "x", "lens": {"colour": 5.0}},
        "unknown key lens.colour; allowed: count, f_number, focus_m, on",
    ),
    # Of a tagged union, the keys of the member with the tag are allowed, and the tag itself is no part of the key.
    "a key of the other shape": (
        {"name": "x", "led": [{"shape": "disc", "radius_m": 1.0, "side_m": 1.0}]},
        "unknown key led[0].side_m; allowed: radius_m, shape",
    ),
    # The former key is reported as unknown and the present one as missing: the unknown one says more.
    "unknown before missing": (
        {"name": "x", "led": [{"shape": "square", "side_cm": 1.0}]},
        "unknown key led[0].side_cm; did you mean side_m? allowed: shape, side_m (and 1 more)",
    ),
    "a limit": (
        {"name": "x", "led": [{"shape": "square", "side_m": -1.0}]},
        "led[0].side_m = -1.0: input should be greater than 0",
    ),
    "a key of a validator": ({"name": "x", "lens": {"count": 13}}, "lens.count: is 13; give any other number"),
    "two problems": (
        {"name": "x", "lens": {"f_number": "a", "on": "b"}},
        'lens.f_number = "a": input should be a valid number (and 1 more)',
    ),
    "the longest value shown whole": (
        {"name": "x", "lens": {"count": "y" * 58}},
        f'lens.count = "{"y" * 58}": input should be a valid integer',
    ),
    "a long value": (
        {"name": "x", "lens": {"count": "y" * 100}},
        f'lens.count = "{"y" * 56}...: input should be a valid integer',
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_refusal_names_key_value_and_what_is_allowed(case: str) -> None:
    tree, message = REFUSED[case]
    assert refusal(tree) == f"here: {message}"


@pytest.mark.parametrize("former", RENAMED_KEYS)
def test_a_former_key_is_found_in_tables_and_in_arrays_of_tables(former: str) -> None:
    first, *rest = former.split(".")
    message = f"here: key {former} was renamed: write {RENAMED_KEYS[former]}"
    below: Any = 1
    for key in reversed(rest):
        below = {key: below}
    assert refusal({first: below}) == message
    if rest:
        assert refusal({first: [{}, below]}) == message
        assert "renamed" not in refusal({first: [{}, {"other": below}]})


def test_assignments_are_values_of_toml_or_bare_words() -> None:
    tree = override(
        {},
        [
            "a=1",
            "b.c = 2.5",
            "b.d=[1, 2]",
            'e="text"',
            "f=none",
            "g=two words",
            "h=true",
            "i=x\ny = 3",
            "j=1\nk = 2",
            "l=a=b",
        ],
    )
    assert tree == {
        **{"a": 1, "b": {"c": 2.5, "d": [1, 2]}, "e": "text", "f": "none", "g": "two words", "h": True},
        **{"i": "x\ny = 3", "j": "1\nk = 2", "l": "a=b"},  # no second key comes in with a value
    }


def test_an_assignment_leaves_the_tree_that_was_given() -> None:
    given = {"lens": {"f_number": 2.0, "deep": {"x": 1}}, "name": "x"}
    before = copy.deepcopy(given)
    changed = override(given, ["lens.f_number=4.0", "lens.deep.x=2", "name=y", "new.key=1"])
    assert given == before
    assert changed == {"lens": {"f_number": 4.0, "deep": {"x": 2}}, "name": "y", "new": {"key": 1}}


def test_of_two_assignments_of_a_key_the_last_counts() -> None:
    assert override({"a": {"b": 0}}, ["a.b=1", "a.b=2"]) == {"a": {"b": 2}}


@pytest.mark.parametrize("assignment", ["", "a", "=1", "a.=1", ".a=1", "a..b=1", " =1"])
def test_an_assignment_without_a_key_or_a_value_is_refused(assignment: str) -> None:
    with pytest.raises(InputError, match="is not key=value") as error:
        override({}, [assignment])
    assert str(error.value).startswith(f"--set {assignment}: ")


def test_an_assignment_below_a_value_is_refused() -> None:
    with pytest.raises(InputError, match=r"^--set a\.b\.c=1: b is not a table of the recipe$"):
        override({"a": {"b": 3}}, ["a.b.c=1"])


def test_an_item_of_a_list_has_its_number_or_name() -> None:
    given = {"rig": [{"name": "left", "yaw": 1}, {"name": "1", "yaw": 2}], "size": [1.0, 2.0]}
    before = copy.deepcopy(given)
    changed = override(given, ["rig.left.yaw=3", "rig.1.yaw=4", "rig.0.tilt=5", "size.1=6.0"])
    assert changed == {
        "rig": [{"name": "left", "yaw": 3, "tilt": 5}, {"name": "1", "yaw": 4}],
        "size": [1.0, 6.0],
    }
    assert given == before
    with pytest.raises(InputError, match=r"^--set rig\.right\.yaw=1: no item right: 2 items, .* or named left, 1$"):
        override(given, ["rig.right.yaw=1"])
    with pytest.raises(InputError, match=r"^here: size\.2=1: no item 2: 2 items, numbered from 0$"):
        override(given, ["size.2=1"], "here: ")


@pytest.mark.parametrize("value", [True, 3, -1.5e-07, 'a "b" \\ c', [1, [2.5, "x"]], {"a b": {"c": [False]}}])
def test_a_value_survives_its_toml(value: object) -> None:
    assert override({}, [f"key={toml_text(value, 'here')}"]) == {"key": value}


def test_a_value_that_toml_has_not_is_refused() -> None:
    with pytest.raises(InputError, match=r"^here = None: has to be a number, a text"):
        toml_text(None, "here")


def test_a_file_that_is_no_toml_is_refused_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    for content, words in (
        (None, "cannot be read: No such file or directory"),
        (b"a = ", "is not TOML: "),
        (b"a = 1\na = 2", "is not TOML: "),
        (b"a = 'caf\xe9'", "is not UTF-8 text; give a TOML file"),
        (b"a = " + b"9" * 5000, "is not TOML: "),
        (b"a = " + b"[" * 100_000, "is not TOML: "),
    ):
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InputError) as error:
            read_toml(path)
        assert str(error.value).startswith(f"{path}: {words}")
    path.write_text("name = 'é'\n[lens]\nf_number = 2\n", encoding="utf-8")
    assert read_toml(path) == {"name": "é", "lens": {"f_number": 2}}
