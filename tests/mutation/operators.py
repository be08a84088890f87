"""Sites of a Python source that can be mutated, each with the text that replaces it.

A mutation keeps the source valid Python and changes what it computes: a comparison, an operator, a number, a condition,
a truth value, or a statement that is left out. Strings, messages of exceptions and annotations are left alone.
"""

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass

COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
}
OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.Pow: "*",
    ast.FloorDiv: "/",
    ast.Mod: "*",
    ast.BitAnd: "|",
    ast.BitOr: "&",
}


Span = Callable[[ast.expr | ast.stmt], tuple[int, int]]


@dataclass(frozen=True)
class Site:
    """A stretch of a source, `start` to `end` in characters, and what stands there instead."""

    start: int
    end: int
    line: int
    replacement: str

    def applied(self, source: str) -> str:
        """The mutated source."""
        return source[: self.start] + self.replacement + source[self.end :]


def sites(source: str) -> list[Site]:
    """All sites of a source, in order of their place."""
    tree = ast.parse(source)
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    lines = source.splitlines(keepends=True)

    def place(line: int, column: int) -> int:
        # The parser counts columns in UTF-8 bytes.
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    def span(node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return place(node.lineno, node.col_offset), place(node.end_lineno, node.end_col_offset)

    found = [
        Site(start, end, line, replacement)
        for node in _computing(tree)
        for start, end, line, replacement in _of_node(node, source, span)
    ]
    return sorted(found, key=lambda site: (site.start, site.end, site.replacement))


def _computing(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that compute: no annotation, no message of an exception, no check for type checkers."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "exc", "msg", "type_comment"):
            continue
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr):
                yield from _computing(child)


def _of_node(node: ast.AST, source: str, span: Span) -> Iterator[tuple[int, int, int, str]]:
    if isinstance(node, ast.Compare):
        left = node.left
        for operator, right in zip(node.ops, node.comparators, strict=True):
            between = span(left)[1], span(right)[0]
            yield *between, node.lineno, _around(source, *between, COMPARISONS[type(operator)])
            left = right
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS and not _is_text(node):
        between = span(node.left)[1], span(node.right)[0]
        yield *between, node.lineno, _around(source, *between, OPERATORS[type(node.op)])
    elif isinstance(node, ast.BoolOp):
        swapped = "or" if isinstance(node.op, ast.And) else "and"
        between = span(node.values[0])[1], span(node.values[1])[0]
        if len(node.values) == 2:
            yield *between, node.lineno, _around(source, *between, swapped)
    elif isinstance(node, ast.Constant) and type(node.value) in (bool, int, float):
        yield *span(node), node.lineno, _other_constant(node.value)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        start, end = span(node)
        inner = span(node.operand)
        yield start, end, node.lineno, f"({source[inner[0] : inner[1]]})"
    elif isinstance(node, ast.IfExp | ast.If | ast.While):
        start, end = span(node.test)
        yield start, end, node.lineno, f"not ({source[start:end]})"
    elif isinstance(node, ast.AugAssign) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield *span(node), node.lineno, "pass"


def _around(source: str, start: int, end: int, operator: str) -> str:
    """The text between two operands with another operator; parentheses and line breaks are kept."""
    before = source[start:end]
    closing = before[: len(before) - len(before.lstrip(") \n\t"))]
    opening = before[len(before.rstrip("( \n\t")) :]
    return f"{closing or ' '} {operator} {opening or ' '}"


def _is_text(node: ast.BinOp) -> bool:
    return any(
        isinstance(side, ast.JoinedStr) or (isinstance(side, ast.Constant) and isinstance(side.value, str))
        for side in (node.left, node.right)
    )


def _other_constant(value: bool | int | float) -> str:
    if isinstance(value, bool):
        return str(not value)
    if isinstance(value, int):
        return str(value + 1)
    return repr(value * 1.1) if value else "1.0"
