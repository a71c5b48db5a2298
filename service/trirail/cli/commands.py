"""The command line: `trirail COMMAND`. Errors are one line on standard error; exit 1, or 2 for wrong usage."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import App, CycloptsError, Parameter

from trirail import __version__
from trirail.cli import config_commands, math_commands, recording_commands, terminal
from trirail.errors import TrirailError
from trirail.wire.vocabulary import Command
from trirail.wire.zenoh_session import DEFAULT_LOCATOR

if TYPE_CHECKING:
    from trirail.client.client import GoalHandle, Robot

app = App(
    name="trirail",
    help="Drives a 3-PRP planar parallel robot in real time: goals in over Zenoh, setpoints out over CAN.",
    version=f"trirail {__version__}",
)

Flag = math_commands.Flag


@Parameter(name="*")
@dataclass(frozen=True)
class Service:
    """Which service to talk to."""

    robot: Annotated[str, Parameter(env_var="TRIRAIL_ROBOT")] = "demo"
    "Name of the robot, as in its configuration."
    connect: Annotated[str, Parameter(env_var="TRIRAIL_CONNECT")] = DEFAULT_LOCATOR
    "Zenoh locator of the service or of a router."
    json: Annotated[bool, Flag] = False
    "Print one JSON object instead of words."


HERE = Service()


@app.command
def run(config: Path | None = None, /, *, record: Path | None = None) -> int:
    """Run the service in the foreground until SIGTERM or Ctrl-C: then a controlled stop, drives disabled, exit 0.

    Parameters
    ----------
    config
        Configuration file; the simulated robot if absent.
    record
        Recording file to write, instead of one named by the time in the configured folder.
    """
    from trirail.config import SIM, load
    from trirail.processes.supervisor import Supervisor

    settings = load(config or SIM)
    return Supervisor(settings, record, terminal.say).run(lambda ready: terminal.up(settings, ready))


@app.command
def demo(*, stay: Annotated[bool, Flag] = False, record: Path | None = None) -> int:
    """Start the service on simulated drives, enable it, send it a tour of goals, and report.

    Parameters
    ----------
    stay
        Keep the service and its live view up afterwards, until Ctrl-C.
    record
        Recording file to leave.
    """
    from trirail.cli import demo as shown

    return shown.run(stay=stay, record=record)


@app.command
def goto(
    x: float,
    y: float,
    phi: float,
    /,
    *,
    wait: Annotated[bool, Flag] = False,
    speed: float = 1.0,
    blend: float | None = None,
    deg: Annotated[bool, Flag] = False,
    service: Service = HERE,
) -> int:
    """Move the platform to a pose.

    Parameters
    ----------
    x
        Position of the platform's centre [m].
    y
        Position of the platform's centre [m].
    phi
        Angle of the platform [rad].
    wait
        Show the progress; exit 0 only when the robot has arrived.
    speed
        Fraction of full speed, up to 1.
    blend
        The next goto waits for this one, and begins that near to its end [m], instead of preempting it.
    deg
        The angle is in degrees.
    """
    from trirail.client.client import Robot

    angle = math.radians(phi) if deg else phi
    with Robot(service.robot, service.connect) as robot:
        goal = robot.move_to(x=x, y=y, phi=angle, speed=speed, blend=blend)
        return _follow(service, robot, goal, wait, f"x {x:g} m, y {y:g} m, φ {math.degrees(angle):g}°")


@app.command
def sliders(
    a: float,
    b: float,
    c: float,
    /,
    *,
    wait: Annotated[bool, Flag] = False,
    speed: float = 1.0,
    service: Service = HERE,
) -> int:
    """Move the sliders to positions [m]; also the way out of a pose that goto refuses.

    Parameters
    ----------
    wait
        Show the progress; exit 0 only when the robot has arrived.
    speed
        Fraction of full speed, up to 1.
    """
    from trirail.client.client import Robot

    with Robot(service.robot, service.connect) as robot:
        goal = robot.move_sliders(a, b, c, speed=speed)
        return _follow(service, robot, goal, wait, f"A {a:g} m, B {b:g} m, C {c:g} m")


@app.command
def jog(vx: float, vy: float, w: float, /, *, seconds: float | None = None, service: Service = HERE) -> int:
    """Move at a velocity [m/s, rad/s] while the command lasts: until Ctrl-C, or for some seconds.

    Parameters
    ----------
    seconds
        How long.
    """
    from trirail.client.client import Robot

    with Robot(service.robot, service.connect) as robot:
        try:
            with robot.jog(x=vx, y=vy, phi=w) as jogging:
                terminal.jogging(robot, jogging, seconds, show=not service.json)
        except KeyboardInterrupt:
            pass
        if jogging.error is not None:
            raise jogging.error
        result = jogging.result
    _print(service, result._asdict() if result else {}, result.message if result else "the jog has no known end")
    return 0 if result and result.outcome == "done" else 1


@app.command
def follow(
    file: Path,
    /,
    *,
    stretch: Annotated[bool, Flag] = False,
    wait: Annotated[bool, Flag] = False,
    service: Service = HERE,
) -> int:
    """Follow a timed trajectory from where the robot stands.

    Parameters
    ----------
    file
        CSV with columns t, x, y, phi (and vx, vy, w, and ax, ay, e), or JSON with a list of points.
    stretch
        Slow down what is too fast, instead of refusing it.
    wait
        Show the progress; exit 0 only when the robot has arrived.
    """
    from trirail.client.client import Robot
    from trirail.client.trajectory import read

    points = read(file)
    with Robot(service.robot, service.connect) as robot:
        goal = robot.follow(points, stretch=stretch)
        return _follow(service, robot, goal, wait, f"{file.name}: {len(points)} points")


@app.command(name=Command.OVERRIDE, help=Command.OVERRIDE.help)
def override(percent: float, /, *, service: Service = HERE) -> int:
    """Send the one command that takes a number; its help is the command's, as of the others below."""
    from trirail.client.client import Robot

    with Robot(service.robot, service.connect) as robot:
        robot.override(percent)
    _print(service, {"override": percent}, f"override: {percent:g} %")
    return 0


@app.command
def status(*, service: Service = HERE) -> int:
    """Print the present state."""
    from trirail.client.client import Robot

    with Robot(service.robot, service.connect) as robot:
        state = robot.state()
    if service.json:
        terminal.json(msgspec.to_builtins(state))
    else:
        terminal.show(state, service.robot)
    return 0


@app.command
def watch(*, service: Service = HERE) -> int:
    """Show the state live until Ctrl-C."""
    from trirail.client.client import Robot

    with Robot(service.robot, service.connect) as robot:
        if service.json:
            for state in robot.states():
                terminal.json(msgspec.to_builtins(state))
        else:
            terminal.watch(robot)
    return 0


@app.command
def events(*, service: Service = HERE) -> int:
    """Print past events and those to come until Ctrl-C."""
    from trirail.client.client import Robot

    with Robot(service.robot, service.connect) as robot:
        robot.state()  # so that a missing service is said, not waited for
        for event in robot.events(history=True):
            if service.json:
                terminal.json(msgspec.to_builtins(event))
            else:
                terminal.event(event)
    return 0


@app.command
def doctor(config: Path | None = None, /, *, json: Annotated[bool, Flag] = False) -> int:
    """Check this machine and a configuration; exit 1 only if something would keep the robot from running.

    Parameters
    ----------
    config
        Configuration file; the simulated robot if absent.
    json
        Print one JSON object instead of words.
    """
    from trirail.cli import probes
    from trirail.cli.doctor import examine
    from trirail.config import SIM, load

    settings = load(config or SIM)
    checks = examine(settings, probes.machine(settings))
    fit = all(check.verdict != "failure" for check in checks)
    if json:
        terminal.json({"ok": fit, "checks": msgspec.to_builtins(checks)})
    else:
        terminal.checks(checks)
    return 0 if fit else 1


@app.command
def view(
    file: Path | None = None,
    /,
    *,
    web: Annotated[bool, Flag] = False,
    records: Annotated[bool, Flag] = False,
    service: Service = HERE,
) -> int:
    """Open the Rerun viewer on the robot as it moves, or on a recording, until it is closed or Ctrl-C.

    Parameters
    ----------
    file
        Recording to open, instead of the live view.
    web
        Show it in a browser on this machine, instead of in a window of its own.
    records
        Draw it here, from the records that the service publishes; so it is done anyway where --connect names
        another machine.
    """
    from trirail.cli import view as viewer

    def say(content: dict[str, str], words: str) -> None:
        _print(service, content, words)

    return viewer.run(file, service.robot, service.connect, web=web, records=records, say=say)


app.command(config_commands.app)
app.command(math_commands.ik)
app.command(math_commands.fk)
app.command(math_commands.workspace)
app.command(recording_commands.replay)
app.command(recording_commands.report)


def _tells(name: Command) -> Callable[..., int]:
    """Return the command of the command line that sends one without content."""

    def tell(*, service: Service = HERE) -> int:
        from trirail.client.client import Robot

        with Robot(service.robot, service.connect) as robot:
            reply = robot.command(name)
        _print(service, msgspec.to_builtins(reply), f"{name}: done, the robot is {reply.mode}")
        return 0

    return tell


for each in Command:
    if each is not Command.OVERRIDE:
        app.command(_tells(each), name=each.replace("_", "-"), help=each.help)


def _follow(service: Service, robot: Robot, goal: GoalHandle, wait: bool, title: str) -> int:
    """Say that a goal is accepted, or follow it to its end."""
    if not wait:
        words = f"goal {goal.id}: {goal.expected}{terminal.notes(goal.reply)}"
        _print(service, msgspec.to_builtins(goal.reply), words)
        return 0
    result = terminal.follow(robot, goal, title, show=not service.json)
    _print(service, result._asdict(), result.message)
    return 0 if result.outcome == "done" else 1


def _print(service: Service, content: object, words: str) -> None:
    if service.json:
        terminal.json(content)
    else:
        terminal.say(words)


def main() -> None:
    """Run a command and exit as it says."""
    try:
        code = app(exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        terminal.complain(f"{str(error).strip()} (trirail --help tells the usage)")
        code = 2
    except TrirailError as error:
        terminal.complain(str(error))
        code = 1
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:  # the reader, head for one, has seen enough
        sys.stderr.close()
        code = 0
    sys.exit(code if isinstance(code, int) else 0)
