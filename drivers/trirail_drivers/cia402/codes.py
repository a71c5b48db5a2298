"""Descriptions of the error codes in EMCY and object 603Fh, with remedies.

The sources are CiA 301, table "emergency error code classes", and CiA 402-2 (IEC 61800-7-201), table of error codes. A
code in neither table is described by the class of its first digits; codes FFxxh are manufacturer-specific.
"""

from __future__ import annotations

_CODES = {
    0x1000: "generic error",
    0x2110: "short circuit or earth leakage at the input",
    0x2120: "earth leakage at the input",
    0x2130: "short circuit at the input",
    0x2211: "overcurrent inside the drive, no. 1",
    0x2212: "overcurrent inside the drive, no. 2",
    0x2213: "overcurrent in the ramp",
    0x2214: "overcurrent in the sequence",
    0x2220: "continuous overcurrent inside the drive",
    0x2230: "short circuit or earth leakage inside the drive",
    0x2240: "earth leakage inside the drive",
    0x2250: "short circuit inside the drive",
    0x2310: "continuous overcurrent of the motor",
    0x2311: "overcurrent of the motor, no. 1",
    0x2312: "overcurrent of the motor, no. 2",
    0x2320: "short circuit or earth leakage at the motor",
    0x2330: "earth leakage at the motor",
    0x2340: "short circuit at the motor",
    0x3110: "mains overvoltage",
    0x3120: "mains undervoltage",
    0x3130: "a mains phase is missing",
    0x3140: "mains frequency",
    0x3210: "DC link overvoltage",
    0x3220: "DC link undervoltage",
    0x3230: "load error",
    0x3310: "output overvoltage",
    0x4110: "surroundings too hot",
    0x4120: "surroundings too cold",
    0x4210: "device too hot",
    0x4220: "device too cold",
    0x4310: "drive too hot",
    0x4320: "drive too cold",
    0x4410: "supply too hot",
    0x4420: "supply too cold",
    0x5110: "low-voltage supply",
    0x5112: "24 V supply",
    0x5113: "5 V supply",
    0x5210: "measuring circuit",
    0x5220: "computing circuit",
    0x5300: "operating unit",
    0x5400: "power section",
    0x5410: "output stages",
    0x5430: "input stages",
    0x5440: "contacts",
    0x5450: "fuses",
    0x5510: "RAM",
    0x5520: "program memory",
    0x5530: "parameter memory",
    0x6010: "software reset by the watchdog",
    0x6310: "parameters lost",
    0x6320: "parameter error",
    0x7110: "brake chopper",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor or commutation wrong",
    0x7300: "sensor",
    0x7301: "tachometer fault",
    0x7302: "tachometer polarity wrong",
    0x7303: "resolver 1",
    0x7304: "resolver 2",
    0x7305: "incremental encoder 1",
    0x7306: "incremental encoder 2",
    0x7310: "speed",
    0x7320: "position",
    0x7400: "computation",
    0x7500: "communication of the drive's own modules",
    0x7510: "serial interface 1",
    0x7520: "serial interface 2",
    0x8110: "CAN overrun: frames were lost",
    0x8120: "CAN is error passive",
    0x8130: "the master's heartbeat is missing",
    0x8140: "back from bus-off",
    0x8150: "another node has the same CAN identifier",
    0x8210: "a PDO was too short to be used",
    0x8220: "a PDO was too long",
    0x8240: "SYNC with data that it should not have",
    0x8250: "an RPDO did not come in time",
    0x8311: "excess torque",
    0x8312: "difficult start-up",
    0x8331: "torque fault",
    0x8400: "velocity controller",
    0x8500: "position controller",
    0x8600: "positioning controller",
    0x8611: "following error",
    0x8612: "position limit",
    0x8700: "SYNC is missing or not in time",
    0x8800: "winding controller",
    0x8900: "process data",
    0x8A00: "control",
    0xF001: "deceleration",
}
"""Error codes that manufacturers use most. The other codes are described by their class."""

_CLASSES = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current at the input",
    0x22: "current inside the drive",
    0x23: "current of the motor",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the drive",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "temperature of the surroundings",
    0x42: "temperature of the device",
    0x43: "temperature of the drive",
    0x44: "temperature of the supply",
    0x50: "hardware of the drive",
    0x60: "software of the drive",
    0x61: "internal software of the drive",
    0x62: "user software of the drive",
    0x63: "data set of the drive",
    0x70: "an additional module",
    0x71: "power",
    0x72: "measurement",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "CANopen protocol",
    0x83: "torque",
    0x84: "velocity controller",
    0x85: "position controller",
    0x86: "positioning controller",
    0x87: "SYNC",
    0x90: "external error",
    0xF0: "additional function",
    0xFF: "manufacturer-specific",
}
"""Error classes by the upper byte of the code or, if this byte is not listed, by the first digit of the code."""

_UNKNOWN_CLASS = "of no class of CiA 301"

_LATE_REMEDY = "was the service stopped or too slow? cable, terminators; trirail doctor"
_REMEDIES = {
    0x2: "check motor, cable and load",
    0x3: "check the supply; braking feeds energy back into it",
    0x4: "let it cool down; check load and airflow",
    0x7121: "check whether something blocks the slider",
    0x73: "check the encoder and its cable",
    0x8130: _LATE_REMEDY,
    0x8150: "give each node an identifier of its own",
    0x81: "check cable, terminators and bitrate: trirail doctor",
    0x8250: _LATE_REMEDY,
    0x82: "find the other node that sends with this drive's identifiers",
    0x84: "check load, limits and tuning",
    0x85: "check load, limits and tuning",
    0x8611: "check load, tuning, limits and counts_per_metre, and whether something blocks the slider",
    0x86: "check load, limits and tuning",
    0x8700: _LATE_REMEDY,
    0x9: "check the wiring of the drive's inputs",
}
"""Remedies by the code, the upper byte of the code, or its first digit; the most specific entry applies."""
_DEFAULT_REMEDY = "see the drive's manual"


def describe_error(code: int, also: str = "") -> str:
    """Describe an error code [0, FFFFh]: the hexadecimal code, its meaning and a remedy.

    `also` is text to insert after the meaning.
    """
    meaning = _CODES.get(code) or _by_class(_CLASSES, code) or _UNKNOWN_CLASS
    remedy = _REMEDIES.get(code) or _by_class(_REMEDIES, code) or _DEFAULT_REMEDY
    return f"0x{code:04X} ({meaning}){also}; {remedy}"


def _by_class(table: dict[int, str], code: int) -> str:
    upper, digit = code >> 8, code >> 12
    return table.get(upper) or table.get(digit << 4) or table.get(digit) or ""
