"""Commands to a running service: goals, commands, state and events.

Each command reports an error if the service does not answer.
"""

from __future__ import annotations

import contextlib
import inspect
import itertools
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import msgspec
from cyclopts import CycloptsError, Parameter, validators

from trirail.cli import live, notation, terminal
from trirail.cli.options import (
    HERE,
    Address,
    Flag,
    Service,
    Speed,
    Wait,
    axes_names,
    described,
    frame_names,
    taught_poses,
    tool_names,
)
from trirail.cli.options import poses as poses_of_robot
from trirail.naming import Labels
from trirail.wire import boundary
from trirail.wire.goals import Goal, MoveGoal, PoseGoal, TrajectoryGoal
from trirail.wire.messages import CommandReply
from trirail.wire.text import check_name, check_new_pose
from trirail.wire.units import LENGTH, quantity
from trirail.wire.vocabulary import LONGEST_LEASE, SHORTEST_LEASE, Command, Mode

if TYPE_CHECKING:
    from trirail.client.client import GoalHandle, Robot
    from trirail.wire.messages import Event

Tool = Annotated[notation.ToolPoint, Parameter(completer=tool_names), described(PoseGoal, "tool", "; typed U V")]
Blend = Annotated[notation.Distance, described(PoseGoal, "blend")]

NO_END = "the jog has no known end"


def goto(
    x: Annotated[str, Parameter(completer=poses_of_robot)],
    y: notation.Length | None = None,
    phi: notation.Angle | None = None,
    /,
    *,
    wait: Wait = False,
    speed: Speed = 1.0,
    blend: Blend | None = None,
    tool: Tool | None = None,
    frame: Annotated[str, Parameter(completer=frame_names), described(PoseGoal, "frame")] = "base",
    deg: Annotated[bool, Flag] = False,
    service: Service = HERE,
) -> int:
    """Move the platform to a pose: to X Y PHI, or to the pose of a NAME.

    Parameters
    ----------
    x
        Position of the platform's centre along x [m], or with a unit: 20mm, -0.8in. Without Y and PHI, the name of a
        pose.
    y
        Position along y.
    phi
        Angle of the platform, counterclockwise [rad], or with a unit: 10deg, 50mrad.
    deg
        An angle without a unit is in degrees.
    """
    if y is None or phi is None:
        if y is not None:
            typed = f"X = {x} and Y = {notation.written(y, 'mm', 3)}"
            raise CycloptsError(
                msg=f"goto takes X, Y and PHI, but only {typed} are given: add the angle PHI, such as 0"
            )
        if notation.is_length(x):
            raise CycloptsError(
                msg=f"goto takes X, Y and PHI, or the NAME of a pose, but only X = {x.strip()} is given"
            )
        if tool is not None or frame != "base":
            raise CycloptsError(msg="the pose of a NAME is fixed: it cannot be combined with --tool or --frame")
        check_name(x, "pose")
        with service.open() as robot:
            return _follow(service, robot, robot.move_to_named(x, speed=speed, blend=blend), wait, x)
    try:
        at, angle = quantity(x, LENGTH), notation.radians(phi, deg)
    except ValueError as error:
        raise CycloptsError(msg=f"Invalid value for X: {error}") from error
    with service.open() as robot:
        goal = robot.move_to(x=at, y=y, phi=angle, speed=speed, blend=blend, tool=tool, frame=frame)
        return _follow(service, robot, goal, wait, notation.pose((at, y, angle)))


def move(
    dx: notation.Length,
    dy: notation.Length,
    dphi: notation.Angle,
    /,
    *,
    wait: Wait = False,
    speed: Speed = 1.0,
    tool: Tool | None = None,
    frame: Annotated[str, Parameter(completer=axes_names), described(MoveGoal, "frame")] = "base",
    measured: Annotated[bool, Flag] = False,
    deg: Annotated[bool, Flag] = False,
    service: Service = HERE,
) -> int:
    """Move the platform relative to its commanded pose.

    Parameters
    ----------
    dx
        Distance along x [m], or with a unit: 5mm, 0.5um, -0.2in.
    dy
        Distance along y.
    dphi
        Rotation, counterclockwise [rad], or with a unit: 1deg.
    measured
        Move relative to the measured pose instead.
    deg
        An angle without a unit is in degrees.
    """
    angle = notation.radians(dphi, deg)
    with service.open() as robot:
        origin: Literal["commanded", "measured"] = "measured" if measured else "commanded"
        goal = robot.move(x=dx, y=dy, phi=angle, speed=speed, tool=tool, frame=frame, origin=origin)
        return _follow(service, robot, goal, wait, f"by {notation.pose((dx, dy, angle))}")


def goal(content: str, /, *, wait: Wait = False, service: Service = HERE) -> int:
    """Send a goal of any kind, as JSON.

    Parameters
    ----------
    content
        Kind and fields of the goal as in messages, in SI units and radians.
    """
    request: Goal = boundary.decode(content.encode(errors="surrogateescape"), Goal, "not a goal")
    with service.open() as robot:
        return _follow(service, robot, robot.send(request), wait, str(request.__struct_config__.tag))


def sliders(
    a: notation.Length,
    b: notation.Length,
    c: notation.Length,
    /,
    *,
    wait: Wait = False,
    speed: Speed = 1.0,
    service: Service = HERE,
) -> int:
    """Move the sliders to positions.

    Use this command also to leave a pose from which goto is refused.

    Parameters
    ----------
    a
        Position of slider A [m], or with a unit: 20mm.
    b
        Position of slider B.
    c
        Position of slider C.
    """
    with service.open() as robot:
        title = _sliders(robot.info().labels, a, b, c)
        goal = robot.move_sliders(a, b, c, speed=speed)
        return _follow(service, robot, goal, wait, title)


def jog(
    vx: notation.Velocity | None = None,
    vy: notation.Velocity | None = None,
    w: notation.AngularVelocity | None = None,
    /,
    *,
    seconds: notation.Time | None = None,
    tool: Tool | None = None,
    service: Service = HERE,
) -> int:
    """Move at a velocity until Ctrl-C, or while keys are held.

    With --seconds, the motion ends after that time. Without a velocity, the robot moves while you hold a key.

    Parameters
    ----------
    vx
        Velocity of the platform's centre along x [m/s], or with a unit: 5mm/s.
    vy
        Velocity along y.
    w
        Angular velocity of the platform [rad/s], or with a unit: 2deg/s.
    seconds
        Duration of the motion [s].
    """
    if vx is None:
        from trirail.cli import pendant

        with service.open() as robot:
            return pendant.run(robot, tool)
    if vy is None or w is None:
        raise CycloptsError(msg="jog takes VX, VY and W, or none of them: then keys move the robot while they are held")
    with service.open() as robot:
        jogging = robot.jog(x=vx, y=vy, phi=w, tool=tool)
        labels = robot.info().labels
        with contextlib.suppress(KeyboardInterrupt), jogging, live.ending(jogging, seconds):
            if not service.json and jogging.reply is not None and (words := terminal.slowed(jogging.reply)):
                terminal.print_error(words)
            live.show_jog(robot, jogging, labels, show=not service.json)
        if jogging.error is not None:
            raise jogging.error
        reply, result = jogging.reply, jogging.result
    slowed = {"slowed": reply.slowed} if reply else {}
    show(service, (result._asdict() if result else {}) | slowed, result.message if result else NO_END)
    return 0 if result and result.outcome == "done" else 1


def follow(
    file: Path,
    /,
    *,
    stretch: Annotated[bool, Flag, described(TrajectoryGoal, "stretch")] = False,
    go_there: Annotated[bool, Flag] = False,
    wait: Wait = False,
    service: Service = HERE,
) -> int:
    """Follow a timed trajectory from the robot's current pose.

    Parameters
    ----------
    file
        CSV with columns t, x, y, phi (and vx, vy, w, and ax, ay, e), or JSON with a list of points.
    go_there
        If the robot is not at the first point, move there first with an ordinary goal.
    """
    from trirail.client.trajectory import check_arrived, first_pose, read

    points = read(file)
    with service.open() as robot:
        if go_there:
            way = robot.send(first_pose(points))
            check_arrived(terminal.follow(robot, way, f"to the first point of {file.name}", show=not service.json))
        goal = robot.follow(points, stretch=stretch)
        return _follow(service, robot, goal, wait, f"{file.name}: {terminal.counted(len(points), 'point')}")


def teach(name: str, /, *, service: Service = HERE) -> int:
    """Save the current pose under a name, for goto.

    The saved pose is the measured pose, whether the robot has power or was moved by hand.

    Parameters
    ----------
    name
        Name of letters, digits, - and _, which must not be a number or quantity. A pose that was taught under this name
        before is replaced.
    """
    check_new_pose(name)
    with service.open() as robot:
        pose = robot.teach(name)
    show(service, msgspec.to_builtins(pose), f"{name}: {notation.pose((pose.x, pose.y, pose.phi))}")
    return 0


def forget(name: Annotated[str, Parameter(completer=taught_poses)], /, *, service: Service = HERE) -> int:
    """Remove a pose that was taught.

    Parameters
    ----------
    name
        Name of a pose that `trirail poses` lists as taught.
    """
    with service.open() as robot:
        pose = robot.forget(name)
    show(service, msgspec.to_builtins(pose), f"{name} is removed; it was {notation.pose((pose.x, pose.y, pose.phi))}")
    return 0


def poses(*, service: Service = HERE) -> int:
    """List the named poses."""
    with service.open() as robot:
        named_poses = robot.poses()
    if service.json:
        terminal.json({name: msgspec.to_builtins(pose) for name, pose in named_poses.items()})
        return 0
    width = max(map(len, named_poses), default=0)
    for name, pose in named_poses.items():
        whose = "taught" if pose.taught else "of [poses]"
        whose += ", with another geometry: check it, and teach it again" if pose.other_geometry else ""
        terminal.print_line(f"{name:<{width}}   {notation.pose((pose.x, pose.y, pose.phi), 9)}   {whose}")
    if not named_poses:
        terminal.print_line("there are no saved poses: trirail teach NAME saves the present pose of the robot")
    return 0


def override(percent: notation.Percent, /, *, service: Service = HERE) -> int:
    """Set the speed override.

    Parameters
    ----------
    percent
        Share of full speed, such as 50 or 50%.
    """
    with service.open() as robot:
        robot.override(percent)
    show(service, {"override": percent}, f"override: {percent:g} %")
    return 0


def output(name: str, value: Literal["on", "off"], /, *, service: Service = HERE) -> int:
    """Set a digital output of a drive from the next setpoints on.

    Parameters
    ----------
    name
        Name of an output in the configuration.
    value
        New value of the output.
    """
    with service.open() as robot:
        robot.set_output(name, value == "on")
    show(service, {"output": name, "value": value == "on"}, f"output {name}: {value}")
    return 0


WAKE_INTERVAL_S = 0.2
"""Interval of checking for signals while waiting [s]. The kernel may deliver a signal to another thread."""


def acquire(*, force: Annotated[bool, Flag] = False, timeout: notation.Time = 1.0, service: Service = HERE) -> int:
    """Hold the lease until Ctrl-C or SIGTERM, or until it is lost.

    Parameters
    ----------
    force
        Take the lease over from its holder. This needs the role in [control] takeover, by default maintainer.
    timeout
        Time without a sign of life from this command after which the lease ends with a controlled stop: 0.1 to 10 s.
    """
    if not SHORTEST_LEASE <= timeout <= LONGEST_LEASE:
        allowed = f"use {SHORTEST_LEASE:g} to {LONGEST_LEASE:g} s"
        raise CycloptsError(msg=f"Invalid value for --timeout: {timeout:g} s: {allowed}")
    with (
        service.open() as robot,
        robot.lease(force=force, timeout=timeout) as lease,
    ):
        show(service, {"lease": robot.user}, f"{robot.user} holds the lease until Ctrl-C")
        with contextlib.suppress(KeyboardInterrupt):
            while not lease.wait(WAKE_INTERVAL_S):
                pass
    if lease.lost is not None:
        raise lease.lost
    return 0


def status(*, service: Service = HERE) -> int:
    """Print the current state."""
    with service.open() as robot:
        state, info = robot.state(), robot.info()
    if service.json:
        fixed = {"missing_protections": info.missing_protections, "correction": info.correction}
        terminal.json(msgspec.to_builtins(state) | msgspec.to_builtins(fixed))
    else:
        live.show(state, info)
    return 0


def watch(*, service: Service = HERE) -> int:
    """Show the state live until Ctrl-C."""
    with service.open() as robot:
        live.watch(robot, json_lines=service.json)
    return 0


HISTORY_TIMEOUT_S = 1.0
"""Time without another event after which the past events count as complete [s]. A thousand take a tenth of this."""


def events(
    *,
    last: Annotated[int | None, Parameter(validator=validators.Number(gte=0))] = None,
    follow: Annotated[bool, Flag] = False,
    service: Service = HERE,
) -> int:
    """Print past events and new ones, until Ctrl-C.

    With --last, print only past events.

    Parameters
    ----------
    last
        Print this number of the newest past events, then end; 0 for all.
    follow
        Continue with new events after --last.
    """
    with service.open() as robot:
        now = robot.state().t  # fails immediately without a service, whereas events would only be silent
        seen = "", 0
        if last is not None:
            until_now = itertools.takewhile(
                lambda event: event.t <= now, robot.events(history=True, timeout=HISTORY_TIMEOUT_S)
            )
            for event in terminal.end_with_reader(deque(until_now, maxlen=last or None)):
                _show_event(service, event)
                seen = event.run, event.seq
            if not follow:
                return 0
        later = itertools.dropwhile(
            lambda event: event.run == seen[0] and event.seq <= seen[1], robot.events(history=True)
        )
        for event in terminal.end_with_reader(later):
            _show_event(service, event)
    return 0


def _show_event(service: Service, event: Event) -> None:
    if service.json:
        terminal.json(msgspec.to_builtins(event))
    else:
        terminal.print_event(event)


COMMANDS = (goto, move, goal, sliders, jog, follow, teach, forget, poses, status, watch, events)
"""Commands with their own parameters, in the order of the help; `command_line_of` creates the others."""


def command_line_of(name: Command) -> Callable[..., int]:
    """Return the function of the command line that sends a command.

    Each required field of the command's content is an argument.
    """

    def send_command(*values: object, service: Service = HERE) -> int:
        with service.open() as robot:
            try:
                reply = robot.command(name, name.content(*values) if values else None)
            except KeyboardInterrupt:
                if name is Command.HOME:
                    terminal.err.print("homing is stopped")
                raise
        confirmed(service, name, reply)
        return 0

    signature = inspect.signature(send_command)
    help_text = Parameter(help=f"Of its content: {name.content.words}.")
    each = [
        inspect.Parameter(
            field.name, inspect.Parameter.POSITIONAL_ONLY, annotation=Annotated[_plain_type(field.type), help_text]
        )
        for field in msgspec.structs.fields(name.content)
        if field.required
    ]
    send_command.__signature__ = signature.replace(  # type: ignore[attr-defined]  # where cyclopts looks
        parameters=[*each, signature.parameters["service"].replace(annotation=Service)]
    )
    return send_command


def _plain_type(kind: Any) -> Any:
    """Return the type of a field without its constraints, which are checked when the content is created."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def confirmed(service: Service, name: Command, reply: CommandReply) -> None:
    """Print that a command was carried out."""
    show(
        service,
        msgspec.to_builtins(reply),
        f"{name}: done, the robot is {'in fault' if reply.mode == Mode.FAULT else reply.mode}",
    )


def _sliders(labels: Labels, *positions: float) -> str:
    return "   ".join(f"{name} {notation.written(at, 'mm', 3)}" for name, at in zip(labels, positions, strict=True))


def _follow(service: Service, robot: Robot, goal: GoalHandle, wait: bool, title: str) -> int:
    """Print that a goal was accepted or, with `wait`, follow it to its end."""
    if not wait:
        words = f"goal {goal.id}: {goal.expected}{terminal.notes(goal.reply)}"
        show(service, msgspec.to_builtins(goal.reply), words)
        return 0
    if not service.json and (words := terminal.slowed(goal.reply)):
        terminal.print_error(words)
    result = terminal.follow(robot, goal, title, show=not service.json)
    show(service, result._asdict() | {"slowed": goal.reply.slowed}, result.message)
    return 0 if result.outcome == "done" else 1


def show(service: Address, content: object, words: str) -> None:
    """Print the result of a command as text or, with --json, as its content."""
    if service.json:
        terminal.json(content)
    else:
        terminal.print_line(words)
