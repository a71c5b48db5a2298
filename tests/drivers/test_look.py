"""What a look at a drive says of it, its set-up says as well: with each object in turn missing or of another kind."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import canopen
import pytest
from canopen import SdoAbortedError
from canopen.objectdictionary import ODVariable
from edsfiles import Row, eds
from rigs import STEP, Closing, ideal_servo
from trirail_drivers.cia402 import inspection, setup
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.config import Drive, Drives, Homing
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import DriveError
from trirail_drivers.simulated import SimulatedDrive
from trirail_drivers.simulated.sdo_server import SdoServer

from drivers import test_cia402

FASTEST = 0.5
HOMING = Homing(method=19, speed_switch=0.02, speed_zero=0.005, acceleration=0.5)
INTEGER16, INTEGER64, REAL32 = 0x03, 0x15, 0x08
"""CiA 301 data types."""


def _own() -> list[Row]:
    """The facts of the simulated drive's own dictionary."""
    found: list[Row] = []
    for item in canopen.import_od(str(SERVO), 1).values():
        for each in [item] if isinstance(item, ODVariable) else item.subindices.values():
            kind, default = each.data_type or 0, each.default
            found.append((each.index, each.subindex, kind, each.access_type, default, bool(each.pdo_mappable)))
    return found


OWN: Final = _own()
MEMBERS: Final = {row[0] for row in OWN if row[1]}
PROFILE: Final = [row[:2] for row in OWN if row[0] >= 0x6000 and (row[1] or row[0] not in MEMBERS)]
"""Objects of CiA 402."""
COMMUNICATION: Final = [
    (0x1000, 0), (0x1005, 0), (0x1006, 0), (0x1014, 0), (0x1016, 1), (0x1017, 0), (0x1029, 1), (0x1400, 1), (0x1401, 1),
    (0x1401, 2), (0x1600, 1), (0x1601, 0), (0x1601, 1), (0x1601, 2), (0x1800, 1), (0x1800, 5), (0x1801, 2), (0x1A01, 1),
]  # fmt: skip
"""Objects of CiA 301."""


class Rig(test_cia402.Rig):
    """Three drives, of which A has a dictionary of its own, written into a folder."""

    def __init__(self, folder: Path, eds_of_a: str, **keys: Any) -> None:
        self._path = folder / f"{len(list(folder.iterdir()))}.eds"
        self._path.write_text(eds_of_a)
        a = Drive(node=1, counts_per_metre=1e6, **keys)
        b, c = (Drive(node=node, counts_per_metre=1e6) for node in (2, 3))
        super().__init__(Drives("cia402", a, b, c, sdo_timeout=0.01))

    def device(self, drive: Drive, counts: float) -> SimulatedDrive:
        path = self._path if drive.node == 1 else SERVO
        return SimulatedDrive(drive.node, ideal_servo(drive, round(counts)), eds=path)

    def look(self) -> str:
        """Why a look refuses drive A; "" where it does not."""
        scales = tuple(scale_of(name, drive) for name, drive in zip("ABC", self.config.each, strict=True))
        found = setup.survey(self.bus, self.config, scales, STEP, self.clock, FASTEST)[0]
        return str(found) if isinstance(found, DriveError) else found.refused

    def set_up(self) -> str:
        """Why the set-up refuses; "" where it does not."""
        try:
            self.drives.configure(STEP, FASTEST)
        except DriveError as error:
            return str(error)
        return ""

    def held(self, number: int = 0) -> list[tuple[int, bytes]]:
        """All that a drive holds, A the first."""
        entries = self.devices[number].objects
        return [(entries[row[:2]].value, entries[row[:2]].content) for row in OWN if row[:2] in entries]


def others(row: Row, types: Iterable[int]) -> Iterable[tuple[str, list[Row]]]:
    """An object that is not there, and that is of another kind."""
    index, subindex, kind, access, default, mappable = row
    yield "missing", []
    for each in {"ro", "wo"} - {access}:
        yield each, [(index, subindex, kind, each, default, mappable)]
    for of in types:
        if of != kind:
            yield f"of type {of:02X}h", [(index, subindex, of, access, default, mappable)]


def objects(text: str) -> set[str]:
    """The objects that a refusal names."""
    return set(re.findall(r"\b(?:1[0-9A-F]{3}|6[0-9A-F]{3})\b", text))


def check(folder: Path, key: tuple[int, int], types: Iterable[int] = (), **keys: Any) -> None:
    at = next(number for number, row in enumerate(OWN) if row[:2] == key)
    for kind, instead in others(OWN[at], types):
        rig = Rig(folder, eds([*OWN[:at], *instead, *OWN[at + 1 :]]), **keys)
        before = rig.held()
        looked = rig.look()
        assert rig.held() == before, kind
        refused = rig.set_up()
        # The one may have been told so by the drive, the other by its dictionary: they name an object that both know.
        assert bool(looked) == bool(refused), f"{kind}: {looked!r}, {refused!r}"
        assert not refused or objects(looked) & objects(refused), f"{kind}: {looked!r}, {refused!r}"
        rig.drives.close()


@pytest.mark.long
@pytest.mark.parametrize("key", PROFILE, ids=lambda key: f"{key[0]:04X}:{key[1]}")
def test_a_look_and_the_set_up_come_to_one_verdict(key: tuple[int, int], tmp_path: Path) -> None:
    check(tmp_path, key, (INTEGER16, INTEGER64, *([REAL32] if key != (0x6061, 0) else [])), homing=HOMING)


@pytest.mark.long
@pytest.mark.parametrize("key", COMMUNICATION, ids=lambda key: f"{key[0]:04X}:{key[1]}")
def test_a_look_and_the_set_up_come_to_one_verdict_of_the_bus(key: tuple[int, int], tmp_path: Path) -> None:
    check(tmp_path, key)


@pytest.mark.parametrize(
    ("key", "kind", "access", "named"),
    [
        ((0x60A9, 0), 0x07, "wo", "60A9"),
        ((0x6060, 0), 0x02, "ro", "6060:00"),
        ((0x607A, 0), 0x06, "rw", "607A"),
        ((0x6064, 0), 0x04, "wo", "6064"),
    ],
)
def test_what_is_refused_is_named(
    closing: Closing, key: tuple[int, int], kind: int, access: str, named: str, tmp_path: Path
) -> None:
    rig = closing(Rig(tmp_path, eds([row if row[:2] != key else (*key, kind, access, None, True) for row in OWN])))
    assert named in rig.look()
    shown = inspection.inspect(rig.bus, rig.config, STEP, rig.clock, FASTEST, apply=False)
    assert [named in each["refused"] for each in shown] == [True, False, False]
    before = [rig.held(number) for number in range(3)]
    with pytest.raises(DriveError, match=named):
        inspection.inspect(rig.bus, rig.config, STEP, rig.clock, FASTEST, apply=True)
    assert [rig.held(number) for number in range(3)] == before, "all three are written, or none"


def test_a_drive_is_asked_by_a_look_alone_and_not_by_the_service(
    closing: Closing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin, asked = SdoServer.init_download, []

    def listening(server: SdoServer, data: bytes) -> None:
        asked.append(not data[0] & 2)  # not expedited: only the length comes with it
        begin(server, data)

    monkeypatch.setattr(SdoServer, "init_download", listening)
    rig = closing(Rig(tmp_path, eds(OWN)))
    assert rig.look() == ""
    assert asked
    assert all(asked)
    asked.clear()
    assert rig.set_up() == ""
    assert asked
    assert not any(asked)


@pytest.mark.parametrize(
    ("unit", "wanted"),
    [
        (0xF7B5_0300, "limits.slider.velocity = 0.5 is 5e.14 of it, .*; use a coarser unit"),
        (0x09B5_0300, "limits.slider.velocity = 0.5 is 0.0005 of it, .*; use a finer unit"),
    ],
)
def test_a_unit_that_cannot_say_the_sliders_limit_is_refused(
    closing: Closing, unit: int, wanted: str, tmp_path: Path
) -> None:
    """60A9h = 1e-9 and 1e9 counts a second (CiA 303-2), at 1e6 counts a metre."""
    rig = closing(Rig(tmp_path, eds(OWN, {(0x60A9, 0): unit})))
    looked = rig.look()
    assert re.match(f"drive A: its unit of velocity .*60A9.*: {wanted}", looked)
    assert rig.set_up() == looked


@pytest.mark.parametrize("code", [0x0504_0001, 0x0607_0010, None])
def test_a_drive_that_knows_no_segments_is_set_up_all_the_same(
    closing: Closing, code: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It refuses each download that is not expedited, or does not answer it: that says nothing of the object."""
    begin = SdoServer.init_download

    def expedited(server: SdoServer, data: bytes) -> None:
        if data[0] & 2:
            begin(server, data)
        elif code is not None:
            server._name(data)
            raise SdoAbortedError(code)

    monkeypatch.setattr(SdoServer, "init_download", expedited)
    rig = closing(Rig(tmp_path, eds(OWN)))
    assert (rig.look(), rig.set_up()) == ("", "")
