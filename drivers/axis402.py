"""One CiA 402 drive as its frames tell of it: position, state, and what is wrong with it."""

from __future__ import annotations

import math

from drivers import frames
from drivers.interface import DriveFault, PowerState
from drivers.scaling import Scale

MISSED_SYNCS = 3
MISSED_HEARTBEATS = 3
RESET_TIME = 2 * frames.STATUS_PERIOD
"""How long a drive may take to leave fault after a fault reset, in which it tells its state twice [s]."""

_NMT_STATES = {frames.STOPPED: "stopped", frames.PRE_OPERATIONAL: "pre-operational"}
_IN_FAULT = (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)


class Axis:
    """One drive's newest feedback; the `on_` methods take a frame's data or raise struct.error."""

    __slots__ = (
        "_between",
        "_heartbeat_timeout",
        "_operational",
        "_prompt",
        "_restarted",
        "controlword",
        "counts",
        "cyclic",
        "error_code",
        "event",
        "follows",
        "heard",
        "held",
        "homed",
        "left_operational",
        "mode_bits",
        "mute",
        "name",
        "node",
        "position",
        "powered_up",
        "reset_until",
        "sampled",
        "scale",
        "sdo_answer",
        "seen_clear",
        "state",
        "statusword",
        "syncs",
    )

    def __init__(self, name: str, node: int, scale: Scale, heartbeat: float) -> None:
        self.name = name
        self.node = node
        self.scale = scale
        self.counts = 0
        """Actual position."""
        self.position = math.nan
        """Actual position [m]."""
        self.statusword = 0
        """The newest one."""
        self.seen_clear = 0
        """Statusword bits that have been 0 since somebody began to watch."""
        self.state = PowerState.NOT_READY_TO_SWITCH_ON
        self.powered_up = False
        """It has reached operation enabled since that was asked for."""
        self.controlword = frames.DISABLE_VOLTAGE
        """The last one sent."""
        self.mode_bits = 0
        """Controlword bits that go with "enable operation"."""
        self.held: int | None = None
        """The position [counts] that it gets in place of setpoints."""
        self.cyclic = True
        """It is in cyclic synchronous position mode for sure."""
        self.follows = True
        """It follows setpoints, or soon will: those that come are to hold it."""
        self.homed = True
        """Its position is counted from a known place."""
        self.sdo_answer: bytes | None = None
        """The newest answer about an object."""
        self.error_code = 0
        """What the drive last gave as the reason of its fault; 0 once it said that is over."""
        self.event: DriveFault | None = None
        """A fault that a frame told of, rather than a state that lasts."""
        self.heard = math.inf
        """Time of the last heartbeat [s]."""
        self.reset_until = -math.inf
        """Until when a fault reset is under way [s]."""
        self.mute = False
        """Its last heartbeat was that of a drive that sends no PDO: its state has to be asked for."""
        self.left_operational = False
        """It said that it is operational no more, and was not started again since."""
        self._operational = self._restarted = False
        self.syncs = 0
        """How many were sent."""
        self.sampled = 0
        """The number of the SYNC at which the position was sampled."""
        self._between = False
        """This cycle's frames have been read, and the next SYNC was not sent."""
        self._prompt = False
        """The last position came before the cycle of its SYNC had read."""
        self._heartbeat_timeout = MISSED_HEARTBEATS * heartbeat

    @property
    def age(self) -> int:
        """SYNCs sent after the one at which the position was sampled."""
        return self.syncs - self.sampled

    def sync_sent(self) -> None:
        """Count a SYNC: positions that come from now on may be answers to it."""
        self.syncs += 1
        self._between = False

    def read_over(self) -> None:
        """This cycle's frames have been read: positions that come from now on answer its SYNC, but late."""
        self._between = True

    def on_position(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002  one signature for all
        """TPDO2: the position sampled at a SYNC; it does not say at which.

        Answers take less than a cycle, so one that is there before the next SYNC is sent answers the last one. One
        that comes just after a SYNC answers that one where the one before is answered, or where the drive's answers
        have been so prompt; else it is the late answer to the one before.
        """
        (counts,) = frames.POSITION.unpack(data)
        self.take_position(counts)
        self._operational = True  # else it would send no PDO
        late = not self._between and not self._prompt and self.sampled < self.syncs - 1
        self.sampled = self.syncs - late
        self._prompt = not self._between and not late

    def take_position(self, counts: int) -> None:
        """Note an actual position."""
        self.counts = counts
        self.position = self.scale.metres(counts)

    def on_sdo(self, data: bytes | bytearray, now: float) -> None:
        """An SDO server's answer; one that is not eight bytes long is none (CiA 301)."""
        if len(data) != 8:
            return
        self.sdo_answer = bytes(data)
        if self.sdo_answer[:4] == frames.STATUSWORD_UPLOADED:
            self.on_status(data[4:6], now)

    def on_status(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """TPDO1: the statusword, when it changes and from time to time."""
        (statusword,) = frames.STATUSWORD.unpack(data)
        self.take_status(statusword)

    def take_status(self, statusword: int) -> None:
        """Note the state in a statusword."""
        self.statusword = statusword
        self.seen_clear |= ~statusword
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
            self.event = self._fault("state", 0, "has restarted and lost its set-up; restart the service")
        elif self._operational:  # before that, it is a heartbeat from before the drive was started
            self._operational = False
            self.left_operational = True
            self.tell("state", 0, f"left NMT operational: is {_NMT_STATES.get(state, f'in {state:02X}')}")
        self.mute = self.left_operational and state != frames.OPERATIONAL

    def forgive(self, now: float) -> None:
        """Forget what happened, but not what lasts, and allow time for a fault reset."""
        if not self._restarted:
            self.event = None
        if self.state is PowerState.FAULT:
            self.reset_until = now + RESET_TIME
        if self.left_operational:
            self.left_operational = False
            self.sampled = self.syncs

    def tell(self, cause: str, code: int, text: str) -> None:
        """Keep the first event since faults were last reset."""
        if self.event is None:
            self.event = self._fault(cause, code, text)

    def late_for(self, wanted: str, seconds: float) -> DriveFault | None:
        """What is wrong where `seconds` [s] after it was `wanted` to lose its power the drive has not.

        A drive in fault has a fault of its own to tell.
        """
        if self.state is PowerState.SWITCH_ON_DISABLED or self.state in _IN_FAULT:
            return None
        text = f"is {self.state} {seconds:g} s after {wanted}; switch on disabled was expected"
        return self._fault("timeout", 0, text)

    def fault(self, now: float, wanted: frames.Wanted) -> DriveFault | None:
        """What is wrong with the drive at time `now`, given what it was asked for."""
        if self.event is not None:
            return self.event
        if self.state in _IN_FAULT:
            if now >= self.reset_until:
                reason = f", error {self.error_code:04X}" if self.error_code else ""
                if self.reset_until > -math.inf:
                    reason += f", still {RESET_TIME:g} s after a fault reset"
                return self._fault("fault", self.error_code, f"{self.state}{reason}")
        elif self._missed >= MISSED_SYNCS:
            return self._fault("silent", 0, f"no position for {self._missed} SYNCs in a row")
        elif now - self.heard > self._heartbeat_timeout:
            return self._fault("heartbeat", 0, f"no heartbeat for {now - self.heard:.3g} s")
        elif (
            self.powered_up
            and wanted is PowerState.OPERATION_ENABLED
            and self.state is not PowerState.OPERATION_ENABLED
        ):
            return self._fault("state", 0, f"left operation enabled unasked: {self.state}")
        return None

    @property
    def _missed(self) -> int:
        """SYNCs without an answer; one whose answer is not due yet does not count."""
        return self.age - (not self._prompt)

    def _fault(self, cause: str, code: int, text: str) -> DriveFault:
        return DriveFault(self.name, cause, code, f"drive {self.name}: {text}")
