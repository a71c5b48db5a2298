"""Sections [outputs] and [inputs] of a configuration file: named digital outputs and inputs of the drives."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Annotated, Literal

from msgspec import Meta, Struct
from trirail_drivers.config import DigitalIo, DriveIo
from trirail_drivers.driver.requirements import Rule
from trirail_drivers.interface import NAMES

from trirail.errors import ConfigError
from trirail.wire.marks import OutputName

__all__ = ["Input", "Output", "OutputName", "digital_io", "digital_rules"]

FIRST_BIT = 16
"""First bit in 60FDh and 60FEh that CiA 402-2 leaves to the manufacturer."""
LAST_BIT = 31


class Output(Struct, frozen=True, forbid_unknown_fields=True):
    """A digital output of a drive: section [outputs.NAME]."""

    drive: Literal["A", "B", "C"]
    """Drive that has the output."""
    bit: Annotated[int, Meta(ge=0, le=LAST_BIT)]
    """Bit of the output in object 60FEh, from the manufacturer's manual: 16 to 31, because CiA 402 reserves the others.
    Bit 0 sets the brake."""
    safe: bool = False
    """Value while the robot is disabled or in fault, and when the service ends."""
    delay: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.0
    """Switching delay of the device at the output, such as a valve [s]. On a path, the output switches earlier by this
    time."""
    always: bool = False
    """Whether the output may also be set while the robot is disabled or in fault."""


class Input(Struct, frozen=True, forbid_unknown_fields=True):
    """A digital input of a drive: section [inputs.NAME]."""

    drive: Literal["A", "B", "C"]
    """Drive that has the input."""
    bit: Annotated[int, Meta(ge=0, le=LAST_BIT)]
    """Bit of the input in object 60FDh, from the manufacturer's manual: 16 to 31, because CiA 402 reserves the others.
    Bits 0 to 3 are the limit switches, the home switch and the interlock."""


_RESERVED = {0: "sets the brake"}
"""Meaning of reserved bits of 60FEh (CiA 402-2)."""
_RESERVED_INPUTS = {
    0: "is the negative limit switch",
    1: "is the positive limit switch",
    2: "is the home switch",
    3: "is the interlock",
}
"""Meaning of reserved bits of 60FDh (CiA 402-2)."""


def named_io(outputs: Mapping[str, Output], inputs: Mapping[str, Input]) -> list[str]:
    """Return the keys of all outputs and inputs."""
    return [*(f"outputs.{name}" for name in outputs), *(f"inputs.{name}" for name in inputs)]


def digital_rules(outputs: Mapping[str, Output], inputs: Mapping[str, Input]) -> Iterator[Rule]:
    """Yield the checks of all outputs and inputs."""
    for name, output in outputs.items():
        yield Rule(f"outputs.{name}.bit", (), partial(_check_bit, f"outputs.{name}", output.bit, "60FEh", _RESERVED))
    for name, each in inputs.items():
        yield Rule(f"inputs.{name}.bit", (), partial(_check_bit, f"inputs.{name}", each.bit, "60FDh", _RESERVED_INPUTS))
    for name in outputs:
        yield Rule(f"outputs.{name}.bit", ("outputs",), partial(_check_single, "output", name, outputs))
    for name in inputs:
        yield Rule(f"inputs.{name}.bit", ("inputs",), partial(_check_single, "input", name, inputs))
    for name in inputs:
        yield Rule(f"inputs.{name}", (), partial(_check_name, name, outputs))


def _check_bit(key: str, bit: int, index: str, reserved: Mapping[int, str]) -> None:
    if bit < FIRST_BIT:
        raise ConfigError(
            f"{key}.bit = {bit}: bit {bit} of object {index} {reserved.get(bit, 'is reserved')} in CiA 402; use one of "
            f"{FIRST_BIT} to {LAST_BIT}, as in the manufacturer's manual"
        )


def _check_single(kind: str, name: str, pins: Mapping[str, Output | Input]) -> None:
    """Refuse an output or input that has the same drive and bit as an earlier one of its kind."""
    pin = pins[name]
    for other, each in itertools.takewhile(lambda item: item[0] != name, pins.items()):
        if (each.drive, each.bit) == (pin.drive, pin.bit):
            raise ConfigError(
                f"{kind}s.{name}.bit = {pin.bit}: bit {pin.bit} of drive {pin.drive} already "
                f"belongs to {kind} {other}; use another bit, or only one of the two names"
            )


def _check_name(name: str, outputs: Mapping[str, Output]) -> None:
    if name in outputs:
        raise ConfigError(f"inputs.{name}: the name {name} already belongs to an output; use another name")


def digital_io(outputs: Mapping[str, Output], inputs: Mapping[str, Input]) -> DriveIo:
    """Return the digital outputs and inputs of the drives A, B, C."""
    a, b, c = (
        DigitalIo(
            _bits(output.bit for output in outputs.values() if output.drive == name),
            _bits(output.bit for output in outputs.values() if output.drive == name and output.safe),
            _bits(each.bit for each in inputs.values() if each.drive == name),
        )
        for name in NAMES
    )
    return a, b, c


def _bits(numbers: Iterable[int]) -> int:
    return sum({1 << number for number in numbers})
