"""Every command is known in every room through which it goes: Command is the table, the rooms follow from it."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import message_schemas
import msgspec
import pytest
from control_rig import CONFIG, ControlRig
from trirail.cli.app import app
from trirail.client.async_client import AsyncRobot
from trirail.client.client import Robot
from trirail.config import geometry
from trirail.control.commands import EFFECTS, CommandProgress, Effect
from trirail.control.feedback import MeasuredState
from trirail.control.modes import ModeEvent
from trirail.wire import packets
from trirail.wire.messages import CommandReply
from trirail.wire.packets import CommandDone, Refused
from trirail.wire.vocabulary import Command, CommandContent, Mode, NoContent, Override, Role
from trirail_drivers.interface import Feedback, PowerState

SERVICE = Path(__file__).parents[2] / "service"
ARGUMENTS = {Command.OVERRIDE: (50.0,), Command.SET_OUTPUT: ("valve", True)}
"""Arguments of the commands that need some, for a client's method."""
every_command = pytest.mark.parametrize("name", Command)


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


def test_every_command_has_an_effect_and_each_that_changes_the_mode_an_event() -> None:
    assert set(EFFECTS) == set(Command)
    change = {name.name for name, effect in EFFECTS.items() if effect.begin is Effect._field_defaults["begin"]}
    assert change - set(ModeEvent.__members__) == set()


@every_command
@pytest.mark.parametrize("mode", Mode)
def test_in_every_mode_there_is_a_rule_when_a_command_is_carried_out(name: Command, mode: Mode) -> None:
    off = PowerState.SWITCH_ON_DISABLED
    measured = MeasuredState(geometry(CONFIG.geometry).packed(), CONFIG.period, 1e-3)
    measured.start(Feedback((0.0, 0.0, 0.0), (off, off, off), None))
    assert isinstance(EFFECTS[name].rule(CommandProgress(mode, "why", measured, settled=True)), str | None)


def test_a_request_that_is_no_commands_or_carries_what_it_does_not_take_is_not_decoded() -> None:
    request = msgspec.msgpack.decode(packets.encode(packets.CommandRequest(1, "ann", Command.OVERRIDE, Override(50.0))))
    assert packets.decode_request(msgspec.msgpack.encode(request)).content == Override(50.0)
    for wrong, why in (({"name": "dance"}, "dance"), ({"name": "stop"}, "percent"), ({"value": 0.5}, "value")):
        with pytest.raises(msgspec.ValidationError, match=why):
            packets.decode_request(msgspec.msgpack.encode(request | wrong))


@every_command
@pytest.mark.parametrize("enabled", [False, True])
def test_the_control_answers_every_command(rig: ControlRig, name: Command, enabled: bool) -> None:
    if enabled:
        rig.enable()
    assert isinstance(rig.command(name), CommandDone | Refused)
    assert rig.control.fault is None or name is Command.QUICK_STOP


@every_command
def test_a_method_of_a_commands_name_sends_that_and_both_clients_have_it(name: Command) -> None:
    sent: list[str] = []

    class Deaf(AsyncRobot):
        def __init__(self) -> None:
            pass

        async def command(self, name: str, content: CommandContent | bytes | None = None) -> CommandReply:
            sent.append(name)
            return CommandReply(name, "holding", 1)

    assert hasattr(Robot, name) == hasattr(AsyncRobot, name)
    if hasattr(Robot, name):
        asyncio.run(getattr(Deaf(), name)(*ARGUMENTS.get(name, ())))
    assert sent == [name] * hasattr(Robot, name)


@every_command
def test_the_command_line_has_every_command_and_helps_with_it(name: Command) -> None:
    typed = "output" if name is Command.SET_OUTPUT else name.replace("_", "-")
    assert name.help.endswith(".")
    assert app[typed].help == name.help
    arguments = ["valve", "on"] if name is Command.SET_OUTPUT else map(str, ARGUMENTS.get(name, ()))
    app.parse_args([typed, *arguments], exit_on_error=False, print_error=False)


@every_command
def test_what_a_command_may_carry_has_a_type_words_and_a_schema(name: Command) -> None:
    assert (name.content is NoContent) == (name.content.words == "no content")
    assert (name.content is not NoContent) == (message_schemas.FOLDER / f"command-{name}.json").exists()


def row_of(guide: str, first_cell: str) -> set[str]:
    """Return the names in a row of a table."""
    text = (SERVICE / guide).read_text(encoding="utf-8")
    (row,) = re.findall(rf"^\| {re.escape(first_cell)} \|.*$", text, re.MULTILINE)
    return set(re.findall(r"`(\w+)`", row))


def test_the_guide_names_every_command() -> None:
    assert set(Command) - row_of("talking.md", "`cmd/<user>/<name>`") == set()


def test_the_table_of_roles_names_every_command_in_the_row_of_its_lowest_role() -> None:
    rows = {role: row_of("network.md", role) for role in Role}
    lowest = {name: [role for role in Role if name in rows[role]][:1] for name in Command}
    assert lowest == {name: [name.role] for name in Command}
