"""A goal's kind and a robot's mechanism are known where they are at home: everybody else asks their faces."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
import trirail
from trirail.wire.goals import Goal
from trirail.wire.vocabulary import Command

PACKAGE = Path(trirail.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))
GOALS = {kind.__name__ for kind in get_args(Goal)}
TAGS = {kind.__struct_config__.tag for kind in get_args(Goal)}
LEGS = {"Leg", "CrossLeg"}
KINDS = {"3-PRP", "3-PPR"}
AT_HOME = {
    "goals": ("wire/kinds/", "motion/kinds/"),
    "mechanisms": ("kinematics/", "config/tables.py"),
}
KNOWN = {
    # A name becomes a pose where the named poses are; maps are older than the second mechanism.
    ("processes/poses.py", "isinstance(goal, NamedGoal)"),
    # A trajectory alone has parts: the client cuts it, and the gateway puts it together.
    ("client/outgoing.py", "isinstance(goal, TrajectoryGoal)"),
    ("processes/gateway.py", "isinstance(sent, TrajectoryGoal)"),
    ("config/as_built.py", "robot.kind == '3-PRP'"),
}


def names(node: ast.AST) -> set[str]:
    """Return the names in an expression, and the last ones of attributes."""
    inside = list(ast.walk(node))
    return {each.id for each in inside if isinstance(each, ast.Name)} | {
        each.attr for each in inside if isinstance(each, ast.Attribute)
    }


def texts(node: ast.AST) -> set[str]:
    """Return the texts in an expression."""
    return {each.value for each in ast.walk(node) if isinstance(each, ast.Constant) and isinstance(each.value, str)}


def asked(tree: ast.AST, classes: set[str], words: set[str], attributes: set[str]) -> Iterator[str]:
    """Yield where it is asked of which class an object is, or which of some words an attribute of it holds."""
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name("isinstance" | "issubclass"), args=[_, kind]) if names(kind) & classes:
                yield ast.unparse(node)
            case ast.Compare() if texts(node) & words and names(node) & attributes:
                yield ast.unparse(node)
            case ast.Compare() if "type" in names(node) and names(node) & classes:
                yield ast.unparse(node)
            case ast.MatchClass(cls=kind) if names(kind) & classes:
                yield ast.unparse(kind)
            case ast.Match(subject=subject, cases=cases) if names(subject) & attributes:
                yield from (ast.unparse(case.pattern) for case in cases if texts(case.pattern) & words)


def elsewhere(of: str, classes: set[str], words: set[str]) -> set[tuple[str, str]]:
    """Return where that is asked outside of where it is at home."""
    found = set()
    for path in SOURCES:
        name = path.relative_to(PACKAGE).as_posix()
        if not name.startswith(AT_HOME[of]):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found |= {(name, told) for told in asked(tree, classes, words, {"kind"})}
    return found


def test_nobody_else_asks_of_which_kind_a_goal_is() -> None:
    found = elsewhere("goals", GOALS, TAGS)
    assert found - KNOWN == {("panel/feed.py", "event.kind == 'pose'")}  # of an event, that poses have changed


def test_nobody_else_asks_of_which_mechanism_a_robot_is() -> None:
    assert elsewhere("mechanisms", LEGS, KINDS) - KNOWN == set()


@pytest.mark.parametrize("word", ["lambda_32", "lambda_21", "summit"])
def test_the_parts_of_one_mechanism_are_named_in_its_room_alone(word: str) -> None:
    told = [path.relative_to(PACKAGE).parts[0] for path in SOURCES if word in path.read_text(encoding="utf-8")]
    assert set(told) <= {"kinematics"}


def test_commands_are_asked_for_by_their_rows() -> None:
    """Which command it is, is asked where it is carried out; everybody else asks what is true of it."""
    commands = {command.name for command in Command}
    found = set()
    for path in SOURCES:
        room = path.relative_to(PACKAGE).parts[0]
        if room not in ("wire", "client", "cli", "panel"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Compare) and "Command" in names(node) and names(node) & commands:
                    found.add(f"{path.relative_to(PACKAGE).as_posix()}: {ast.unparse(node)}")
    assert found == {"control/transitions.py: name is not Command.HOME"}, "homing alone sends away goals that wait"


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("isinstance(goal, (goals.PoseGoal, int))", 1),
        ("goal.kind == 'pose'", 1),
        ("goal.kind in ('pose', 'move')", 1),
        ("type(goal) is PoseGoal", 1),
        ("match goal:\n    case PoseGoal(x=1.0): pass", 1),
        ("match goal.kind:\n    case 'pose' | 'move': pass", 1),
        ("goal.renewed and goal.kind", 0),
        ("name == 'pose'", 0),
    ],
)
def test_whatever_way_it_is_asked_is_seen(code: str, found: int) -> None:
    assert len(list(asked(ast.parse(code), GOALS, TAGS, {"kind"}))) == found
