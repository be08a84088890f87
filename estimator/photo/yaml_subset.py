"""The part of YAML that calibration files use: mappings by indentation, sequences, numbers, words and tags.

OpenCV's own reader accepts its own files alone. Anchors, block scalars, and several documents are not read.
"""

import re
from typing import Any

NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
MAX_DEPTH = 30


class YamlError(ValueError):
    """A line that is not in the subset; the message names it."""


def parse_yaml(text: str) -> Any:
    """Parse a document: mappings are dicts, sequences lists, numbers int or float, other scalars str, bool or None.

    Raises YamlError.
    """
    lines = _logical_lines(text)
    if not lines:
        return None
    value, rest = _block(lines, 0, lines[0][0], 0)
    if rest != len(lines):
        raise YamlError(f"line {lines[rest][2]}: unexpected indentation")
    return value


Line = tuple[int, str, int]
"""Indentation, text, number."""


def _logical_lines(text: str) -> list[Line]:
    """Lines without comments, tags and document marks; flow collections over several lines are joined."""
    lines: list[Line] = []
    open_brackets = 0
    for number, raw in enumerate(text.splitlines(), start=1):
        bare = _without_comment(raw)
        if not bare.strip() or (not lines and bare.startswith("%")) or bare.strip() in ("---", "..."):
            continue
        if "\t" in bare[: len(bare) - len(bare.lstrip())]:
            raise YamlError(f"line {number}: a tab as indentation")
        if open_brackets:
            indent, before, first = lines[-1]
            lines[-1] = indent, f"{before} {bare.strip()}", first
        else:
            lines.append((len(bare) - len(bare.lstrip(" ")), bare.strip(), number))
        open_brackets += sum(bare.count(sign) for sign in "[{") - sum(bare.count(sign) for sign in "]}")
    if open_brackets:
        raise YamlError("a bracket is not closed")
    return lines


def _without_comment(line: str) -> str:
    quoted: str | None = None
    for place, sign in enumerate(line):
        if quoted:
            quoted = None if sign == quoted else quoted
        elif sign in "\"'":
            quoted = sign
        elif sign == "#" and (place == 0 or line[place - 1] in " \t"):
            return line[:place].rstrip()
    return line.rstrip()


def _block(lines: list[Line], at: int, indent: int, depth: int) -> tuple[Any, int]:
    """The value of lines from `at` on that are indented by `indent`, and the line after it."""
    if depth > MAX_DEPTH:
        raise YamlError(f"line {lines[at][2]}: nested too deeply")
    if lines[at][1].startswith("- ") or lines[at][1] == "-":
        return _sequence(lines, at, indent, depth)
    mapping: dict[str, Any] = {}
    while at < len(lines) and lines[at][0] == indent:
        _, text, number = lines[at]
        found = re.match(r"(\"[^\"]*\"|'[^']*'|[^\s:\[\]{}][^:]*?)\s*:(?:\s+(.*))?$", text)
        if not found:
            raise YamlError(f"line {number}: needed KEY: VALUE")
        key, value = found[1].strip("\"'"), _without_tag(found[2] or "")
        if value:
            mapping[key] = _scalar(value, number)
            at += 1
        elif at + 1 < len(lines) and (
            lines[at + 1][0] > indent or (lines[at + 1][0] == indent and lines[at + 1][1].startswith("- "))
        ):
            mapping[key], at = _block(lines, at + 1, lines[at + 1][0], depth + 1)
        else:
            mapping[key], at = None, at + 1
    return mapping, at


def _sequence(lines: list[Line], at: int, indent: int, depth: int) -> tuple[list[Any], int]:
    items: list[Any] = []
    while at < len(lines) and lines[at][0] == indent and (lines[at][1].startswith("- ") or lines[at][1] == "-"):
        _, text, number = lines[at]
        value = text[1:].strip()
        if not value and at + 1 < len(lines) and lines[at + 1][0] > indent:
            item, at = _block(lines, at + 1, lines[at + 1][0], depth + 1)
        elif re.match(r"[^\s\"'\[{][^:]*:(\s|$)", value) or value.startswith("- "):
            inner = indent + len(text) - len(text[1:].lstrip())
            item, at = _block([*lines[:at], (inner, value, number), *lines[at + 1 :]], at, inner, depth + 1)
        else:
            item, at = _scalar(value, number), at + 1
        items.append(item)
    return items, at


def _without_tag(value: str) -> str:
    return re.sub(r"^!\S+\s*", "", value)


def _scalar(text: str, number: int) -> Any:
    text = text.strip()
    if text.startswith(("[", "{")):
        value, rest = _flow(text, number, 0)
        if rest.strip():
            raise YamlError(f"line {number}: text after a bracket")
        return value
    if text[:1] in ("&", "*", "|", ">"):
        raise YamlError(f"line {number}: {text[:1]} is not read")
    return _plain(text)


def _plain(text: str) -> Any:
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    if NUMBER.match(text):
        return int(text) if re.fullmatch(r"[-+]?\d+", text) else float(text)
    return {"true": True, "false": False, "null": None, "~": None, "": None}.get(text.lower(), text)


def _flow(text: str, number: int, depth: int) -> tuple[Any, str]:
    """A flow collection or scalar at the start of a text, and the rest."""
    if depth > MAX_DEPTH:
        raise YamlError(f"line {number}: nested too deeply")
    text = text.lstrip()
    if text.startswith("["):
        items, rest = [], text[1:].lstrip()
        while not rest.startswith("]"):
            item, rest = _flow(rest, number, depth + 1)
            items.append(item)
            rest = _after_comma(rest, "]", number)
        return items, rest[1:]
    if text.startswith("{"):
        mapping, rest = {}, text[1:].lstrip()
        while not rest.startswith("}"):
            key, colon, rest = rest.partition(":")
            if not colon:
                raise YamlError(f"line {number}: needed KEY: VALUE in braces")
            mapping[key.strip().strip("\"'")], rest = _flow(rest, number, depth + 1)
            rest = _after_comma(rest, "}", number)
        return mapping, rest[1:]
    found = re.match(r"\"[^\"]*\"|'[^']*'|[^,\[\]{}]*", text)
    taken = found[0] if found else ""
    return _plain(taken.strip()), text[len(taken) :]


def _after_comma(rest: str, end: str, number: int) -> str:
    rest = rest.lstrip()
    if rest.startswith(","):
        return rest[1:].lstrip()
    if not rest.startswith(end):
        raise YamlError(f"line {number}: needed , or {end}")
    return rest
