"""Duration of frames, against frames that are built here bit by bit as ISO 11898-1 has them, with CRC and stuffing."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.timing import BusTiming, fd_frame_bits, frame_bits

CRC_15 = (15, 0x4599)
CRC_17 = (17, 0x1685B)
CRC_21 = (21, 0x102899)
LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Data lengths of CAN FD by their code DLC."""


def number(value: int, bits: int) -> list[int]:
    return [value >> i & 1 for i in reversed(range(bits))]


def octets(data: bytes) -> list[int]:
    return [bit for byte in data for bit in number(byte, 8)]


def crc(bits: list[int], kind: tuple[int, int], begins: int = 0) -> list[int]:
    width, polynomial = kind
    register = begins
    for bit in bits:
        feedback = bit ^ register >> (width - 1)
        register = (register << 1) & ((1 << width) - 1)
        if feedback:
            register ^= polynomial
    return number(register, width)


def stuffed(bits: list[int]) -> list[tuple[int, int, bool]]:
    """Bits with those that stuffing inserts: value, place of the bit that it is or follows, whether it is inserted."""
    result: list[tuple[int, int, bool]] = []
    run, last = 0, None
    for place, bit in enumerate(bits):
        run = run + 1 if bit == last else 1
        last = bit
        result.append((bit, place, False))
        if run == 5:
            last, run = 1 - bit, 1
            result.append((last, place, True))
    return result


def classical(identifier: int, data: bytes) -> int:
    """Bits of a classical frame with its interframe space."""
    bits = [0, *number(identifier, 11), 0, 0, 0, *number(len(data), 4), *octets(data)]
    delimiter, acknowledgement, end, space = 1, 2, 7, 3
    return len(stuffed(bits + crc(bits, CRC_15))) + delimiter + acknowledgement + end + space


def fd(identifier: int, data: bytes) -> tuple[int, int]:
    """Bits of a CAN FD frame with bit rate switch, at either bit rate, with its interframe space."""
    head = [0, *number(identifier, 11), 0, 0, 1, 0, 1]  # SOF, identifier, RRS, IDE, FDF, res, BRS
    bits = [*head, 0, *number(LENGTHS.index(len(data)), 4), *octets(data)]  # ESI, DLC, data
    # A stuff bit behind the last bit of the data gives way to the first fixed one.
    dynamic = stuffed(bits)
    if dynamic[-1][2]:
        del dynamic[-1]
    inserted = sum(extra for _, _, extra in dynamic)
    gray = inserted % 8 ^ inserted % 8 >> 1
    count = number(gray, 3)
    count.append(sum(count) % 2)
    kind = CRC_17 if len(data) <= 16 else CRC_21
    # The CRC of CAN FD covers the stuff bits and the stuff count, and begins with a one.
    rest = count + crc([bit for bit, _, _ in dynamic] + count, kind, 1 << kind[0] - 1)
    fixed: list[int] = []
    for place, bit in enumerate(rest):
        if place % 4 == 0:
            fixed.append(1 - (fixed or [dynamic[-1][0]])[-1])
        fixed.append(bit)
    early = sum(place < len(head) for _, place, extra in dynamic if not extra)
    early += sum(place < len(head) - 1 for _, place, extra in dynamic if extra)
    acknowledgement, end, space, delimiter = 2, 7, 3, 1
    return early + acknowledgement + end + space, len(dynamic) - early + len(fixed) + delimiter


identifiers = st.integers(0, 0x7FF) | st.sampled_from([0, 0x080, 0x7FF, 0x301])
payloads = st.binary(max_size=8) | st.builds(bytes, st.lists(st.sampled_from([0, 255, 0x78, 0x87, 0xF0]), max_size=8))
long_payloads = st.sampled_from(LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n))


@example(identifier=0, data=bytes(8))
@given(identifier=identifiers, data=payloads)
def test_no_classical_frame_takes_longer_than_is_said(identifier: int, data: bytes) -> None:
    assert classical(identifier, data) <= frame_bits(len(data))


@example(identifier=0, data=bytes(8))
@example(identifier=0x7FF, data=b"\xff" * 64)
@given(identifier=identifiers, data=payloads | long_payloads)
def test_no_frame_of_can_fd_takes_longer_than_is_said(identifier: int, data: bytes) -> None:
    arbitration, bits = fd(identifier, data)
    worst_arbitration, worst_bits = fd_frame_bits(len(data))
    # A stuff bit that is counted for the arbitration, and comes later, is shorter than counted.
    assert arbitration <= worst_arbitration
    assert arbitration + bits <= worst_arbitration + worst_bits
    for timing in (BusTiming(1_000_000, 1_000_000), BusTiming(1_000_000, 5_000_000), BusTiming(500_000, 8_000_000)):
        assert timing.data_bitrate is not None
        seconds = arbitration / timing.bitrate + bits / timing.data_bitrate
        assert seconds <= timing.frame_ns(len(data)) * 1e-9 * (1 + 1e-12)


@given(identifier=identifiers, data=payloads | long_payloads)
def test_without_stuffing_the_count_is_exact(identifier: int, data: bytes) -> None:
    """What a frame lacks to the worst case are stuff bits alone."""
    arbitration, bits = fd(identifier, data)
    head = [0, *number(identifier, 11), 0, 0, 1, 0, 1, 0, *number(LENGTHS.index(len(data)), 4), *octets(data)]
    last = stuffed(head)[-1][2]
    inserted = sum(extra for _, _, extra in stuffed(head)) - last
    assert arbitration + bits - inserted == sum(fd_frame_bits(len(data))) - (22 + 8 * len(data) - 1) // 4


def most_stuff_bits(n: int) -> int:
    """Number of stuff bits that the worst identifier and data have, found among all of them."""
    free = [0, 1]
    head = [[0], *(11 * [free]), [0], [0], [1], [0], [1], [0], *([bit] for bit in number(n, 4))]
    most = {(0, 0): 0}  # by the last bit and the length of its run
    for choices in head + 8 * n * [free]:
        after: dict[tuple[int, int], int] = {}
        for (last, run), inserted in most.items():
            for bit in choices:
                length = run + 1 if bit == last else 1
                key, value = ((1 - bit, 1), inserted + 1) if length == 5 else ((bit, length), inserted)
                after[key] = max(value, after.get(key, 0))
        most = after
    return max(most.values())


@pytest.mark.parametrize("n", range(9))
def test_the_worst_case_of_can_fd_is_nearly_reached(n: int) -> None:
    """The fixed bits of the head cost some of the stuff bits that are counted."""
    counted = (22 + 8 * n - 1) // 4
    assert counted - 3 <= most_stuff_bits(n) <= counted


@pytest.mark.parametrize(("data_bitrate", "rate"), [(5_000_000, 2852), (8_000_000, 3271)])
def test_the_rate_that_fills_a_bus_of_can_fd(data_bitrate: int, rate: float) -> None:
    """SYNC and six PDOs of six bytes, worst case; computed by hand from the lengths of the fields."""
    timing = BusTiming(1_000_000, data_bitrate)
    cycle = timing.frame_ns(0) + 6 * timing.frame_ns(6)
    assert 1e9 / cycle == pytest.approx(rate, abs=1.0)


def test_two_kilohertz_fit_on_can_fd_alone() -> None:
    assert canopen_frames.TRAFFIC.highest_rate(BusTiming(1_000_000), 0.1) < 2000
    load = canopen_frames.TRAFFIC.bus_load(2000, BusTiming(1_000_000, 5_000_000), 0.1)
    assert 0.6 < load < 0.8


def test_times_are_rounded_up() -> None:
    assert BusTiming(1_000_000).frame_ns(0) == 55_000
    assert BusTiming(7).frame_ns(0) == -(-55 * 10**9 // 7)


@pytest.mark.parametrize("timing", [BusTiming(500_000), BusTiming(500_000, 2_000_000)], ids=["classical", "fd"])
def test_a_total_bounds_the_sum_of_its_frames(timing: BusTiming) -> None:
    lengths = (0, 1, 2, 4, 6, 8, 8)
    exact = sum(map(timing.frame_ns, lengths)) * 1e-9
    total = timing.total_seconds(len(lengths), sum(lengths))
    assert exact - 1e-8 <= total <= exact + len(lengths) / timing.bitrate
    assert timing.fd == (timing.data_bitrate is not None)
