"""One CiA 402 drive as its frames tell of it: position, state, and what is wrong with it."""

from __future__ import annotations

import math
from typing import Any

from trirail_drivers.cia402 import canopen_frames, process_data
from trirail_drivers.cia402.codes import words
from trirail_drivers.cia402.duplicate_node import AnswersAfter, AnswersPerSync, warning
from trirail_drivers.cia402.shown_mode import ShownMode
from trirail_drivers.cia402.units import Units
from trirail_drivers.config import Drives
from trirail_drivers.driver.axis import Axis
from trirail_drivers.driver.cyclic import expected
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.interface import DriveFault, PowerState

MISSED_STATUSES = 3
FOLLOW_TIME = MISSED_STATUSES * canopen_frames.STATUS_PERIOD
"""How long an enabled drive may take to say that it follows setpoints [s]."""
REGISTER_TIME = 0.5
"""How long a drive may take to tell its error register after a reset [s]."""
STILL = 2e-5
"""A slider that has been within this [m] of a place for STILL_FOR [s] stands."""
STILL_FOR = 0.1
RESET_TIME = 2 * canopen_frames.STATUS_PERIOD
"""How long a drive may take to leave fault after a fault reset, in which it tells its state twice [s]."""

_NMT_STATES = {canopen_frames.STOPPED: "stopped", canopen_frames.PRE_OPERATIONAL: "pre-operational"}
_STATE_BITS = 0x6F
"""Bits of a statusword that tell the state."""
_IN_FAULT = (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)
_WITHOUT_POWER = (PowerState.NOT_READY_TO_SWITCH_ON, PowerState.SWITCH_ON_DISABLED)
_ON_THE_WAY = (PowerState.SWITCH_ON_DISABLED, PowerState.READY_TO_SWITCH_ON, PowerState.SWITCHED_ON)
"""States from which a drive that is to be enabled goes on by controlwords."""
_CAN_MOVE_OR_SOON = (PowerState.READY_TO_SWITCH_ON, PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED)
"""States in which no drive stays that has been told to stop or to lose power."""


class Cia402Axis(Axis):
    """One drive's newest feedback; the `on_` methods take a frame's data or raise struct.error."""

    def __init__(self, name: str, node: int, scale: Scale, drives: Drives) -> None:
        super().__init__(name, node, scale, drives)
        self.set_up(process_data.usual(node), Units(scale, scale.counts_per_metre, abs(scale.counts_per_metre)))
        self.velocity_step, self.velocity_bytes = 1.0, 4
        self.still = max(1.0, abs(scale.counts_per_metre) * STILL)
        self.status_heard = self.stands_since = math.inf
        self.status_within = MISSED_STATUSES * canopen_frames.STATUS_PERIOD
        self.has_setpoint = False
        """It was sent one."""
        self.state = PowerState.NOT_READY_TO_SWITCH_ON
        self.controlword = canopen_frames.DISABLE_VOLTAGE
        """The last one sent."""
        self.mode_bits = 0
        """Controlword bits that go with "enable operation"."""
        self.held: int | None = None
        """The position [counts] that it gets in place of setpoints."""
        self.mode = ShownMode(drives.sdo_timeout)
        self.cyclic = True
        """It is for sure in the mode in which it follows setpoints."""
        self.follows = True
        """It follows setpoints, or soon will: those that come are to hold it."""
        self.has_followed = False
        """It has said that it follows setpoints, since it was to get power."""
        self.homed = True
        """Its position is counted from a known place."""
        self.sdo_answer: bytes | None = None
        """The newest answer about an object."""
        self.error_code = 0
        """What the drive last gave as the reason of its fault; 0 once it said that is over."""
        self.reset_until = -math.inf
        """Until when a fault reset is under way [s]."""
        self.mute = False
        """Its last heartbeat was that of a drive that sends no PDO: its state has to be asked for."""
        self.left_operational = False
        """It said that it is operational no more, and was not started again since."""
        self.sdo_asked: bytes | None = None
        """The index of the object that is asked about and was not answered."""
        self.poll_due = self._register_until = -math.inf
        """When its statusword is to be asked for again [s]."""
        self.register_wanted = False
        """Its error register 1001h is to be asked for."""
        self._operational = self._restarted = self._followed = self.stopped = False
        self._unfollowed_since: float | None = None
        self._answers_per_sync, self._answers_after = AnswersPerSync(self), AnswersAfter()

    def set_up(self, way: process_data.Exchange, units: Units) -> None:
        """Note what goes by which frames, and in which units."""
        self.way, self.units = way, units
        self.velocity_per_metre = units.velocity_per_metre
        self.position_at, self.velocity_at = way.setpoints.place(0), way.setpoints.place(1)

    def aim(self, target: int, offset: int) -> None:
        """Note position and velocity that it is sent, in its units."""
        self.target, self.offset, self.has_setpoint = target, offset, True

    @property
    def setpoint(self) -> tuple[int, int]:
        """What it was sent last, in its units; where that is nothing yet, the place where it is."""
        return (self.target, self.offset) if self.has_setpoint else (self.actual, 0)

    def on_position(self, data: bytes | bytearray, now: float) -> None:
        """TPDO2: the position sampled at a SYNC, and the statusword where the drive's way has it here."""
        counts, statusword = self.way.feedback.unpack(data)
        if abs(counts - self.stands_at) > self.still:
            self.stands_at, self.stands_since = counts, now
        self.stands_since = min(self.stands_since, now)
        self._answers_per_sync.come(counts)
        self.take_position(counts)
        self.answer()
        if statusword is not None:
            self.status_heard = now
            self.take_status(statusword)
        self._operational = True  # CiA 301: PDOs are sent in NMT operational only

    def rests(self, wanted: canopen_frames.Wanted) -> bool:
        """Whether nothing is to be done for it, nor found out, as long as its frames say nothing new."""
        settled = self.state is wanted and wanted is not PowerState.QUICK_STOP_ACTIVE
        told = self.event is None and not self.error_code and self.reset_until == -math.inf
        lives = self._operational and not (self.stopped or self.left_operational or self.mute or self.register_wanted)
        asked = self.sdo_asked is not None or self.way.polled or self.awaits_mode
        follows = wanted is PowerState.OPERATION_ENABLED and self.way.tells_following
        quiet = self._answers_after.idle and self._answers_per_sync.calm and self._unfollowed_since is None
        return (
            (settled and told and lives and quiet and not asked)
            and (self.cyclic and self.follows and self.holds is None and self.has_setpoint)
            and self.missed == 0
            and self._followed == follows
            and self.controlword == self.word(-math.inf, wanted)
        )

    def expected(self, number: int) -> list[tuple[Any, ...]]:
        """The frames that say nothing new of it, as rows of trirail_drivers.driver.cyclic.EXPECTED; it has a number."""
        way, word = self.way, canopen_frames.STATUSWORD.pack(self.statusword)
        decides = canopen_frames.STATUSWORD.pack(_STATE_BITS | (canopen_frames.FOLLOWS if way.tells_following else 0))
        feedback, place = way.feedback, way.feedback.place(process_data.STATUSWORD)
        data, mask = bytearray(feedback.size), bytearray(feedback.size)
        if place >= 0:
            data[place : place + 2], mask[place : place + 2] = word, decides
        position, identifier = feedback.place(process_data.ACTUAL_POSITION), feedback.identifier
        rows = [expected(identifier, number, bytes(data), bytes(mask), position_at=position, status_at=place)]
        if way.status is not None:
            rows.append(expected(way.status, number, word, decides, status_at=0))
        alive = canopen_frames.NMT_STATE.pack(canopen_frames.OPERATIONAL)
        bits = bytes([canopen_frames.NMT_STATE_BITS if way.guarded else 0xFF])
        rows.append(expected(canopen_frames.HEARTBEAT + self.node, number, alive, bits, lives=way.heard))
        return rows

    def take_position(self, counts: int) -> None:
        """Note an actual position."""
        self.actual = counts
        self.position = self.scale.metres(counts)

    def on_sdo(self, data: bytes | bytearray, now: float) -> None:
        """An SDO server's answer; one that is not eight bytes long is none (CiA 301)."""
        if len(data) != 8:
            return
        if data[1:3] == self.sdo_asked:
            self.sdo_answer, self.sdo_asked = bytes(data), None
        if data[:4] == canopen_frames.MODE_DISPLAY_UPLOADED and self.awaits_mode:
            self._take_mode(data[4])
        elif data[:4] == canopen_frames.STATUSWORD_UPLOADED:
            self.on_status(data[4:6], now)
        elif data[:4] == canopen_frames.ERROR_REGISTER_UPLOADED and now < self._register_until:
            self._register_until = -math.inf
            if data[4] == 0:
                self.error_code = 0  # CiA 301, 1001h: there is no error

    @property
    def awaits_mode(self) -> bool:
        """It has power, and is to show its mode before it gets setpoints."""
        return not self.mode.shown and self.cyclic and self.state is PowerState.OPERATION_ENABLED

    def _take_mode(self, mode: int) -> None:
        """6061h: 0 is none yet, and no other will do."""
        self.mode.shown = mode == self.way.mode
        if not self.mode.shown and mode:
            self.note_fault("state", 0, f"shows mode {mode} (object 6061), with power; wanted {self.way.mode}")

    def request(self) -> bytes:
        """What it is to be asked for by SDO: its statusword, the mode that it shows, or both in turn."""
        both = self.way.polled or self.mute
        for_mode = self.awaits_mode and self.mode.is_next(alone=not both)
        return canopen_frames.MODE_DISPLAY_UPLOAD if for_mode else canopen_frames.STATUSWORD_UPLOAD

    @property
    def holds(self) -> int | None:
        """The position [counts] that it gets in place of setpoints; None where it gets those."""
        return self.held if self.mode.shown or self.held is not None else self.actual

    def on_status(self, data: bytes | bytearray, now: float) -> None:
        """TPDO1: the statusword, when it changes and from time to time."""
        (statusword,) = canopen_frames.STATUSWORD.unpack(data)
        self.status_heard = now
        self.take_status(statusword)

    def take_status(self, statusword: int) -> None:
        """Note the state in a statusword."""
        self.statusword = statusword
        self.seen_clear |= ~statusword
        state = canopen_frames.power_state(statusword)
        if state is None:
            self.note_fault("state", 0, f"statusword {statusword:04X} is that of no CiA 402 state")
            return
        if state is PowerState.OPERATION_ENABLED:
            self.powered_up = True
        if state not in _IN_FAULT:
            if self.state in _IN_FAULT:
                self.error_code = 0  # it was the fault's reason
            self.reset_until = -math.inf
        self.state = state

    def cycle_over(self) -> DriveFault | None:
        """Note that the frames of a cycle are in: a node answers a SYNC once, and only while it is operational.

        Returns what this drive was said to have done, and another node of its id has: `event` says so from now on.
        """
        mistaken = self._answers_after.of_another(came=self.came)
        if self._answers_per_sync.from_two_nodes():
            self.note_fault("frame", 0, warning(self.node, "each SYNC has two positions"))
        if mistaken is not None:
            self._restarted = self.left_operational = self.mute = False
            by = "one has booted, or is not operational, and the other goes on"
            self.event = self.made("frame", 0, warning(self.node, by))
        return mistaken

    @property
    def shown_state(self) -> PowerState:
        """Its state; "switched on" while it has power and does not say yet that it follows setpoints."""
        waits = self.cyclic and (not self.mode.shown or (self.way.tells_following and not self.has_followed))
        return PowerState.SWITCHED_ON if waits and self.state is PowerState.OPERATION_ENABLED else self.state

    def on_emergency(self, data: bytes | bytearray, now: float) -> None:  # noqa: ARG002
        """EMCY: an error code, of which 00xxh say that errors are over (CiA 301)."""
        code, register, _ = canopen_frames.EMERGENCY.unpack(data)
        if code & 0xFF00 == 0:
            self.error_code = 0
            return
        self.error_code = code
        self.note_fault("emcy", code, f"emergency {words(code, f', error register 0x{register:02X}')}")

    def on_heartbeat(self, data: bytes | bytearray, now: float) -> None:
        """Heartbeat, answer to node guarding or boot-up: the drive lives, and should be operational."""
        (state,) = canopen_frames.NMT_STATE.unpack(data)
        if self.way.guarded:
            state &= canopen_frames.NMT_STATE_BITS
        if self.way.heard:
            self.heard = now
        self.stopped = state == canopen_frames.STOPPED
        if state == canopen_frames.OPERATIONAL:
            self._operational = True
        elif state == canopen_frames.BOOT_UP:
            self._restarted = True
            self.state = PowerState.NOT_READY_TO_SWITCH_ON
            # Takes the place of an earlier event, for it is the one that a reset cannot help.
            self.event = self.made("state", 0, "has restarted and lost its set-up; restart the service")
            self._answers_after.begin(self.event)
        elif self._operational:  # before that, it is a heartbeat from before the drive was started
            self.leave_operational()
            self.note_fault("state", 0, f"left NMT operational: is {_NMT_STATES.get(state, f'in {state:02X}')}")
            self._answers_after.begin(self.event)
        self.mute = self.left_operational and state != canopen_frames.OPERATIONAL

    def leave_operational(self) -> None:
        """It hears PDOs no more: its state is unknown until it answers, which stopped ones do not."""
        self._operational = False
        self.left_operational = True
        self.state = PowerState.NOT_READY_TO_SWITCH_ON

    @property
    def may_be_deaf(self) -> bool:
        """It may hear no PDO: what it is to do it has to be told by SDO too."""
        return self.left_operational or self.missed > 0

    def forgive(self, now: float) -> None:
        """Forget what happened, but not what lasts, and allow time for a fault reset."""
        self._answers_after.forget()
        if not self._restarted:
            self.event = None
        if self.state is PowerState.FAULT or self.left_operational:  # not operational, it did not tell of a fault
            self.reset_until = now + RESET_TIME
        if self.left_operational:
            self.left_operational = False
            self.forgive_unanswered()
            self.status_heard = now
        if self.error_code and self.state not in _IN_FAULT:
            # An EMCY that was never followed by "error reset": the register tells whether it is over.
            self.register_wanted = True
            self._register_until = now + REGISTER_TIME

    def word(self, now: float, wanted: canopen_frames.Wanted) -> int:
        """The controlword that the drive is to have at time `now`, on its way to the state that is `wanted`."""
        if self.state is PowerState.FAULT and now < self.reset_until:
            # Bit 7 stays up until the drive is out of fault: some look at it once in a few cycles only.
            return canopen_frames.FAULT_RESET
        if self.state is PowerState.QUICK_STOP_ACTIVE and self._stands(now):
            # 605Ah = 5 to 8: it would stay there, with power (CiA 402-2, transition 12). Before, it would coast.
            return canopen_frames.DISABLE_VOLTAGE
        word = canopen_frames.controlword(self.state, wanted)
        if word != canopen_frames.ENABLE_OPERATION:
            return word
        interpolates = self.way.mode == process_data.INTERPOLATED_POSITION and self.cyclic
        if interpolates and self.state is PowerState.OPERATION_ENABLED:
            word |= canopen_frames.INTERPOLATE
        return word | self.mode_bits

    def is_not_followed(self, word: int, wanted: canopen_frames.Wanted) -> bool:
        """Whether a controlword, by what the drive says, has not taken it where it is to go."""
        if self.state is PowerState.QUICK_STOP_ACTIVE:
            return word == canopen_frames.DISABLE_VOLTAGE
        if wanted is PowerState.OPERATION_ENABLED:
            return self.state in _ON_THE_WAY or not self.cyclic  # of its mode's bits the state does not tell
        return self.state in _CAN_MOVE_OR_SOON

    def _stands(self, now: float) -> bool:
        """Whether its slider stands: only positions that still come can tell."""
        return now - self.stands_since >= STILL_FOR and self.missed == 0

    def late_for(self, wanted: str, seconds: float) -> DriveFault | None:
        """What is wrong where `seconds` [s] after it was `wanted` to lose its power the drive has not.

        A drive in fault, or that is not operational, has a fault of its own to tell.
        """
        if self.state in _WITHOUT_POWER or self.state in _IN_FAULT:
            return None
        text = f"is {self.state} {seconds:g} s after {wanted}; switch on disabled was expected"
        return self.made("timeout", 0, text)

    def fault(self, now: float, wanted: canopen_frames.Wanted) -> DriveFault | None:
        """What is wrong with the drive at time `now`, given what it was asked for."""
        if self.event is not None:
            return self.event
        if self.state in _IN_FAULT:
            if now >= self.reset_until:
                still = f", still {RESET_TIME:g} s after a fault reset" if self.reset_until > -math.inf else ""
                reason = f", error {words(self.error_code, still)}" if self.error_code else still
                return self.made("fault", self.error_code, f"{self.state}{reason}")
        elif (
            self.error_code and now >= self._register_until
        ):  # CiA 301: in force until the drive sends "error reset", code 00xxh
            return self.made("emcy", self.error_code, f"emergency {words(self.error_code, ' is still in force')}")
        elif silent := self.silence(now):
            return silent
        elif now - self.status_heard > self.status_within:
            return self.made("silent", 0, f"no statusword for {now - self.status_heard:.3g} s")
        elif (
            self.powered_up
            and wanted is PowerState.OPERATION_ENABLED
            and self.state is not PowerState.OPERATION_ENABLED
        ):
            return self.made("state", 0, f"left operation enabled unasked: {self.state}")
        else:
            return self._not_following(now, wanted)
        return None

    def _not_following(self, now: float, wanted: canopen_frames.Wanted) -> DriveFault | None:
        """CiA 402-2, modes 7 and 8: bit 12 of the statusword says that setpoints are followed, not ignored."""
        if (waited := self.mode.waited(now, awaited=self.awaits_mode)) is not None:
            return self.made("state", 0, f"shows no mode (object 6061) {waited:.3g} s after it got power")
        enabled = wanted is self.state is PowerState.OPERATION_ENABLED
        meant_to = enabled and self.cyclic and self.mode.shown and self.way.tells_following
        if not meant_to or self.statusword & canopen_frames.FOLLOWS:
            self._followed = meant_to
            self.has_followed = self.has_followed or meant_to
            self._unfollowed_since = None
            return None
        if self._unfollowed_since is None:
            self._unfollowed_since = now
        if not self._followed and now - self._unfollowed_since <= FOLLOW_TIME:
            return None
        text = f"does not follow setpoints: bit 12 of its statusword {self.statusword:04X} is clear"
        never = "" if self._followed else '; if it never sets that, say accept_without = ["6041"]'
        return self.made("state", 0, text + never)
