"""Digital outputs and inputs of the drives: sections [outputs.NAME] and [inputs.NAME]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from msgspec import Meta, Struct
from trirail_drivers.config import DigitalIo, DriveIo
from trirail_drivers.interface import NAMES

from trirail.errors import ConfigError

Bit = Annotated[int, Meta(ge=0, le=31)]
FIRST_BIT = 16
"""Lowest bit that may be named: those below belong to the drive (CiA 402-2: brake, limit switches, home, interlock)."""


class Output(Struct, frozen=True, forbid_unknown_fields=True):
    """One digital output of a drive: section [outputs.NAME]."""

    drive: Literal["A", "B", "C"]
    """Drive to which it is wired."""
    bit: Bit
    """Bit of object 60FEh, 16 to 31."""
    safe: bool = False
    """Value while the robot is disabled or in fault, and when the service ends."""
    delay: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.0
    """Delay of the device that is switched [s]: on a path, the output switches earlier by that."""
    always: bool = False
    """Whether it may also be set while the robot is disabled or in fault."""


class Input(Struct, frozen=True, forbid_unknown_fields=True):
    """One digital input of a drive: section [inputs.NAME]."""

    drive: Literal["A", "B", "C"]
    """Drive to which it is wired."""
    bit: Bit
    """Bit of object 60FDh, 16 to 31."""


Bits = Mapping[str, Output] | Mapping[str, Input]


def check_bit(table: str, name: str, each: Bits, others: Bits, protocol: str) -> None:
    """Check one output or input beside those of its own `table` and of the other one. Raises ConfigError."""
    key, bit = f"{table}.{name}", each[name].bit
    if protocol == "odrive":
        raise ConfigError(
            f"{key}: CANSimple has no message for the GPIO of an ODrive: leave it out, or use CiA 402 drives"
        )
    if bit < FIRST_BIT:
        meaning = (
            "the brake and reserved bits of 60FEh"
            if table == "outputs"
            else "limit switches, home and reserved bits of 60FDh"
        )
        raise ConfigError(f"{key}.bit = {bit}: bits 0 to 15 are {meaning}; use 16 to 31")
    if name in others:
        raise ConfigError(f"{key}: an output and an input have this name; use another one")
    same = [other for other, its in each.items() if (its.drive, its.bit) == (each[name].drive, bit) and other != name]
    if same:
        raise ConfigError(
            f"{key}.bit = {bit}: {table}.{same[0]} has this bit of drive {each[name].drive} too; use another one"
        )


def digital_io(outputs: Mapping[str, Output], inputs: Mapping[str, Input]) -> DriveIo:
    """Return the bits that each drive switches and reports."""

    def word(table: Bits, drive: str) -> int:
        return sum(1 << each.bit for each in table.values() if each.drive == drive)

    safe = {name: each for name, each in outputs.items() if each.safe}
    a, b, c = (DigitalIo(word(outputs, name), word(safe, name), word(inputs, name)) for name in NAMES)
    return a, b, c
