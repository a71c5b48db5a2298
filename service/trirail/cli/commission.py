"""`trirail commission`: guide for the first hour with real drives.

A person at a terminal or a script answers the questions, or the command accepts every proposed answer itself.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from trirail.cli import terminal
from trirail.cli.options import Flag
from trirail.errors import ConfigError

if TYPE_CHECKING:
    from trirail.commissioning.judgement import Judgement
    from trirail.commissioning.person import Question

VERDICTS = {"ok": "green", "wrong": "bold red", "failed": "red", "skipped": "yellow"}


def commission(
    config: Path,
    /,
    *,
    out: Path | None = None,
    report: Path | None = None,
    yes: Annotated[bool, Flag] = False,
    fault: Annotated[tuple[str, ...], Parameter(negative="", show_default=False, consume_multiple=False)] = (),
    json: Annotated[bool, Flag] = False,
) -> int:
    """Guide through the first hour with drives.

    It moves one drive at a time, 1 mm at 5 mm/s, and asks before each step.

    The steps are: find the nodes on the bus, set up the drives, move each slider by hand, switch on the power of one
    drive alone, move it 1 mm there and back, test the watchdogs, home, move the platform along a square, and determine
    the kind of mechanism. The command then writes a new configuration with the results. You can refuse and repeat every
    step. Ctrl-C and Ctrl-Z stop all drives immediately and end the command. A report is saved. Answers are lines of
    standard input, from a person or a script. The exit code is 0 only if the guide was followed to its end, at least
    one step was run, and no step found an error. Stop the service first.

    Parameters
    ----------
    config
        Configuration file; it is never changed.
    out
        Configuration to write. If absent, it gets an unused name beside CONFIG.
    report
        Report to write in JSON, with a text version beside it (.txt). If absent, commission-ROBOT-TIME.json.
    yes
        Ask nothing and accept every proposed answer. Only with simulated drives.
    fault
        Fault to simulate in simulated drives, such as "A reversed" or "B scale 0.5"; may be repeated.
    json
        Print the report as one JSON object; all other output goes to standard error.
    """
    from trirail.commissioning import config_edit
    from trirail.commissioning import report as reports
    from trirail.commissioning.guide import Guide
    from trirail.commissioning.opening import open_steps
    from trirail.commissioning.person import QuitRequest
    from trirail.config import load
    from trirail.telemetry.provenance import software

    settings = load(config)
    simulated = settings.can.interface == "simulated"
    if (yes or fault) and not simulated:
        option = "--yes" if yes else "--fault"
        raise ConfigError(f"{option} is only for simulated drives: a person must watch real drives")
    if out is not None:
        config_edit.check_new_file(out)
    name = f"commission-{settings.robot.name}-{time.strftime('%Y%m%d-%H%M%S')}.json"
    made = reports.CommissioningReport(settings.robot.name, str(config), reports.now(), simulated, str(software()))
    keeper = reports.ReportFile(made, report or Path(name))
    person = Console(by_itself=yes, quiet=json)
    try:
        with interruption() as interrupted, open_steps(settings, fault, person, interrupted) as steps:
            guide = Guide(settings, config, steps, person, keeper)
            try:
                with contextlib.suppress(QuitRequest):
                    guide.run()
                guide.write(out)
            finally:
                if keeper.is_saved:
                    person.show(f"Report: {keeper.path} (for people: {keeper.text_path.name})")
    except KeyboardInterrupt:
        if json and keeper.is_saved:
            terminal.json(reports.content(made))
        raise
    finally:
        keeper.remove_if_empty()
    if json:
        terminal.json(reports.content(made))
    return 0 if made.ok else 1


@contextlib.contextmanager
def interruption() -> Iterator[Callable[[], bool]]:
    """Record the signals that end or suspend a process, so that the drives are stopped first.

    The process is not suspended, since its drives would keep their power. Under nohup, SIGHUP is still ignored.
    A second Ctrl-C ends the process.
    """
    came = False

    def note(number: int, _frame: FrameType | None) -> None:
        nonlocal came
        if came and number == signal.SIGINT:
            raise KeyboardInterrupt
        came = True

    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGTSTP]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, note) for number in numbers}
    for number in (signal.SIGTTIN, signal.SIGTTOU):
        before[number] = signal.signal(number, signal.SIG_IGN)
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Console:
    """Source of answers: a person at a terminal, the lines of a script, or the proposed answers themselves."""

    def __init__(self, *, by_itself: bool, quiet: bool) -> None:
        """Create a console; `quiet` reserves standard output for the report."""
        self._by_itself = by_itself
        self._shown = terminal.err if quiet else terminal.out
        self._typed = b""
        self._open = sys.stdin is not None and not sys.stdin.closed
        self._echoes = not (self._open and sys.stdin.isatty())

    def show(self, line: str) -> None:
        """Print a line."""
        self._shown.print(terminal.plain(line), soft_wrap=True)

    def show_judgement(self, judgement: Judgement) -> None:
        """Print a verdict and its text, with the remedy below it."""
        first, *others = judgement.words
        verdict = f"[{VERDICTS[judgement.verdict]}]{judgement.verdict:8}[/]"
        self._shown.print(f"  {verdict} {terminal.plain(first)}", soft_wrap=True)
        for word in others:
            self._shown.print(f"  {'':8} {terminal.plain(word)}", soft_wrap=True)
        if judgement.remedy:
            self._shown.print(f"  {'':8} -> {terminal.plain(judgement.remedy)}", soft_wrap=True)

    def ask(self, question: Question, idle: Callable[[], object]) -> str:
        """Print a question and return the next line as the answer; the end of the input counts as quitting."""
        from trirail.commissioning.person import QuitRequest

        if not self._echoes:
            # Input typed before the question, such as a second Enter, is not an answer: the answer may start a motion.
            termios.tcflush(sys.stdin, termios.TCIFLUSH)
            self._typed = b""
        proposed = f" \\[{terminal.plain(question.default)}]" if question.default is not None else ""
        self._shown.print(f"  {terminal.plain(question.text.strip())}{proposed} ", end="", soft_wrap=True)
        while True:
            answer = self._next()
            if answer is None:
                idle()
                continue
            if self._echoes:
                self._shown.print(terminal.plain(answer or (question.default or "")))
            if answer or question.default is not None:
                return answer or question.default or ""
            if not self._open and not self._typed:
                raise QuitRequest
            self._shown.print("  enter an answer, or q to leave: ", end="")

    def _next(self) -> str | None:
        """Return the next line that was typed, or None if there is none yet."""
        if self._by_itself:
            return ""
        if b"\n" not in self._typed and self._open and select.select([sys.stdin], [], [], 0.0)[0]:
            chunk = os.read(sys.stdin.fileno(), 4096)
            self._open = bool(chunk)
            self._typed += chunk
        if b"\n" not in self._typed:
            return None if self._open else self._last()
        line, _, self._typed = self._typed.partition(b"\n")
        return line.decode(errors="replace").strip()

    def _last(self) -> str:
        """Return the text after the last line break. Raises QuitRequest if it is empty."""
        from trirail.commissioning.person import QuitRequest

        line, self._typed = self._typed.decode(errors="replace").strip(), b""
        if not line:
            raise QuitRequest
        return line
