"""What is said of drives that are lost and return, and of sliders that are elsewhere without having been moved."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from control_rig import ControlRig, PerfectDrives
from hypothesis import given
from hypothesis import strategies as st
from trirail.control.returning_drives import JUMP_CYCLES, ReturningDrives
from trirail.wire.event_codes import EventCode, EventText
from trirail_drivers.interface import DriveFault, Feedback, PowerState, Triple, Unready

OFF = (PowerState.SWITCH_ON_DISABLED,) * 3
LABELS, WINDOWS = ("A", "B", "C"), (1e-4, 2e-4, 3e-4)
PLACES = 0.0, 1.5e-4, -2.5e-4, 3.5e-4


class Seen(NamedTuple):
    """One drive in one cycle."""

    place: float
    unready: str | None
    homed: bool
    jumps: bool


SEEN = st.builds(Seen, st.sampled_from(PLACES), st.sampled_from([*[None] * 6, "p", "q"]), st.booleans(), st.booleans())
CYCLE = st.tuples(SEEN, SEEN, SEEN)
START = (Seen(0.0, None, True, False),) * 3


def feedback(cycle: Sequence[Seen], fault: str | None = None) -> Feedback:
    a, b, c = cycle
    return Feedback(
        (a.place, b.place, c.place),
        OFF,
        DriveFault("", "bus", 0, fault) if fault is not None else None,
        homed=(a.homed, b.homed, c.homed),
        unready=(_unready(a), _unready(b), _unready(c)),
    )


def _unready(seen: Seen) -> Unready | None:
    return None if seen.unready is None else Unready(seen.unready)


def moved(text: EventText) -> tuple[object, ...]:
    return tuple(text.params[name] for name in EventCode.SLIDER_MOVED.params)


@given(st.lists(CYCLE, min_size=6, max_size=30))
def test_a_slider_has_jumped_if_it_is_elsewhere_three_cycles_later_and_its_drive_was_there_throughout(
    cycles: list[tuple[Seen, Seen, Seen]],
) -> None:
    watch, said = ReturningDrives(LABELS, WINDOWS), []
    before = START
    for number, cycle in enumerate(cycles):
        now, (a, b, c) = feedback(cycle), cycle
        places: Triple = (before[0].place, before[1].place, before[2].place)
        for level, text in watch.update_jumps(now, (a.jumps, b.jumps, c.jumps), places):
            assert (level, text.code) == ("warning", EventCode.SLIDER_MOVED)
            said.append((number, *moved(text)))
        list(watch.update(now))
        before = cycle
    expected = []
    for i, label in enumerate(LABELS):
        track = [START[i], *(cycle[i] for cycle in cycles)]
        there = [False, *(one.unready is two.unready is None for one, two in pairwise(track))]
        k = 1
        while k < len(track):
            last = k + JUMP_CYCLES
            if not (there[k] and track[k].jumps):
                k += 1
            elif not all(there[k : last + 1]):
                k = there.index(False, k)
            else:
                if last < len(track) and abs(track[last].place - track[k - 1].place) > WINDOWS[i]:
                    expected.append((last - 1, label, track[k - 1].place, track[last].place))
                k = last + 1
    assert sorted(said) == sorted(expected)


@given(st.lists(st.tuples(CYCLE, st.sampled_from([None, "p"])), min_size=4, max_size=30))
def test_each_drive_that_is_lost_or_returns_is_said_once_with_what_has_become_of_its_slider(
    cycles: list[tuple[tuple[Seen, Seen, Seen], str | None]],
) -> None:
    watch, before = ReturningDrives(LABELS, WINDOWS), START
    lost_at: dict[int, float | None] = {}
    for cycle, fault in cycles:
        expected: list[tuple[str, EventCode, tuple[object, ...]]] = []
        reported = {fault}
        for i, (label, old, new) in enumerate(zip(LABELS, before, cycle, strict=True)):
            if old.unready is None and new.unready is not None:
                lost_at[i] = new.place if new.homed else None
            if new.unready is not None:
                if new.unready != old.unready and new.unready not in reported:
                    expected.append(("warning", EventCode.DRIVE_NOT_READY, (label, new.unready)))
                    reported.add(new.unready)
            elif old.unready is not None:
                last = lost_at.pop(i)
                alone = all(each.unready is None for each in cycle)
                expected.append(("info", EventCode.DRIVES_READY if alone else EventCode.DRIVE_READY, (label,)))
                if not new.homed:
                    expected.append(("warning", EventCode.POSITION_UNKNOWN, (label,)))
                elif last is not None and abs(new.place - last) > WINDOWS[i]:
                    expected.append(("warning", EventCode.SLIDER_MOVED, (label, last, new.place)))
        said = [
            (level, text.code, tuple(text.params[name] for name in text.code.params))
            for level, text in watch.update(feedback(cycle, fault))
        ]
        assert said == expected
        before = cycle


class PushedDrives(PerfectDrives):
    """Drives whose positions are those of another zero from a SYNC on."""

    shift = 0.0

    def read(self) -> Feedback:
        told = super().read()
        a, b, c = told.position
        return told._replace(position=(a + self.shift, b, c))


def test_a_jump_is_said_once_and_watched_to_its_end_whenever_the_robot_is_enabled_afterwards() -> None:
    for after in range(1, 8):
        drives = PushedDrives()
        rig = ControlRig(driver=drives)
        rig.cycles(10)
        drives.shift = 2.1 * rig.control.setpoints.step
        rig.cycles(after)
        rig.order("enable")
        rig.cycles(10)
        assert [notice.event_code for notice in rig.notices].count(EventCode.SLIDER_MOVED) == 1, after
        assert rig.control.steady_state() is not None
