"""Commands for recorded sessions, which do not need a service: replay, report and export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter
from rich.text import Text

from trirail.cli import alignment_lines, notation, terminal
from trirail.cli.options import Flag, Json
from trirail.errors import ServiceError, TrirailError
from trirail.naming import Labels, label
from trirail.telemetry import palette

if TYPE_CHECKING:
    from trirail.analysis.replay import Comparison
    from trirail.analysis.summary import GoalSummary, Summary
    from trirail.telemetry.provenance import Software
    from trirail.telemetry.recording import Recording

Recordings = Annotated[Path, Parameter(required=True)]
"""At least one recording."""


def replay(
    *file: Recordings,
    config: Path | None = None,
    json: Json = False,
) -> int:
    """Run a recorded session through the control again, cycle by cycle, and compare the setpoints.

    With the recorded configuration and the recorded answers of the drives, the setpoints are identical to the last bit.
    The exit code is 1 if they differ although the software is the same.

    Parameters
    ----------
    file
        Recording, or all files of a rotated recording. Of several files, unreadable ones are left out.
    config
        Configuration to try instead of the recorded one; the drives are then simulated.
    """
    from trirail.analysis.replay import replay_session
    from trirail.config import load
    from trirail.telemetry import provenance

    recording = _read(file)
    settings = load(config) if config else provenance.configuration(recording.texts)
    if settings is None:
        raise ServiceError(
            f"{file[0]}: the recording does not contain its configuration, as in older versions: give it with --config"
        )
    by, here = provenance.recorded_by(recording.texts), provenance.software()
    compared = replay_session(recording, settings, simulated=config is not None)
    if json:
        same = {"same_software": by == here, "simulated_drives": config is not None}
        terminal.json({"name": recording.name} | compared._asdict() | same)
    else:
        _print_comparison(recording, compared, by, here, config)
    differs = compared.differing or compared.plans_differing
    return 1 if differs and by == here and config is None else 0


def report(*file: Recordings, plot: Path | None = None, json: Annotated[bool, Flag] = False) -> int:
    """Summarise a recorded session.

    The report contains the goals and their outcomes, the tracking error, the timing, faults, and missing data.

    Parameters
    ----------
    file
        Recording, or all files of a rotated recording. Of several files, unreadable ones are left out.
    plot
        Picture to draw. The suffix selects the format: .png, .svg or .pdf.
    json
        Print one JSON object, in SI units, instead of text.
    """
    from trirail.analysis.summary import summarise

    recording = _read(file)
    summed = summarise(recording)
    if plot:
        _draw(plot, recording, summed)
    if json:
        terminal.json(summed)
        return 0
    _print_summary(summed)
    if plot:
        terminal.print_line("")
        terminal.print_line(f"drawn to {plot}")
    return 0


export_app = App(name="export", help="Write a recorded session as a table, CSV or Parquet, or as MCAP.")


@export_app.default
def export(
    *file: Recordings,
    out: Path | None = None,
    begin: Annotated[notation.Time | None, Parameter(name="--from")] = None,
    end: Annotated[notation.Time | None, Parameter(name="--to")] = None,
    every: notation.Time | None = None,
    columns: str = "",
    goal: str | None = None,
    switches: Annotated[bool, Flag] = False,
    format: Literal["csv", "parquet", "npy", "mcap"] | None = None,  # noqa: A002 - the option's name
    json: Json = False,
) -> int:
    """Write a recorded session as a table, CSV, Parquet or numpy, or as MCAP.

    The table has one row per cycle, in SI units. The measured pose is valid only in rows with all sliders homed.
    MCAP contains ROS 2 messages for Foxglove, PlotJuggler and ros2 bag, with joints and poses only of these rows.

    Parameters
    ----------
    file
        Recording, or all files of a rotated recording. Of several files, unreadable ones are left out.
    out
        File to write; an existing file is never overwritten. The suffix selects the format: .csv, .parquet, .npy or
        .mcap. If absent, a CSV file beside the recording.
    begin
        First time to write, since the start of the service's loop, as shown by report: 12.5s.
    end
        Last time to write.
    every
        Write one row per interval, the first in each: 10ms. MCAP has every change of the mode and every event.
    columns
        Names of columns, or words in their names, separated by commas: pose,error. If absent, all columns.
    goal
        Write only the time from when the goal with this id was given until it ended.
    switches
        Write instead one row per switch of an output on a path, with the cycle and both poses. A goal has all of its
        switches, even those after its end.
    format
        Format of the file. If absent, the suffix of --out selects it.
    """
    path = out or file[0].parent / f"{file[0].stem}.{format or 'csv'}"
    if format is not None and path.suffix != f".{format}":
        raise TrirailError(f"{path}: the name of a file of format {format} must end in .{format}")
    wanted = [column.strip() for column in columns.split(",") if column.strip()]
    if path.suffix == ".mcap" and wanted:
        raise TrirailError("--columns is only for tables: MCAP messages contain all columns")
    if switches and (every is not None or wanted or path.suffix == ".mcap"):
        raise ServiceError("--switches writes a table with one row per switch: omit --every, --columns and MCAP")
    recording = _read(file)
    part = recording.part(begin, end, goal=goal)
    if path.suffix == ".mcap":
        unit, count = "messages", _write_mcap(part, path, every)
    elif switches:
        from trirail.analysis.export import write_switches

        unit, count = "rows", write_switches(recording, path, begin, end, goal)
    else:
        from trirail.analysis.export import write

        unit, count = "rows", write(part.part(every=every), path, wanted)
    if json:
        terminal.json({"file": str(path), unit: count})
    else:
        terminal.print_line(f"{count} {unit} written to {path}")
    return 0


@export_app.command
def urdf(config: Path | None = None, /, *, out: Path | None = None, json: Json = False) -> int:
    """Write the mechanism as URDF, with the joints of exported recordings.

    Parameters
    ----------
    config
        Configuration of the robot. If absent, the configuration of the simulated robot.
    out
        File to write; an existing file is never overwritten. If absent, standard output.
    """
    from trirail.analysis.new_file import new_file
    from trirail.analysis.urdf import document
    from trirail.config import SIM, geometry, load

    settings = load(config or SIM)
    text = document(settings.robot.name, geometry(settings.geometry), settings.limits)
    if out is not None:
        with new_file(out) as file:
            file.write(text.encode())
    if json:
        terminal.json({"file": str(out) if out else None, "urdf": text})
    elif out is not None:
        terminal.print_line(f"URDF written to {out}")
    else:
        terminal.write(text)
    return 0


def _write_mcap(recording: Recording, path: Path, every: float | None) -> int:
    try:
        from trirail.analysis import mcap
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "rosbags":
            raise
        raise TrirailError("MCAP needs rosbags: pip install 'trirail[mcap]'") from error
    return mcap.write(recording, path, every)


def _read(files: tuple[Path, ...]) -> Recording:
    from trirail.telemetry.reading import read_session

    return read_session(files)


def _draw(file: Path, recording: Recording, summed: Summary) -> None:
    with terminal.drawing(file):
        from trirail.analysis import charts

        charts.draw(file, recording, summed)


def _print_comparison(
    recording: Recording, compared: Comparison, by: Software | None, here: Software, config: Path | None
) -> None:
    from trirail.telemetry import provenance

    labels = provenance.labels(recording.texts)
    drives = f"simulated drives, {config}" if config else "the drives' recorded answers"
    lines = _Lines()
    lines.add("session", terminal.plain(recording.name))
    lines.add("replayed", f"{compared.cycles} cycles, {compared.requests} requests, on {drives}")
    lines.add("recorded by", terminal.plain(str(by)) if by else "[yellow]unknown software[/]")
    if by != here:
        lines.add("[yellow]replayed by[/]", f"{terminal.plain(str(here))}: other software may plan differently")
    if compared.lacking:
        lines.add("[yellow]not replayed[/]", f"{compared.lacking} cycles: what came before them is not recorded")
    if compared.plans:
        otherwise = f"[bold red]{compared.plans_differing} come out otherwise[/]"
        rounded = f"all come out the same, {compared.plans_rounded} of them except for rounding"
        alike = rounded if compared.plans_rounded else "all come out the same to the last bit"
        again = otherwise if compared.plans_differing else alike
        lines.add("plans", f"{compared.plans} as they were answered; planned again, {again}")
    else:
        lines.add("plans", "computed again: the recording has none, or those of another configuration")
    if compared.first is None:
        lines.add("setpoints", "[bold green]the same to the last bit[/], in every cycle")
    else:
        share = compared.differing / compared.cycles
        lines.add("setpoints", f"[bold red]differ[/] in {compared.differing} cycles ({share:.1%})")
        lines.add("  first", f"in cycle {compared.first}")
        lines.add("  at most", _each(labels, compared.position, 1e6, "µm"))
        lines.add("", _each(labels, compared.velocity, 1e3, "mm/s"))
    lines.show()


def _print_summary(summed: Summary) -> None:
    lines = _Lines()
    lines.add("session", f"[bold]{terminal.plain(summed.name)}[/], {summed.began}")
    lines.add("recorded by", terminal.plain(summed.software))
    times = summed.modes | ({"not recorded": summed.unrecorded} if summed.lacking else {})
    modes = ", ".join(f"{name} {_seconds(time)}" for name, time in times.items())
    lines.add("duration", f"{_seconds(summed.duration)}: {modes}")
    lines.add("moved", _each(summed.labels, summed.distance, 1.0, "m", 3))
    missed = f"[yellow]{summed.missed} missed[/]" if summed.missed else "none missed"
    lacking = f"[yellow]{summed.lacking} lack[/] in the recording" if summed.lacking else "all recorded"
    lines.add("cycles", f"{summed.cycles} at {summed.rate_hz} Hz, {missed}, {lacking}")
    lines.add("lateness", terminal.percentiles(summed.lateness_us))
    lines.add("cycle time", terminal.percentiles(summed.cycle_us))
    for tracking in summed.tracking:
        rms = f"rms {tracking.rms * 1e6:7.1f} µm, in motion {tracking.moving_rms * 1e6:7.1f} µm"
        lines.add(f"error of {label(tracking.slider, summed.labels)}", f"max {tracking.max * 1e6:7.1f} µm, {rms}")
    commands = ", ".join(f"{name} {count}×" if count > 1 else name for name, count in summed.commands.items())
    lines.add("commands", commands or "none")
    outcomes = [goal.outcome for goal in summed.goals]
    counts = ", ".join(f"{outcomes.count(outcome)} {outcome}" for outcome in dict.fromkeys(outcomes))
    lines.add("goals", counts or "none")
    lines.show()
    if summed.goals:
        _print_goals(summed.goals)
    if summed.alignments:
        alignment_lines.show_recorded(summed.alignments)
    for title, colour, incidents in (("faults", "bold red", summed.faults), ("warnings", "yellow", summed.warnings)):
        if incidents:
            terminal.out.print(f"\n[{colour}]{title}[/]")
        for incident in incidents:
            terminal.out.print(f"  {incident.t:9.3f} s  {terminal.plain(incident.message)}", soft_wrap=True)


def _print_goals(goals: list[GoalSummary]) -> None:
    """Print one line per goal, without truncating it in a narrow terminal."""
    longest = max(len(goal.id) for goal in goals)
    for goal in goals:
        begin = "before" if goal.given is None else f"{goal.given:.3f} s"
        took = "" if goal.ended is None or goal.given is None else f"{goal.ended - goal.given:.3f} s"
        colour = palette.code(palette.OUTCOMES[goal.outcome])
        name = terminal.plain(f"{goal.id:{longest}}")
        words = "" if goal.outcome == "done" else f": {terminal.plain(goal.message)}"
        if goal.settle is not None:
            words = f", settled in {goal.settle * 1e3:g} ms"
        line = f"  {begin:>11}  {took:>9}  [{colour}]{goal.outcome:9}[/]  {name}  {goal.kind} of "
        terminal.out.print(f"{line}{terminal.plain(goal.user)}{words}", soft_wrap=True)


class _Lines:
    """Lines that each begin with a name and are not truncated in a narrow terminal."""

    def __init__(self) -> None:
        self._rows: list[tuple[str, str]] = []

    def add(self, name: str, words: str) -> None:
        self._rows.append((name, words))

    def show(self) -> None:
        for name, words in self._rows:
            padding = " " * (14 - len(Text.from_markup(name)))
            terminal.out.print(f"{name}{padding}{words}", soft_wrap=True)


def _each(labels: Labels, values: tuple[float, float, float], scale: float, unit: str, digits: int = 4) -> str:
    return "   ".join(f"{name} {value * scale:.{digits}g} {unit}" for name, value in zip(labels, values, strict=True))


def _seconds(time: float) -> str:
    if time < 120.0:
        return f"{time:.1f} s"
    minutes, seconds = divmod(round(time), 60)
    return f"{minutes} min {seconds} s"
