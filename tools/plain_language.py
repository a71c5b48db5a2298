"""Find names and sentences that an engineer who is new to the project may not understand.

python tools/plain_language.py                        list every place
python tools/plain_language.py service/trirail/wire   list the places in a folder or in a file

plain_language.toml lists the words, the beginnings of docstrings and the phrases to find. It also lists exceptions with
their reasons: names that are keys of messages or recordings. tests/test_language.py fails if there is any other place.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
WORDS = Path(__file__).with_suffix(".toml")
CONTEXT = 40
"""Number of characters shown on either side of a phrase."""


class Place(NamedTuple):
    """Name or sentence to review."""

    file: str
    line: int
    rule: str
    text: str

    @property
    def key(self) -> str:
        """Key of the place among the exceptions."""
        return f"{self.file}: {self.text}"


class _Rules:
    """Word lists of plain_language.toml as sets and compiled patterns."""

    def __init__(self) -> None:
        lists = tomllib.loads(WORDS.read_text(encoding="utf-8"))
        names = lists["names"]
        classes, endings = "|".join(names["classes"]), "|".join(names["class_endings"])
        self.class_name = re.compile(rf"_?(?:{classes}|\w+(?:{endings}))")
        self.verbs = frozenset(names["verbs"])
        self.constants = frozenset(names["constants"])
        self.arguments = frozenset(names["arguments"])
        self.variables = frozenset(names["variables"])
        self.opening = re.compile(rf"(?:{'|'.join(lists['docstrings']['openings'])})\b")
        self.phrases = {name: re.compile(pattern) for name, pattern in lists["phrases"].items()}

    def names(self, node: ast.AST) -> Iterator[tuple[int, str, str]]:
        """Yield the line, rule and text of each name that a node defines and that is in one of the lists."""
        match node:
            case ast.ClassDef(name=name) if self.class_name.fullmatch(name):
                yield node.lineno, "class", name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                bare = name.strip("_")
                if bare in self.verbs or bare.split("_")[0] in self.verbs:
                    yield node.lineno, "function", name
            case ast.arg(arg=name) if name in self.arguments:
                yield node.lineno, "argument", name
            case ast.Name(id=name, ctx=ast.Store()) if name in self.variables:
                yield node.lineno, "variable", name

    def sentences(self, line: int, text: str) -> Iterator[tuple[int, str, str]]:
        """Yield the line, rule and context of each listed phrase in a text."""
        for rule, pattern in self.phrases.items():
            for hit in pattern.finditer(text):
                yield line, rule, text[max(0, hit.start() - CONTEXT) : hit.end() + CONTEXT].strip()


@cache
def _rules() -> _Rules:
    return _Rules()


def places_in_python(source: str) -> Iterator[tuple[int, str, str]]:
    """Yield the line, rule and text of each place in Python source code."""
    rules, tree = _rules(), ast.parse(source)
    for statement in tree.body:
        targets = (
            statement.targets
            if isinstance(statement, ast.Assign)
            else [statement.target]
            if isinstance(statement, ast.AnnAssign)
            else []
        )
        for target in targets:
            if isinstance(target, ast.Name) and target.id.strip("_") in rules.constants:
                yield statement.lineno, "constant", target.id
    for node in ast.walk(tree):
        yield from rules.names(node)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            summary = " ".join(node.value.value.split("\n\n")[0].split())
            if rules.opening.match(summary):
                yield node.lineno, "docstring", summary[: 2 * CONTEXT]
            yield from rules.sentences(node.lineno, " ".join(node.value.value.split()))
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield from rules.sentences(token.start[0], token.string.lstrip("# "))
        elif token.type == tokenize.STRING and " " in token.string and not token.string.startswith(('"""', "r", "b")):
            yield from rules.sentences(token.start[0], token.string)


def places_in_guide(text: str) -> Iterator[tuple[int, str, str]]:
    """Yield the line, rule and text of each place in a Markdown page, except in code."""
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        fenced ^= line.lstrip().startswith("```")
        if not fenced and not line.startswith("    "):
            yield from _rules().sentences(number, re.sub(r"`[^`]*`|\[([^]]*)\]\([^)]*\)", r"\1", line))


def places(file: str) -> list[Place]:
    """Return the places in a file, whose path is relative to the checkout."""
    text = (ROOT / file).read_text(encoding="utf-8")
    look = places_in_guide if file.endswith(".md") else places_in_python
    return [Place(file, *place) for place in look(text)]


def files() -> list[str]:
    """Return the files to check: source code, tools and guides."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard", "*.py", "*.md"],
                            cwd=ROOT, capture_output=True, text=True, check=True)  # fmt: skip
    return sorted(file for file in listed.stdout.split() if not file.startswith("tests/") and (ROOT / file).exists())


def exceptions() -> dict[str, str]:
    """Return the reason for each permitted place, by file and text, such as "wire/packets.py: given"."""
    reasons: dict[str, str] = tomllib.loads(WORDS.read_text(encoding="utf-8"))["exceptions"]
    return reasons


def main() -> int:
    """Print the places in the given folders and files, or everywhere; return 1 if one of them is not an exception."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("paths", nargs="*", default=[""], help="folders and files; default: all")
    reasons, left, known = exceptions(), 0, files()
    chosen = set()
    for path in parser.parse_args().paths:
        below = [file for file in known if file == path or file.startswith(path and path.rstrip("/") + "/")]
        if not below:
            parser.error(f"{path}: no file to check; a path is relative to {ROOT}, and not in tests/")
        chosen.update(below)
    for file in sorted(chosen):
        for place in places(file):
            reason = reasons.get(place.key)
            left += reason is None
            print(f"{place.file}:{place.line}: {place.rule}: {place.text}" + (f" ({reason})" if reason else ""))
    return int(left > 0)


if __name__ == "__main__":
    sys.exit(main())
