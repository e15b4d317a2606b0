"""Docstrings of fields, which Python drops: they stand below the fields in the source."""

from __future__ import annotations

import ast
import inspect
import sys
from functools import cache
from itertools import pairwise
from typing import Any


def field_docs(kind: Any) -> dict[str, str]:
    """Return the docstrings of the fields of class `kind` of a module, without those that it inherits."""
    found = {}
    for node, below in pairwise(_bodies(kind.__module__).get(kind.__name__, [])):
        match node, below:
            case (ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as text))):
                found[name] = text
    return found


@cache
def _bodies(module: str) -> dict[str, list[ast.stmt]]:
    """Return the statements of each class of `module`, whose source is read once."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: node.body for node in tree.body if isinstance(node, ast.ClassDef)}
