"""Docstrings of a type's fields: the string below each field in the source code, which Python itself discards."""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
import sys

from msgspec import Struct


def fields(kind: type) -> dict[str, str]:
    """Return the docstring, own or inherited, of each documented field of a Struct or NamedTuple, on one line."""
    end = Struct if issubclass(kind, Struct) else tuple
    return {
        field: text
        for each in reversed(kind.__mro__[: kind.__mro__.index(end)])
        for field, text in _module_fields(each.__module__).get(each.__name__, {}).items()
    }


@functools.cache
def _module_fields(name: str) -> dict[str, dict[str, str]]:
    tree = ast.parse(inspect.getsource(sys.modules[name]))
    return {node.name: _class_fields(node) for node in tree.body if isinstance(node, ast.ClassDef)}


def _class_fields(node: ast.ClassDef) -> dict[str, str]:
    texts = {}
    for field, below in itertools.pairwise(node.body):
        match field, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                texts[name] = " ".join(text.split())
    return texts
