"""Small mistakes put into a source file, one at a time, as by a careless edit.

Not mutated: docstrings and texts for people, annotations, decorators, imports.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

_COMPARE: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}
_BINARY: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
}
_CALLS = {"min": "max", "max": "min", "cos": "sin", "sin": "cos"}
_UNTOUCHED = ("annotation", "returns", "decorator_list", "type_params")
"""Fields of nodes that do nothing when the code runs."""
_REMOVED = (ast.AugAssign, ast.Continue, ast.Break)
"""Statements that one mutant does without; also assignments to what outlives the function, and calls."""

Members = Mapping[str, tuple[str, ...]]
"""Enumerations by the name they have in the source; a member becomes the next one."""


class Mutant(NamedTuple):
    """One changed source: the line's number and text, what became of what, and its number among such."""

    line: int
    text: str
    change: str
    nth: int
    source: str

    @property
    def name(self) -> str:
        """Unique name among the module's mutants, independent of line numbers."""
        again = f" ({self.nth})" if self.nth > 1 else ""
        return f"{self.text}: {self.change}{again}"


class _Place(NamedTuple):
    """Where a node hangs, and in what."""

    node: ast.AST
    parent: ast.AST
    field: str
    position: int | None


def mutants(source: str, members: Members | None = None) -> Iterator[Mutant]:
    """Yield every mutant of `source`."""
    tree, lines = ast.parse(source), source.splitlines()
    original = ast.unparse(tree)
    seen: Counter[tuple[str, str]] = Counter()
    for location in list(_places(tree)):
        for new in _changes(location.node, members or {}):
            change = f"{_head(location.node)} -> {_head(new)}"
            _put(location, new)
            mutated = ast.unparse(ast.fix_missing_locations(tree))
            _put(location, location.node)
            if mutated != original:
                line = getattr(location.node, "lineno", 0)
                text = lines[line - 1].strip()
                seen[text, change] += 1
                yield Mutant(line, text, change, seen[text, change], mutated)


def _places(parent: ast.AST) -> Iterator[_Place]:
    """Yield the nodes below `parent` that may be changed."""
    for field, value in ast.iter_fields(parent):
        if field in _UNTOUCHED:
            continue
        for index, child in enumerate(value if isinstance(value, list) else [value]):
            if isinstance(child, ast.AST) and not isinstance(child, ast.Import | ast.ImportFrom):
                yield _Place(child, parent, field, index if isinstance(value, list) else None)
                yield from _places(child)


def _head(node: ast.AST) -> str:
    """Return `node` as source, of a compound statement its first line."""
    return ast.unparse(node).split("\n")[0]


def _changes(node: ast.AST, members: Members) -> Iterator[ast.AST]:
    """Yield the mutants of `node`."""
    match node:
        case ast.Compare(left=left, ops=ops, comparators=right):
            for k, op in enumerate(ops):
                for other in _COMPARE.get(type(op), ()):
                    yield ast.Compare(left, [*ops[:k], other(), *ops[k + 1 :]], right)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            yield ast.BinOp(left, _BINARY[type(op)](), right)
        case ast.BoolOp(op=op, values=values):
            yield ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
            for k in range(len(values)):
                rest = [*values[:k], *values[k + 1 :]]
                yield ast.BoolOp(op, rest) if len(rest) > 1 else rest[0]
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield operand
        case ast.If(test=test, body=body, orelse=orelse):
            yield ast.If(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.IfExp(test=test, body=body, orelse=orelse):
            yield ast.IfExp(test, orelse, body)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=keywords) if name in _CALLS:
            yield ast.Call(ast.Name(_CALLS[name], ast.Load()), args, keywords)
        case ast.Call(func=ast.Name(id="abs"), args=[argument]):
            yield argument
        case ast.Attribute(value=ast.Name(id=owner) as enumeration, attr=member) if owner in members:
            names = members[owner]
            if member in names:
                yield ast.Attribute(enumeration, names[(names.index(member) + 1) % len(names)], ast.Load())
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant):
            yield ast.Return(ast.Constant(0))
        case ast.Constant(value=bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield ast.Constant(value + 1)
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]) | ast.Expr(value=ast.Call()):
            yield ast.Pass()
        case _ if isinstance(node, _REMOVED):
            yield ast.Pass()


def _put(location: _Place, node: ast.AST) -> None:
    if location.position is None:
        setattr(location.parent, location.field, node)
    else:
        getattr(location.parent, location.field)[location.position] = node
