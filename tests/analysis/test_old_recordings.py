"""Recordings of earlier versions: sessions are replayed to the last bit, and their reports name what was done."""

from __future__ import annotations

import lzma
from pathlib import Path

import pytest
from trirail.analysis.replay import replay_session
from trirail.analysis.summary import summarise
from trirail.motion.rules import RULES
from trirail.telemetry import provenance
from trirail.telemetry.reading import read

SOFTWARE_OF_BEFORE = '{"trirail": "0.1.0", "source": "0", "machine": "Linux x86_64", "versions": {}}'
RECORDINGS = sorted((Path(__file__).parents[1] / "data" / "recordings").iterdir())


@pytest.mark.parametrize("packed", RECORDINGS, ids=[each.name.removesuffix(".rrd.xz") for each in RECORDINGS])
@pytest.mark.filterwarnings("ignore:.*older version")
def test_a_recording_of_an_earlier_version_is_replayed_to_the_last_bit(packed: Path, tmp_path: Path) -> None:
    """Each session has an ordinary goal, a pause, a stop, a jog, two blended goals and power switched on and off.

    The plans are those that were recorded; planned again, they may be rounded otherwise on this processor.
    """
    path = tmp_path / "session.rrd"
    path.write_bytes(lzma.decompress(packed.read_bytes()))
    recording = read(path)
    config = provenance.configuration(recording.texts)
    assert config is not None
    comparison = replay_session(recording, config, simulated=False)
    assert (comparison.differing, comparison.plans_differing, comparison.lacking) == (0, 0, 0)
    assert comparison.cycles > 200
    assert comparison.requests >= 10
    assert comparison.plans >= 4
    outcomes = [goal.outcome for goal in summarise(recording).goals]
    assert outcomes.count("done") >= 3
    assert "stopped" in outcomes


def test_there_are_recordings_of_three_earlier_versions() -> None:
    assert len(RECORDINGS) >= 3


def test_a_recording_names_the_rules_of_its_changes_of_rate() -> None:
    assert provenance.recorded_by({provenance.SOFTWARE: SOFTWARE_OF_BEFORE}).rules == 1  # type: ignore[union-attr]
    assert provenance.software().rules == RULES > 1
