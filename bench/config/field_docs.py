"""Docstrings of fields, which Python drops: they stand below the fields in the source."""

from __future__ import annotations

import ast
import inspect
import textwrap
from itertools import pairwise
from typing import Any


def field_docs(kind: Any) -> dict[str, str]:
    """Return the docstrings of the fields of class `kind`, without those that it inherits."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    found = {}
    body = getattr(definition, "body", [])
    for node, below in pairwise(body):
        match node, below:
            case (ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as text))):
                found[name] = text
    return found
