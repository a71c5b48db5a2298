"""One CiA 402 drive as its frames tell of it: position, state, and what is wrong with it."""

from __future__ import annotations

import math

from drivers import axis, frames
from drivers.interface import DriveFault, PowerState
from drivers.scaling import Scale

RESET_TIME = 2 * frames.STATUS_PERIOD
"""How long a drive may take to leave fault after a fault reset, in which it tells its state twice [s]."""

_NMT_STATES = {frames.STOPPED: "stopped", frames.PRE_OPERATIONAL: "pre-operational"}
_IN_FAULT = (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)


class Axis(axis.Axis):
    """One drive's newest feedback; the `on_` methods take a frame's data or raise struct.error."""

    __slots__ = (
        "_operational",
        "_restarted",
        "controlword",
        "error_code",
        "left_operational",
        "reset_until",
        "state",
    )

    def __init__(self, name: str, node: int, scale: Scale, heartbeat: float) -> None:
        super().__init__(name, node, scale, heartbeat)
        self.state = PowerState.NOT_READY_TO_SWITCH_ON
        self.controlword = frames.DISABLE_VOLTAGE
        """The last one sent."""
        self.error_code = 0
        """What the drive last gave as the reason of its fault; 0 once it said that is over."""
        self.reset_until = -math.inf
        """Until when a fault reset is under way [s]."""
        self.left_operational = False
        """It said that it is operational no more, and was not started again since."""
        self._operational = False
        self._restarted = False

    def on_position(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002  one signature for all
        """TPDO2: the position sampled at a SYNC."""
        (counts,) = frames.POSITION.unpack(data)
        self.position = self.scale.metres(counts)
        self.unanswered = 0

    def on_status(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """TPDO1: the statusword, when it changes and from time to time."""
        (statusword,) = frames.STATUSWORD.unpack(data)
        self.take_status(statusword)

    def take_status(self, statusword: int) -> None:
        """Note the state in a statusword."""
        state = frames.power_state(statusword)
        if state is None:
            self.tell("state", 0, f"statusword {statusword:04X} is that of no CiA 402 state")
            return
        self.state = state
        if state is PowerState.OPERATION_ENABLED:
            self.powered_up = True
        if state not in _IN_FAULT:
            self.reset_until = -math.inf

    def on_emergency(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """EMCY: an error code, of which 00xxh say that errors are over (CiA 301)."""
        code, register, _ = frames.EMERGENCY.unpack(data)
        if code & 0xFF00 == 0:
            self.error_code = 0
            return
        self.error_code = code
        self.tell("emcy", code, f"emergency {code:04X}, error register {register:02X}")

    def on_heartbeat(self, data: bytes | bytearray, now: float) -> None:
        """Heartbeat or boot-up: the drive lives, and should be operational."""
        (state,) = frames.NMT_STATE.unpack(data)
        self.heard = now
        if state == frames.OPERATIONAL:
            self._operational = True
        elif state == frames.BOOT_UP:
            self._restarted = True
            # Takes the place of an earlier event, for it is the one that a reset cannot help.
            self.event = self.made("state", 0, "has restarted and lost its set-up; restart the service")
        elif self._operational:  # before that, it is a heartbeat from before the drive was started
            self._operational = False
            self.left_operational = True
            self.tell("state", 0, f"left NMT operational: is {_NMT_STATES.get(state, f'in {state:02X}')}")

    def forgive(self, now: float) -> None:
        """Forget what happened, but not what lasts, and allow time for a fault reset."""
        if not self._restarted:
            self.event = None
        if self.state is PowerState.FAULT:
            self.reset_until = now + RESET_TIME
        if self.left_operational:
            self.left_operational = False
            self.unanswered = 0

    def fault(self, now: float, wanted: frames.Wanted) -> DriveFault | None:
        """What is wrong with the drive at time `now`, given what it was asked for."""
        if self.event is not None:
            return self.event
        if self.state in _IN_FAULT:
            if now >= self.reset_until:
                reason = f", error {self.error_code:04X}" if self.error_code else ""
                return self.made("fault", self.error_code, f"{self.state}{reason}")
        elif silent := self.silence(now):
            return silent
        elif (
            self.powered_up
            and wanted is PowerState.OPERATION_ENABLED
            and self.state is not PowerState.OPERATION_ENABLED
        ):
            return self.made("state", 0, f"left operation enabled unasked: {self.state}")
        return None
