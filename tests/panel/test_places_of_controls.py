"""No control of the page moves because of a state: a second click never hits what was elsewhere before."""

from __future__ import annotations

import random
from typing import Any

import pytest
from chromium import Page, needs_chromium
from panel.fake_robot import FakeRobot
from trirail.panel.server import Panel
from trirail.wire.state import GoalState, Pose
from trirail.wire.vocabulary import Mode, Role

pytestmark = [pytest.mark.viewer, needs_chromium]

SIZES = {"desk": (1280, 800, False), "wide": (1920, 1080, False), "phone": (390, 844, True)}
SITUATIONS = 6
"""Number of situations tried at each size and in each language."""
WORDS = ["ok", "drive B: EMCY 8700: it missed the service's SYNC", "word " * 60, "W" * 120]
NAMES = ["bob", "ann", "w" * 64]
BOXES = """(() => {
  const boxes = {};
  for (const each of document.querySelectorAll('button, input, select, #mechanism')) {
    if (!each.checkVisibility()) continue;
    const { x, y, width, height } = each.getBoundingClientRect();
    const name = each.id || JSON.stringify(each.dataset);
    boxes[name] = [x, y, width, height].map((value) => Math.round(value * 10) / 10);
  }
  return boxes;
})()"""


def change(robot: FakeRobot, draw: random.Random, number: int) -> None:
    """Put the robot into a situation, which the page shows by its override."""
    mode = draw.choice(list(Mode))
    goal_id, progress = draw.choice(["g-17", "g" * 64]), draw.random()
    goals = [
        None,
        GoalState(goal_id, progress, 1e3 * draw.random(), target=Pose(0.03, 0.02, 0.2)),
        GoalState(goal_id, 0.0, 0.0),
        GoalState(goal_id, progress, 1.0, target=Pose(0.1, 0.0, 0.0), lag=draw.random()),
    ]
    with robot._lock:
        robot.mode, robot._alive_until = mode, float("inf")
        robot.goal = draw.choice(goals) if mode in (Mode.MOVING, Mode.HOLDING, Mode.STOPPING) else None
        robot.faults = tuple(draw.choices(WORDS, k=draw.randint(1, 5))) if mode == Mode.FAULT else ()
        robot.pose = (draw.uniform(-0.1, 0.1), draw.uniform(-0.1, 0.1), draw.uniform(-0.5, 0.5))
        robot.holder = draw.choice([None, *NAMES])
        robot.connected = draw.choices(NAMES, k=draw.randint(0, 9))
        robot.warnings = tuple(draw.choices(WORDS, k=draw.randint(0, 3)))
        robot.share = number / 100.0
    robot.say("lease", kind="lease", user=robot.holder)
    for words in draw.choices(WORDS, k=draw.randint(0, 4)):
        robot.say(words, draw.choice(["info", "warning", "error"]))
    if draw.random() < 0.3:
        mark = {"name": "left", "pixel": (10.0, 20.0), "to_go": (1e-4, 0.0)}
        look = {"id": "a-1", "purpose": "alignment", "number": number, "marks": [mark], "end": "corrections"}
        robot.say("a look", kind="alignment", user="bob", alignment=look)
    name = f"pose-{draw.randint(0, 30)}"
    robot.named = {"park": (0.0, 0.05, 0.0), name: (0.0, 0.0, 0.0)} if draw.random() < 0.5 else robot.named
    robot.say("poses", kind="pose")


def measure(page: Page) -> dict[str, Any]:
    """Return where each control is, but for the named poses: these come and go."""
    boxes: dict[str, Any] = page.evaluate(BOXES)
    return {name: box for name, box in boxes.items() if '"pose"' not in name}


@pytest.mark.parametrize("role", [Role.MAINTAINER, pytest.param(Role.VIEWER, marks=pytest.mark.long)])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.generated(0, 1, 2)
def test_no_control_moves_because_of_a_state(browser: Page, size: str, role: Role, seed: int) -> None:
    draw = random.Random(seed)
    robot = FakeRobot(homes=("A",))
    robot.granted = role
    width, height, phone = SIZES[size]
    with Panel(robot.robot(), 0) as panel:
        page = browser.another()
        page.open(panel.url)
        page.resize(width, height, phone=phone)
        page.until("document.body.dataset.contact === 'yes'")  # its script listens to the choice of a language
        for code in ("de", "en"):
            page.show_language(code)
            page.until(f"document.documentElement.lang === {code!r} && document.body.dataset.contact === 'yes'")
            before = measure(page)
            assert len(before) > 30 if role is Role.MAINTAINER else before
            for number in draw.sample(range(1, 200), SITUATIONS):
                change(robot, draw, number)
                page.until(f"document.querySelector('#override-says').textContent === '{number} %'")
                page.evaluate(f"document.querySelector('#answer').textContent = {draw.choice(WORDS)!r}")
                assert measure(page) == before, (code, number, robot.mode)
            robot.silent.set()
            page.until("document.body.dataset.contact === 'none'")
            assert measure(page) == before, code
            robot.silent.clear()
            page.until("document.body.dataset.contact === 'yes'")
        page.close()
