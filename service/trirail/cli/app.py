"""The command line `trirail COMMAND`.

An error is printed as one line on standard error. The exit code is then 1, or 2 for wrong usage.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal

import msgspec
from cyclopts import App, CoercionError, CycloptsError, Parameter, UnknownOptionError, UnusedCliTokensError

from trirail import __version__
from trirail.cli import (
    align_command,
    commission,
    config_commands,
    drives_command,
    fleet_command,
    help_pages,
    keys_command,
    math_commands,
    notation,
    panel_command,
    recording_commands,
    robot_commands,
    router_command,
    sessions_command,
    stop_commands,
    terminal,
)
from trirail.cli.options import ALL_HERE, ConfigFile, Flag, Services
from trirail.cli.tab_completion import Shell, script
from trirail.errors import TrirailError
from trirail.wire.stop_protocol import STOPS
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Command

app = App(
    name="trirail",
    help="Drives a 3-PRP planar robot, or a UVW, XXY or 3-PPR stage, in real time: goals by Zenoh, setpoints by CAN.",
    version=f"trirail {__version__}",
    console=terminal.out,
)


@app.command
def run(config: ConfigFile = None, /, *, record: Path | None = None, log: Literal["text", "json"] | None = None) -> int:
    """Run the service in the foreground until SIGTERM or Ctrl-C.

    The service then makes a controlled stop, disables the drives, and exits with 0; with 1 if a drive keeps power.

    Parameters
    ----------
    record
        Recording file to write, which must not exist yet. By default, the file is in the configured folder and is named
        after the time.
    log
        Format of the log: text for people, or JSON. By default, [telemetry] log selects it.
    """
    from trirail.processes.operating_system import ONE_THREAD

    os.environ.update(ONE_THREAD)  # before anything imports numpy

    from trirail.cli.service_log import Log, is_journal
    from trirail.config import SIM, load
    from trirail.processes.supervisor import Supervisor
    from trirail.wire.starting import Starting

    settings = load(config or SIM)
    form = log or settings.telemetry.log
    lines = Log(form, to_journal=is_journal(1))
    can = settings.can
    drives = f"drives on {can.interface} {can.channel}".strip() if can.interface != "simulated" else "simulated drives"
    lines.log(f"starting robot {settings.robot.name}: {drives}, {settings.loop.rate_hz} Hz")

    starting = Starting(settings.zenoh.listen)

    def up(ready: dict[str, dict[str, Any]]) -> None:
        starting.up()
        if form == "json":
            lines.log(f"up: robot {settings.robot.name}, goals {', '.join(settings.zenoh.listen)}")
        else:
            with terminal.out.capture() as printed:
                terminal.up(settings, ready)
            lines.text(printed.get())

    try:
        return Supervisor(settings, record, lines.log, lines.event).run(up, lines.start)
    finally:
        starting.up()
        lines.close()


@app.command
def demo(name: str = "sim", /, *, stay: Annotated[bool, Flag] = False, record: Path | None = None) -> int:
    """Drive simulated drives through a tour of goals, and report.

    The command starts its own service and enables the robot.

    Parameters
    ----------
    name
        Shipped configuration, as listed by `trirail config`: sim, or a stage such as uvw, xxy or uvw-ppr. With align,
        two simulated cameras align parts on uvw.
    stay
        Keep the service and its live view running afterwards, until Ctrl-C.
    record
        Recording file to write, which must not exist yet.
    """
    from trirail.cli import demo as shown

    if name == "align":
        return shown.run_align(record)
    return shown.run(name, stay=stay, record=record)


@app.command
def doctor(
    config: Annotated[
        Path | None, Parameter(help="Configuration file, or a CAN interface; the simulated robot if absent.")
    ] = None,
    /,
    *,
    quick: Annotated[bool, Flag] = False,
    json: Annotated[bool, Flag] = False,
) -> int:
    """Check this machine and a configuration, or a CAN interface.

    Exit 1 only if a problem would prevent the robot from running. A CAN interface is checked with the shipped
    configuration for SocketCAN.

    For ten seconds, the command runs the service's cycle with simulated drives, to measure which rates this machine can
    hold. It never uses the configured bus for that.
    On SocketCAN, it then measures for five seconds when the frames of cycles are on the bus: those of a running
    service, or on an idle bus, test frames that no drive uses.

    Parameters
    ----------
    quick
        Skip these measurements.
    json
        Print one JSON object with the numbers instead of text.
    """
    from trirail.cli import probes, rail_drawing
    from trirail.cli.doctor import run_checks
    from trirail.cli.doctor_cycle import compute_held_rate
    from trirail.cli.machine import Machine
    from trirail.config import SIM, Config, everything
    from trirail.diagnosis import stops
    from trirail.diagnosis.drive_checks import bus_use

    path, channel = config or SIM, ""
    if config is not None and probes.is_interface(config):
        path, channel = SIM.with_name("socketcan.toml"), str(config)
    findings = everything(path)
    if channel:
        findings = findings._replace(config=probes.on_interface(findings.config, channel))
    read: list[Machine] = []

    def machine(config: Config) -> Machine:
        try:
            with terminal.measuring("measuring cycles", show=not quick) as progress:
                read.append(probes.machine(config, quick=quick, progress=progress))
        except KeyboardInterrupt:
            terminal.print_error("the measurement was interrupted; trirail doctor --quick checks without it")
            raise
        return read[-1]

    checks = run_checks(path, findings, machine)
    fit = all(check.verdict != "failure" for check in checks)
    stop_distances = None if findings.mistakes else stops(findings.config)
    if json:
        cycles = [compute_held_rate(each.cycles) for each in read if not isinstance(each.cycles, str)]
        timings = [each.bus_timing for each in read if not isinstance(each.bus_timing, str)]
        content = {
            "checks": checks,
            "stops": stop_distances,
            "cycle": cycles[0] if cycles else None,
            "bus": None if findings.mistakes else bus_use(findings.config),
            "bus_timing": timings[0] if timings else None,
        }
        terminal.json({"ok": fit, **msgspec.to_builtins(content)})
        return 0 if fit else 1
    terminal.print_checks(checks)
    if stop_distances is not None:
        rail_drawing.show(stop_distances)
    return 0 if fit else 1


@app.command
def view(
    file: Path | None = None,
    /,
    *,
    web: Annotated[bool, Flag] = False,
    records: Annotated[bool, Flag] = False,
    services: Services = ALL_HERE,
) -> int:
    """Open the Rerun viewer on the robot, or on a recording.

    The command ends when you close the viewer or press Ctrl-C.

    Several robots behind one router, --robot a --robot b, are shown side by side.

    Parameters
    ----------
    file
        Recording to open instead of the live view.
    web
        Show the view in a browser on this machine instead of in its own window.
    records
        Draw the view on this machine from the records that the service publishes. This is always the case for several
        robots, and if --connect names another machine.
    """
    from trirail.cli import view as viewer

    def print_source(content: dict[str, str], words: str) -> None:
        robot_commands.show(services, content, words)

    return viewer.run(file, services.robot, services.connect, services.tls, web=web, records=records, say=print_source)


app.command(router_command.router)
app.command(fleet_command.fleet)
app.command(drives_command.app)
app.command(commission.commission)
app.command(panel_command.panel)
app.command(align_command.app)
for command in robot_commands.COMMANDS:
    app.command(command)
app.command(robot_commands.override, name=Command.OVERRIDE, help=Command.OVERRIDE.help)
app.command(robot_commands.acquire, name=Command.ACQUIRE, help=Command.ACQUIRE.help)
app.command(robot_commands.output, help=Command.SET_OUTPUT.help)
for each in Command:
    if each not in (Command.OVERRIDE, Command.ACQUIRE, Command.SET_OUTPUT):
        made = stop_commands.stopping(each) if each in STOPS else robot_commands.command_line_of(each)
        app.command(made, name=each.replace("_", "-"), help=each.help)
app.command(config_commands.app)
app.command(keys_command.app)
app.command(math_commands.ik)
app.command(math_commands.fk)
app.command(math_commands.workspace)
app.command(recording_commands.replay)
app.command(recording_commands.report)
app.command(recording_commands.export_app)
app.command(sessions_command.sessions)


@app.command
def completion(shell: Shell | None = None, /, *, install: Annotated[bool, Flag] = False) -> int:
    """Print a script for tab completion, of robots, poses, tools and frames too, or install it for this user.

    Parameters
    ----------
    shell
        Shell: bash, zsh or fish. If absent, the current shell.
    install
        Write the script to where the shell finds it and, if necessary, load it from the shell's start file.
    """
    with help_pages.show_all(app):
        return script(app, shell, install=install)


@app.command(name="help")
def help_(*command: str) -> int:
    """Show this page, with the seldom needed commands too, or the page of one command.

    Parameters
    ----------
    command
        Name of a command, or all.
    """
    if command == ("all",):
        with help_pages.show_all(app):
            app("--help")
    else:
        app([*command, "--help"])
    return 0


help_pages.arrange(app)


def _terminated(number: int, _frame: FrameType | None) -> None:
    # timeout(1) sends SIGTERM twice, which would interrupt the exit. A second Ctrl-\ is meant to.
    signal.signal(number, signal.SIG_DFL if number == signal.SIGQUIT else signal.SIG_IGN)
    raise terminal.Terminated(number)


def main() -> None:
    """Run a command and exit with its exit code."""
    words = sys.argv[1:]
    os.environ["RERUN"] = "on"  # otherwise a shell that switches Rerun off for other programs would empty every view
    warnings.showwarning = lambda message, *_, **__: terminal.print_error(str(message))
    try:
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
            if signal.getsignal(number) is signal.SIG_DFL:  # unless it is ignored, as under nohup
                signal.signal(number, _terminated)
        code = app(
            notation.numbers(notation.spread(words)),
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
    except CycloptsError as error:
        _print_failure(UsageError(_wrong_usage(error, words)), words)
        code = 2
    except TrirailError as error:
        _print_failure(error, words)
        code = 1
    except KeyboardInterrupt:
        code = 130
    except terminal.Terminated as terminated:
        code = 128 + terminated.number
    except BrokenPipeError:  # the reader, such as head, has closed the pipe of an endless output
        terminal.discard(sys.stdout)
        code = 0
    except OSError as error:
        _print_system_error(error, words)
        code = 1
    sys.exit(code if isinstance(code, int) else 0)


class UsageError(TrirailError):
    """The command line is wrong."""


def _print_failure(error: TrirailError, words: list[str]) -> None:
    """Print why a command failed, as one line or, with --json, as one JSON object."""
    if "--json" in words:
        try:
            terminal.print_error_json(error)
        except OSError:
            terminal.discard(sys.stdout)
        else:
            return
    terminal.print_error(str(error))


def _print_system_error(error: OSError, words: list[str]) -> None:
    """Print an error of the operating system like other errors, with the name of the file if it is known."""
    reason = error.strerror or str(error)
    try:
        sys.stdout.flush()
    except OSError:
        terminal.discard(sys.stdout)
        error.filename = terminal.OUTPUT
    if error.filename == terminal.OUTPUT:
        words = []  # JSON would not arrive
    is_named = isinstance(error.filename, str | bytes) and error.filename
    _print_failure(TrirailError(f"{os.fsdecode(error.filename)}: {reason}" if is_named else reason), words)


def _wrong_usage(error: CycloptsError, words: list[str]) -> str:
    """Return the message for a wrong command line, with the command and a pointer to its usage."""
    message = str(error).strip()
    behind = words[words.index("--") :] if "--" in words else []
    unknown = error.token.keyword if isinstance(error, UnknownOptionError) else None
    if unknown and any(word.split("=")[0] == unknown for word in behind):
        message = f"{unknown} follows --, after which options are not recognised; negative numbers need no --"
    elif isinstance(error, CoercionError) and error.msg and error.argument and not message.startswith("Invalid value"):
        message = f"Invalid value for {error.argument.name.strip('-')}: {message}"
    elif isinstance(error, UnusedCliTokensError):
        more = " ".join(quoted(word.strip()) for word in error.unused_tokens or ())
        message = f"{more} {'is' if ' ' not in more else 'are'} more than the command takes"
        options = error.app.assemble_argument_collection() if error.app else ()
        if more.endswith(".toml") and any("--config" in option.names for option in options):
            message += f": a configuration is --config {more.split()[-1]}"
    by_command = type(error) is CycloptsError  # raised by the command itself, which does not know its name
    command = " ".join(("trirail", *(words[:1] if by_command else error.command_chain or ())))
    return f"{message} ({command} --help shows the usage)"
