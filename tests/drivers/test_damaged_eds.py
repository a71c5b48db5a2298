"""EDS files as makers really write them: what is sound is used, what is not is told with its section and line."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import canopen
import numpy as np
import pytest
from edsfiles import MAKES, eds, rows
from trirail_drivers.cia402.eds import REQUIRED, load
from trirail_drivers.errors import DriveError

NODE = 1
HARMLESS: dict[str, Callable[[str], str]] = {
    "byte order mark": lambda text: "\ufeff" + text,
    "Ctrl-Z": lambda text: text + "\x1a",
    "Comments": lambda text: text + "[Comments]\nlines=2\nLine1=hello\nand a line without a value\n",
    "Comments without Lines": lambda text: text + "[Comments]\n",
    "VendorNumber": lambda text: text.replace("[DeviceInfo]\n", "[DeviceInfo]\nVendorNumber=001\n"),
    "PDOMapping": lambda text: text.replace("PDOMapping=0", "PDOMapping="),
    "section twice": lambda text: text + text[text.index("[1000]") :].partition("\n\n")[0] + "\n",
    "subindex first": lambda text: "\n\n".join(reversed(text.split("\n\n"))),
    "lines of Windows": lambda text: text.replace("\n", "\r\n"),
}
"""What changes nothing, and needs no words."""


def content(objects: canopen.ObjectDictionary) -> dict[tuple[int, int], tuple[str, int | None, object]]:
    """Everything that is read of an EDS and matters, by index and subindex."""
    found = {}
    for item in objects.values():
        for each in [item] if isinstance(item, canopen.objectdictionary.ODVariable) else item.values():
            found[each.index, each.subindex] = each.name, each.data_type, each.default
    return found


def written(folder: Path, text: str) -> Path:
    path = folder / "maker.eds"
    path.write_text(text, newline="")
    return path


@pytest.mark.parametrize("make", MAKES)
@pytest.mark.parametrize("harm", HARMLESS)
def test_what_has_a_plain_meaning_is_read_without_words(tmp_path: Path, make: str, harm: str) -> None:
    whole = eds(rows(make))
    sound, _ = load("A", written(tmp_path, whole), NODE)
    damaged, warning = load("A", written(tmp_path, HARMLESS[harm](whole)), NODE)
    assert warning == ""
    assert content(damaged) == content(sound)


def _spoilt(text: str, section: str, how: str) -> str:
    begin = text.index(f"[{section}]\n")
    end = text.find("\n[", begin) % (len(text) + 1)
    own = text[begin:end]
    match how:
        case "no DataType":
            own = re.sub("DataType=.*\n", "", own)
        case "bad DataType":
            own = re.sub("DataType=.*", "DataType=zz", own)
        case "bad PDOMapping":
            own = re.sub("PDOMapping=.*", "PDOMapping=yes", own)
        case "no name":
            own = re.sub("ParameterName=.*\n", "", own)
    return text[:begin] + own + text[end:]


@pytest.mark.generated(*range(6))
@pytest.mark.parametrize("make", MAKES)
def test_objects_that_are_sound_are_used_and_others_told_with_section_and_line(
    tmp_path: Path, make: str, seed: int
) -> None:
    """An object that every drive needs is refused, by section and line as well."""
    rng = np.random.default_rng(seed)
    whole = eds(rows(make))
    sound, _ = load("A", written(tmp_path, whole), NODE)
    variables = re.findall(r"\[([0-9A-F]{4}(?:sub[0-9A-F]+)?)\]\nParameterName=.*\nObjectType=0x7", whole)
    section = str(rng.choice(variables))
    text = _spoilt(whole, section, str(rng.choice(["no DataType", "bad DataType", "bad PDOMapping", "no name"])))
    if rng.integers(2):
        text += "\n[5FFFsub1]\nParameterName=Orphan\nDataType=0x7\nAccessType=rw\n"
    place = f"[{section}] in line {text[: text.index(f'[{section}]')].count(chr(10)) + 1}: "
    path = written(tmp_path, text)
    index, _, subindex = section.partition("sub")
    if int(index, 16) in REQUIRED:
        with pytest.raises(DriveError, match=re.escape(place)) as refused:
            load("A", path, NODE)
        assert str(refused.value).endswith("every drive needs this object")
        return
    objects, warning = load("A", path, NODE)
    assert warning.startswith(f"skipped in {path}: ")
    assert place in warning
    assert ("[5FFFsub1] in line " in warning) is ("[5FFFsub1]" in text)
    lost = {key for key in content(sound) if key == (int(index, 16), int(subindex or "0", 16))}
    assert content(objects) == {key: value for key, value in content(sound).items() if key not in lost}


def _records(text: str) -> list[tuple[str, int, list[int]]]:
    """Each record with its index, its end, and the places in it where a cut leaves out whole sub-objects."""
    found = []
    for record in re.finditer(r"\[([0-9A-F]{4})\]\n[^[]*SubNumber=\d+\n\n?(?:\[\1sub[^[]*)+", text):
        subs = [record.start() + each.start() for each in re.finditer(r"\[\w{4}sub", record[0])]
        found.append((record[1], record.end(), subs))
    return found


@pytest.mark.parametrize("make", MAKES)
def test_a_file_that_ends_within_a_record_is_refused(tmp_path: Path, make: str) -> None:
    """One that ends after it is read; and so is one whose maker counted wrongly before its end."""
    text = eds(rows(make))
    records = _records(text)
    assert len(records) > 5
    for index, end, subs in records[::7]:
        load("A", written(tmp_path, text[:end]), NODE)
        for cut in subs:
            path = written(tmp_path, text[:cut])
            with pytest.raises(
                DriveError, match=re.escape(f"drive A: {path}: it ends within object {index}, with ")
            ) as refused:
                load("A", path, NODE)
            assert str(refused.value).endswith("is the file complete?")
    miscounted = text[: records[0][1]].replace("SubNumber=", "SubNumber=1") + text[records[0][1] :]
    assert content(load("A", written(tmp_path, miscounted), NODE)[0]) == content(
        load("A", written(tmp_path, text), NODE)[0]
    )


def test_objects_that_are_listed_and_not_described_are_told(tmp_path: Path) -> None:
    """As in a file that ends between two objects."""
    whole = eds(rows(MAKES[0]))
    lists = "[OptionalObjects]\nSupportedObjects=3\n1=0x6065\n2=0x5FFE\n3=0x5fff\n\n"
    path = written(tmp_path, whole.replace("[1000]\n", f"{lists}[1000]\n"))
    _, warning = load("A", path, NODE)
    assert warning == (
        f"skipped in {path}: 2 objects that it lists but does not describe, such as 5FFE; is the file complete?"
    )


@pytest.mark.parametrize(
    ("record", "is_whole"),
    [
        ("ObjectType=0x9\n", False),
        ("ObjectType=8\nsubnumber=1\n", False),
        ("ObjectType=8\nDataType=7\nAccessType=rw\nCompactSubObj=2\n", True),
        ("ObjectType=9\nSubNumber=x\n[5000sub0]\nParameterName=a\nDataType=7\nAccessType=rw\n", True),
        ("ObjectType=9\nSubNumber=3\n[5000sub2]\nParameterName=a\nDataType=7\nAccessType=rw\n", True),
        ("ObjectType=7\nDataType=7\nAccessType=rw\nSubNumber=1\n", True),
        ("SubNumber=3\n[5000sub0]\nParameterName=a\nDataType=7\nAccessType=rw\n", False),
    ],
)
def test_the_last_object_is_whole_if_it_has_as_many_sub_objects_as_it_says(
    tmp_path: Path, record: str, is_whole: bool
) -> None:
    path = written(tmp_path, f"{eds(rows(MAKES[0]))}\n[5000]\nParameterName=Last\n{record}")
    if is_whole:
        assert 0x5000 in load("A", path, NODE)[0]
    else:
        with pytest.raises(DriveError, match="it ends within object 5000, with"):
            load("A", path, NODE)


@pytest.mark.parametrize(
    "text", ["", "\n\n", "\ufeff", "\x1a", "[DeviceInfo]\nVendorName=x\n", "[5FFFsub1]\nDataType=7\n"]
)
def test_a_file_without_objects_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(DriveError, match=r"^drive A: \S+ is not an EDS according to CiA 306: .+"):
        load("A", written(tmp_path, text), NODE)


@pytest.mark.parametrize("name", ["maker", "maker.txt", "maker.epf", "maker.EDS"])
def test_a_file_of_any_name_is_read_by_its_content(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(written(tmp_path, eds(rows(MAKES[0]))).read_bytes())
    assert content(load("A", path, NODE)[0]) == content(load("A", tmp_path / "maker.eds", NODE)[0])
    path.write_text("<?xml version='1.0'?>\n<epf/>\n")
    with pytest.raises(DriveError, match=f"^drive A: {path} is not an EDS according to CiA 306: line 1: "):
        load("A", path, NODE)
