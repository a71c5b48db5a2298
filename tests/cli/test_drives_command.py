"""`trirail drives`: what simulated drives say of themselves, and what their set-up would change."""

from __future__ import annotations

import dataclasses
import errno
import json
import re
from pathlib import Path
from typing import Any

import pytest
from trirail.cli import drives_command
from trirail.cli.app import app
from trirail.cli.drives_command import UNTESTED_NOTE
from trirail.config import SIM, load
from trirail.processes.loop_process import rehearse
from trirail_drivers import files
from trirail_drivers.cia402 import parameter_file
from trirail_drivers.cia402.backup import RestoreResult, UnrestoredParameter
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.cia402.parameter_file import ParameterDifference
from trirail_drivers.cia402.parameters import Parameter, named
from trirail_drivers.errors import DriveError, FileError
from trirail_drivers.protocols import CIA402
from trirail_drivers.simulated import SimulatedDrive


def run(*words: str) -> int:
    return int(app(list(words), result_action="return_value") or 0)


def test_differences_are_shown_and_not_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", str(SIM), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["ok"], told["applied"]) == (True, False)
    assert [(drive["name"], drive["node"], drive["device_type"]) for drive in told["drives"]] == [
        ("A", 1, "00020192"),
        ("B", 2, "00020192"),
        ("C", 3, "00020192"),
    ]
    for drive in told["drives"]:
        assert (drive["velocity_unit"], drive["acceleration_unit"]) == ("counts/s", "counts/s2")
        changes = {each["object"]: (each["found"], each["wanted"]) for each in drive["differences"]}
        assert changes["1017:00"] == ("0", "100")
        assert changes["6060:00"] == ("0", "8")


def test_differences_are_written_when_that_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", str(SIM), "--apply") == 0
    words = capsys.readouterr().out
    assert "drive C, node 3" in words
    assert "written: 1017:00 Producer heartbeat time: 0 -> 100, for monitoring by this service" in words


def narrow(path: Path) -> Path:
    """Write the configuration of a robot whose drive B has software limits that are narrower than its travel."""
    limit = '[[drives.B.write]]\nobject = 0x607D\nsub = {}\nvalue = {}\ntype = "i32"\nwhy = "…"\n'
    path.write_text(SIM.read_text() + "\n" + limit.format(1, -20_000) + limit.format(2, 20_000))
    return path


def test_a_drive_whose_limits_exclude_some_of_the_travel_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(narrow(tmp_path / "robot.toml"))
    assert run("drives", path) == 1
    said = "drive B: object 607D (software position limit) is -20000 to 20000 counts, but limits.slider.position"
    assert said in " ".join(capsys.readouterr().out.split())
    with pytest.raises(DriveError, match=re.escape(said)):
        run("drives", path, "--apply")


def test_simulated_drives_are_not_refused_for_such_limits(tmp_path: Path) -> None:
    """They have the default values of a maker's EDS, and the real drives may have others."""
    assert rehearse(load(narrow(tmp_path / "robot.toml"))) == ()


@pytest.mark.parametrize("simulated", [True, False])
def test_of_real_drives_it_is_said_that_no_make_was_tried(
    simulated: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trirail.diagnosis.check.is_simulated", lambda section: simulated)
    assert run("drives", str(SIM)) == 0
    assert (UNTESTED_NOTE in capsys.readouterr().out) == (not simulated)


def test_drives_that_tell_nothing(tmp_path: Path) -> None:
    text = SIM.read_text().replace('protocol = "cia402"', 'protocol = "odrive"')
    text = text.replace("counts_per_metre = 1e7", "counts_per_metre = 30.0")
    (tmp_path / "odrive.toml").write_text(text)
    with pytest.raises(DriveError, match="have no objects to show"):
        run("drives", str(tmp_path / "odrive.toml"))
    with pytest.raises(DriveError, match="protocol odrive have no object dictionary to save"):
        run("drives", "save", str(tmp_path), "--config", str(tmp_path / "odrive.toml"))


@pytest.mark.long
def test_parameters_are_saved_compared_and_restored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", "save", str(tmp_path)) == 0
    assert "drive C, node 3: 81 parameters in" in capsys.readouterr().out
    a, b = (tmp_path / f"drive-{name}.dcf" for name in "AB")
    assert run("drives", "compare", str(a)) == 0
    assert "0 of 81 parameters differ" in capsys.readouterr().out
    head, section, rest = a.read_text().partition("[607C]")
    a.write_text(head + section + rest.replace("ParameterValue=0", "ParameterValue=77", 1))
    assert run("drives", "compare", str(a), "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["ok"], told["other"]) == (False, "drive A")
    assert told["differences"] == [{"object": "607C:00", "name": "Home offset", "one": 77, "other": 0}]
    assert run("drives", "compare", str(a), str(b)) == 1
    words = capsys.readouterr().out
    assert "serial: 00000001h and 00000002h" in words
    assert "607C:00" in words
    assert run("drives", "restore", str(a), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["ok"], told["written"], told["left"], told["stored"]) == (True, ["607C:00"], [], False)
    assert run("drives", "restore", str(b), "--drive", "A", "--replace", "--store") == 1, "these drives store nothing"
    assert "not stored: Object does not exist" in capsys.readouterr().out
    with pytest.raises(DriveError, match="drive A has serial 00000001h"):
        run("drives", "restore", str(b), "--drive", "A")
    b.write_text(b.read_text().replace("NodeID=2", "NodeID=9"))
    with pytest.raises(
        DriveError, match=r"drive-B\.dcf has node id 9, the drives have 1, 2, 3; select the drive with --drive"
    ):
        run("drives", "restore", str(b))
    with pytest.raises(DriveError, match=r"drive B has node 2 \(the file's 9\)"):
        run("drives", "restore", str(b), "--drive", "B")


def test_what_an_eds_lacks_is_told_with_the_parameters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It was cut off between two objects: parameters that it does not describe are not known to be absent."""
    text = SERVO.read_text(encoding="utf-8")
    (tmp_path / "cut.eds").write_text(text[: text.index("[6085]")])
    (tmp_path / "robot.toml").write_text(SIM.read_text().replace("[drives.A]\n", '[drives.A]\neds = "cut.eds"\n'))
    config = "--config", str(tmp_path / "robot.toml")
    assert run("drives", "save", str(tmp_path)) == 0
    whole = tmp_path / "drive-A.dcf"
    capsys.readouterr()
    lacking = r"[1-9]\d* objects that it lists but does not describe, such as 6085; is the file complete\?"
    assert run("drives", "compare", str(whole), *config) == 0
    words = capsys.readouterr().out
    assert re.search(lacking, words)
    assert "not compared: 6085:00" in words
    assert run("drives", "compare", str(whole), *config, "--json") == 0
    assert re.search(lacking, json.loads(capsys.readouterr().out)["notes"][0])
    whole.unlink()
    assert run("drives", "save", str(tmp_path), *config, "--drive", "A") == 0
    assert re.search(lacking, capsys.readouterr().out)
    whole.unlink()
    assert run("drives", "save", str(tmp_path), *config, "--drive", "A", "--json") == 0
    assert re.search(lacking, json.loads(capsys.readouterr().out)["drives"]["A"]["notes"][0])


def test_a_restore_lists_every_parameter_that_it_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine, theirs = (Parameter(5, bytes([value]), "Node-ID") for value in (1, 2))
    of_setup = [(0x1A00, sub) for sub in range(1, 13)]
    left = tuple(
        UnrestoredParameter(
            ParameterDifference(key, "Node-ID", mine, theirs), f"why {key[0]:04X}", True, key in of_setup
        )
        for key in (*of_setup, (0x2000, 0))
    )
    done = RestoreResult((), left, False, "")
    run("drives", "save", str(tmp_path), "--drive", "A")
    protocol = dataclasses.replace(CIA402, restore=lambda *_, **__: done)
    monkeypatch.setattr("trirail_drivers.protocols.PROTOCOLS", {"cia402": protocol})
    capsys.readouterr()
    assert run("drives", "restore", str(tmp_path / "drive-A.dcf")) == 0
    words = capsys.readouterr().out
    assert all(named(each.different.key) in words for each in left)
    assert re.search(r"2000:00 +Node-ID +1 +2 +why 2000", words)
    for stored in (left, left[-1:]):
        done = RestoreResult((), stored, True, "")
        assert run("drives", "restore", str(tmp_path / "drive-A.dcf"), "--store") == 0
        words = capsys.readouterr().out
        assert "stored in the drive" in words
        assert ("with the present values of the set-up" in words) is (len(stored) > 1)


def test_the_drives_that_answer_are_saved_and_the_others_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        SimulatedDrive, "silent", property(lambda drive: drive.node == 2, lambda *_: None), raising=False
    )
    text = SIM.read_text().replace("[drives]\n", "[drives]\nsdo_timeout = 0.01\n")
    (tmp_path / "robot.toml").write_text(text)
    assert run("drives", "save", str(tmp_path), "--config", str(tmp_path / "robot.toml"), "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert (sorted(told["drives"]), sorted(told["failed"])) == (["A", "C"], ["B"])
    assert "need drives.A.eds" in told["drives"]["A"]["notes"][0]
    assert sorted(path.name for path in tmp_path.glob("drive-*")) == ["drive-A.dcf", "drive-C.dcf"]


def test_a_file_is_never_written_over(tmp_path: Path) -> None:
    assert run("drives", "save", str(tmp_path), "--drive", "B") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["drive-B.dcf"]
    with pytest.raises(FileError, match=r"drive-B\.dcf already exists"):
        run("drives", "save", str(tmp_path))
    with pytest.raises(FileError, match="nowhere: no such folder"):
        run("drives", "save", str(tmp_path / "nowhere"))
    with pytest.raises(FileError, match=r"drive-B\.dcf: a file, not a folder; give a configuration with --config"):
        run("drives", "save", str(tmp_path / "drive-B.dcf"))
    assert [path.name for path in tmp_path.iterdir()] == ["drive-B.dcf"]


def test_a_file_that_cannot_be_written_costs_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    create = files.create

    def full(path: Path, content: bytes) -> None:
        if path.name == "drive-B.dcf":
            raise OSError(errno.ENOSPC, "No space left on device")
        create(path, content)

    monkeypatch.setattr(files, "create", full)
    assert run("drives", "save", str(tmp_path), "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["ok"], sorted(told["drives"])) == (False, ["A", "C"])
    assert list(told["failed"]) == ["B"]
    assert "No space left" in told["failed"]["B"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive-A.dcf", "drive-C.dcf"]


def test_a_file_made_meanwhile_is_not_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = drives_command._read

    def slow(*words: Any) -> Any:
        (tmp_path / "drive-A.dcf").write_text("another's")
        return read(*words)

    monkeypatch.setattr(drives_command, "_read", slow)
    assert run("drives", "save", str(tmp_path)) == 1
    assert (tmp_path / "drive-A.dcf").read_text() == "another's"
    assert (tmp_path / "drive-B.dcf").exists()


def dcf(path: Path, product: int, value: str, kind: int = 7, index: int = 0x2000) -> str:
    """Write a file with one parameter."""
    section = f"ObjectType=7\nAccessType=rw\nParameterName=X\nDataType={kind}\nParameterValue={value}\n"
    lists = "".join(
        f"[{name}]\nSupportedObjects={number}\n" + (f"1=0x{index:04X}\n" if number else "")
        for name, number in (("MandatoryObjects", 0), ("OptionalObjects", 0), ("ManufacturerObjects", 1))
    )
    info = f"[DeviceInfo]\nVendorNumber=1\nProductNumber={product}\n"
    path.write_text(f"[FileInfo]\nFileName=x\n{info}[{index:04X}]\n{section}{lists}")
    return str(path)


@pytest.mark.parametrize(
    ("two", "ok", "compared", "only"),
    [
        ((1, "5"), True, 1, []),
        ((2, "5"), False, 1, []),
        ((1, "6"), False, 1, []),
        ((1, "5", 7, 0x2001), False, 0, ["2001:00"]),
    ],
)
def test_files_are_alike_only_with_the_same_product_and_something_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], two: Any, ok: bool, compared: int, only: list[str]
) -> None:
    paths = dcf(tmp_path / "one.dcf", 1, "5"), dcf(tmp_path / "two.dcf", *two)
    assert run("drives", "compare", *paths, "--json") == (0 if ok else 1)
    told = json.loads(capsys.readouterr().out)
    assert (told["ok"], told["compared"], told["only_other"]) == (ok, compared, only)
    assert told["identity"]["other"]["product"] == two[0]
    assert run("drives", "compare", *paths) == (0 if ok else 1)
    assert all(each in capsys.readouterr().out for each in only)


@pytest.mark.parametrize("value", ["inf", "-inf"])
def test_a_value_that_json_does_not_have_is_a_text(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], value: str
) -> None:
    paths = dcf(tmp_path / "one.dcf", 1, value, 8), dcf(tmp_path / "two.dcf", 1, "1.5", 8)
    assert run("drives", "compare", *paths, "--json") == 1
    (found,) = json.loads(capsys.readouterr().out)["differences"]
    assert (found["one"], found["other"]) == (value, 1.5)


def test_a_drive_that_does_not_answer_for_a_parameter_is_not_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = Path(dcf(tmp_path / "one.dcf", 1, "5"))
    saved = parameter_file.read(path)
    silent = dataclasses.replace(
        saved, parameters={}, unread={(0x2000, 0): "no answer within 0.5 s"}, unanswered=frozenset({(0x2000, 0)})
    )
    monkeypatch.setattr(drives_command, "_load_config", lambda _: (None, None))
    monkeypatch.setattr(drives_command, "_load_file", lambda *_: ("A", saved))
    monkeypatch.setattr(drives_command, "_read", lambda *_: {"A": silent})
    assert run("drives", "compare", str(path), "--json") == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["unread"], told["only_one"]) == ({"2000:00": "no answer within 0.5 s"}, [])
    assert run("drives", "compare", str(path)) == 1
    assert "2000:00 not compared: no answer" in capsys.readouterr().out
