"""Output of the commands: text for people or, with --json, JSON for programs."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from json import dumps
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text
from trirail_drivers.bus import load
from trirail_drivers.errors import shortened

from trirail.cli.options import HERE
from trirail.errors import RefusedError, ServiceError, TrirailError
from trirail.telemetry import palette
from trirail.wire.messages import Event, GoalReply
from trirail.wire.state import GoalState, Percentiles, State
from trirail.wire.text import json_printable, printable, wall_clock
from trirail.wire.vocabulary import Mode

if TYPE_CHECKING:
    from trirail.client.client import GoalHandle, Result, Robot
    from trirail.config import Config
    from trirail.diagnosis import Check

_reader_left = threading.Event()
"""Set when a line was written to a pipe whose reader had closed it."""


def discard(stream: IO[str]) -> None:
    """Discard what is written to a stream from now on. Python would try again at its end, and exit with 120."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


OUTPUT = "standard output"
"""Name of the stream in errors."""


@contextlib.contextmanager
def _named_errors(stream: str) -> Iterator[None]:
    """Give an error of writing, such as that of a full disk, the name of the stream."""
    try:
        yield
    except OSError as error:
        error.filename = stream
        raise


class _CommandConsole(Console):
    """Console of a command, which continues to its own exit code if the reader of its output, such as head, leaves."""

    def __exit__(self, *exception: Any) -> None:
        with _named_errors("standard error" if self.stderr else OUTPUT):
            super().__exit__(*exception)

    def on_broken_pipe(self) -> None:
        """Discard the output, whereas Rich would exit with code 1."""
        _reader_left.set()
        discard(self.file)


def end_with_reader(items: Iterable[T]) -> Iterator[T]:
    """Yield items to print. Raises BrokenPipeError when the reader of the output has closed its pipe."""
    for item in items:
        yield item
        if _reader_left.is_set():
            raise BrokenPipeError


MIN_WIDTH, MIN_HEIGHT = 20, 2
"""Minimum size of a terminal that COLUMNS and LINES may give [characters]. Rich prints nothing if COLUMNS is 0."""
for variable, least in (("COLUMNS", MIN_WIDTH), ("LINES", MIN_HEIGHT)):
    if (number := os.environ.get(variable, "")).isdecimal() and int(number) < least:
        del os.environ[variable]

out = _CommandConsole(highlight=False, emoji=False)
err = _CommandConsole(stderr=True, highlight=False, emoji=False)

T = TypeVar("T")
COLOURS = {mode.value: palette.code(colour) for mode, colour in palette.MODES.items()}
LEVELS = {"info": "green", "warning": "yellow", "error": "bold red"}
VERDICTS = {"ok": "green", "warning": "yellow", "failure": "bold red"}
SERVICE_TIMEOUT_S = 3.0
"""Time without an answer after which the service counts as gone [s]."""


TABLE_WIDTH = 10_000
"""Maximum width of a table [characters]."""


class Terminated(BaseException):
    """Signal that asks this process to end. As after Ctrl-C, the command stops its goal and releases its lease."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def can_redraw() -> bool:
    """Return True if standard output is a terminal on which a display can be redrawn, unlike one with TERM=dumb."""
    return out.is_terminal and not out.is_dumb_terminal


def plain(words: str) -> str:
    """Return external text for the console, without markup, control characters or line breaks."""
    return escape(printable(words))


def counted(number: int, what: str) -> str:
    """Return a number and its noun, in the plural if necessary: 1 robot, 2 robots."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def print_line(words: str) -> None:
    """Print a line."""
    out.print(plain(words), soft_wrap=True)


def print_table(rows: Table) -> None:
    """Print a table in its whole width, which neither a narrow terminal nor a pipe reduces."""
    whole = out.render(rows, out.options.update(max_width=TABLE_WIDTH))
    for segments in Segment.split_lines(whole):
        line = Text.assemble(*((text, style or "") for text, style, _ in segments))
        line.rstrip()
        out.print(line, soft_wrap=True)


@contextlib.contextmanager
def drawing(file: Path) -> Iterator[None]:
    """Convert errors that occur while a picture is drawn to a file into a TrirailError with the reason.

    Matplotlib would add .png to a name without a suffix, and write that file instead.
    """
    if not file.suffix:
        raise TrirailError(f"cannot draw to {file}: the name must end in .png, .svg or .pdf")
    try:
        yield
    except ImportError as error:
        raise TrirailError("--plot needs matplotlib: pip install 'trirail[analysis]'") from error
    except (OSError, ValueError) as error:
        raise TrirailError(f"cannot draw to {file}: {getattr(error, 'strerror', None) or error}") from error


def print_error(words: str) -> None:
    """Print an error as one line of bounded length on standard error."""
    err.print(f"trirail: {plain(shortened(' '.join(words.split())))}", soft_wrap=True)


def write(text: str) -> None:
    """Write text to standard output as it is, and flush the output."""
    try:
        with _named_errors(OUTPUT):
            sys.stdout.write(text)
            sys.stdout.flush()
    except BrokenPipeError:
        out.on_broken_pipe()


def json(content: object) -> None:
    """Print one JSON object on its own line, and flush the output."""
    try:
        line = msgspec.json.encode(content).decode()
    except UnicodeEncodeError:  # the name of a file need not be UTF-8
        line = dumps(msgspec.to_builtins(content))
    write(json_printable(line, sys.stdout.encoding) + "\n")


def print_error_json(error: TrirailError) -> None:
    """Print an error as one JSON object, with the code of a refusal and the value that exceeds a limit."""
    content = {"ok": False, "error": type(error).__name__, "message": str(error)}
    if isinstance(error, RefusedError):
        content["code"] = error.code
    beyond = {name: getattr(error, name, None) for name in ("slider", "leg", "value", "limit")}
    json(content | {name: value for name, value in beyond.items() if value not in (None, "")})


def up(config: Config, ready: dict[str, dict[str, Any]]) -> None:
    """Print that the service is running, with its addresses and missing rights."""
    from trirail.config import metrics_url
    from trirail.diagnosis.drive_checks import plan_traffic, usage_of

    loop, recorder = ready["loop"], ready["recorder"]
    out.print(f"[bold green]up[/]  robot [bold]{config.robot.name}[/] at {config.loop.rate_hz} Hz", soft_wrap=True)
    out.print(f"    goals      {plain(', '.join(config.zenoh.listen))}", soft_wrap=True)
    if recorder["live"]:
        out.print(f"    live view  trirail view  ({recorder['live']})", soft_wrap=True)
    out.print(f"    recording  {plain(recorder['recording'])}", soft_wrap=True)
    if url := metrics_url(config):
        out.print(f"    metrics    {plain(url)}", soft_wrap=True)
    out.print(f"    bus load   {usage_of(config, loop['bus_load'])}", soft_wrap=True)
    out.print(f"    next       {plain(' '.join(['trirail enable', *_reach(config)]))}", soft_wrap=True)
    if omission := plan_traffic(config).omission:
        out.print(f"    [yellow]warning[/] {omission}", soft_wrap=True)
    if warning := load.warning(config.loop.rate_hz, loop["bus_load"]):
        out.print(f"    [yellow]warning[/] {warning}", soft_wrap=True)
    for lack in loop["lacking"]:
        out.print(f"    [yellow]without[/] {plain(lack)}", soft_wrap=True)
    for warning in ready["gateway"]["warnings"]:
        out.print(f"    [yellow]warning[/] {plain(warning)}", soft_wrap=True)


def _reach(config: Config) -> list[str]:
    """Return the options with which a command on this machine reaches the service; no options for the default one."""
    options = []
    if (robot := config.robot.name) != HERE.robot:
        options += ["--robot", robot]
    if HERE.connect not in config.zenoh.listen:
        anywhere = config.zenoh.listen[0].replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
        options += ["--connect", anywhere]
    return options


MIN_SLOWDOWN = 1.001
"""Slowdown below which a goal counts as unchanged."""


def slowed(reply: GoalReply) -> str:
    """Return the slowdown of an accepted goal in words, or "" if it is not slowed down."""
    return f"slowed {reply.slowed:.4g} times, to keep within the limits" if reply.slowed > MIN_SLOWDOWN else ""


def notes(reply: GoalReply) -> str:
    """Return remarks on an accepted goal in parentheses, or "" if it is executed as requested."""
    remarks = [words] if (words := slowed(reply)) else []
    if reply.stops_first:
        remarks.append("stops on its present path first")
    if reply.queued:
        remarks.append("waits for the previous goal")
    return f" ({', '.join(remarks)})" if remarks else ""


@contextlib.contextmanager
def measuring(title: str, *, show: bool = True) -> Iterator[Callable[[float], None]]:
    """Show the progress of a measurement on standard error if it is a terminal, without a drawing thread."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
    show = show and err.is_terminal
    with Progress(*columns, console=err, transient=True, auto_refresh=False, disable=not show) as progress:
        task = progress.add_task(title, total=1.0)
        yield lambda share: progress.update(task, completed=share, refresh=True)


def follow(robot: Robot, goal: GoalHandle, title: str, *, show: bool = True) -> Result:
    """Wait for the end of a goal and show its progress.

    Ctrl-C stops the goal; a second Ctrl-C raises ServiceError. Terminated also stops the goal, and is raised again.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Progress(*columns, console=out, transient=True, disable=not (show and out.is_terminal)) as progress:
        task = progress.add_task(plain(title) + notes(goal.reply), total=1.0, left="")

        def wait_for_end() -> Result:
            cycle = 0
            for state in robot.states(SERVICE_TIMEOUT_S):
                if goal.result is not None:
                    return goal.result
                if state.seq < cycle:
                    raise ServiceError(f"the service has restarted: the end of goal {goal.id} is unknown")
                cycle = state.seq
                if state.goal is not None and state.goal.id == goal.id:
                    progress.update(task, completed=state.goal.progress, left=left(state, state.goal))
            if goal.result is not None:
                return goal.result
            raise ServiceError(f"the service no longer sends its state: the end of goal {goal.id} is unknown")

        try:
            return wait_for_end()
        except KeyboardInterrupt:
            # In another thread, so that a second Ctrl-C takes effect immediately.
            threading.Thread(target=_cancel, args=(goal,), name="cancel", daemon=True).start()
            progress.update(task, description="stopping; Ctrl-C again leaves")
        except Terminated:
            _cancel(goal)
            raise
        try:
            return wait_for_end()
        except KeyboardInterrupt as second:
            raise ServiceError(
                f"goal {goal.id} may still be running, since the stop was not confirmed; "
                "run trirail stop to stop the robot"
            ) from second


def _cancel(goal: GoalHandle) -> None:
    with contextlib.suppress(TrirailError):  # the goal has ended, or the service does not answer
        goal.cancel()


def left(state: State, goal: GoalState) -> str:
    """Return the remaining time of the active goal in words, or the text that the robot is settling."""
    if goal.progress >= 1.0:
        return "settling"
    if state.mode == Mode.HOLDING:
        return "no expected end while it is paused"
    return f"{goal.remaining:.1f} s left" if state.override else "no expected end while the override is 0"


def print_event(occurred: Event) -> None:
    """Print an event on one line, with its wall-clock time."""
    level = f"[{LEVELS[occurred.level]}]{occurred.level:7}[/]"
    out.print(f"{occurred.seq:5}  {wall_clock(occurred.time)}  {level}  {plain(occurred.message)}", soft_wrap=True)


def print_checks(checks: Sequence[Check]) -> None:
    """Print each check on one line, with the remedy below it."""
    for check in checks:
        verdict = f"[{VERDICTS[check.verdict]}]{check.verdict:8}[/]"
        out.print(f"{verdict} {check.name:13} {plain(check.found)}", soft_wrap=True)
        if check.remedy:
            out.print(f"{'':22} {plain(check.remedy)}", soft_wrap=True, style="dim")


def percentiles(values: Percentiles) -> str:
    """Format percentiles on one line."""
    return f"p50 {values.p50:.0f}  p99 {values.p99:.0f}  p99.9 {values.p999:.0f}  max {values.max:.0f} µs"


def budget_share(values: Percentiles, budget_us: float) -> str:
    """Format percentiles as shares of the part of a cycle that the bus leaves to the loop [µs]."""
    if budget_us <= 0.0:
        return "the bus leaves no time to the loop"
    p50, p999, worst = (f"{value / budget_us:.0%}" for value in (values.p50, values.p999, values.max))
    return f"p50 {p50}, p99.9 {p999}, worst {worst} of the {budget_us:.0f} µs that the bus leaves"


def table(first: str, *others: str) -> Table:
    """Return an empty table with these headings and right-aligned numbers; a column without a heading holds units."""
    made = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="bold")
    made.add_column(first)
    for name in others:
        made.add_column(name, justify="right" if name else "left")
    return made
