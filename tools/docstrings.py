"""What the source says of a type's fields: the string below each, which Python itself throws away."""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
import sys


def fields(kind: type) -> dict[str, str]:
    """Return the docstring of each field of a class that has one, on one line."""
    return _of_module(kind.__module__).get(kind.__name__, {})


@functools.cache
def _of_module(name: str) -> dict[str, dict[str, str]]:
    tree = ast.parse(inspect.getsource(sys.modules[name]))
    return {node.name: _of_class(node) for node in tree.body if isinstance(node, ast.ClassDef)}


def _of_class(node: ast.ClassDef) -> dict[str, str]:
    found = {}
    for field, below in itertools.pairwise(node.body):
        match field, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                found[name] = " ".join(text.split())
    return found
