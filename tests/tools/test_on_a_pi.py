"""The report of a user's machine: every measurement is in it, and one that failed is said to have failed."""

from __future__ import annotations

from typing import Any

import on_a_pi
import pytest

VALUES = [1.0, 2.0, 3.0, 4.0]
RESULTS: dict[str, Any] = {
    "doctor": {"checks": [{"name": "clock", "verdict": "warning", "found": "hpet"}]},
    "peers": {"machine_us": {"before": VALUES}, "deviation_us": {"trirail, moving": VALUES}},
    "loop": {
        "rates": [
            {"lateness": VALUES, "to_setpoints": VALUES, "cycles": 60_000, "missed": 3, "lost_by_the_machine": 2},
        ]
    },
}


def test_the_block_has_a_row_per_measurement() -> None:
    block = list(on_a_pi.block(RESULTS, brief=False))
    rows = [line for line in block if line.endswith("| 1 | 2 | 3 | 4 |")]
    assert len(rows) == 4
    assert "- clock: warning, hpet" in block
    assert any("3 ticks were missed; the machine itself lost 2" in line for line in block)
    assert not any("failed" in line for line in block)


@pytest.mark.parametrize("failed", sorted(RESULTS))
def test_a_failed_measurement_is_named(failed: str) -> None:
    block = list(on_a_pi.block(RESULTS | {failed: None}, brief=True))
    assert [line for line in block if "failed" in line] == [f"{failed}: failed, see the messages above."]
    assert "not for comparison" in block[0]


def test_a_rate_that_is_not_kept_is_named() -> None:
    loop = {"rate_hz": 1000, "not_kept": "90 faults in 60 s, the last: drive A is silent"}
    block = list(on_a_pi.block(RESULTS | {"loop": {"rates": [loop]}}, brief=False))
    assert block[-1] == "The loop did not keep 1000 Hz: 90 faults in 60 s, the last: drive A is silent."


def test_the_report_is_made_on_this_machine(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(on_a_pi, "COMMANDS", {"doctor": on_a_pi.COMMANDS["doctor"]})
    monkeypatch.setattr("sys.argv", ["on_a_pi.py", "--brief"])
    assert on_a_pi.main() == 0
    assert capsys.readouterr().out.startswith("### trirail on ")
