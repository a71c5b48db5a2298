"""Guide that leads a person through the steps of a commissioning.

The person can skip and repeat each step. A step may require that earlier steps were successful.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from trirail_drivers import files
from trirail_drivers.config import Drives
from trirail_drivers.errors import FileError
from trirail_drivers.interface import NAMES

from trirail import naming
from trirail.commissioning import config_edit
from trirail.commissioning.bench import INTERRUPTED
from trirail.commissioning.judgement import Changes, Judgement
from trirail.commissioning.person import Operator, Question, ask_choice
from trirail.commissioning.report import ReportFile
from trirail.commissioning.session import StepOutcome
from trirail.commissioning.steps import Steps
from trirail.config import Config
from trirail.errors import ConfigError

KEYS_OF_THE_MAKE: Final = (
    "eds",
    "endpoints",
    "velocity_unit",
    "acceleration_unit",
    "revolutions_per_metre",
    "accept_without",
    "write",
)
"""Keys of a drive that follow the drive, not the slider, if two node ids are exchanged, and that nothing measures."""
MEASURED_KEYS: Final = ("direction", "counts_per_metre")
"""Keys of a drive that follow the drive as well, and that are measured for each slider."""


def merge_changes(proposals: Sequence[Changes], drives: Drives) -> tuple[dict[str, int | float], str]:
    """Merge the changes that the steps propose; return them, and the reason why node ids cannot be changed, or "".

    If a node id moves to another slider, the slider that had this node id needs another one. The two node ids are
    therefore exchanged, unless another step contradicts the exchange. A slider without a measurement of its own then
    gets the direction and the counts per metre that are configured for its new drive.
    """
    changes = {key: value for each in proposals for key, value in each.items()}
    nodes = {name: drive.node for name, drive in zip(NAMES, drives.each, strict=True)}
    proposed = {name: int(changes.pop(f"drives.{name}.node", node)) for name, node in nodes.items()}
    moved = {name: node for name, node in proposed.items() if node != nodes[name]}
    after = {**nodes, **moved}
    free = [node for node in nodes.values() if node not in after.values()]
    for name in NAMES:
        doubled = name not in moved and after[name] in moved.values()
        has_measurement = any(key.startswith(f"drives.{name}.") for key in changes)
        if doubled and free and not has_measurement:
            after[name] = free.pop(0)
    # Measured with another drive, which a slider does not get without a change of its node id.
    others = {key: value for key, value in changes.items() if key.split(".")[1] not in moved}
    if len(set(after.values())) < len(NAMES):
        return others, "two drives moved one slider, or one drive moved two; check the cables, and repeat those steps"
    owners = {node: name for name, node in nodes.items()}
    of = dict(zip(NAMES, drives.each, strict=True))
    for name, node in after.items():
        owner = owners.get(node, name)
        if differing := [key for key in KEYS_OF_THE_MAKE if getattr(of[name], key) != getattr(of[owner], key)]:
            return others, (
                f"drives.{name}.node = {node} is that of another make: exchange the keys of drives.{name} and "
                f"drives.{owner} by hand, also {', '.join(differing)}"
            )
        if node != nodes[name]:
            changes[f"drives.{name}.node"] = node
        if node not in (nodes[name], moved.get(name)):
            differing = [key for key in MEASURED_KEYS if getattr(of[name], key) != getattr(of[owner], key)]
            changes |= {f"drives.{name}.{key}": getattr(of[owner], key) for key in differing}
    return dict(sorted(changes.items())), ""


class GuideStep(NamedTuple):
    """One step of the guide."""

    name: str
    drive: str
    title: str
    description: str
    """Line that warns the person of motion or power, and describes the person's task."""
    run: Callable[[], StepOutcome]
    needs: tuple[tuple[str, str], ...] = ()
    """Steps, each with its drive, that must be ok before this step runs."""
    not_after: tuple[tuple[str, str], ...] = ()
    """Steps, each with its drive, that prevent this step if they have found a defect."""


def plan_steps(steps: Steps, config: Config) -> list[GuideStep]:
    """Return the steps of the guide in order."""

    def named(name: str) -> str:
        return naming.drive(name, config.geometry.labels)

    plan = [
        GuideStep(
            "bus",
            "",
            "Drives on the bus",
            "Reads the identity of each drive. Writes nothing; no drive gets power.",
            steps.session.inspect_bus,
        ),
        GuideStep(
            "setup",
            "",
            "Set-up",
            "Writes different values into the drives' memory and reads them back; stores nothing. No drive gets power.",
            steps.session.set_up,
            (("bus", ""),),
        ),
    ]
    plan += [
        GuideStep(
            "push",
            name,
            f"Slider {steps.slider_label(name)} by hand",
            f"You push slider {steps.slider_label(name)}, without power. Skip it (s) if it cannot be pushed.",
            partial(steps.push, name),
            (("setup", ""),),
        )
        for name in NAMES
    ]
    plan += [
        GuideStep(
            "power",
            name,
            f"Power on {named(name)} alone",
            f"POWER on drive {name}, which holds for a second. Hand on the emergency stop; Ctrl-C stops as well.",
            partial(steps.power, name),
            (("setup", ""),),
            (("push", name),),
        )
        for name in NAMES
    ]
    plan += [
        GuideStep(
            "move",
            name,
            f"D{named(name)[1:]} moves 1 mm",
            f"MOTION: drive {name} alone moves 1 mm, or less if its limits are near, and back, up to 5 mm/s. "
            "Keep both sides free; Ctrl-C stops.",
            partial(steps.move, name),
            (("power", name),),
            (("push", name),),
        )
        for name in NAMES
    ]
    plan += [
        GuideStep(
            "switches",
            name,
            f"Switches of slider {steps.slider_label(name)}",
            f"You press each limit switch and the home switch of slider {steps.slider_label(name)} by hand, "
            "without power.",
            partial(steps.switches, name),
            (("setup", ""),),
        )
        for name in NAMES
        if steps.session.reports_inputs
    ]
    # Before homing, since a drive that has left NMT operational is no longer homed.
    plan += [
        GuideStep(
            "watchdog",
            name,
            f"Watchdog of {named(name)}",
            f"POWER on drive {name}, then SYNC and heartbeat end: it must switch its power off by itself.",
            partial(steps.watchdog, name),
            (("power", name),),
            (("push", name), ("move", name)),
        )
        for name in NAMES
    ]
    plan += [
        GuideStep(
            "home",
            name,
            f"Home of slider {steps.slider_label(name)}",
            f"MOTION: drive {name} alone searches for its home switch, as [drives.{name}.homing] says. Ctrl-C stops.",
            partial(steps.home, name),
            (("move", name),),
            (("switches", name),),
        )
        for name in NAMES
        if config.drives.each[NAMES.index(name)].homing is not None
    ]
    moves = [(step.name, step.drive) for step in plan if step.name in ("move", "home")]
    plan.append(
        GuideStep(
            "square",
            "",
            "All three: a square of 1 mm",
            "MOTION of all three: the platform moves 1 mm along x, along y, and back, up to 5 mm/s. Ctrl-C stops.",
            steps.square,
            tuple(moves),
            tuple(("watchdog", name) for name in NAMES),
        )
    )
    plan.append(
        GuideStep(
            "kind",
            "",
            "3-PRP or 3-PPR",
            "MOTION of all three: the platform turns, moves along x or y, and back, up to 5 mm/s. You read a dial "
            "gauge or microscope; skip it (s) without one.",
            steps.kind,
            (("square", ""),),
        )
    )
    return plan


class Guide:
    """Guide that runs the steps together with a person, and records the judgements in a report."""

    def __init__(self, config: Config, path: Path, steps: Steps, operator: Operator, report_file: ReportFile) -> None:
        """Create the guide; `path` is the path of the configuration file."""
        self._config = config
        self._path = path
        self._steps = steps
        self._operator = operator
        self._report_file = report_file
        self._plan = plan_steps(steps, config)

    def run(self) -> None:
        """Run all steps. Raises QuitRequest if the person quits."""
        plan = self._plan
        self._report_file.report.plan = tuple((step.name, step.drive) for step in plan)
        if self._report_file.report.simulated:
            self._operator.show(
                "Simulated drives: brackets show the answer that a person would give; Enter accepts it."
            )
        at = 0
        while at < len(plan):
            step = plan[at]
            self._operator.show("")
            self._operator.show(f"{at + 1}/{len(plan)}  {step.title}")
            if reason := self._missing(step):
                self._skip(step, reason)
                at += 1
                continue
            if warning := self._steps.session.power_warning:
                self._operator.show(f"  {warning}")
            self._operator.show(f"  {step.description}")
            if step.name == "setup":
                for line in self._steps.session.describe_setup():
                    self._operator.show(f"  {line}")
            if self._run_step(step):
                at += 1
            else:  # a step that cannot run would only lead forward again
                at = max((k for k in range(at) if not self._missing(plan[k])), default=0)

    def write(self, out: Path | None) -> Path | None:
        """Write the corrected configuration to `out`, or to an unused path in the folder of the original.

        Return the path of the new file; None if the configuration needs no correction, or if the corrected values
        contradict other values.
        """
        latest = self._report_file.report.latest.values()
        changes, conflict = merge_changes([entry.changes for entry in latest], self._config.drives)
        self._operator.show("")
        if conflict:
            self._operator.show(f"Node ids: {conflict}.")
        written = None
        if changes:
            self._operator.show("Corrected values:")
            for key, value in changes.items():
                self._operator.show(f"  {key} = {value:.10g}")
            try:
                written = self._write_changes(changes, out or config_edit.find_free_path(self._path))
                self._operator.show(
                    f"written to {written}; the original is unchanged. Start again with it: "
                    f"trirail commission {written}"
                )
            except ConfigError as error:
                self._operator.show(f"not written: {error}")
        elif self._report_file.report.complete:
            self._operator.show("The configuration needs no correction.")
        else:
            missing = ", ".join(self._report_file.report.incomplete)
            self._operator.show(f"No corrected values; steps that have not passed: {missing}.")
        self._report_file.conclude(changes, written)
        return written

    def _write_changes(self, changes: Changes, path: Path) -> Path:
        """Write a configuration with the changed values to `path`; return it. Raises ConfigError."""
        text = config_edit.edit_text(files.text(self._path), changes)
        if self._report_file.report.simulated and self._config.can.simulated.built is None:
            text = config_edit.add_simulated_build(text, self._config.drives)
        if path.parent.resolve() != self._path.parent.resolve():
            text = config_edit.resolve_paths(text, self._path.parent)
        config_edit.write_new_file(path, text)
        return path

    def _run_step(self, step: GuideStep) -> bool:
        """Ask the person to run a step, skip it or return to the previous step; return False for the previous step."""
        choices = {"y": "run it", "s": "skip it", "b": "previous step"}
        choice = self._ask("  Run it? Enter or y, s skip, b back, q quit:", "y", choices)
        if choice == "s":
            self._skip(step, "left out")
        while choice == "y":
            try:
                judgement, measured = step.run()
            except KeyboardInterrupt as interrupt:
                self._record(step, Judgement("failed", (str(interrupt) or INTERRUPTED,)))
                raise
            self._record(step, judgement, measured)
            if judgement.verdict == "ok":
                return True
            choices = {"s": "continue", "y": "repeat it", "b": "previous step"}
            choice = self._ask("  Continue with the next step? Enter or s, y repeat, b back, q quit:", "s", choices)
        return choice == "s"

    def _ask(self, text: str, default: str, choices: dict[str, str]) -> str:
        return ask_choice(self._operator, self._steps.session.idle, Question(text, default), choices)

    def _record(
        self, step: GuideStep, judgement: Judgement, measured: dict[str, float | int | str | bool | None] | None = None
    ) -> None:
        judgement, problem = self._steps.session.warn_of_power(judgement), ""
        try:
            self._report_file.add(step.name, step.drive, judgement, measured or {})
        except FileError as error:
            problem = f"  The report is not saved: {error}"
        self._operator.show_judgement(judgement)  # after the report, since the terminal may have been closed
        if problem:
            self._operator.show(problem)

    def _skip(self, step: GuideStep, reason: str) -> None:
        """Record that a step is skipped, unless it was run before: the result of its last run still counts."""
        entry = self._report_file.report.latest.get((step.name, step.drive))
        if entry is None or entry.verdict == "skipped":
            self._record(step, Judgement("skipped", (reason,)))
        else:
            self._operator.show(f"  {reason}; its last result still counts: {entry.verdict}")

    def _missing(self, step: GuideStep) -> str:
        """Return the reason why a step, or one that it needs, cannot be run; "" if the step can be run."""
        latest = self._report_file.report.latest
        missing = [
            f"{name} {drive}".rstrip()
            for name, drive in step.needs
            if (name, drive) not in latest or latest[name, drive].verdict != "ok"
        ]
        if missing:
            return f"requires {', '.join(missing)} to be ok"
        wrong = [
            f"{name} {drive}".rstrip()
            for name, drive in step.not_after
            if (name, drive) in latest and latest[name, drive].verdict == "wrong"
        ]
        if wrong:
            return f"not run after the defect that {', '.join(wrong)} found"
        reasons = (self._missing(each) for each in self._plan if (each.name, each.drive) in step.needs)
        return next(filter(None, reasons), "")
