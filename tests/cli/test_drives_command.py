"""`trirail drives`: what simulated drives say of themselves, and what their set-up would change."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from trirail.cli.commands import app
from trirail.config import SIM
from trirail_drivers.errors import DriveError


def run(*words: str) -> int:
    return int(app(list(words), result_action="return_value") or 0)


def test_differences_are_shown_and_not_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", str(SIM), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["ok"], told["applied"]) == (True, False)
    assert [(drive["name"], drive["node"], drive["device_type"]) for drive in told["drives"]] == [
        ("A", 1, "00020192"),
        ("B", 2, "00020192"),
        ("C", 3, "00020192"),
    ]
    for drive in told["drives"]:
        assert (drive["velocity_unit"], drive["acceleration_unit"]) == ("counts/s", "counts/s2")
        changes = {each["object"]: (each["found"], each["wanted"]) for each in drive["differences"]}
        assert changes["1017:00"] == ("0", "100")
        assert changes["6060:00"] == ("0", "8")


def test_differences_are_written_when_that_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", str(SIM), "--apply") == 0
    words = capsys.readouterr().out
    assert "drive C, node 3" in words
    assert "written: 1017:00 Producer heartbeat time: 0 -> 100, for this service's watch on it" in words


def test_drives_that_tell_nothing(tmp_path: Path) -> None:
    text = SIM.read_text().replace('protocol = "cia402"', 'protocol = "odrive"')
    text = text.replace("counts_per_metre = 1e7", "counts_per_metre = 30.0")
    (tmp_path / "odrive.toml").write_text(text)
    with pytest.raises(DriveError, match="have no objects to be shown"):
        run("drives", str(tmp_path / "odrive.toml"))
