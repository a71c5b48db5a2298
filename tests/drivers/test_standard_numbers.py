"""The numbers of the standards, as they stand there: driver and simulated drive could agree on a wrong one.

Nothing here is taken from the code under test. Sections are those of CiA 301 (4.2), CiA 402-2, and of ODrive's manual
for firmware 0.6, chapter "CAN Protocol".
"""

from __future__ import annotations

from collections.abc import Mapping
from struct import Struct
from types import ModuleType

import pytest
from drivers.test_cia402 import PERIOD
from drivers.test_odrive_frames import DBC
from rigs import Bus, DeviceRig
from trirail_drivers.cia402 import canopen_frames as canopen
from trirail_drivers.cia402 import homing, process_data, sdo
from trirail_drivers.interface import PowerState
from trirail_drivers.odrive import cansimple
from trirail_drivers.simulated import Servo, SimulatedDrive, SimulatedOdrive

from drivers import test_cia402, test_odrive

P = PowerState

CANOPEN: dict[str, dict[str, object]] = {
    "CiA 301, 7.3.3 identifiers of the predefined connection set": {
        "NMT": 0x000,
        "SYNC": 0x080,
        "EMCY": 0x080,
        "TPDO1": 0x180,
        "RPDO1": 0x200,
        "TPDO2": 0x280,
        "RPDO2": 0x300,
        "TPDO3": 0x380,
        "RPDO3": 0x400,
        "SDO_ANSWER": 0x580,
        "SDO_REQUEST": 0x600,
        "HEARTBEAT": 0x700,
    },
    "CiA 301, 7.2.8 network management: node control, and the states of a heartbeat": {
        "NMT_COMMAND": "<BB",
        "NMT_START": 1,
        "NMT_PRE_OPERATIONAL": 128,
        "NMT_STATE": "<B",
        "BOOT_UP": 0,
        "STOPPED": 4,
        "OPERATIONAL": 5,
        "PRE_OPERATIONAL": 127,
    },
    "CiA 301, 7.2.7 emergency: error code, error register, five bytes of the maker": {"EMERGENCY": "<HB5s"},
    "CiA 301, 7.2.4 SDO: initiate upload, expedited with two bytes": {
        "STATUSWORD_UPLOAD": bytes.fromhex("4041600000000000"),
        "STATUSWORD_UPLOADED": bytes.fromhex("4b416000"),
        "CONTROLWORD_DOWNLOAD": bytes.fromhex("2b406000"),
    },
    "CiA 301, 7.2.4 SDO: expedited with four bytes, and abort; CiA 402-2 digital outputs 60FEh:01": {
        "OUTPUTS_DOWNLOAD": bytes.fromhex("23fe6001"),
        "OUTPUTS_REFUSED": bytes.fromhex("80fe6001"),
    },
    "CiA 301, 7.2.4 SDO: expedited with four bytes; CiA 402-2 digital inputs 60FDh": {
        "INPUTS_UPLOAD": bytes.fromhex("40fd600000000000"),
        "INPUTS_UPLOADED": bytes.fromhex("43fd6000"),
    },
    "CiA 402-2, types of 60FDh and 60FEh:01": {"INPUTS": "<I", "OUTPUTS": "<I"},
    "CiA 301, 7.2.4 SDO: expedited with one byte; CiA 402-2 modes of operation display 6061h": {
        "MODE_DISPLAY_UPLOAD": bytes.fromhex("4061600000000000"),
        "MODE_DISPLAY_UPLOADED": bytes.fromhex("4f616000"),
    },
    "CiA 301, 7.2.4 SDO: expedited with one byte; 7.5.2 error register 1001h": {
        "ERROR_REGISTER_UPLOAD": bytes.fromhex("4001100000000000"),
        "ERROR_REGISTER_UPLOADED": bytes.fromhex("4f011000"),
    },
    "CiA 301, 7.2.8 node guarding: bits 0 to 6 are the state": {"NMT_STATE_BITS": 0x7F},
    "CiA 402-2, modes 7 and 8: controlword bit 4, statusword bit 12": {
        "INTERPOLATE": 0x0010,
        "FOLLOWS_SETPOINTS": 0x1000,
    },
    "CiA 402-2, statusword 6041h: bit 9": {"REMOTE": 0x0200},
    "CiA 402-2, controlword 6040h: coding of commands, and bits 4 and 8": {
        "CONTROLWORD": "<H",
        "DISABLE_VOLTAGE": 0b0000_0000,
        "QUICK_STOP": 0b0000_0010,
        "SHUTDOWN": 0b0000_0110,
        "SWITCH_ON": 0b0000_0111,
        "ENABLE_OPERATION": 0b0000_1111,
        "FAULT_RESET": 0b1000_0000,
        "HOMING_START": 0b0001_0000,
        "HALT": 0b1_0000_0000,
    },
    "CiA 402-2, types of 6041h, 607Ah with 60B1h, 6064h": {"STATUSWORD": "<H", "SETPOINT": "<ii", "POSITION": "<i"},
}
OWN = {"POLL_PERIOD", "STATUS_PERIOD", "TRAFFIC"}
"""What this driver decides, not the standard."""

CANSIMPLE: dict[str, dict[str, object]] = {
    "RxSdo and TxSdo: command ids, layout, opcodes, and types of endpoints": {
        "RX_SDO": 0x04,
        "TX_SDO": 0x05,
        "SDO": "<BHB",
        "READ": 0,
        "WRITE": 1,
        "TYPES": {
            "bool": "<?",
            "uint8": "<B",
            "int8": "<b",
            "uint16": "<H",
            "int16": "<h",
            "uint32": "<I",
            "int32": "<i",
            "float": "<f",
        },
    },
    "Address: command id, and bytes 1 to 6 for the serial number": {
        "ADDRESS": 0x06,
        "ADDRESS_FIRMWARE": (0, 6, 9),
        "SERIAL_AT": slice(1, 7),
    },
    "units, and node ids of six bits without 3Fh": {
        "VELOCITY_SCALE": 1000,
        "VELOCITY_STEP": 0.001,
        "MAX_FEED_FORWARD": 32.767,
        "NODES": range(63),
    },
    "ControlMode and InputMode": {"POSITION_CONTROL": 3, "PASSTHROUGH": 1},
}
IN_THE_DBC = {message.name.upper() for message in DBC.messages} | {
    "VERSION", "BEAT", "ERRORS", "AXIS_STATE", "ESTIMATES", "CONTROLLER_MODE", "INPUT_POS", "CLEAR", "PROCEDURES",
}  # fmt: skip
"""What test_odrive_frames holds against its maker's file."""
OWN_OF_ODRIVE = {"ERROR_PERIOD", "TRAFFIC"}


def number(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: number(each) for name, each in value.items()}
    return value.format if isinstance(value, Struct) else value


def constants(module: ModuleType) -> set[str]:
    return {name for name in vars(module) if name.isupper() and not name.startswith("_")}


@pytest.mark.parametrize("table", CANOPEN)
def test_canopen(table: str) -> None:
    assert {name: number(getattr(canopen, name)) for name in CANOPEN[table]} == CANOPEN[table]


@pytest.mark.parametrize("table", CANSIMPLE)
def test_cansimple(table: str) -> None:
    assert {name: number(getattr(cansimple, name)) for name in CANSIMPLE[table]} == CANSIMPLE[table]


def test_no_number_is_left_out() -> None:
    assert constants(canopen) == OWN | {name for table in CANOPEN.values() for name in table}
    assert constants(cansimple) == OWN_OF_ODRIVE | IN_THE_DBC | {name for table in CANSIMPLE.values() for name in table}


STATES = {
    # CiA 402-2, statusword 6041h, state coding: xxxx xxxx x0xx 0000b and so on.
    "0xx0000": P.NOT_READY_TO_SWITCH_ON,
    "1xx0000": P.SWITCH_ON_DISABLED,
    "01x0001": P.READY_TO_SWITCH_ON,
    "01x0011": P.SWITCHED_ON,
    "01x0111": P.OPERATION_ENABLED,
    "00x0111": P.QUICK_STOP_ACTIVE,
    "0xx1111": P.FAULT_REACTION_ACTIVE,
    "0xx1000": P.FAULT,
}


@pytest.mark.parametrize("word", range(1 << 7))
def test_every_statusword(word: int) -> None:
    bits = f"{word:07b}"
    found = [state for code, state in STATES.items() if all(c in ("x", b) for c, b in zip(code, bits, strict=True))]
    assert canopen.power_state(word) is (found[0] if found else None)


def test_modes_of_operation_and_bits_of_objects() -> None:
    # CiA 402-2: 6060h, 6061h.
    assert (homing.HOMING, process_data.INTERPOLATED_POSITION, process_data.CYCLIC_SYNCHRONOUS_POSITION) == (6, 7, 8)
    # CiA 301, 7.5.2: a PDO's COB-ID, bits 31 and 30; 7.2.4: abort codes of an object or subindex that is not there.
    assert (sdo.INVALID, sdo.NO_REMOTE_REQUEST) == (0x8000_0000, 0x4000_0000)
    assert sdo.NO_SUCH_OBJECT == (0x0602_0000, 0x0609_0011)


# ---------------------------------------------------------------------- what is on the bus


class Device(DeviceRig[SimulatedDrive | SimulatedOdrive]):
    """A simulated drive, asked and heard in candump's form."""

    def answer(self, frame: str) -> list[str]:
        """What it answers to a frame as 601#4041600000000000 or 069#R."""
        can_id, _, data = frame.partition("#")
        if data == "R":
            self.drive.receive_remote(int(can_id, 16), self.now)
        else:
            self.drive.receive(int(can_id, 16), bytes.fromhex(data), self.now)
        return self.said()

    def said(self) -> list[str]:
        return [f"{can_id:03X}#{data.hex().upper()}" for can_id, data in self.take()]

    def after(self, seconds: float) -> list[str]:
        """What it says when it is looked at for the first time after so long."""
        self.now += seconds
        self.drive.poll(self.now)
        return self.said()


def servo(position: float) -> Servo:
    return Servo(position, time_constant=0.0, max_velocity=2e6, max_acceleration=1e9)


PDOS = (
    # TPDO1: the statusword on change.
    "23001801850100C0", "2F001802FF000000", "2F001A0000000000", "23001A0110004160", "2F001A0001000000",
    "2300180185010040",
    # TPDO2: the position with every SYNC.
    "23011801850200C0", "2F01180201000000", "2F011A0000000000", "23011A0120006460", "2F011A0001000000",
    "2301180185020040",
    # RPDO1: the controlword.
    "2300140105020080", "2F001402FF000000", "2F00160000000000", "2300160110004060", "2F00160001000000",
    "2300140105020000",
)  # fmt: skip
"""CiA 301, 7.5.2.35 to 38: a PDO is switched off, its kind and mapping are written, and it is switched on."""


def test_a_simulated_cia402_drive_by_its_bytes() -> None:
    device = Device(SimulatedDrive(5, servo(0x0012_3456)))
    assert device.said() == ["705#00"]  # boot-up
    # SDO, expedited: device type 1000h, a servo as CiA 402 has it; one, two, four bytes; an object that is not there.
    assert device.answer("605#4000100000000000") == ["585#4300100092010200"]
    assert device.answer("605#2F60600008000000") == ["585#6060600000000000"]
    assert device.answer("605#2B17100064000000") == ["585#6017100000000000"]
    assert device.after(0.001) == ["705#7F"]
    assert device.answer("605#2306100010270000") == ["585#6006100000000000"]
    assert device.answer("605#4000300000000000") == ["585#8000300000000206"]
    for request in PDOS:
        assert device.answer(f"605#{request}") == [f"585#60{request[2:8]}00000000"]
    assert device.answer("000#0105") == ["185#5002"]  # start node 5: switch on disabled
    assert device.answer("080#") == ["285#56341200"]
    assert device.after(0.1) == ["705#05"]
    # Shutdown, switch on, enable operation, quick stop.
    for controlword, statusword in (("0600", "3102"), ("0700", "3302"), ("0F00", "3712"), ("0200", "1702")):
        assert device.answer(f"205#{controlword}") == [f"185#{statusword}"]
        assert device.answer("080#")[0] == "285#56341200"
        device.after(0.001)
    assert device.answer("605#4041600000000000") == ["585#4B41600050020000"]  # at rest it ends at once
    device.drive.fail(0x4310)
    assert device.said() == ["085#1043090000000000"]  # drive excess temperature; generic, and temperature
    assert device.after(0.001) == ["185#1F02"]  # fault reaction, then fault
    assert device.answer("080#")[1:] == ["185#1802"]
    assert device.answer("205#0000") == []
    assert device.answer("205#8000") == ["085#0000000000000000", "185#5002"]
    assert device.answer("000#8005") == []  # pre-operational
    assert device.answer("080#") == []
    assert device.answer("000#8105") == ["705#00"]  # reset node


def test_a_simulated_odrive_by_its_bytes() -> None:
    device = Device(SimulatedOdrive(3, servo(1.5), heartbeat=0.1, friction=50.0))
    assert device.after(0.0) == ["061#0000000001000000"]  # idle
    assert device.answer("060#R") == ["060#0204043A00060A00"]
    assert device.answer("063#R") == ["063#0000000000000000"]
    assert device.answer("069#R") == ["069#0000C03F00000000"]  # 1.5 turns, at rest
    # RxSdo: enable_watchdog, E0h, is off; input_vel_scale, 106h, is 1000, then 500; endpoint 1 is none that it tells.
    assert device.answer("064#00E00000") == ["065#00E0000000"]
    assert device.answer("064#00060100") == ["065#00060100E8030000"]
    assert device.answer("064#01060100F4010000") == []
    assert device.answer("064#00060100") == ["065#00060100F4010000"]
    assert device.answer("064#00010000") == []
    assert device.answer("06B#0300000001000000") == []  # position control, passthrough
    assert device.answer("067#0800000000000000") == []  # closed loop control
    assert device.after(0.1) == ["061#0000000008000000"]
    assert device.answer("06C#0000004000000000") == []  # 2.0 turns
    device.after(0.01)
    assert device.answer("069#R")[0].startswith("069#00000040")
    assert device.answer("062#") == []  # Estop
    assert device.answer("063#R") == ["063#0000000200000002"]
    assert device.answer("078#00") == []
    assert device.answer("063#R") == ["063#0000000000000000"]


def sent(bus: Bus) -> list[str]:
    frames, bus.sent[:] = [f"{can_id:03X}#{data.hex().upper()}" for can_id, data in bus.sent], []
    return frames


def test_the_cia402_driver_by_its_bytes() -> None:
    rig = test_cia402.Rig()
    rig.drives.configure(PERIOD)
    said = sent(rig.bus)
    # Drive B is node 5: its heartbeat 100 ms, the master's watched for 300 ms, window 5 mm, mode 8, start.
    for frame in ("605#2B17100064000000", "605#231610012C017E00", "605#2365600010270000", "605#2F60600008000000"):
        assert frame in said, frame
    assert "000#0105" in said
    rig.cycle()
    said = sent(rig.bus)
    assert said[:2] == ["080#", "77E#05"]
    # Drive A is at 0.01 m with 1 µm a count, C at 0.03 m; B counts 0.5 µm downwards from 0.1 m.
    position = {1: 10_000, 5: 240_000, 9: 30_000}
    setpoints = [f"{0x300 + node:03X}#{Struct('<ii').pack(at, 0).hex().upper()}" for node, at in position.items()]
    assert [frame for frame in said if frame.startswith("3")] == setpoints
    rig.drives.enable()
    for _ in range(10):
        rig.cycle()
    assert [each for each in sent(rig.bus) if each.startswith("205")] == ["205#0600", "205#0700", "205#0F00"]
    rig.drives.quick_stop()
    assert [frame for frame in sent(rig.bus) if frame[:3] == "205"] == ["205#0200"]
    for _ in range(100):
        rig.cycle()
    rig.devices[1].fail(0x4310)
    for _ in range(10):
        rig.cycle()
    sent(rig.bus)
    rig.drives.reset()
    assert "205#8000" in sent(rig.bus)
    rig.drives.close()
    said = sent(rig.bus)
    assert [frame for frame in said if frame in WANTED_AT_CLOSE] == ["205#0000", "605#2B40600000000000", "000#8005"]


WANTED_AT_CLOSE = {"205#0000", "605#2B40600000000000", "000#8005"}


def test_the_odrive_driver_by_its_bytes() -> None:
    rig = test_odrive.Rig()
    rig.drives.configure(PERIOD)
    said = sent(rig.bus)
    # Drive B is node 7: E0h and the command.
    assert [frame for frame in said if frame[:2] in ("0E", "0F")] == [
        # Its identity: Get_Version and, by the manual of Address, the serial number.
        "0E7#0100000000000000", "0E0#", "0E6#",
        # RxSdo reads: watchdog, its timeout, input_vel_scale, heartbeats, what is cyclic: E0h, DFh, 106h, FEh, FDh …
        "0E4#00E00000", "0E4#00DF0000", "0E4#00060100", "0E4#00FE0000", "0E4#00FD0000", "0E4#00FF0000",
        *(f"0E4#00{low:02X}0100" for low in range(6)),
        "0E3#", "0E9#",
    ]  # fmt: skip
    rig.enable()
    said = sent(rig.bus)
    assert [frame for frame in said if frame[:3] == "0EB"] == ["0EB#0300000001000000"] * 3
    assert [frame for frame in said if frame[:3] == "0E7"] == ["0E7#0800000000000000"]
    # At -0.02 m with 50 turns/m downwards from 0.1 m: 6 turns.
    assert "0EC#0000C04000000000" in said
    rig.drives.disable()
    assert "0E7#0100000000000000" in sent(rig.bus)
    rig.devices[1].fail(0x200)
    rig.cycles(50)
    sent(rig.bus)
    rig.drives.reset()
    assert sent(rig.bus) == ["018#00", "0F8#00", "7D8#00"]
    rig.drives.close()
