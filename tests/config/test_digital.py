"""Sections [outputs] and [inputs]: what they refuse, and what they say to the driver."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.config import SIM, Config, parse
from trirail.errors import ConfigError
from trirail_drivers.config import DigitalIo
from trirail_drivers.interface import NAMES

TEXT = SIM.read_text()
VALVE = '[outputs.valve]\ndrive = "A"\nbit = 16\n'
PART = '[inputs.part]\ndrive = "B"\nbit = 16\n'


def made(*sections: str, text: str = TEXT) -> Config:
    return parse("\n".join([text, *sections]))


def table(section: str, name: str, **keys: Any) -> str:
    lines = [f"{key} = {str(value).lower() if isinstance(value, bool) else repr(value)}" for key, value in keys.items()]
    return "\n".join([f"[{section}.{name}]", *lines, ""])


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        (
            [table("outputs", "valve", drive="A", bit=0)],
            r"^outputs.valve.bit = 0: bit 0 of object 60FEh sets the brake",
        ),
        ([table("outputs", "valve", drive="A", bit=32)], r"^outputs.valve.bit = 32: .*31"),
        (
            [table("inputs", "part", drive="B", bit=2)],
            r"^inputs.part.bit = 2: bit 2 of object 60FDh is the home switch",
        ),
        ([table("inputs", "part", drive="D", bit=16)], r"^inputs.part.drive = 'D': expected one of 'A', 'B', 'C'"),
        ([VALVE, VALVE.replace("valve", "lamp")], r"^outputs.lamp.bit = 16: .* A already belongs to output valve; use"),
        (
            [PART, PART.replace("part", "door")],
            r"^inputs.door.bit = 16: .* drive B already belongs to input part; use another",
        ),
        (
            [VALVE, PART.replace("part", "valve")],
            r"^inputs.valve: the name valve already belongs to an output; use another",
        ),
        ([table("outputs", "valve", drive="A", bit=16, delay=0.2)], r"^outputs.valve.delay = 0.2: .*0.1"),
        ([table("outputs", "valve", drive="A", bit=16, delay=-0.001)], r"^outputs.valve.delay = -0.001: .*0"),
        ([table("outputs", "valve", drive="A", bit=16, pin=3)], r"outputs.valve.pin: unknown key"),
        ([table("outputs", "valve", drive="A")], r"^outputs.valve.bit: missing key"),
        ([table("outputs", '"a b"', drive="A", bit=16)], r"^outputs: 'a b' is not a valid name here"),
        ([table("inputs", '"5"', drive="A", bit=16)], r"^inputs: '5' is not a valid name here"),
    ],
)
def test_what_cannot_be_is_refused_with_key_and_remedy(sections: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        made(*sections)


@pytest.mark.parametrize("section", [VALVE, PART])
def test_odrives_have_none_and_the_refusal_says_why(section: str) -> None:
    text = TEXT.replace('protocol = "cia402"', 'protocol = "odrive"')
    assert text != TEXT
    with pytest.raises(ConfigError, match=r"^(outputs.valve|inputs.part): .*CANSimple has no message for .*GPIO"):
        made(section, text=text)


PINS = st.dictionaries(
    st.from_regex(r"[A-Za-z][A-Za-z0-9_-]{0,8}", fullmatch=True),
    st.tuples(st.booleans(), st.sampled_from(NAMES), st.integers(0, 31), st.booleans()),
    max_size=8,
)


@given(PINS)
def test_bits_are_the_makers_and_each_has_one_name(pins: dict[str, tuple[bool, str, int, bool]]) -> None:
    """Whatever is accepted is the driver's in full, and whatever is refused breaks a rule."""
    sections = [
        table("outputs", name, drive=drive, bit=bit, safe=safe) if out else table("inputs", name, drive=drive, bit=bit)
        for name, (out, drive, bit, safe) in pins.items()
    ]
    places = [(out, drive, bit) for out, drive, bit, _ in pins.values()]
    allowed = all(bit >= 16 for _, _, bit, _ in pins.values()) and len(set(places)) == len(places)
    if not allowed:
        with pytest.raises(ConfigError):
            made(*sections)
        return
    io = made(*sections).drive_io
    for each, drive in zip(io, NAMES, strict=True):
        mine = [(out, bit, safe) for out, where, bit, safe in pins.values() if where == drive]
        masks = [sum({1 << bit for bit in bits}) for bits in (
            [bit for out, bit, _ in mine if out],
            [bit for out, bit, safe in mine if out and safe],
            [bit for out, bit, _ in mine if not out],
        )]  # fmt: skip
        assert each == DigitalIo(*masks)


def test_without_them_drives_have_none() -> None:
    assert set(itertools.chain.from_iterable(made().drive_io)) == {0}
