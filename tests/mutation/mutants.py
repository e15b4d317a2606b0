"""Small mistakes put into a source file, one at a time: what a careless edit might do.

Not mutated: docstrings and texts for people, annotations, decorators, `if TYPE_CHECKING`.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from typing import NamedTuple

_COMPARE: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
}  # fmt: skip
_BINARY: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
}  # fmt: skip
_CALLS = {"min": "max", "max": "min", "cos": "sin", "sin": "cos"}
_MEMBERS = {
    "Reaction": ("COMPLETE", "BRAKE", "BLIND_BRAKE", "PASSIVE", "VENT"),
    "_S": ("ESTOP", "SAFE", "HOMING", "READY", "ARMED", "SWINGING", "RECOVERING", "ACCESS", "FAULT"),
    "Request": ("ARM", "SWING", "DISARM", "RESET", "HOME", "ACCESS", "SECURE", "TEE", "STOP"),
}
"""Entries of the tables; each becomes the next one."""


class Mutant(NamedTuple):
    """One changed source."""

    line: int
    what: str
    source: str


def mutants(source: str) -> Iterator[Mutant]:
    """Yield every mutant of `source`."""
    tree = ast.parse(source)
    count = sum(1 for _ in _places(tree))
    for number in range(count):
        changed = copy.deepcopy(tree)
        node, parent, field, index = list(_places(changed))[number]
        for what, new in _changes(node):
            before = ast.unparse(node)
            _put(parent, field, index, new)
            text = f"{before} -> {ast.unparse(new) if new is not None else what}"
            yield Mutant(getattr(node, "lineno", 0), text, ast.unparse(ast.fix_missing_locations(changed)))
            _put(parent, field, index, node)


def _places(tree: ast.AST) -> Iterator[tuple[ast.AST, ast.AST, str, int | None]]:
    """Yield the nodes that may be changed, with where they hang."""
    for parent in ast.walk(tree):
        for field, value in ast.iter_fields(parent):
            if field in ("annotation", "returns", "decorator_list", "keywords") and field != "keywords":
                continue
            children = value if isinstance(value, list) else [value]
            for index, child in enumerate(children):
                if isinstance(child, ast.AST) and not _is_text(parent, child) and _changes_exist(child):
                    yield child, parent, field, index if isinstance(value, list) else None


def _is_text(parent: ast.AST, child: ast.AST) -> bool:
    """Tell whether `child` is prose, or a name of a field."""
    return isinstance(child, ast.Expr | ast.Constant) and isinstance(
        getattr(child, "value", None), str | ast.Constant
    ) and not isinstance(getattr(child, "value", None), bool)  # fmt: skip


def _changes_exist(node: ast.AST) -> bool:
    return next(_changes(node), None) is not None


def _changes(node: ast.AST) -> Iterator[tuple[str, ast.AST | None]]:
    """Yield what may be made of `node`; None takes a statement away."""
    match node:
        case ast.Compare(left=left, ops=[op], comparators=right):
            for other in _COMPARE.get(type(op), ()):
                yield "", ast.Compare(left, [other()], right)
        case ast.Compare(left=left, ops=ops, comparators=right):
            for k, op in enumerate(ops):
                for other in _COMPARE.get(type(op), ()):
                    yield "", ast.Compare(left, [*ops[:k], other(), *ops[k + 1 :]], right)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            yield "", ast.BinOp(left, _BINARY[type(op)](), right)
        case ast.BoolOp(op=op, values=values):
            yield "", ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
            for k in range(len(values)):
                rest = [*values[:k], *values[k + 1 :]]
                yield "", ast.BoolOp(op, rest) if len(rest) > 1 else rest[0]
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield "", operand
        case ast.If(test=test, body=body, orelse=orelse):
            yield "", ast.If(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.IfExp(test=test, body=body, orelse=orelse):
            yield "", ast.IfExp(test, orelse, body)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=keywords) if name in _CALLS:
            yield "", ast.Call(ast.Name(_CALLS[name], ast.Load()), args, keywords)
        case ast.Call(func=ast.Name(id="abs"), args=[argument]):
            yield "", argument
        case ast.Attribute(value=ast.Name(id=enumeration) as owner, attr=member) if others := _MEMBERS.get(
            enumeration
        ):
            if member in others:
                following = others[(others.index(member) + 1) % len(others)]
                yield "", ast.Attribute(owner, following, ast.Load())
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant):
            yield "", ast.Return(ast.Constant(0))
        case ast.Constant(value=bool() as value):
            yield "", ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield "", ast.Constant(value + 1)
        case ast.AugAssign() | ast.Continue() | ast.Break():
            yield "pass", ast.Pass()


def _put(parent: ast.AST, field: str, index: int | None, new: ast.AST | None) -> None:
    if index is None:
        setattr(parent, field, new)
    else:
        getattr(parent, field)[index] = new
