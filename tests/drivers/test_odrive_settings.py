"""How ODrives are set is read by RxSdo, and what is not as it must be counts as a missing protection."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import msgspec
import pytest
from drivers.test_odrive import CONFIG, PERIOD, Rig
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from rigs import START, Closing
from trirail.config import SIM, load
from trirail.config.loading import everything
from trirail.errors import ConfigError
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import NAMES
from trirail_drivers.odrive import cansimple, flat_endpoints
from trirail_drivers.odrive.flat_endpoints import KNOWN_TABLES, Version
from trirail_drivers.odrive.protections import (
    ABSOLUTE_SETPOINTS,
    CYCLIC,
    FROM_POWER_ON,
    HEARTBEAT,
    PROTECTIONS,
    SCALE,
    UNCHECKED,
    WATCHDOG,
    WATCHDOG_TIMEOUT,
)

S1 = Version((5, 2, 0), (0, 6, 10))
UNKNOWN = Version((5, 2, 0), (0, 6, 99))
OF = {
    WATCHDOG: "enable_watchdog",
    WATCHDOG_TIMEOUT: "enable_watchdog",
    SCALE: "input_vel_scale",
    HEARTBEAT: "heartbeat_msg_rate_ms",
    **dict.fromkeys(CYCLIC, "cyclic_messages"),
}
"""Which protection each setting is."""
VALUES: dict[str, st.SearchStrategy[float]] = {
    WATCHDOG: st.booleans(),
    WATCHDOG_TIMEOUT: st.floats(3.0 * PERIOD, 100.0) | st.sampled_from([0.02, 0.3]),  # shorter is refused, see below
    SCALE: st.sampled_from([1000, 1, 100, 10_000, 999]),
    HEARTBEAT: st.sampled_from([100, 0, 10, 99, 1000]),
    **dict.fromkeys(CYCLIC, st.sampled_from([0, 0, 0, 1, 10, 1000])),
}
SETTINGS = st.fixed_dictionaries(VALUES)


def is_right(path: str, value: float) -> bool:
    """Whether a setting is as the manual of this driver wants it, heartbeats being 0.1 s."""
    if path == WATCHDOG_TIMEOUT:
        return value <= 0.3000001  # as the float of 32 bits that it is told as
    return value == {WATCHDOG: True, SCALE: 1000, HEARTBEAT: 100}.get(path, 0)


def accepting(*names: str) -> Any:
    each = {name: msgspec.structs.replace(getattr(CONFIG, name), accept_without=names) for name in NAMES}
    return msgspec.structs.replace(CONFIG, **each)


@settings(max_examples=60)
@example(told=[{}, {WATCHDOG: False}, {}], version=None)
@given(
    told=st.lists(st.fixed_dictionaries({}, optional=VALUES), min_size=3, max_size=3),
    version=st.sampled_from([None, S1, Version((5, 2, 0), (0, 6, 8))]),
)
def test_a_setting_that_is_not_as_it_must_be_is_refused_or_accepted_and_told(
    told: list[dict[str, float]], version: Version | None
) -> None:
    """Of each drive exactly what it lacks, with path, value and what is wanted; the same where it is accepted."""
    lacks = []
    for changes in told:
        values: dict[str, float] = {WATCHDOG: True, **changes}
        wrong = {path for path, value in values.items() if not is_right(path, value)}
        if not values[WATCHDOG]:
            wrong -= {WATCHDOG_TIMEOUT}  # one that is off is that
        if version is not None and version.firmware == (0, 6, 8):
            wrong -= {SCALE, "axis0.config.can.powers_msg_rate_ms"}  # it has neither
        lacks.append(wrong)
    for accepted in ((), tuple(PROTECTIONS)):
        rig = Rig(accepting(*accepted))
        for device, changes in zip(rig.devices, told, strict=True):
            device.version = version or device.version
            device.settings |= changes
            device._due["heartbeat"] = 0.0  # one that sends none is refused for that
            device.settings[HEARTBEAT] = device.settings[HEARTBEAT]
        try:
            rig.drives.configure(PERIOD)
        except DriveError as error:
            said = str(error)
            silent = any(changes.get(HEARTBEAT) in (0, 1000) for changes in told)
            if accepted:
                assert silent
                assert "heartbeat" in said
                continue
            assert any(lacks) or silent
            for name, wrong in zip(NAMES, lacks, strict=True):
                first = name == "A" or lacks[0] != wrong
                assert not wrong or not first or f"drive {name}" in said or len(said) > 300
        else:
            assert accepted or not any(lacks)
            found = {(missing.drive, missing.object) for missing in rig.drives.missing_protections}
            assert found == {(name, OF[path]) for name, wrong in zip(NAMES, lacks, strict=True) for path in wrong}
            warned = " ".join(rig.drives.read().warnings)
            assert all(f"lacks {OF[path]}" in warned for wrong in lacks for path in wrong)
        finally:
            rig.drives.close()


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (WATCHDOG, False, "enable_watchdog, its stop when the host is silent: axis0.config.enable_watchdog is False"),
        (WATCHDOG_TIMEOUT, 5.0, "axis0.config.watchdog_timeout is 5 s, expected at most 0.3 s"),
        (SCALE, 100, "axis0.config.can.input_vel_scale is 100, expected 1000"),
        (HEARTBEAT, 50, "axis0.config.can.heartbeat_msg_rate_ms is 50, expected 100, drives.heartbeat"),
        (CYCLIC[1], 10, "axis0.config.can.encoder_msg_rate_ms is 10, expected 0"),
    ],
)
def test_each_is_said_with_what_is_wanted_and_how_to_accept_it(
    closing: Closing, path: str, value: float, said: str
) -> None:
    rig = closing(Rig())
    rig.devices[1].settings[path] = value
    with pytest.raises(DriveError) as refused:
        rig.drives.configure(PERIOD)
    assert str(refused.value).startswith("drive B lacks protections: ")
    assert said in str(refused.value)
    assert f'drives.B.accept_without = ["{OF[path]}"]' in str(refused.value)


def test_wrong_settings_end_the_start_also_where_another_drive_is_awaited(closing: Closing) -> None:
    rig = closing(Rig())
    rig.devices[0].silent = True
    rig.devices[2].settings[HEARTBEAT] = 10
    with pytest.raises(DriveError, match=r"^drive C lacks protections: heartbeat_msg_rate_ms") as refused:
        rig.drives.configure(PERIOD, awaits=True)
    assert "drive A" not in str(refused.value)


@pytest.mark.parametrize("seconds", [0.0, 0.0005, 2.9 * PERIOD])
def test_a_watchdog_that_ends_motion_is_refused_whatever_is_accepted(closing: Closing, seconds: float) -> None:
    rig = closing(Rig(accepting(*PROTECTIONS)))
    rig.devices[2].settings[WATCHDOG_TIMEOUT] = seconds
    with pytest.raises(DriveError, match=r"drive C: axis0\.config\.watchdog_timeout is .* less than 3 cycles"):
        rig.drives.configure(PERIOD)


@settings(max_examples=20)
@given(firmware=st.tuples(st.just(0), st.integers(6, 9), st.integers(0, 30)), line=st.integers(3, 9))
def test_a_firmware_that_nobody_knows_is_a_missing_protection(firmware: tuple[int, int, int], line: int) -> None:
    version = Version((line, 1, 1), firmware)
    for accepted in ((), ("endpoints",)):
        rig = Rig(accepting(*accepted))
        rig.devices[0].version = version
        try:
            if not accepted:
                with pytest.raises(DriveError, match=r"drive A lacks protections: endpoints, .*\[\"endpoints\"\]$"):
                    rig.drives.configure(PERIOD)
                continue
            rig.drives.configure(PERIOD)
            assert [(found.drive, found.object) for found in rig.drives.missing_protections] == [("A", "endpoints")]
            asked = [can_id for can_id, _ in rig.bus.sent if can_id == cansimple.identifier(0, cansimple.RX_SDO)]
            assert asked == []
        finally:
            rig.drives.close()


def test_a_development_version_is_none_that_is_known(closing: Closing) -> None:
    rig = closing(Rig())
    rig.devices[0].version = rig.devices[0].version._replace(unreleased=True)
    with pytest.raises(DriveError, match="drive A lacks protections: endpoints"):
        rig.drives.configure(PERIOD)


def table(
    version: Version,
    numbers: dict[str, int],
    types: dict[str, str] | None = None,
    more: dict[str, tuple[int, str]] | None = None,
) -> str:
    """A flat_endpoints.json, with what else such a file has, and with `more` numbers and types."""
    (known,) = [each for each in KNOWN_TABLES if each.matches(S1)]
    each = {
        path: {"id": numbers.get(path, endpoint.id), "type": (types or {}).get(path, endpoint.type)}
        for path, endpoint in known.endpoints.items()
        if numbers.get(path) != -1
    } | {path: {"id": number, "type": kind} for path, (number, kind) in (more or {}).items()}
    whole: dict[str, Any] = {
        "fw_version": ".".join(map(str, version.firmware)),
        "hw_version": ".".join(map(str, version.hardware)),
        "crc": 1,
        "endpoints": {"reboot": {"id": 3, "type": "function", "inputs": [], "outputs": []}, **each},
    }
    return json.dumps(whole)


def with_file(path: Path) -> Any:
    each = {name: msgspec.structs.replace(getattr(CONFIG, name), endpoints=str(path)) for name in NAMES}
    return msgspec.structs.replace(CONFIG, **each)


def test_a_users_own_table_makes_a_firmware_known(
    closing: Closing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "flat_endpoints.json").write_text(table(UNKNOWN, {WATCHDOG: 999}))
    own = flat_endpoints.read("A", tmp_path / "flat_endpoints.json")
    monkeypatch.setattr("trirail_drivers.simulated.odrive.KNOWN_TABLES", (own,))  # such a drive numbers them so
    rig = closing(Rig(with_file(tmp_path / "flat_endpoints.json")))
    for device in rig.devices:
        device.version = UNKNOWN
    rig.drives.configure(PERIOD)
    assert rig.drives.missing_protections == ()
    asked = {struct.unpack_from("<BHB", data)[1] for can_id, data in rig.bus.sent if can_id & 31 == cansimple.RX_SDO}
    assert 999 in asked


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (table(S1, {}), r"is for firmware 0\.6\.10 on hardware 5\.2\.0, but the drive has firmware 0\.6\.99 on"),
        (table(UNKNOWN, {WATCHDOG: -1}), r"the file lacks axis0\.config\.enable_watchdog"),
        (table(UNKNOWN, {SCALE: 70_000}), r"is endpoint 70000 of type 'uint32', which fits in no message"),
        (table(UNKNOWN, {}, {SCALE: "uint64"}), r"of type 'uint64', which fits in no message"),
        ("{}", r"is not a valid flat_endpoints\.json \(Object missing"),
        ("[", r"is not a valid flat_endpoints\.json"),
        (None, r"No such file"),
    ],
)
def test_a_table_that_is_none_or_another_drives_is_refused(
    closing: Closing, tmp_path: Path, content: str | None, said: str
) -> None:
    path = tmp_path / "flat_endpoints.json"
    if content is not None:
        path.write_text(content)
    rig = closing(Rig(with_file(path)))
    for device in rig.devices:
        device.version = UNKNOWN
    with pytest.raises(DriveError, match=rf"drives\.A\.endpoints: .*{said}"):
        rig.drives.configure(PERIOD)


def test_a_table_that_is_not_there_is_told_by_the_doctor_and_refused_of_other_drives(tmp_path: Path) -> None:
    for name in ("odrive_s1", "elmo_gold"):
        text = (SIM.parent / f"drives/{name}.toml").read_text()
        (tmp_path / f"{name}.toml").write_text(text.replace("[drives.B]", '[drives.B]\nendpoints = "no.json"'))
    (found,) = everything(tmp_path / "odrive_s1.toml").mistakes
    assert found.key == "drives.B.endpoints"
    assert f"{tmp_path}/no.json: No such file" in found.text
    with pytest.raises(ConfigError, match="only ODrives have endpoints"):
        load(tmp_path / "elmo_gold.toml")


@pytest.fixture
def absolute(closing: Closing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """Drives whose firmware, by the user's own table, has the setting absolute_setpoints."""
    (tmp_path / "flat_endpoints.json").write_text(table(UNKNOWN, {}, more={ABSOLUTE_SETPOINTS: (700, "bool")}))
    own = flat_endpoints.read("A", tmp_path / "flat_endpoints.json")
    monkeypatch.setattr("trirail_drivers.simulated.odrive.KNOWN_TABLES", (own,))
    rig = closing(Rig(with_file(tmp_path / "flat_endpoints.json")))
    for device in rig.devices:
        device.version = UNKNOWN
    return rig


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(told=st.tuples(st.booleans(), st.booleans(), st.booleans()))
def test_a_drive_whose_positions_count_from_power_on_is_named_with_the_remedy(
    absolute: Rig, told: tuple[bool, bool, bool]
) -> None:
    for device, value in zip(absolute.devices, told, strict=True):
        device.settings[ABSOLUTE_SETPOINTS] = value
    absolute.drives.configure(PERIOD)
    warnings = [line for line in absolute.drives.read().warnings if ABSOLUTE_SETPOINTS in line]
    if all(told):
        assert warnings == []
    else:
        (warning,) = warnings
        assert f"{FROM_POWER_ON}" in warning
        named = warning.partition(":")[0]
        assert [name for name, value in zip(NAMES, told, strict=True) if not value] == [n for n in NAMES if n in named]


@pytest.mark.parametrize("value", [True, False])
def test_a_drive_that_restarts_keeps_its_position_only_if_its_positions_are_absolute(
    absolute: Rig, value: bool
) -> None:
    absolute.devices[2].settings[ABSOLUTE_SETPOINTS] = value
    absolute.ready()
    assert absolute.cycles(50).homed == (True, True, True)
    absolute.devices[2].restart(absolute.clock.now)
    absolute.found("state", within=40)
    for _ in range(3000):
        if not any(absolute.cycle().unready):
            break
    absolute.drives.reset()
    feedback = absolute.cycles(100)
    assert feedback.fault is None
    assert feedback.position == pytest.approx((*START[:2], START[2] if value else 0.0), abs=1e-6)
    assert feedback.homed == (True, True, value)


def test_firmware_whose_number_of_absolute_setpoints_is_unknown_is_named_with_the_remedy(closing: Closing) -> None:
    rig = closing(Rig())
    rig.drives.configure(PERIOD)
    assert [line for line in rig.drives.read().warnings if line.endswith(UNCHECKED)]


@pytest.mark.parametrize("lost", [1, 2, 3])
def test_an_answer_that_is_lost_is_asked_for_again(closing: Closing, lost: int) -> None:
    """Three times in sdo_timeout; then the drive does not answer."""
    rig = closing(Rig())
    device, left = rig.devices[1], [lost]
    keep = device._handlers[cansimple.RX_SDO]

    def deaf(data: bytes) -> None:
        left[0] -= 1
        if left[0] < 0:
            keep(data)

    device._handlers[cansimple.RX_SDO] = deaf
    if lost < 3:
        rig.drives.configure(PERIOD)
    else:
        with pytest.raises(DriveTimeout, match=r"drive B: no answer to RxSdo of axis0\.config\.enable_watchdog"):
            rig.drives.configure(PERIOD)


def test_the_tables_are_the_makers() -> None:
    """Of each firmware at hand: version, hardware, and some numbers of its flat_endpoints.json, by hand."""
    found = {(each.fw_version, each.hw_version): each.endpoints for each in KNOWN_TABLES}
    assert set(found) == {("0.6.8", "5.2.0"), ("0.6.10", "5.2.0"), ("0.6.10", "4.4.58")}
    assert found["0.6.8", "5.2.0"][WATCHDOG].id == 201
    assert found["0.6.10", "5.2.0"][WATCHDOG].id == 214
    assert found["0.6.10", "4.4.58"][SCALE].id == 262
    assert SCALE not in found["0.6.8", "5.2.0"]
    for each in found.values():
        numbers = [endpoint.id for endpoint in each.values()]
        assert len(set(numbers)) == len(numbers)


def test_the_guide_has_every_protection() -> None:
    """One row each, with what is said of it."""
    guide = (Path(__file__).parents[2] / "drivers/requirements.md").read_text()
    section = guide.partition("## What an ODrive must be set to")[2].partition("\n## ")[0]
    rows = {row[0]: row for row in (line.strip("| ").split(" | ") for line in section.splitlines() if line[:1] == "|")}
    for name, (purpose, without) in PROTECTIONS.items():
        assert rows[name][2:] == [purpose, without]
    for each in KNOWN_TABLES:
        assert each.fw_version in section
        assert each.hw_version in section
