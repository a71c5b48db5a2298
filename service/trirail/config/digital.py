from __future__ import annotations

from typing import Literal

from msgspec import Struct


class Output(Struct, frozen=True, forbid_unknown_fields=True):
    drive: Literal["A", "B", "C"]
    bit: int
    safe: bool = False
    delay: float = 0.0
    always: bool = False


class Input(Struct, frozen=True, forbid_unknown_fields=True):
    drive: Literal["A", "B", "C"]
    bit: int
