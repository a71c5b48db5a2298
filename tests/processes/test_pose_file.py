"""What was taught lasts: after a power cut at any moment the file is the old or the new one, whole."""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.cli.key_folder import KeyFolder
from trirail.client.calibration_file import keep_old
from trirail.errors import ServiceError
from trirail.processes.pose_file import NAME, PoseFile, TaughtPose, state_directory
from trirail_drivers import files

PICK, PLACE = TaughtPose(0.01, -0.02, 0.3, "0123abcd"), TaughtPose(-0.05, 0.0, -0.1)


class PowerCut(BaseException):
    """Ends everything, like a process that is no more."""


class Disk:
    """What a disk holds that keeps what it was told to: contents by fsync of the file, names by that of the folder.

    Between those it may have written anything already. `possible` yields every state in which a power cut may leave
    a folder: of each name the file it was given last or before, of each file all of its content or none.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, cut_after: int) -> None:
        self.folder = folder
        self.steps = 0
        self._cut_after = cut_after
        self._kept: dict[int, bytes] = {path.stat().st_ino: path.read_bytes() for path in folder.iterdir()}
        self._names: list[dict[str, int]] = [self._now()]
        fsync, replace, link = os.fsync, os.replace, os.link

        def on_fsync(descriptor: int) -> None:
            self._step()
            fsync(descriptor)
            place = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
            if place == folder:
                self._names = [self._now()]
            elif place.is_file():
                self._kept[os.fstat(descriptor).st_ino] = place.read_bytes()

        def on_replace(source: str, target: Path) -> None:
            self._step()
            replace(source, target)
            self._names.append(self._now())

        def on_link(source: Path, target: Path) -> None:
            self._step()
            link(source, target)
            self._names.append(self._now())

        monkeypatch.setattr(os, "fsync", on_fsync)
        monkeypatch.setattr(os, "link", on_link)
        monkeypatch.setattr(os, "replace", on_replace)

    def _now(self) -> dict[str, int]:
        return {path.name: path.stat().st_ino for path in self.folder.iterdir()}

    def _step(self) -> None:
        if self.steps == self._cut_after:
            self._names.append(self._now())  # what a handler of the exception removes, a power cut leaves
            raise PowerCut
        self.steps += 1

    def possible(self) -> Iterator[dict[str, bytes]]:
        names = [*self._names, self._now()]
        content = {path.stat().st_ino: path.read_bytes() for path in self.folder.iterdir()}
        for tree, all_of_it in itertools.product(names, (True, False)):
            yield {
                name: self._kept.get(inode, content.get(inode, b"") if all_of_it else b"")
                for name, inode in tree.items()
            }


def after(disk: dict[str, bytes], folder: Path) -> dict[str, Any]:
    """Read the taught poses of a disk as it was left."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, content in disk.items():
        (folder / name).write_bytes(content)
    return PoseFile(folder).read()


@pytest.mark.parametrize("cut_after", range(4))
def test_a_power_cut_at_any_step_leaves_the_old_or_the_new_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cut_after: int
) -> None:
    folder = tmp_path / "demo"
    PoseFile(folder).change("pick", PICK)
    old, new = {"pick": PICK}, {"pick": PICK, "place": PLACE}
    whole = 3  # the content, its name, and the name on the disk
    with monkeypatch.context() as patched:
        disk = Disk(folder, patched, cut_after)
        if cut_after < whole:
            with pytest.raises(PowerCut):
                PoseFile(folder).change("place", PLACE)
        else:
            PoseFile(folder).change("place", PLACE)
        left = list(disk.possible())
        assert disk.steps == min(cut_after, whole)
    found = [after(each, tmp_path / "after") for each in left]
    assert all(each in (old, new) for each in found)
    if cut_after == whole:  # it was said to be kept
        assert all(each == new for each in found)


@pytest.mark.parametrize("cut_after", range(4))
def test_a_power_cut_at_any_step_leaves_a_whole_new_file_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cut_after: int
) -> None:
    whole = 3
    with monkeypatch.context() as patched:
        disk = Disk(tmp_path, patched, cut_after)
        if cut_after < whole:
            with pytest.raises(PowerCut):
                files.create(tmp_path / "drive-A.dcf", b"whole")
        else:
            files.create(tmp_path / "drive-A.dcf", b"whole")
        found = {each.get("drive-A.dcf") for each in disk.possible()}
        assert disk.steps == min(cut_after, whole)
    assert found <= {None, b"whole"}
    if cut_after == whole:
        assert found == {b"whole"}


def test_a_copy_of_an_old_calibration_is_whole_before_the_new_one_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "camera.json"
    path.write_bytes(b"targets")
    path.chmod(0o640)
    with monkeypatch.context() as patched:
        disk = Disk(tmp_path, patched, 9)
        old = keep_old(path)
        assert old is not None
        assert {each[old.name] for each in disk.possible()} == {b"targets"}
    assert old.stat().st_mode & 0o777 == 0o640


def test_a_folder_of_certificates_has_its_name_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[list[str]] = []
    sync = files.sync_folder

    def on_sync(folder: Path) -> None:
        sync(folder)
        synced.append(sorted(path.name for path in folder.iterdir()))

    monkeypatch.setattr(files, "sync_folder", on_sync)
    KeyFolder(tmp_path / "keys").create("demo", ["127.0.0.1"], 1.0)
    assert synced[-1] == ["keys"]


@pytest.mark.parametrize("fails", [False, True])
def test_a_disk_without_links_gets_whole_files_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    """FAT has none. A file that is there already is never replaced."""

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "drive-A.dcf"
    if fails:
        monkeypatch.setattr(os, "replace", refuse)
        with pytest.raises(PermissionError):
            files.create(path, b"whole")
        assert list(tmp_path.iterdir()) == []
        return
    files.create(path, b"whole")
    with pytest.raises(FileExistsError):
        files.create(path, b"other")
    assert path.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [path]


def test_the_model_of_a_disk_finds_what_is_not_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The test above can fail: a file that is renamed before its content is on the disk may be empty afterwards."""
    folder = tmp_path / "demo"
    PoseFile(folder).change("pick", PICK)
    with monkeypatch.context() as patched:
        disk = Disk(folder, patched, 9)
        (folder / "beside").write_bytes(b"{}")
        os.replace(str(folder / "beside"), folder / NAME)
        assert {each[NAME] for each in disk.possible()} > {b"", b"{}"}


TEACHES = """
import itertools, sys
from pathlib import Path
from trirail.processes.pose_file import PoseFile, TaughtPose
print("begun", flush=True)
for number in itertools.count():
    PoseFile(Path(sys.argv[1])).change(f"p{number % 40}", TaughtPose(float(number), 0.0, 0.0))
"""


def test_a_service_that_is_killed_while_it_writes_leaves_a_whole_file(tmp_path: Path) -> None:
    for number in range(5):
        folder = tmp_path / str(number)
        with subprocess.Popen([sys.executable, "-c", TEACHES, str(folder)], stdout=subprocess.PIPE) as teaching:
            assert teaching.stdout is not None
            assert teaching.stdout.readline() == b"begun\n"
            while len(PoseFile(folder).read()) < 5 + number:
                assert teaching.poll() is None
            teaching.send_signal(signal.SIGKILL)
        numbers = sorted(round(x) for x, *_ in PoseFile(folder).read().values())
        assert numbers == list(range(numbers[-1] - len(numbers) + 1, numbers[-1] + 1))


poses = st.dictionaries(
    st.from_regex(r"\A[A-Za-z0-9_-]{1,64}\Z"),
    st.builds(TaughtPose, *[st.floats(-1e3, 1e3)] * 3),
    min_size=1,
    max_size=5,
)


@given(taught=poses)
def test_what_is_taught_is_read_again_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, taught: Any) -> None:
    file = PoseFile(tmp_path_factory.mktemp("state") / "new" / "folders")
    assert file.read() == {}
    for name, pose in taught.items():
        file.change(name, pose)
    assert PoseFile(file.path.parent).read() == taught
    gone, *_ = taught
    file.change(gone, None)
    assert PoseFile(file.path.parent).read() == {name: pose for name, pose in taught.items() if name != gone}


@given(
    content=st.binary(max_size=60) | st.sampled_from([b"{", b'{"pick": [1, 2]}', b'{"a b": [0, 0, 0]}', b"[" * 9999])
)
def test_a_file_that_is_none_of_ours_is_refused_by_name_and_never_overwritten(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    file = PoseFile(tmp_path_factory.mktemp("state"))
    file.path.write_bytes(content)
    try:
        msgspec.json.decode(content, type=dict[str, tuple[float, float, float]])
    except (msgspec.MsgspecError, ValueError, RecursionError):
        for attempt in (file.read, lambda: file.change("pick", PICK)):
            with pytest.raises(ServiceError, match=r"poses\.json: "):
                attempt()
        assert file.path.read_bytes() == content


def test_services_of_one_robot_that_write_at_once_keep_each_other_s(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as several:
        list(several.map(lambda n: PoseFile(tmp_path).change(f"p{n}", TaughtPose(n, 0.0, 0.0)), range(40)))
    assert set(PoseFile(tmp_path).read()) == {f"p{n}" for n in range(40)}
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ServiceError, match="file"):
        PoseFile(tmp_path / "file" / "demo").change("pick", PICK)


@pytest.mark.parametrize(
    ("environment", "folder"),
    [
        ({"STATE_DIRECTORY": "/var/lib/trirail", "XDG_STATE_HOME": "/x"}, "/var/lib/trirail/demo"),
        ({"STATE_DIRECTORY": "/var/lib/trirail:/var/lib/other"}, "/var/lib/trirail/demo"),
        ({"XDG_STATE_HOME": "/x", "HOME": "/home/ann"}, "/x/trirail/demo"),
        ({"HOME": "/home/ann"}, "/home/ann/.local/state/trirail/demo"),
    ],
)
def test_the_state_directory_is_systemd_s_or_the_user_s(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], folder: str
) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert state_directory("demo") == Path(folder)


def test_a_user_without_a_home_is_told_and_poses_are_not_put_in_the_working_directory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    with pytest.raises(ServiceError, match="the home folder is unknown: set HOME, or set STATE_DIRECTORY"):
        state_directory("demo")
