"""Active errors of a device: error register, error history and emergency messages (CiA 301, EMCY; 1001h, 1003h)."""

from __future__ import annotations

from collections.abc import Callable
from struct import Struct
from typing import Final

from canopen import SdoAbortedError

from trirail_drivers.simulated.dictionary import INVALID_VALUE, Dictionary, ObjectEntry

_EMERGENCY: Final = Struct("<HBH3x")

_GENERIC, _COMMUNICATION, _PROFILE = 0x01, 0x10, 0x20
_REGISTER_BITS: Final = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x7: _PROFILE, 0x8: _COMMUNICATION, 0xF: 0x80}
"""Bits of the error register by the first digit of the error code."""


class Emergencies:
    """Active errors of a device and their EMCY messages."""

    def __init__(self, objects: Dictionary, send: Callable[[bytes], None]) -> None:
        self._send = send
        self._register = objects.internal(0x1001, 0)
        self._count = objects.internal(0x1003, 0)
        self._history = [objects[0x1003, n] for n in range(1, 255) if (0x1003, n) in objects]
        self._active: set[tuple[int, int]] = set()
        self._muted = False
        self._held_back: bytes | None = None
        objects.on_write(0x1003, self._history_written)

    def __bool__(self) -> bool:
        """Whether an error is active."""
        return bool(self._active)

    def report(self, code: int, detail: int = 0) -> None:
        """Report an error, unless it is already active. `detail` is added to the EMCY and to the history."""
        if (code, detail) in self._active:
            return
        self._active.add((code, detail))
        self._update_register()
        self._remember(detail << 16 | code)
        self._emit(code, detail)

    def _remember(self, error: int) -> None:
        """Insert the error at the front of the history 1003h, if the device has this object."""
        if not self._history:
            return
        self._count.value = min(self._count.value + 1, len(self._history))
        for older, newer in zip(self._history[:0:-1], self._history[-2::-1], strict=True):
            older.value = newer.value
        self._history[0].value = error

    def clear(self, code: int, detail: int = 0) -> None:
        """Clear an error. When no active error is left, send "error reset" (code 0)."""
        if (code, detail) not in self._active:
            return
        self._active.remove((code, detail))
        self._update_register()
        if not self._active:
            self._emit(0, 0)

    def forget(self, but: int) -> None:
        """Drop all errors after a reset, except those with the code `but`, without sending an EMCY."""
        self._active = {key for key in self._active if key[0] == but}
        self._update_register()
        self._held_back = None

    def suppress(self, muted: bool) -> None:
        """Suppress EMCYs if `muted` (NMT state STOPPED); otherwise send the newest suppressed EMCY (CiA 301)."""
        self._muted = muted
        if not muted and self._held_back is not None:
            emergency, self._held_back = self._held_back, None
            self._send(emergency)

    def _update_register(self) -> None:
        self._register.value = 0
        for code, _ in self._active:
            self._register.value |= _register_bits(code)

    def _emit(self, code: int, detail: int) -> None:
        emergency = _EMERGENCY.pack(code, self._register.value, detail)
        if self._muted:
            self._held_back = emergency
        else:
            self._send(emergency)

    def _history_written(self, entry: ObjectEntry, _old: int) -> None:
        if entry.value:  # CiA 301, 1003h: only 0 may be written, which clears the history
            raise SdoAbortedError(INVALID_VALUE)


def _register_bits(code: int) -> int:
    if code >> 8 == 0x86:  # positioning controller: an error of the CiA 402 profile, not of communication
        return _GENERIC | _PROFILE
    return _GENERIC | _REGISTER_BITS.get(code >> 12, 0)
