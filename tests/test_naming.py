"""What people read has the labels of the sliders; keys, records and messages have their letters."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import calibrate
import msgspec
import numpy as np
import pytest
import trirail
from hypothesis import given
from hypothesis import strategies as st
from trirail import naming
from trirail.cli import live
from trirail.config import Config, geometry, load, parse
from trirail.config.loading import SIM
from trirail.config.tables import GeometryTable
from trirail.diagnosis.dial_gauge import CONFIG_CHECKS
from trirail.errors import ConfigError, KinematicsError
from trirail.kinematics.calibration import corrected
from trirail.kinematics.robot import inverse
from trirail.motion.limits import Bounds
from trirail.panel.description import describe
from trirail.processes.publications import info
from trirail.telemetry import curves, provenance, readout
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.readout import ReadoutState
from trirail.wire.records import DTYPE
from trirail.workspace.violations import violations
from trirail_drivers.interface import NAMES

STAGES = [path.stem for path in sorted(SIM.parent.glob("*.toml")) if load(path).geometry.labels != NAMES]
LETTER = re.compile(r"\b(slider|leg|of|rail) [ABC]\b")


def labelled(*labels: str) -> Config:
    """Return the configuration of a stage with other labels."""
    text = (SIM.parent / "uvw.toml").read_text(encoding="utf-8")
    return parse(text.replace('["U", "V", "W"]', str(list(labels))))


def test_the_shipped_stages_have_labels() -> None:
    assert STAGES == ["uvw-ppr", "uvw", "xxy"]


@given(st.lists(st.from_regex(r"[A-Za-z][A-Za-z0-9]{0,3}", fullmatch=True), min_size=3, max_size=3))
def test_labels_are_taken_unless_one_could_be_taken_for_another(labels: list[str]) -> None:
    low = [label.casefold() for label in labels]
    others = [{"a", "b", "c"} - {own} for own in "abc"]
    clear = len(set(low)) == 3 and not any(label in letters for label, letters in zip(low, others, strict=True))
    if clear and not {"n", "q"} & set(low):
        assert labelled(*labels).geometry.labels == tuple(labels)
    else:
        with pytest.raises(ConfigError, match=r"geometry\.labels"):
            labelled(*labels)


@pytest.mark.parametrize("label", ["", " U", "U V", "1", "ABCDE", "U\n", "\u202eU", "_", "U-"])
def test_what_is_not_short_and_printable_is_refused(label: str) -> None:
    with pytest.raises(ConfigError, match=r"geometry\.labels"):
        labelled(label, "V", "W")


def test_a_drive_has_the_letter_of_its_table_and_its_label() -> None:
    assert naming.drive("B", ("U", "V", "W")) == "drive B (V)"
    assert naming.drive("B", NAMES) == "drive B"


@pytest.mark.parametrize("stage", STAGES)
def test_nothing_that_people_read_of_a_stage_has_the_letter_of_a_slider(stage: str) -> None:
    config = load(SIM.parent / f"{stage}.toml")
    labels, limits = config.geometry.labels, config.limits
    told = info(config)
    robot = DrawnRobot.from_info(msgspec.convert(msgspec.to_builtins(told), type(told)))
    said = [str(each) for each in violations(robot.geometry, limits, (0.02, 0.02, 0.02))]
    bounds = Bounds(limits, config.period, labels=robot.geometry.labels)
    for number, label in enumerate(labels):
        found = bounds.setpoint_violation([np.eye(3)[number]])
        assert found is not None
        assert found.axis == NAMES[number]
        assert found.subject == f"slider {label}"
        said.append(str(found))
    with pytest.raises(KinematicsError) as wrong:
        inverse(robot.geometry, (0.0, 0.0, np.nan))
    said.append(str(wrong.value))
    said += [check.found + check.remedy for each in CONFIG_CHECKS for check in each.run(config)]
    said.append(readout.markdown(np.zeros(1, DTYPE)[0], ReadoutState(), labels))
    assert not [words for words in said if LETTER.search(words)]
    assert f"| {' | '.join(labels)} |" in said[-1]
    shown = describe(told, robot, "me", None)
    assert (shown["sliders"], shown["resolution"]["unit"]) == (labels, "µm")
    drawn = curves.plots(robot)[curves.POSITION].moving
    assert tuple(line.name for line in drawn) == labels
    assert provenance.labels(provenance.text_documents(config)) == labels
    assert provenance.labels({}) == NAMES
    assert live.limits_of(told) == limits


def test_no_source_spells_the_letters_where_it_writes_for_people() -> None:
    spelt = re.compile(r'"ABC"|slider \{(NAMES|LEGS)\[')
    for file in Path(trirail.__file__).parent.rglob("*"):
        if file.suffix in (".py", ".js"):
            assert not spelt.search(file.read_text(encoding="utf-8")), file


@pytest.mark.parametrize("stage", ["uvw", "xxy", "uvw-ppr"])
def test_a_calibrated_geometry_keeps_its_labels(stage: str) -> None:
    """The section that is written is put into a configuration as it is."""
    as_configured = geometry(load(SIM.with_name(f"{stage}.toml")).geometry)
    written = tomllib.loads(calibrate.section(corrected(as_configured, np.zeros((3, 5)))))
    read = geometry(msgspec.convert(written["geometry"], GeometryTable))
    assert (read, read.labels) == (as_configured, as_configured.labels)
