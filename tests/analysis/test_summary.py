"""Summary of a session: its numbers are those of the robot, not those of noise or of missing records."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from trirail.analysis.summary import summarise
from trirail.cli import recording_commands
from trirail.telemetry.recording import Recording
from trirail.wire.goals import PoseGoal
from trirail.wire.packets import CommandRequest, ControlInput, GoalRequest
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import MODES, AcquireLease, Command, Mode

PERIOD = 1e-3
COUNT = 1e-7
"""One count of an encoder [m]."""
SESSION = (
    (Mode.DISABLED, 40, 0.3),
    (Mode.ENABLING, 10, 0.0),
    (Mode.HOMING, 60, 0.2),
    (Mode.HOLDING, 50, 0.0),
    (Mode.MOVING, 300, 0.05),
    (Mode.STOPPING, 20, 0.001),
    (Mode.HOLDING, 200, 0.0),
    (Mode.DISABLED, 30, 0.1),
)
"""Modes with their cycles and the travel of every slider [m]. Without power, somebody pushes the sliders."""


def session(seed: int) -> NDArray[np.void]:
    """Return records of SESSION. The encoders flicker by a count, and the homing sets their zero."""
    random, position, parts = np.random.default_rng(seed), 0.0, []
    for mode, cycles, travel in SESSION:
        part = np.zeros(cycles, DTYPE)
        part["mode"] = MODES.index(mode)
        part["commanded_position"] = np.linspace(position, position + travel, cycles)[:, None]
        position = 0.0 if mode is Mode.HOMING else position + travel
        parts.append(part)
    records = np.concatenate(parts)
    records["cycle"] = np.arange(7, 7 + len(records))
    records["backlash"] = 1e-5 * np.sign(np.arange(len(records)) % 100 - 50.5)[:, None]
    records["commanded_position"] += records["backlash"]
    records["position"] = records["commanded_position"] + COUNT * random.integers(0, 2, (len(records), 3))
    return records


def recorded(records: NDArray[np.void]) -> Recording:
    wall = np.datetime64("2026-01-01", "ns") + (records["cycle"] * 1_000_000).astype("timedelta64[ns]")
    return Recording("session", records, records["cycle"] * PERIOD, wall, [], {})


@given(st.integers(0, 2**32 - 1))
def test_the_travel_is_that_of_motions_and_not_of_noise_homing_or_hands(seed: int) -> None:
    assert summarise(recorded(session(seed))).distance == pytest.approx((0.051,) * 3, abs=1e-9)


@given(rate=st.sampled_from([rate for rate in range(1, 4001) if 1_000_000 % rate == 0]), days=st.integers(0, 400))
def test_goals_begin_in_their_cycle_also_after_days(rate: int, days: int) -> None:
    records = session(0)
    records["cycle"] += days * 86400 * rate
    nominal = records["cycle"] * (1_000_000_000 // rate) / 1e9
    requests = tuple(
        ControlInput(number, int(cycle), 0, GoalRequest(number, "ann", f"g-{number}", PoseGoal(0.0, 0.0, 0.0), 0))
        for number, cycle in enumerate(records["cycle"][::100])
    )
    goals = summarise(recorded(records)._replace(t=nominal, requests=requests)).goals
    assert [goal.given for goal in goals] == pytest.approx(nominal[::100].tolist(), abs=1e-6, rel=0.0)


@given(lost=st.sets(st.integers(1, 708)), seed=st.integers(0, 9))
def test_times_in_modes_and_without_records_add_up_to_the_duration(lost: set[int], seed: int) -> None:
    whole = session(seed)
    kept = np.delete(whole, sorted(lost))
    full, summed = summarise(recorded(whole)), summarise(recorded(kept))
    assert summed.duration == full.duration
    assert sum(summed.modes.values()) + summed.unrecorded == pytest.approx(full.duration + PERIOD)
    assert summed.unrecorded == pytest.approx(len(lost) * PERIOD)
    assert all(summed.modes[mode] <= full.modes[mode] + 1e-9 for mode in summed.modes)


def test_a_report_shows_the_time_without_records(capsys: pytest.CaptureFixture[str]) -> None:
    records = session(0)
    recording_commands._print_summary(summarise(recorded(records)))
    assert "not recorded" not in capsys.readouterr().out
    recording_commands._print_summary(summarise(recorded(np.delete(records, np.arange(150, 450)))))
    assert "not recorded 0.3 s" in " ".join(capsys.readouterr().out.split())


LEASES = st.tuples(st.sampled_from(["ann", "ben"]), st.sampled_from(["l-1", "l-2", None]))


@given(st.lists(LEASES | st.just("stop"), max_size=30))
def test_a_lease_counts_once_however_often_it_is_renewed(given_commands: list[tuple[str, str | None] | str]) -> None:
    requests = [
        CommandRequest(seq, "ann", Command.STOP)
        if isinstance(each, str)
        else CommandRequest(seq, each[0], Command.ACQUIRE, AcquireLease(each[1]))
        for seq, each in enumerate(given_commands)
    ]
    inputs = tuple(ControlInput(seq, 1, 1, request) for seq, request in enumerate(requests))
    counted = summarise(recorded(session(1))._replace(requests=inputs)).commands
    leases = [each for each in given_commands if each != "stop"]
    expected = len({each for each in leases if each[1] is not None}) + sum(each[1] is None for each in leases)
    assert counted.get("acquire", 0) == expected
    assert counted.get("stop", 0) == given_commands.count("stop")
