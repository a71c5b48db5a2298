"""What measurements make of what they see, and that they run; no test asserts what comes of them: see `make bench`."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bench
import bench_aims
import bench_align
import bench_fairness
import bench_frames
import bench_geometry
import bench_latency
import bench_linuxcnc
import bench_loop
import bench_peers
import bench_rig
import numpy as np
import pytest
from bare_loop import BareCycles
from bench_latency import Setpoint
from bench_rig import QUANTILES, Rig
from trirail.wire.records import PART_NAMES


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """One service for all that is measured of one, on a bus where others can listen."""
    with bench_rig.rig(1000) as made:
        yield made


def is_spread(values: list[float]) -> bool:
    """Whether these are numbers at QUANTILES, rising."""
    return len(values) == len(QUANTILES) and all(map(math.isfinite, values)) and values == sorted(values)


def assert_shown(found: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    """It is told to programs whole, and to people with every name."""
    bench.report(found, True)
    assert set(json.loads(capsys.readouterr().out)) == set(found)
    bench.report(found, False)
    shown = capsys.readouterr().out
    assert all(name in shown for name in found)


# ---------------------------------------------------------------------- that they run


def test_frames_are_measured_both_ways(capsys: pytest.CaptureFixture[str]) -> None:
    told = bench_frames.measure(50)
    assert told["ratio"] == told["python_can_us"]["p50"] / told["socket_us"]["p50"]
    assert_shown(told, capsys)


@pytest.mark.alone
def test_goals_are_measured_to_their_setpoints(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    latency = bench_latency.measure(rig, 2)
    assert latency["without_effect"] < 2 * latency["goals"]
    assert is_spread(latency["at_rest_ms"])
    assert_shown(latency, capsys)


@pytest.mark.alone
def test_what_one_users_flood_costs_another_is_measured(rig: Rig) -> None:
    told = bench_fairness.measure(rig, 4, rounds=1)
    assert told["messages_per_second"] > 0.0
    for what in ("goal", "stop"):
        assert is_spread(told[f"{what}_quiet_ms"])
        assert told[f"{what}_p99_ratio"] == told[f"{what}_flooded_ms"][1] / told[f"{what}_quiet_ms"][1]


@pytest.mark.alone
def test_the_loop_is_measured_beside_the_machine(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_loop, "MOST_FAULTS", 100.0)  # a stall of the machine does not end the measurement
    told = bench_loop.measure(0.6, (1000,), 1)
    (found,) = told["rates"]
    assert set(found["parts"]) == set(PART_NAMES)
    assert all(is_spread(found[what]) for what in ("to_setpoints", "to_record"))
    for what in ("cycle", "lateness"):
        assert is_spread(found[what])
    for name in ("bare", "bare_beside_busy"):
        bare = found[name]
        assert 0 < bare["answers"] <= 3 * bare["cycles"]
        for what in ("cycle", "lateness"):
            assert found[f"to_{name}"][what] == [a / b for a, b in zip(found[what], bare[what], strict=True)]
    assert_shown(told, capsys)


# ---------------------------------------------------------------------- what they make of what they see


def test_what_a_goal_changes_first_is_a_setpoint_after_it_with_another_feed_forward() -> None:
    before = [Setpoint(1.0, 0x301, 500), Setpoint(1.0, 0x302, -500)]
    rounding = Setpoint(1.0015, 0x301, 505)
    turn = Setpoint(1.0025, 0x302, -400)
    assert bench_latency.first_change([*before, rounding, turn], 1.001) == pytest.approx(0.0015)
    assert bench_latency.first_change([*before, rounding], 1.001) is None
    late = turn._replace(t=1.001 + 2 * bench_latency.CHANGE_TIMEOUT_S)
    assert bench_latency.first_change([*before, late], 1.001) is None


def test_the_deviation_of_an_interval_has_no_sign() -> None:
    arrivals = np.cumsum([1e-3 + 5e-6 * (-1) ** n for n in range(bench_peers.RATE)])
    assert bench_peers._deviations(arrivals.tolist()) == pytest.approx([5.0] * len(QUANTILES), abs=1e-3)


def test_linuxcnc_that_is_not_installed_or_does_not_start_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(bench_linuxcnc, "INSTALLED", False)
    assert bench_peers._linuxcnc(1.0) == "not installed (Debian's package is linuxcnc-uspace)"
    monkeypatch.setattr(bench_linuxcnc, "INSTALLED", True)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    halrun = tmp_path / "halrun"
    halrun.write_text("#!/bin/sh\necho no shared memory\nexit 1\n", encoding="utf-8")
    halrun.chmod(0o755)
    assert bench_peers._linuxcnc(1.0) == "LinuxCNC did not run: no shared memory"
    # The last word of its script is the file for the samples; a first sample of no interval is left out.
    halrun.write_text(
        '#!/bin/sh\nfile=$(tail -n 1 "$2"); file=${file##* }\necho "0 " > "$file"\necho overrun >> "$file"\n'
        'for k in 1 2 3 4 5; do echo "1007000 " >> "$file"; echo "995000 " >> "$file"; done\n',
        encoding="utf-8",
    )
    assert bench_peers._linuxcnc(0.01) == pytest.approx([6.0, 7.0, 7.0, 7.0])


def test_an_aim_is_met_where_no_number_is_greater() -> None:
    results = {"frames": {"socket_us": {"p50": 9.0}}, "latency": {"at_rest_ms": [2.0, 4.5, 9.0]}}
    rows = {row["name"]: row for row in bench_aims.table(results)}
    assert [row["met"] for name, row in rows.items() if name.startswith("frames")] == [True]
    assert [row["met"] for name, row in rows.items() if "at rest" in name] == [False]
    assert len(rows) == 2, "what was not measured is left out"


@pytest.mark.parametrize(("rate", "rows_of_rate"), [(1000, 4), (2000, 2)])
def test_a_rate_that_is_not_kept_is_said_and_not_met(rate: int, rows_of_rate: int) -> None:
    cycles = BareCycles(np.array([10_000, 600_000]), np.array([20_000, 40_000]), 250_000, 5)
    bare = bench_loop.together([(cycles, 1), (cycles, 0)])
    assert (bare["cycles"], bare["answers"], bare["missed"], bare["lost_by_the_machine"]) == (4, 10, 4, 1)
    assert bare["cycle"][-1] == 40.0
    found = bench_loop.with_ratios({"rate_hz": rate, "seconds": 1.0, "not_kept": "9 faults"}, {"bare": bare})
    assert "to_bare" not in found
    assert any("9 faults" in line for line in bench.lines({"rates": [found]}))
    rows = bench_aims.table({"loop": {"rates": [found]}})
    assert [(row["measured"], row["met"]) for row in rows] == [((), False)] * rows_of_rate


def test_goals_without_effect_count_with_the_longest_time() -> None:
    assert bench_latency.quantiles_ms([0.001] * 50 + [None] * 50)[1] == 1e3 * bench_latency.CHANGE_TIMEOUT_S


def test_a_stage_that_measured_its_geometry_needs_one_correction_where_today_it_needs_two() -> None:
    found = bench_geometry.measure(1)
    for kind in bench_align.FILES:
        calibrated, configured = found[kind]["calibrated geometry"], found[kind]["configured, cameras by 1 mm and 1°"]
        assert calibrated["reached"] == configured["reached"] == 1.0, kind
        assert calibrated["within 1 µm, 5 arcsec after one"] > configured["within 1 µm, 5 arcsec after one"], kind
        assert found[kind]["looks of a calibration"] <= 30, kind


def test_alignment_needs_one_correction_by_the_right_model_and_more_by_the_others() -> None:
    for kind, cases in bench_align.computed(4).items():
        right, built = cases["ideal"], cases["as built"]
        assert right["reached"] == built["reached"] == 1.0, kind
        assert right["reached after at most two"] == built["reached after at most two"] == 1.0, kind
        for wrong in ("small angles", "the other kind's model"):
            assert max(cases[wrong]["µm after one, p50/p95/max"]) > max(right["µm after one, p50/p95/max"]), kind


@pytest.mark.alone
def test_the_intervals_of_sync_are_measured_beside_a_plain_loop_and_the_machine() -> None:
    found = bench_peers.measure(0.3)
    assert set(found["deviation_us"]) >= {"trirail, moving", "python-canopen, SCHED_FIFO, with setpoints"}
    assert all(0.0 < values[-1] < 1e6 for values in found["deviation_us"].values())
    rows = {row["name"]: row for row in bench_aims.table({"peers": found})}
    assert [len(row["measured"]) for row in rows.values()] == [2, 2, 2]
    machine = [max(found["machine_us"][when][k] for when in ("before", "after")) for k in (1, 2)]
    ratios = [found["deviation_us"]["trirail, moving"][k] / own for k, own in zip((1, 2), machine, strict=True)]
    assert rows["SYNC's interval off its period to the machine's lateness spread, p99 / p99.9"]["measured"] == tuple(
        ratios
    )
    for name, sender in (
        ("python-canopen's with setpoints", "python-canopen, SCHED_FIFO, with setpoints"),
        ("that of a bare compiled loop", "a bare compiled loop"),
    ):
        theirs = found["deviation_us"][sender]
        assert rows[f"SYNC's interval off its period to {name}, p99 / p99.9"]["measured"] == tuple(
            found["deviation_us"]["trirail, moving"][k] / theirs[k] for k in (1, 2)
        )
