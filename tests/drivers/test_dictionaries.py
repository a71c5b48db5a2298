"""Simulated drives of any make: every data type of CiA 301, and what real drives' dictionaries have and lack."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError
from edsfiles import MAKES, Row, eds, make_eds, rows
from hypothesis import given
from hypothesis import strategies as st
from trirail_drivers.simulated import Servo, SimulatedDrive

NODE = 5
UNSIGNED = {0x05: 1, 0x06: 2, 0x16: 3, 0x07: 4, 0x18: 5, 0x19: 6, 0x1A: 7, 0x1B: 8}
SIGNED = {0x02: 1, 0x03: 2, 0x10: 3, 0x04: 4, 0x12: 5, 0x13: 6, 0x14: 7, 0x15: 8}
TIMES = (0x0C, 0x0D)
DOMAIN = 0x0F
WRITE_ONLY, READ_ONLY, NO_OBJECT, NO_SUBINDEX = 0x06010001, 0x06010002, 0x06020000, 0x06090011
NO_DATA = 0x08000024


class Line:
    """What canopen's SDO client takes for a network: one simulated drive at the other end."""

    def __init__(self, drive: SimulatedDrive, objects: ObjectDictionary) -> None:
        self.drive = drive
        self.now = 100.0
        self.frames: list[tuple[int, bytes]] = []
        """The answers of its SDO server."""
        self.newest: dict[int, bytes] = {}
        """The last frame of each identifier."""
        self.lost: set[int] = set()
        """Which of the frames to the client get lost, counted from 0."""
        drive.connect(self._from_drive, self.now)
        self.sdo = SdoClient(0x600 + NODE, 0x580 + NODE, objects)  # type: ignore[no-untyped-call]
        self.sdo.network = self  # type: ignore[assignment]
        self.sdo.RESPONSE_TIMEOUT = 0.01

    def blocks(self, mode: str, **options: Any) -> Any:
        """The domain, read or written by block transfer."""
        return self.sdo.open(0x2000 + DOMAIN, 0, mode, block_transfer=True, **options)  # type: ignore[no-untyped-call]

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """A frame of canopen's."""
        self.drive.receive(can_id, bytes(data), self.now)

    def _from_drive(self, can_id: int, data: bytes) -> None:
        if can_id == 0x580 + NODE:
            if len(self.frames) not in self.lost:
                self.sdo.responses.put(data)
            self.frames.append((can_id, data))
        self.newest[can_id] = data


def line(path: Path) -> Line:
    servo = Servo(0, time_constant=0.0, max_velocity=2e6, max_acceleration=1e8)
    return Line(SimulatedDrive(NODE, servo, eds=path), canopen.import_od(str(path), NODE))


# ---------------------------------------------------------------------- the dictionaries of real drives


@pytest.mark.parametrize("make", MAKES)
def test_every_object_of_a_real_drive_answers_as_its_access_says(make: str, tmp_path: Path) -> None:
    """canopen's client reads each one with the right length; what may not be read or written is refused."""
    client = line(make_eds(tmp_path, make)).sdo
    errors = int.from_bytes(client.upload(0x1003, 0), "little") if has_history(make) else 0
    for index, subindex, kind, access, _, _ in rows(make):
        if access == "wo":
            assert refused(client.upload, index, subindex) == WRITE_ONLY
        elif index == 0x1003 and subindex > errors:
            assert refused(client.upload, index, subindex) == NO_DATA
        else:
            content = client.upload(index, subindex)
            assert kind in (0x09, 0x0A) or len(content) == (UNSIGNED | SIGNED)[kind], f"{index:04X}:{subindex:02X}"
        if access in ("ro", "const"):
            assert refused(client.download, index, subindex, b"\0") == READ_ONLY


def has_history(make: str) -> bool:
    return any(row[0] == 0x1003 for row in rows(make))


@pytest.mark.parametrize("make", MAKES)
def test_what_a_real_drive_lacks_does_not_exist(make: str, tmp_path: Path) -> None:
    client = line(make_eds(tmp_path, make)).sdo
    there = {row[0] for row in rows(make)}
    lacking = [index for index in range(0x1000, 0x6600) if index not in there]
    for index in (*lacking[:20], *(index for index in lacking if index > 0x6000)):
        assert refused(client.upload, index, 0) == NO_OBJECT
        assert refused(client.download, index, 0, b"\0") == NO_OBJECT
    assert refused(client.upload, 0x6041, 1) == NO_SUBINDEX


@pytest.mark.parametrize("make", MAKES)
def test_power_on_values_are_the_dictionarys(make: str, tmp_path: Path) -> None:
    client = line(make_eds(tmp_path, make)).sdo
    for index, subindex, kind, access, default, _ in rows(make):
        actual = index in (0x6041, 0x6061, 0x6064, 0x606C, 0x60F4) or (index == 0x1003 and subindex)
        if default is None or access == "wo" or kind in (0x09, 0x0A) or actual:
            continue
        found = int.from_bytes(client.upload(index, subindex), "little", signed=kind in SIGNED)
        assert isinstance(default, int)
        by_node = (
            index == 0x1014 or (subindex and index == 0x1200) or (subindex == 1 and index & 0xFE00 in (0x1400, 0x1800))
        )
        own = by_node and default & 0x7F == 1
        assert found == default + (NODE - 1 if own else 0), f"{index:04X}:{subindex:02X}"


def refused(request: Callable[..., object], *arguments: object) -> int:
    """The abort code of a request."""
    with pytest.raises(SdoAbortedError) as caught:
        request(*arguments)
    return caught.value.code


# ---------------------------------------------------------------------- every data type, every transfer


@pytest.fixture(scope="module")
def typed(tmp_path_factory: pytest.TempPathFactory) -> Line:
    """An object of each data type, 2000h and its type."""
    kinds = (*range(0x01, 0x0E), *range(0x0F, 0x17), *range(0x18, 0x1C))
    facts: list[Row] = [(0x2000 + kind, 0, kind, "rw", None, True) for kind in kinds]
    path = tmp_path_factory.mktemp("typed") / "typed.eds"
    path.write_text(eds([*rows("elmo_gold"), *facts]))
    return line(path)


VALUES = st.one_of(
    st.tuples(st.just(0x01), st.booleans()),
    *(st.tuples(st.just(kind), st.integers(0, (1 << 8 * size) - 1)) for kind, size in UNSIGNED.items()),
    *(
        st.tuples(st.just(kind), st.integers(-(1 << 8 * size - 1), (1 << 8 * size - 1) - 1))
        for kind, size in SIGNED.items()
    ),
    st.tuples(st.just(0x08), st.floats(width=32, allow_nan=False)),
    st.tuples(st.just(0x11), st.floats(allow_nan=False)),
    st.tuples(st.just(0x09), st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=40)),
    st.tuples(st.just(0x0B), st.text(st.characters(min_codepoint=1, max_codepoint=0xD7FF), max_size=40)),
    *(st.tuples(st.just(kind), st.binary(min_size=6, max_size=6)) for kind in TIMES),
    *(st.tuples(st.just(kind), st.binary(max_size=2000)) for kind in (0x0A, DOMAIN)),
)


@given(value=VALUES, segmented=st.booleans())
def test_a_value_of_every_data_type_comes_back(typed: Line, value: tuple[int, Any], segmented: bool) -> None:
    """Encoded, written, read and decoded by canopen: expedited where four bytes will do, else in segments."""
    kind, content = value
    variable = typed.sdo.od.get_variable(0x2000 + kind)
    assert variable is not None
    typed.sdo.download(0x2000 + kind, 0, variable.encode_raw(content), force_segment=segmented)
    assert variable.decode_raw(typed.sdo.upload(0x2000 + kind, 0)) == content


@given(content=st.binary(min_size=1, max_size=4000), lost=st.integers(0, 3000), crc=st.booleans())
def test_blocks_come_and_go_and_what_is_lost_is_sent_again(typed: Line, content: bytes, lost: int, crc: bool) -> None:
    """canopen's block transfers, with the CRC and without; one segment that it does not hear."""
    with typed.blocks("wb", size=len(content), request_crc_support=crc) as out:
        out.write(content)
    segments = -(-len(content) // 7)
    number = lost % segments + 1
    # Of a block's last segment canopen's client asks twice, after it has waited for it, and loses the next one.
    if number < segments and number % 127:
        typed.lost = {len(typed.frames) + number}
    with typed.blocks("rb", request_crc_support=crc) as back:
        assert back.read() == content
    typed.lost = set()


# Frames by hand: CiA 301, SDO block download and upload, command specifiers.


def block_download(typed: Line, content: bytes, crc: int) -> bytes:
    """The last answer to a block download of at most seven bytes."""
    typed.sdo.responses.queue.clear()
    typed.send_message(0x605, struct.pack("<BHBI", 0xC6, 0x200F, 0, len(content)))
    assert typed.frames[-1][1] == struct.pack("<BHBB3x", 0xA4, 0x200F, 0, 127)
    typed.send_message(0x605, b"\x81" + content.ljust(7, b"\0"))
    assert typed.frames[-1][1] == b"\xa2\x01\x7f".ljust(8, b"\0")
    typed.send_message(0x605, struct.pack("<BH5x", 0xC1 | (7 - len(content)) << 2, crc))
    answer = typed.frames[-1][1]
    typed.sdo.responses.queue.clear()
    return answer


def test_a_block_with_its_crc_is_taken_and_one_with_another_is_not(typed: Line) -> None:
    first = block_download(typed, b"1234567", crc_of(b"1234567"))
    assert first == b"\xa1".ljust(8, b"\0")
    assert typed.sdo.upload(0x200F, 0) == b"1234567"
    wrong = block_download(typed, b"7654321", 0x1234)
    assert wrong == struct.pack("<BHBI", 0x80, 0x200F, 0, 0x05040004)
    assert typed.sdo.upload(0x200F, 0) == b"1234567"


def crc_of(content: bytes) -> int:
    """CRC-16-CCITT from 0, bit by bit."""
    value = 0
    for byte in content:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x1021 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def test_the_crc_is_the_standards() -> None:
    assert crc_of(b"123456789") == 0x31C3


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (struct.pack("<BHBI", 0xC6, 0x2007, 0, 5), 0x06070010),
        (struct.pack("<BHBI", 0xC6, 0x1000, 0, 4), READ_ONLY),
        (struct.pack("<BHBI", 0xC6, 0x2FFF, 0, 4), NO_OBJECT),
        (struct.pack("<BHBBB2x", 0xA4, 0x200F, 0, 0, 0), 0x05040002),
        (struct.pack("<BHBBB2x", 0xA4, 0x200F, 0, 128, 0), 0x05040002),
        (struct.pack("<BHBBB2x", 0xA4, 0x1023, 1, 127, 0), WRITE_ONLY),
        (struct.pack("<BHBI", 0xE0, 0x2007, 0, 4), 0x05040001),
    ],
)
def test_a_block_that_is_refused(typed: Line, request_: bytes, code: int) -> None:
    typed.send_message(0x605, request_)
    assert struct.unpack_from("<I", typed.frames[-1][1], 4)[0] == code
    typed.sdo.responses.queue.clear()


@pytest.mark.parametrize(
    ("index", "data", "code"),
    [
        (0x2007, bytes(5), 0x06070012),
        (0x2007, bytes(3), 0x06070013),
        (0x2016, bytes(4), 0x06070012),
        (0x201A, bytes(6), 0x06070010),
        (0x2008, bytes(3), 0x06070013),
        (0x200C, bytes(5), 0x06070010),
        (0x2001, b"\x02", 0x06090031),
    ],
)
def test_lengths_and_ranges_of_data_types(typed: Line, index: int, data: bytes, code: int) -> None:
    assert refused(typed.sdo.download, index, 0, data) in (code, 0x06070010)


@pytest.mark.parametrize(("kind", "size"), sorted((UNSIGNED | SIGNED).items()))
def test_each_integer_travels_by_pdo(kind: int, size: int, typed: Line) -> None:
    """Mapped into an RPDO of Elmo's, then into a TPDO that is sent at the next SYNC."""
    value = bytes(range(0x91, 0x91 + size))
    entry = 0x2000_0000 | kind << 16 | 8 * size
    for communication, identifier in ((0x1403, 0x505), (0x1803, 0x485)):
        write = typed.sdo.download
        write(communication, 1, struct.pack("<I", identifier | 1 << 31))
        write(communication, 2, b"\x01")
        write(communication + 0x200, 0, b"\0")
        write(communication + 0x200, 1, struct.pack("<I", entry))
        write(communication + 0x200, 0, b"\x01")
        write(communication, 1, struct.pack("<I", identifier))
    typed.send_message(0x000, bytes([1, NODE]))
    typed.send_message(0x505, value)
    typed.send_message(0x080, b"")
    typed.send_message(0x080, b"")
    assert typed.newest[0x485] == value
    typed.send_message(0x000, bytes([128, NODE]))
