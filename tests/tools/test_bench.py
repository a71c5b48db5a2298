"""Measurements run, and what they tell programs is whole; no test asserts what comes of them: see `make bench`."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import bench_aims
import bench_loop
import bench_scrape
import numpy as np
import pytest
from trirail.processes.bare_loop import Cycles

ROOT = Path(__file__).parents[2]


def measured(command: str) -> dict[str, Any]:
    """What a command tells programs, measured as briefly as can be."""
    options = ("--json", *bench_aims.BRIEF.get(command, ()))
    done = subprocess.run(
        [sys.executable, "tools/bench.py", command, *options], cwd=ROOT, stdout=subprocess.PIPE, timeout=110, check=True
    )
    told = json.loads(done.stdout)
    assert isinstance(told, dict)
    return told


def is_spread(values: list[float], quantiles: list[float]) -> bool:
    """Whether these are numbers at quantiles, rising."""
    return len(values) == len(quantiles) and all(map(math.isfinite, values)) and values == sorted(values)


def test_frames_are_measured_both_ways() -> None:
    told = measured("frames")
    assert told["cycles"] > 0
    assert told["ratio"] == told["python_can_us"]["p50"] / told["socket_us"]["p50"]


@pytest.mark.slow
def test_the_loop_is_measured_beside_the_machine() -> None:
    (told,) = measured("loop")["rates"]
    assert told["rate_hz"] == 1000
    assert told["goals"] > 0
    assert told["moving"] > 0.5
    assert set(told["parts"]) == {"sync", "read", "mode", "motion", "kinematics", "write", "record"}
    quantiles = [50.0, 99.0, 99.9, 100.0]
    assert is_spread(told["cycle"], quantiles)
    assert is_spread(told["lateness"], quantiles)
    bare = told["bare"]
    assert 0 < bare["answers"] <= 3 * bare["cycles"]
    for what in ("cycle", "lateness"):
        assert is_spread(bare[what], quantiles)
        assert told["to_bare"][what] == [a / b for a, b in zip(told[what], bare[what], strict=True)]
    for run in told["runs"]:
        assert is_spread(run["lateness"], quantiles)
        assert is_spread(run["beside"], quantiles)


@pytest.mark.slow
def test_the_time_from_a_goal_to_its_first_setpoint_is_measured() -> None:
    told = measured("latency")
    assert told["without_effect"] < 2 * told["goals"]
    for where in ("at_rest_ms", "in_motion_ms"):
        assert is_spread(told[where], told["quantiles"])
        assert told[where][0] > 0.0


@pytest.mark.slow
def test_what_one_users_flood_costs_another_is_measured() -> None:
    told = measured("fairness")
    assert told["messages_per_second"] > 0.0
    for what in ("goal", "stop"):
        for when in ("quiet", "flooded"):
            assert is_spread(told[f"{what}_{when}_ms"], told["quantiles"])
        assert told[f"{what}_p99_ratio"] == told[f"{what}_flooded_ms"][1] / told[f"{what}_quiet_ms"][1]


@pytest.mark.slow
def test_a_fleet_is_measured_behind_a_router_that_comes_and_goes() -> None:
    told = measured("fleet")
    assert told["robots"] == 6
    watched = {what: rate["robots_watched"] for what, rate in told["rates"].items()}
    assert watched == {"nobody watches": 0, "fleet": 6, "state of one": 1, "state of all": 6, "records of one": 1}
    received = {what: rate["received_per_s"] for what, rate in told["rates"].items()}
    assert received["nobody watches"] < received["fleet"] < received["state of one"] < received["state of all"]
    for what in ("fault_seen_s", "stop_direct_ms", "stop_routed_ms"):
        assert is_spread(told[what], told["quantiles"])
    assert told["router_back_s"] > 0.0
    assert told["killed_seen_s"] > 0.0


@pytest.mark.slow
def test_lateness_is_measured_with_the_cycles_of_scrapes_and_without() -> None:
    told = measured("scrape")
    assert told["scrapes"] > 0
    assert 0 < told["cycles_of_scrapes"] < told["cycles"]
    for values in (*told["lateness_us"].values(), told["lateness_of_scrapes_us"]):
        assert is_spread(values, told["quantiles"])


def test_cycles_are_of_a_scrape_from_its_beginning_to_its_end() -> None:
    spans = np.array([[1.0, 1.1], [2.0, 2.1]])
    times = np.array([0.9, 1.0, 1.05, 1.1, 1.11, 1.99, 2.1, 2.2])
    assert bench_scrape.within(times, spans).tolist() == [False, True, True, True, False, False, True, False]


@pytest.mark.slow
def test_settling_is_measured() -> None:
    told = measured("settle")
    assert told["outcomes"] == {"done": 3}
    for what in ("settle_ms", "residual_um", "overshoot_um"):
        assert is_spread(told[what], told["quantiles"])
    assert told["settle_ms"][0] > 0.0


@pytest.mark.slow
def test_sync_is_measured_beside_python_canopens() -> None:
    told = measured("peers")
    assert set(told["deviation_us"]) == {"trirail, moving", "python-canopen", "python-canopen, SCHED_FIFO"}
    for values in told["deviation_us"].values():
        assert is_spread(values, told["quantiles"])
    assert told["linuxcnc"]


def test_an_aim_is_met_where_no_number_is_greater() -> None:
    results = {"frames": {"socket_us": {"p50": 9.0}}, "latency": {"at_rest_ms": [2.0, 4.5, 9.0]}}
    rows = {row["name"]: row for row in bench_aims.table(results)}
    assert [row["met"] for name, row in rows.items() if name.startswith("frames")] == [True]
    assert [row["met"] for name, row in rows.items() if "at rest" in name] == [False]
    assert len(rows) == 2, "what was not measured is left out"


def test_a_rate_that_is_not_kept_is_said_and_not_met(capsys: pytest.CaptureFixture[str]) -> None:
    cycles = Cycles(np.array([10_000, 600_000]), np.array([20_000, 40_000]), 250_000, 5)
    bare = bench_loop.together([(cycles, 1), (cycles, 0)])
    assert (bare["cycles"], bare["answers"], bare["missed"], bare["lost_by_the_machine"]) == (4, 10, 4, 1)
    assert bare["cycle"][-1] == 40.0
    found = bench_loop.of_both({"rate_hz": 4000, "seconds": 1.0, "not_kept": "9 faults"}, bare)
    assert "to_bare" not in found
    bench_loop._show(found)
    assert "cannot keep this rate here: 9 faults" in capsys.readouterr().out
    (row,) = bench_aims.table({"loop": {"rates": [found]}})
    assert (row["name"], row["measured"], row["met"]) == ("ticks missed at 4 kHz beyond the machine's", (), False)
