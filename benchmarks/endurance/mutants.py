"""Mutants: one operator, number or condition of a file changed, in Python or in C."""

from __future__ import annotations

import ast
import hashlib
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

SWAPPED = {
    "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "is": "is not", "is not": "is",
    "+": "-", "-": "+", "*": "/", "/": "*", "//": "*", "%": "*", "**": "*", "&": "|", "|": "&",
    "+=": "-=", "-=": "+=", "*=": "/=", "/=": "*=", "&=": "|=", "|=": "&=",
    "and": "or", "or": "and", "&&": "||", "||": "&&",
}  # fmt: skip
OF_PYTHON = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.Is: "is",
    ast.IsNot: "is not", ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%",
    ast.Pow: "**", ast.BitAnd: "&", ast.BitOr: "|", ast.And: "and", ast.Or: "or",
}  # fmt: skip
SIGNS = {ast.Invert: "~", ast.Not: "not ", ast.USub: "-"}  # left out
# In C, operators with a space on both sides: a star before a pointer's name has none.
C_OPERATOR = re.compile(r"(?<= )(<=|>=|==|!=|&&|\|\||[-+*/&|]=|[-+*/<>&|])(?= )")
C_HEX, C_DECIMAL = r"0x[0-9a-fA-F]+(?:\.[0-9a-fA-F]*)?(?:p[-+]?\d+)?", r"\d+(?:\.\d*)?(?:e[-+]?\d+)?"
C_NUMBER = re.compile(rf"(?<![\w.])({C_HEX}|{C_DECIMAL})[fuL]*\b")
C_SIGN = re.compile(r"(~|!(?!=))(?=[\w(])")
NOT_CODE = re.compile(r"/\*.*?\*/|//[^\n]*|\"[^\"\n]*\"|^[ \t]*#(?!define)[^\n]*", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Mutant:
    """A file's text with the bytes from `start` to `stop`, which are `old`, replaced by `new`."""

    path: str  # relative to the repository
    line: int
    column: int
    start: int
    stop: int
    old: str
    new: str
    code: str  # the line as it was
    key: str  # stays the same until the line changes

    def applied(self, text: bytes) -> bytes:
        return text[: self.start] + self.new.encode() + text[self.stop :]


def mutants_of(root: Path, path: Path) -> list[Mutant]:
    """All mutants of a file, in its order."""
    text = path.read_bytes()
    found = set(_of_python(text) if path.suffix == ".py" else _of_c(text.decode()))
    lines, made, equal = text.split(b"\n"), [], Counter[str]()
    for start, stop, new in sorted(found):
        line, column = text[:start].count(b"\n"), start - text.rfind(b"\n", 0, start)
        old, code, place = text[start:stop].decode(), lines[line].decode().strip(), str(path.relative_to(root))
        key = f"{place}: {code}: {old} to {new} at {column}"
        equal[key] += 1
        made.append(Mutant(place, line + 1, column, start, stop, old, new, code, f"{key}, {equal[key]}"))
    return made


def sampled(mutants: Sequence[Mutant], count: int, seed: int) -> list[Mutant]:
    """`count` of the mutants, the same for the same seed: changed lines replace their own mutants alone."""
    return sorted(mutants, key=lambda m: hashlib.sha256(f"{seed} {m.key}".encode()).digest())[:count]


def _of_python(text: bytes) -> Iterator[tuple[int, int, str]]:
    """Start, stop and new text of each change."""
    starts = [0]
    for line in text.split(b"\n"):
        starts.append(starts[-1] + len(line) + 1)

    def begin(node: ast.expr) -> int:
        return starts[node.lineno - 1] + node.col_offset

    def end(node: ast.expr) -> int:
        return starts[(node.end_lineno or 1) - 1] + (node.end_col_offset or 0)

    def swap(left: ast.expr, operator: ast.AST, right: ast.expr) -> Iterator[tuple[int, int, str]]:
        word = OF_PYTHON.get(type(operator))
        if word is not None:
            at = text.index(word.encode(), end(left), begin(right))
            yield at, at + len(word), SWAPPED[word]

    for node in _computing(ast.parse(text)):
        if isinstance(node, ast.Compare):
            for left, operator, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
                yield from swap(left, operator, right)
        elif isinstance(node, ast.BinOp):
            yield from swap(node.left, node.op, node.right)
        elif isinstance(node, ast.BoolOp):
            yield from swap(node.values[0], node.op, node.values[1])
        elif isinstance(node, ast.UnaryOp) and type(node.op) in SIGNS and not isinstance(node.operand, ast.Constant):
            yield begin(node), begin(node) + len(SIGNS[type(node.op)]), ""
        elif isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float)):
            number = node.value
            new = str(not number) if isinstance(number, bool) else _other(str(number))
            yield begin(node), end(node), new


def _computing(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes below, without annotations and the `strict` of zip: they compute nothing."""
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return
    for name, child in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for part in child if isinstance(child, list) else [child]:
            if isinstance(part, ast.AST):
                yield part
                yield from _computing(part)


def _of_c(text: str) -> Iterator[tuple[int, int, str]]:
    """The same of C; its files are ASCII."""
    seen = NOT_CODE.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), text)
    for found in C_OPERATOR.finditer(seen):
        yield found.start(), found.end(), SWAPPED[found[0]]
    for found in C_SIGN.finditer(seen):
        yield found.start(), found.end(), ""
    for found in C_NUMBER.finditer(seen):
        yield found.start(1), found.end(1), _other(found[1])


def _other(number: str) -> str:
    """A whole number plus one; any other number twice, and 1.0 for 0.0."""
    if number.startswith("0x"):
        return f"(2 * {number})" if "p" in number else hex(int(number, 16) + 1)
    if number.isdigit():
        return str(int(number) + 1)
    return "1.0" if float(number) == 0.0 else repr(2.0 * float(number))
