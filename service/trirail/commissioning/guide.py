"""Leads a person through the steps in order: each can be refused and repeated, and needs those before it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from trirail_drivers.interface import NAMES

from trirail import naming
from trirail.commissioning import configuration
from trirail.commissioning.bench import INTERRUPTED
from trirail.commissioning.judgement import Judged
from trirail.commissioning.node_swaps import merged
from trirail.commissioning.person import Person, Question, choose
from trirail.commissioning.report import Keeper
from trirail.commissioning.session import Done
from trirail.commissioning.steps import Steps
from trirail.config import Config


class GuideStep(NamedTuple):
    """One step of the guide."""

    name: str
    drive: str
    title: str
    what: str
    """What will happen, and what is wanted of the person: a line."""
    run: Callable[[], Done]
    needs: tuple[tuple[str, str], ...] = ()
    """Steps that must be as they should be before."""
    not_after: tuple[tuple[str, str], ...] = ()
    """Steps that must not have found anything wrong before."""


def plan(steps: Steps, config: Config) -> list[GuideStep]:
    """Return the steps in their order."""

    def named(name: str) -> str:
        return naming.drive(name, config.geometry.labels)

    made = [
        GuideStep(
            "bus",
            "",
            "Who is on the bus",
            "Reads who each drive is. Writes nothing, no drive gets power.",
            steps.session.bus,
        ),
        GuideStep(
            "setup",
            "",
            "Set-up",
            "Writes what differs into the drives' memory, reads it back, stores nothing. No drive gets power.",
            steps.session.set_up,
            (("bus", ""),),
        ),
    ]
    made += [
        GuideStep(
            "push",
            name,
            f"Slider {steps.labelled(name)} by hand",
            f"You push slider {steps.labelled(name)}, nothing has power. Refuse it (s) where it cannot be pushed.",
            partial(steps.push, name),
            (("setup", ""),),
        )
        for name in NAMES
    ]
    made += [
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
    made += [
        GuideStep(
            "move",
            name,
            f"D{named(name)[1:]} moves 1 mm",
            f"MOTION: drive {name} alone goes 1 mm and back, 5 mm/s at most. Free way on both sides; Ctrl-C stops.",
            partial(steps.move, name),
            (("power", name),),
            (("push", name),),
        )
        for name in NAMES
    ]
    made += [
        GuideStep(
            "switches",
            name,
            f"Switches of slider {steps.labelled(name)}",
            f"You press each limit switch and the home switch of slider {steps.labelled(name)} by hand; "
            "nothing has power.",
            partial(steps.switches, name),
            (("setup", ""),),
        )
        for name in NAMES
        if steps.session.tells_inputs
    ]
    made += [
        GuideStep(
            "home",
            name,
            f"Home of slider {steps.labelled(name)}",
            f"MOTION: drive {name} alone searches its home switch, as [drives.{name}.homing] says. Ctrl-C stops.",
            partial(steps.home, name),
            (("move", name),),
            (("switches", name),),
        )
        for name in NAMES
        if config.drives.each[NAMES.index(name)].homing is not None
    ]
    made += [
        GuideStep(
            "watchdog",
            name,
            f"Watchdog of {named(name)}",
            f"POWER on drive {name}, then SYNC and heartbeat end: it must let go of the slider by itself.",
            partial(steps.watchdog, name),
            (("power", name),),
            (("push", name), ("move", name)),
        )
        for name in NAMES
    ]
    needed = [(step.name, step.drive) for step in made if step.name in ("move", "home")]
    made.append(
        GuideStep(
            "square",
            "",
            "All three: a square of 1 mm",
            "MOTION of all three: the platform goes 1 mm along x, along y, and back, 5 mm/s at most. Ctrl-C stops.",
            steps.square,
            tuple(needed),
            tuple(("watchdog", name) for name in NAMES),
        )
    )
    made.append(
        GuideStep(
            "kind",
            "",
            "3-PRP or 3-PPR",
            "MOTION of all three: the platform turns, goes along x or y, and back, 5 mm/s at most. You read a dial "
            "gauge or microscope; refuse it (s) without one.",
            steps.kind,
            (("square", ""),),
        )
    )
    return made


class Guide:
    """Goes through the plan with a person, and keeps what comes of it."""

    def __init__(self, config: Config, path: Path, steps: Steps, person: Person, keeper: Keeper) -> None:
        """`path` is that of the configuration."""
        self._config = config
        self._path = path
        self._steps = steps
        self._person = person
        self._keeper = keeper

    def run(self) -> None:
        """Go through all steps. Raises Quit where the person leaves."""
        made = plan(self._steps, self._config)
        self._keeper.report.plan = tuple((step.name, step.drive) for step in made)
        if self._keeper.report.simulated:
            self._person.show(
                "Simulated drives: in brackets stands what a person beside them would answer; Enter takes it."
            )
        at = 0
        while at < len(made):
            step = made[at]
            self._person.show("")
            self._person.show(f"{at + 1}/{len(made)}  {step.title}")
            if lacks := self._lacks(step):
                self._keep(step, Judged("skipped", (lacks,)))
                at += 1
                continue
            self._person.show(f"  {step.what}")
            if step.name == "setup":
                for line in self._steps.session.changes_of_set_up():
                    self._person.show(f"  {line}")
            at = self._done(step, at)

    def write(self, out: Path | None) -> Path | None:
        """Write the configuration with what was found, to `out` or a free name beside it; None where nothing was."""
        latest = self._keeper.report.latest.values()
        changes, conflict = merged([entry.changes for entry in latest], self._config.drives)
        self._person.show("")
        if conflict:
            self._person.show(f"Node ids: {conflict}.")
        written = None
        if changes:
            written = out or configuration.free_name(self._path)
            text = configuration.changed(self._path.read_text(encoding="utf-8"), changes)
            if self._keeper.report.simulated and self._config.can.simulated.built is None:
                text = configuration.with_built(text, self._config.drives)
            if written.parent.resolve() != self._path.parent.resolve():
                text = configuration.with_whole_paths(text, self._path.parent)
            configuration.write(written, text)
            self._person.show("The configuration with what was found:")
            for key, value in changes.items():
                self._person.show(f"  {key} = {value:g}")
            self._person.show(f"is {written}; yours is as it was. Begin again with it: trirail commission {written}")
        else:
            self._person.show("Nothing in the configuration is to be changed by what was found.")
        self._keeper.conclude(changes, written)
        return written

    def _done(self, step: GuideStep, at: int) -> int:
        """Do a step as the person wants it; return where to go on."""
        choices = {"y": "do it", "s": "skip it", "b": "back to the step before"}
        choice = self._choice("  Do it? Enter or y, s skip, b back, q quit:", "y", choices)
        if choice == "s" and (step.name, step.drive) not in self._keeper.report.latest:
            self._keep(step, Judged("skipped", ("left out",)))
        while choice == "y":
            try:
                judged, measured = step.run()
            except KeyboardInterrupt as stopped:
                self._keep(step, Judged("failed", (str(stopped) or INTERRUPTED,)))
                raise
            self._keep(step, judged, measured)
            if judged.verdict == "ok":
                return at + 1
            choices = {"s": "go on", "y": "repeat it", "b": "back to the step before"}
            choice = self._choice("  Go on with the next? Enter or s, y repeat, b back, q quit:", "s", choices)
        return at + 1 if choice == "s" else max(0, at - 1)

    def _choice(self, text: str, default: str, choices: dict[str, str]) -> str:
        return choose(self._person, self._steps.session.idle, Question(text, default), choices)

    def _keep(
        self, step: GuideStep, judged: Judged, measured: dict[str, float | int | str | bool | None] | None = None
    ) -> None:
        self._keeper.add(step.name, step.drive, judged, measured or {})
        self._person.judged(judged)

    def _lacks(self, step: GuideStep) -> str:
        latest = self._keeper.report.latest
        missing = [
            f"{name} {drive}".rstrip()
            for name, drive in step.needs
            if (name, drive) not in latest or latest[name, drive].verdict != "ok"
        ]
        if missing:
            return f"not before {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} as it should be"
        wrong = [
            f"{name} {drive}".rstrip()
            for name, drive in step.not_after
            if (name, drive) in latest and latest[name, drive].verdict == "wrong"
        ]
        return f"not after what {', '.join(wrong)} has found" if wrong else ""
