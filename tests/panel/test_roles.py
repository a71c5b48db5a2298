"""What a role may do at the page: all else is not offered there, and refused where it is asked for all the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from chromium import Page, needs_chromium
from hypothesis import given, settings
from hypothesis import strategies as st
from panel.fake_robot import FakeRobot
from trirail.panel.permissions import permissions
from trirail.panel.server import Panel
from trirail.wire.vocabulary import Command, Override, Role, SetOutput
from waiting import WITHIN, wait_until
from websockets.sync.client import connect

MOTION = {"goal", "enable", "disable", "quick_stop", "pause", "resume", "override"}
OPERATOR = MOTION | {"set_output", "acquire", "release"}
MAINTAINER = OPERATOR | {"poses", "takeover", "reset", "home"}
MAY: dict[Role | None, set[str]] = {
    None: set(),
    Role.VIEWER: {"stop"},
    Role.OPERATOR: OPERATOR | {"stop"},
    Role.MAINTAINER: MAINTAINER | {"stop"},
}
"""Once more, by hand."""
PATH = b"t,x,y,phi\n0,0.01,0.005,0.1\n1,0.011,0.005,0.1\n"
ACTIONS: list[tuple[str, dict[str, Any]]] = [
    *(
        (name, {"do": "command", "name": name, "seen": 10**15})
        for name in Command
        if name.content not in (Override, SetOutput)
    ),
    ("override", {"do": "command", "name": "override", "content": {"percent": 50.0}, "seen": 10**15}),
    (
        "set_output",
        {"do": "command", "name": "set_output", "content": {"output": "valve", "value": True}, "seen": 10**15},
    ),
    ("takeover", {"do": "takeover", "seen": 10**15}),
    ("goal", {"do": "hold", "velocity": [0.01, 0.0, 0.0], "seen": 10**15}),
    ("goal", {"do": "goal", "goal": {"kind": "move", "x": 0.001, "y": 0.0, "phi": 0.0}, "seen": 10**15}),
    ("goal", {"do": "goal", "goal": {"kind": "named", "name": "park"}, "seen": 10**15}),
    ("goal", {"do": "goal", "goal": {"kind": "pose", "x": 0.0, "y": 0.0, "phi": 0.0}, "seen": 10**15}),
    ("goal", {"do": "follow", "file": 1, "seen": 10**15}),
    ("poses", {"do": "teach", "name": "here", "seen": 10**15}),
    ("poses", {"do": "forget", "name": "park", "seen": 10**15}),
]


@pytest.mark.parametrize("role", MAY)
@pytest.mark.parametrize("takeover", Role)
def test_a_role_may_what_the_table_says(role: Role | None, takeover: Role) -> None:
    taking = {"takeover"} if role is not None and role.includes(takeover) else set()
    assert permissions(role, takeover) == MAY[role] - {"takeover"} | taking


def done(robot: FakeRobot) -> list[Any]:
    """All that has reached the robot."""
    return [*robot.commands, *robot.sent, *robot.gone_to, *robot.moved_to, *robot.followed, *robot.forced, *robot.named]


@settings(max_examples=60, deadline=None)
@given(role=st.sampled_from(list(MAY)), action=st.sampled_from(ACTIONS), enabled=st.booleans())
def test_what_a_role_may_not_reaches_no_robot(
    role: Role | None, action: tuple[str, dict[str, Any]], enabled: bool
) -> None:
    needs, message = action
    robot = FakeRobot()
    robot.granted, robot.mode = role, "holding" if enabled else "disabled"
    before = done(robot)
    with (
        Panel(robot.robot(), 0) as panel,
        connect(f"{panel.url.replace('http', 'ws')}socket", legacy=True) as opened,
    ):
        opened.send(msgspec.json.encode({"do": "upload", "file": 1, "name": "path.csv", "size": len(PATH)}).decode())
        opened.send(PATH)
        opened.send(msgspec.json.encode(message).decode())
        if message["do"] == "hold" and needs in MAY[role]:
            while not robot.sent:
                opened.recv(WITHIN)
            return
        while True:
            said = msgspec.json.decode(opened.recv(WITHIN))
            if said["tell"] in ("refused", "done", "accepted"):
                break
    if needs in MAY[role]:
        assert done(robot) != before
    else:
        assert said["tell"] == "refused"
        assert "role" in said["message"]
        assert done(robot) == before


# ---------------------------------------------------------------------- the page


@pytest.mark.viewer
@needs_chromium
@pytest.mark.parametrize("role", MAY)
def test_the_page_offers_what_a_role_may_and_nothing_else(browser: Page, role: Role | None, tmp_path: Path) -> None:
    robot = FakeRobot(homes=("A",))
    robot.granted, robot.mode = role, "holding"
    with Panel(robot.robot(), 0) as panel:
        page = browser.another()
        page.open(panel.url)
        page.until("document.body.dataset.contact === 'yes'")
        offered = set(
            page.evaluate(
                "[...document.querySelectorAll('[data-command]')].filter((each) => each.checkVisibility())"
                ".map((each) => each.dataset.command)"
            )
        )
        for what, selector in {"goal": "#pad", "poses": "#teach", "override": "#override", "stop": "#stop"}.items():
            if page.evaluate(f"document.querySelector({selector!r}).checkVisibility()"):
                offered.add(what)
        # STOP is pressed whoever one is: the service decides. This robot has no outputs.
        assert offered == MAY[role] - {"set_output"} | {"stop"}
        before = done(robot)
        for key in ("ArrowRight", "a"):
            page.key_down(key)
        if "goal" in MAY[role]:
            wait_until(lambda: done(robot) != before, "it moves")
        else:
            page.evaluate("new Promise((done) => setTimeout(done, 200))")
            assert done(robot) == before
        for key in ("ArrowRight", "a"):
            page.key_up(key)
        page.close()
