"""Fault injection into the frames between a bus and its simulated drives, and into the drives themselves."""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import random
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from trirail_drivers import files
from trirail_drivers.bus import canerrors
from trirail_drivers.bus.can_frame import ERROR
from trirail_drivers.errors import DriveError, FileError
from trirail_drivers.interface import NAMES, Clock, PowerState
from trirail_drivers.simulated.carriages import Carriages, DriveMounting
from trirail_drivers.simulated.devices import SimulatedDevice
from trirail_drivers.simulated.emergency import Emergencies
from trirail_drivers.simulated.faultlines import OF_PINS, OF_SLIDERS, Condition, Fault, FaultSyntaxError, Frames, parse
from trirail_drivers.simulated.servo import INTACT

MOVING: Final = 1e-3
"""Minimum speed at which a slider counts as moving [m/s]."""
BABBLED: Final = 7000.0
"""Frame rate of a node that saturates a bus of 1 Mbit/s [1/s]."""
MOST_BABBLED: Final = 100
"""Maximum number of babbled frames in one poll. It matters if the receiver has not polled for a long time."""

_STOPPING = (PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
_FAULTY = (PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT)
_ALL_FRAMES = (Frames(None, None),)

Deliver = Callable[[bytes], None]


def _to_nobody(*_said: object) -> None:
    """Discard an announcement of a fault, or a frame, because there is no receiver."""


class _ActiveFault:
    """Pending or active fault."""

    def __init__(self, fault: Fault, since: float) -> None:
        self.fault = fault
        self.since = since
        self.begun = False
        self.struck = 0

    @property
    def over(self) -> bool:
        return self.fault.number is not None and self.struck >= self.fault.number

    def strikes(self, index: int, to_drive: bool, can_id: int, node: int) -> bool:
        if not self.begun or self.over or index not in self.fault.drives:
            return False
        return any(frames.match(to_drive, can_id, node) for frames in self.fault.frames or _ALL_FRAMES)


class Faults:
    """Faults of one bus and its drives. Random numbers are seeded, so that the same calls produce the same faults."""

    def __init__(
        self,
        drives: Sequence[SimulatedDevice],
        counts_per_metre: Sequence[float],
        frames: Mapping[str, Frames],
        seed: int = 0,
        announce: Callable[[str], None] = _to_nobody,
        mounted: Sequence[DriveMounting] | None = None,
    ) -> None:
        """`counts_per_metre` is negative if the counts decrease as the slider position increases.

        `frames` maps the names that lines may use to frames. `announce` is called when a fault begins or ends.
        `mounted` contains the slider that each drive actually moves and its counts per metre, if these differ from the
        drive's own slider and `counts_per_metre`. A line names a drive by the slider that it actually moves.
        """
        self.announce = announce
        self._mounted = (
            [DriveMounting(*each) for each in enumerate(counts_per_metre)] if mounted is None else list(mounted)
        )
        self._drive_of = {each.slider: index for index, each in enumerate(self._mounted)}
        self.carriages = Carriages([drive.servo for drive in drives], [each.counts_per_metre for each in self._mounted])
        """Actual positions of the sliders."""
        for index, each in enumerate(self._mounted):
            self.carriages.couple(index, each.slider, 1.0)
        self._drives = drives
        self._frames = frames
        self._scales = [each.counts_per_metre for each in self._mounted]
        """Counts of each drive per metre of actual slider travel."""
        self._random = random.Random(seed)
        self._active: list[_ActiveFault] = []
        self._held: list[tuple[float, int, Deliver, bytes]] = []
        self._order = itertools.count()
        self._clock: Clock = lambda: 0.0
        self._now = 0.0
        self._emit: Callable[[int, bytes], None] = _to_nobody

    def connect(self, emit: Callable[[int, bytes], None], clock: Clock) -> None:
        """Set the clock [s], and the function `emit(identifier with flags, data)` that receives injected frames."""
        self._emit = emit
        self._clock = clock

    @property
    def idle(self) -> bool:
        """Whether no fault is pending or active and no frame is delayed."""
        return not self._active and not self._held

    @property
    def bus_off(self) -> bool:
        """Whether the master's controller is bus-off and can neither send nor receive."""
        return any(active.begun and active.fault.name == "bus-off" for active in self._active)

    def seed(self, value: int) -> None:
        """Reseed the random number generator."""
        self._random.seed(value)

    def add(self, line: str) -> None:
        """Add the fault described by a line. Raises FaultSyntaxError."""
        fault = self._with_drive_indices(parse(line, self._frames))
        if fault.name == "emcy":
            for index in fault.drives:
                if self._drives[index].emergencies is None:
                    raise FaultSyntaxError(f"{line}: drive {NAMES[index]} has no EMCY; as in: {NAMES[index]} fault 200")
        if fault.name in OF_PINS:
            for index in fault.drives:
                if self._drives[index].pins is None:
                    raise FaultSyntaxError(f"{line}: drive {NAMES[index]} has no digital inputs or outputs")
        if self.idle:
            self._now = self._clock()
        self._active.append(_ActiveFault(fault, self._now))

    def _with_drive_indices(self, fault: Fault) -> Fault:
        """Return the fault with the indices of drives instead of the indices of the sliders that they move."""
        condition, drives = fault.condition, fault.drives
        if fault.name not in OF_SLIDERS:
            drives = tuple(self._drive_of.get(index, index) for index in drives)
        if condition is not None and condition.drive is not None:
            condition = condition._replace(drive=self._drive_of.get(condition.drive, condition.drive))
        return dataclasses.replace(fault, drives=drives, condition=condition)

    def load(self, path: Path) -> None:
        """Load a file with one fault per line; # begins a comment.

        Raises DriveError, which names the file and the line.
        """
        try:
            text = files.text(path)
        except FileError as error:
            raise DriveError(f"cannot read faults: {error}") from error
        for number, line in enumerate(text.splitlines(), start=1):
            words = line.partition("#")[0].strip()
            if words:
                try:
                    self.add(words)
                except FaultSyntaxError as error:
                    raise FaultSyntaxError(f"{path}:{number}: {error}") from error

    def clear(self) -> None:
        """End all active faults and discard pending ones."""
        ended, self._active = self._active, []
        for active in ended:
            if active.begun:
                self._end(active)
        self._break_drives()

    def lines(self) -> list[str]:
        """Return the line of each active or pending fault."""
        return [f"{active.fault.line}{'' if active.begun else '  (to come)'}" for active in self._active]

    def poll(self, now: float) -> None:
        """Do the work due at time `now` [s]."""
        elapsed, self._now = now - self._now, now
        for active in tuple(self._active):
            fault = active.fault
            if not active.begun:
                if self._is_due(active, elapsed):
                    self._begin(active)
            elif active.over or now - active.since >= fault.duration:
                self._active.remove(active)
                self._break_drives()
                self._end(active)
            elif fault.name == "fault":
                self._fail(fault)
            elif fault.name == "babble":
                self._babble(round(fault.value), elapsed)
        while self._held and self._held[0][0] <= now:
            _, _, deliver, data = heapq.heappop(self._held)
            deliver(data)

    def carry(self, index: int, to_drive: bool, can_id: int, data: bytes, deliver: Deliver) -> None:
        """Carry a frame to or from a drive.

        Faults determine how often, when and with which data `deliver` is called.
        """
        if self.bus_off or self._is_talked_down(can_id):
            return
        copies, wait = 1, 0.0
        for active in self._active:
            fault = active.fault
            if not active.strikes(index, to_drive, can_id, self._drives[index].node) or not self._chance(fault):
                continue
            active.struck += 1
            match fault.name:
                case "drop":
                    return
                case "duplicate":
                    copies += 1
                case "delay":
                    wait += fault.value
                case "corrupt":
                    data = self._corrupted(data)
                case "dlc":
                    data = data.ljust(round(fault.value), b"\0")[: round(fault.value)]
        for _ in range(copies):
            if wait > 0.0:
                heapq.heappush(self._held, (self._now + wait, next(self._order), deliver, data))
            else:
                deliver(data)

    # When faults begin and end.

    def _is_due(self, active: _ActiveFault, elapsed: float) -> bool:
        fault = active.fault
        if self._now - active.since < fault.delay or (fault.condition and not self._holds(fault.condition)):
            return False
        # For a fault of frames, the chance applies to each frame. Otherwise it applies to each second; `elapsed` is the
        # part of a second that has passed since the last poll.
        return bool(fault.chance == 1.0 or self._strikes_frames(fault)) or (
            self._random.random() < 1.0 - (1.0 - fault.chance) ** elapsed
        )

    def _holds(self, condition: Condition) -> bool:
        drives = range(len(self._drives)) if condition.drive is None else (condition.drive,)
        return any(self._is(index, condition.state) for index in drives)

    def _is(self, index: int, state: str) -> bool:
        drive = self._drives[index]
        match state:
            case "enabled":
                return drive.power is PowerState.OPERATION_ENABLED
            case "moving":
                return abs(drive.servo.velocity / self._scales[index]) >= MOVING
            case "stopping":
                return drive.power in _STOPPING
            case _:
                return drive.power in _FAULTY

    def _begin(self, active: _ActiveFault) -> None:
        fault = active.fault
        active.begun = True
        active.since = self._now
        self.announce(f"begins: {fault.line}")
        self._break_drives()
        match fault.name:
            case "emcy":
                for errors in self._emergencies(fault):
                    errors.report(round(fault.value))
            case "fault":
                self._fail(fault)
            case "reboot":
                for index in fault.drives:
                    self._drives[index].restart(self._now)
            case "bus-off":
                self._emit_error(canerrors.BUS_OFF)
            case "error-passive":
                self._emit_error(canerrors.CONTROLLER, canerrors.PASSIVE)
        if fault.duration == 0.0:
            self._active.remove(active)
            self._break_drives()
            self._end(active)

    def _end(self, active: _ActiveFault) -> None:
        fault = active.fault
        self.announce(f"is over: {fault.line}" + (f" ({active.struck} frames)" if self._strikes_frames(fault) else ""))
        match fault.name:
            case "emcy":
                for errors in self._emergencies(fault):
                    errors.clear(round(fault.value))
            case "reboot":
                for index in fault.drives:
                    self._drives[index].restart(self._now)
            case "bus-off":
                self._emit_error(canerrors.RESTARTED)
            case "error-passive":
                self._emit_error(canerrors.CONTROLLER, canerrors.ACTIVE)
        if fault.chance < 1.0 and fault.number is None and not self._strikes_frames(fault):
            self._active.append(_ActiveFault(fault, self._now))

    @staticmethod
    def _strikes_frames(fault: Fault) -> bool:
        return fault.name in ("drop", "duplicate", "corrupt", "delay", "dlc")

    # Effects of faults.

    def _break_drives(self) -> None:
        """Apply the active faults to every drive, and restore the drives that have no faults."""
        begun = [active.fault for active in self._active if active.begun]
        wired = {round(each.value): slider for each in begun if each.name == "node" for slider in each.drives}
        counted = {slider: each.value for each in begun if each.name == "counts" for slider in each.drives}
        for index, (drive, (mounted, counts)) in enumerate(zip(self._drives, self._mounted, strict=True)):
            fault = {each.name: each for each in begun if index in each.drives}
            drive.silent = "silent" in fault or "reboot" in fault
            drive.servo.lag = fault["lag"].value if "lag" in fault else None
            slider = wired.get(drive.node, round(fault["swapped"].value) if "swapped" in fault else mounted)
            ratio = (fault["scale"].value if "scale" in fault else 1.0) * (-1.0 if "reversed" in fault else 1.0)
            if slider in counted:
                ratio = counts / counted[slider]
            scale = self._scales[index] = counts / ratio
            drive.servo.forced_velocity = fault["runaway"].value * scale if "runaway" in fault else None
            if "stuck" in fault:
                drive.servo.forced_velocity = 0.0
            if drive.pins is not None:
                stuck, bouncing, reserved = (
                    sum({1 << round(each.value) for each in begun if each.name == name and index in each.drives})
                    for name in OF_PINS
                )
                drive.pins.apply_faults(stuck=stuck, bouncing=bouncing, reserved=reserved)
            drive.servo.motor = -1.0 if "against" in fault else 1.0
            drive.servo.encoder = self._encoder(fault, scale)
            drive.servo.play = fault["play"].value * scale if "play" in fault else 0.0
            self.carriages.couple(index, slider, ratio)

    @staticmethod
    def _encoder(fault: Mapping[str, Fault], rising: float) -> tuple[float, float]:
        """Return the fractions of the travel that a drive's encoder counts, for increasing and for decreasing counts.

        `rising` is negative if the counts decrease as the slider position increases.
        """
        if "loose" in fault:
            return 0.0, 0.0
        if "slips" not in fault:
            return INTACT
        held = 1.0 - fault["slips"].value  # while the slider position increases
        return (held, 1.0) if rising > 0.0 else (1.0, held)

    def _emergencies(self, fault: Fault) -> list[Emergencies]:
        struck = (self._drives[index].emergencies for index in fault.drives)
        return [emergencies for emergencies in struck if emergencies is not None]

    def _fail(self, fault: Fault) -> None:
        for index in fault.drives:
            self._drives[index].fail(round(fault.value))

    def _babble(self, can_id: int, elapsed: float) -> None:
        for _ in range(min(MOST_BABBLED, round(BABBLED * elapsed))):
            self._emit(can_id, bytes(8))

    def _is_talked_down(self, can_id: int) -> bool:
        """Whether a babbling node wins every arbitration against this frame."""
        return any(a.begun and a.fault.name == "babble" and can_id > a.fault.value for a in self._active)

    def _emit_error(self, kind: int, detail: int = 0) -> None:
        self._emit(kind | ERROR, bytes((0, detail, 0, 0, 0, 0, 0, 0)))

    def _chance(self, fault: Fault) -> bool:
        return fault.chance == 1.0 or self._random.random() < fault.chance

    def _corrupted(self, data: bytes) -> bytes:
        if not data:
            return data
        bit = self._random.randrange(8 * len(data))
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        return bytes(flipped)
