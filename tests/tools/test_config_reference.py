"""configs/README.md names every key of the configuration, and says of each what it means."""

from collections.abc import Iterator
from typing import Any

import config_limits
import config_reference
import msgspec
import pytest
from trirail.config import SIM, load

ROWS = [
    (headings, key, row)
    for headings, kind, _ in config_reference.sections()
    for key, *row in config_reference.keys(kind)
]


def test_the_file_is_what_the_types_say() -> None:
    written = config_reference.FILE.read_text(encoding="utf-8")
    assert written == config_reference.reference(), "run python tools/config_reference.py"


@pytest.mark.parametrize(("headings", "key", "row"), ROWS, ids=lambda value: value if isinstance(value, str) else "")
def test_every_key_says_what_it_means(headings: tuple[str, ...], key: str, row: list[str]) -> None:
    _, _, meaning = row
    assert len(meaning) > 15, f"{headings[0]} {key} has no docstring"
    assert meaning.endswith("."), meaning


@pytest.mark.parametrize(
    "ends",
    ["timeout", "following_error", "velocity", "acceleration", "jerk", "passive", "_margin", "overruns", "heartbeat"],
)
def test_every_limit_and_time_out_is_in_the_table_of_where_they_stand(ends: str) -> None:
    told = {place for bound in config_limits.BOUNDS for place in bound.places}
    homing = {f"drives.{drive}.homing." for drive in "BC"}  # as those of A
    for key in config_reference.names():
        own = key.startswith(("can.", "drives.A.simulated", *homing)) or (".homing." in key and ends != "timeout")
        assert own or not key.endswith(ends) or key in told, key


def test_a_place_that_is_not_there_cannot_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for place in ("watchdogs.patience", "trirail.processes.gateway:IMPATIENCE s"):
        monkeypatch.setattr(config_limits, "BOUNDS", [config_limits.Bound("A thing", (place,), "it is refused")])
        with pytest.raises(KeyError, match=r"patience|IMPATIENCE"):
            config_limits.table(config_reference.names())


def test_the_service_bounds_the_following_error_before_the_drives_do_in_every_file_that_is_shipped() -> None:
    for path in SIM.parent.rglob("*.toml"):
        config = load(path)
        assert config.limits.slider.following_error < config.drives.following_error, path.name


def leaves(value: Any, path: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, f"{path}.{key}" if path else key)
    else:
        yield path


def test_every_key_of_a_file_that_is_shipped_is_in_the_reference() -> None:
    told = {f"{heading.strip('[]')}.{key}" for headings, key, _ in ROWS for heading in headings}
    # A table that may be absent is None where it is.
    for path in SIM.parent.rglob("*.toml"):
        for key in leaves(msgspec.to_builtins(load(path))):
            tables = {
                "geometry.leg",
                "drives.A.homing",
                "drives.B.homing",
                "drives.C.homing",
                *(f"drives.{name}.write" for name in "ABC"),
                "zenoh.tls",
                "correction.as_built",
                "can.simulated.built",
            }
            assert key in told | tables, key
