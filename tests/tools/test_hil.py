"""What tools/hil.py needs of a machine, and the configuration it makes; the run itself is `make hil`."""

from __future__ import annotations

import contextlib
import io
import queue
import re
import struct
import tempfile
import threading
import time
from pathlib import Path

import can
import hil
import hil_foreign
import hil_machine
import hil_needs
import hil_second
import pytest
from edsfiles import MAKES
from hil_programs import Failed
from hypothesis import given
from hypothesis import strategies as st
from trirail.config import load
from trirail_drivers.cia402 import setup
from trirail_drivers.config import Drive, Drives
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import DriveError


@given(
    has=st.lists(st.sets(st.sampled_from(hil_needs.DRIVERS)) | st.just(set(hil_needs.DRIVERS)), max_size=4),
    built_in=st.sets(st.sampled_from(hil_needs.DRIVERS)),
    suffix=st.sampled_from(["", ".xz", ".zst"]),
)
def test_kernels_with_all_drivers_are_taken_the_newest_last(
    has: list[set[str]], built_in: set[str], suffix: str
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        boot, modules = Path(folder) / "boot", Path(folder) / "modules"
        boot.mkdir()
        will_do = []
        for number, drivers in enumerate(has):
            release = f"6.1.0-{9 + 40 * number}-amd64"
            (boot / f"vmlinuz-{release}").touch()
            for driver in drivers:
                file = modules / release / f"kernel/{driver}.ko{suffix}"
                file.parent.mkdir(parents=True, exist_ok=True)
                file.touch()
            if number % 2 and built_in:
                (modules / release).mkdir(parents=True, exist_ok=True)
                said = "".join(f"kernel/{driver}.ko\n" for driver in built_in)
                (modules / release / "modules.builtin").write_text(said)
            if drivers | (built_in if number % 2 else set()) == set(hil_needs.DRIVERS):
                will_do.append(f"vmlinuz-{release}")
        assert [kernel.name for kernel in hil_needs.kernels(boot, modules)] == will_do


def elf(segments: list[int], wide: bool, order: str) -> bytes:
    """Return an ELF file with program headers of these types, as elf(5) has them."""
    ident = b"\x7fELF" + bytes([2 if wide else 1, "<>".index(order) + 1, 1]) + bytes(9)
    size, table = (56, 64) if wide else (32, 52)
    address = "Q" if wide else "I"
    head = struct.pack(f"{order}HHI{address}{address}{address}I", 2, 62, 1, 0, table, 0, 0)
    head += struct.pack(f"{order}HHHHHH", table, size, len(segments), 0, 0, 0)
    return ident + head + b"".join(struct.pack(f"{order}I", kind).ljust(size, b"\0") for kind in segments)


@given(segments=st.lists(st.integers(0, 10), min_size=1, max_size=9), wide=st.booleans(), order=st.sampled_from("<>"))
def test_a_program_is_static_that_names_nobody_who_links_it(segments: list[int], wide: bool, order: str) -> None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(elf(segments, wide, order))
        file.flush()
        assert hil_needs.is_static(Path(file.name)) is (hil_needs.PT_INTERP not in segments)


@given(content=st.binary(max_size=80) | st.binary(max_size=80).map(lambda rest: elf([1], True, "<")[:40] + rest))
def test_what_is_no_program_is_not_static_and_no_error(content: bytes) -> None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()
        if not content.startswith(b"\x7fELF"):
            assert not hil_needs.is_static(Path(file.name))
        hil_needs.is_static(Path(file.name))


@given(
    there=st.dictionaries(
        st.tuples(st.sampled_from(["a", "b"]), st.sampled_from(hil_needs.BUSYBOXES)), st.booleans(), max_size=6
    )
)
def test_a_static_busybox_is_taken_wherever_one_is_and_no_other(there: dict[tuple[str, str], bool]) -> None:
    """That of initramfs-tools, which is linked to libraries, stands in the way of none, and counts as missing."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(hil_needs, "SEARCH", f"{folder}/a:{folder}/b")
        for (place, name), static in there.items():
            file = Path(folder) / place / name
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(elf([1] if static else [1, hil_needs.PT_INTERP], True, "<"))
            file.chmod(0o755)
        found = hil_needs.busybox()
        good = {f"{folder}/{place}/{name}" for (place, name), static in there.items() if static}
        assert found in good if good else found is None
        assert ("busybox-static" in hil_needs.lacking()) is (not good)


def test_what_is_missing_is_named_in_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hil_needs, "SEARCH", "/nowhere")
    monkeypatch.setattr(hil_needs, "kernels", list)
    with pytest.raises(Failed) as failed:
        hil_needs.requirements()
    for package in (*hil_needs.PROGRAMS.values(), "linux-image"):
        assert package in str(failed.value)
    assert "\n" not in str(failed.value)


def test_the_machines_configuration_is_that_of_real_drives_but_slower(tmp_path: Path) -> None:
    config = hil.configure(tmp_path)
    assert (config.can.interface, config.can.channel) == ("socketcan", "can0")
    assert config.loop.rate_hz == 20
    assert config.telemetry.capture_can
    assert config.limits.slider.following_error < config.drives.following_error


def test_the_second_robot_has_another_rate_a_drive_to_home_and_one_that_others_made(tmp_path: Path) -> None:
    first = hil.configure(tmp_path)
    second = load(tmp_path / "second.toml")
    assert (second.can.interface, second.can.channel) == ("socketcan", "vcan0")
    assert second.loop.rate_hz != first.loop.rate_hz
    assert second.zenoh.listen != first.zenoh.listen
    assert second.telemetry.directory != first.telemetry.directory
    assert [drive.homing is not None for drive in second.drives.each] == [True, False, False]
    assert (second.outputs["valve"].drive, 1 << second.outputs["valve"].bit) == ("C", hil_second.VALVE)
    assert second.drives.C.revolutions_per_metre == hil_second.REVOLUTIONS
    assert second.limits.slider.following_error < second.drives.following_error
    assert hil_second.MAKE in MAKES
    with simulated_bus(second.can, second.drives) as bus:
        bus.faults.load(tmp_path / "second.faults")


@pytest.mark.long
def test_the_foreign_drive_says_its_units_and_what_it_lacks() -> None:
    """On a bus of this process: the driver's own thread is this one, the drive's another."""
    counts, turns = hil_second.COUNTS, hil_second.REVOLUTIONS
    a, b, c = (Drive(node=node, counts_per_metre=counts, revolutions_per_metre=turns) for node in (1, 2, 3))
    drives = Drives("cia402", a, b, c, sdo_timeout=0.5)  # A and B, which are not there, are waited for
    ends = [can.Bus("hil", interface="virtual") for _ in range(2)]
    said: list[str] = []
    over = threading.Event()
    node = drives.C.node
    thread = threading.Thread(
        target=hil_foreign.serve, args=(ends[1], node, said.append, lambda: not over.is_set()), daemon=True
    )
    thread.start()
    try:
        scales = scale_of("A", a), scale_of("B", b), scale_of("C", c)
        *_, looked = setup.survey(ends[0], drives, scales, 0.1, time.monotonic)
        assert not isinstance(looked, DriveError), looked
        assert looked.missing_protections == ("1006",)
        assert looked.units.velocity_name == "rev/min"
    finally:
        over.set()
        thread.join()
        for end in ends:
            end.shutdown()
    assert said == ["C switch on disabled, 0.000 mm"]


def test_changes_of_the_foreign_drives_outputs_are_compared_with_the_table() -> None:
    log = "C operation enabled, 0.1 mm\noutputs 00010000 at SYNC 71, 3.500\noutputs 00000000 at SYNC 74, 3.800\n"
    changes = [(each.sync, each.on) for each in hil_second.changes(log)]
    assert hil_second.cycles_problem([(170, True), (173, False)], changes) == ""
    assert "[-99, -100] SYNCs" in hil_second.cycles_problem([(170, True), (174, False)], changes)
    assert "in the table to [True]" in hil_second.cycles_problem([(170, True)], changes)


def test_the_time_limit_says_what_was_heard_last() -> None:
    lines: queue.Queue[str | None] = queue.Queue()
    lines.put("the machine is up")
    heard = hil_machine.output_lines(lines, 0.0)
    assert next(heard) == "the machine is up"
    with pytest.raises(Failed, match="the machine is up"):
        next(heard)


def ends_at_once(monkeypatch: pytest.MonkeyPatch, *options: str) -> int:
    """Run tools/hil.py with a machine that ends before its first step; return the exit code."""
    lines: queue.Queue[str | None] = queue.Queue()
    lines.put(None)
    image: list[Path] = []

    def pack(folder: Path) -> tuple[Path, ...]:
        image.append(folder / "python.img")
        image[0].touch()
        return ()

    monkeypatch.setattr(hil, "requirements", lambda: Path("vmlinuz"))
    monkeypatch.setattr(hil, "compiling", contextlib.nullcontext)
    monkeypatch.setattr(hil, "pack", pack)
    monkeypatch.setattr(hil, "machine", lambda *_: contextlib.nullcontext(lines))
    monkeypatch.setattr("sys.argv", ["hil.py", *options])
    with monkeypatch.context() as patch:
        patch.setattr(hil, "interrupt_on_signals", lambda: None)  # of the process of the tests
        code = hil.main()
    assert not image[0].exists()
    return code


RESULTS = {
    "vcan.code": "0\n",
    "vcan.log": "31 passed in 9.00s\n",
    "price.json": '{"socket_us": {"p50": 9.0}, "ratio": 4.0}',
}
"""Results of the tests marked vcan."""


def test_results_of_an_earlier_run_do_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ends_at_once(monkeypatch, "--only", "tests", "--keep", str(tmp_path / "new")) == 1
    assert "exit code none" in capsys.readouterr().err
    for name, content in RESULTS.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(SystemExit) as ended:
        ends_at_once(monkeypatch, "--only", "tests", "--keep", str(tmp_path))
    assert ended.value.code == 2
    assert f"{tmp_path}: the folder is not empty" in capsys.readouterr().err


def test_every_file_with_tests_marked_vcan_is_run_in_the_machine() -> None:
    folder = Path(__file__).parents[1]
    marked = re.compile(r"carriers\.(on_vcan|NEEDS_VCAN)\b|import .*\bon_vcan\b")
    files = {path for path in folder.rglob("test_*.py") if marked.search(path.read_text(encoding="utf-8"))}
    assert {str(path.relative_to(folder.parent)) for path in files} == set(hil_machine.TESTS)


@pytest.mark.parametrize("summary", ["", "31 skipped in 9.00s", "30 passed, 1 skipped in 9.00s"])
def test_tests_in_the_machine_must_all_have_passed(summary: str, tmp_path: Path) -> None:
    for name, content in (RESULTS | {"vcan.log": summary}).items():
        (tmp_path / name).write_text(content)
    with pytest.raises(Failed, match="the tests marked vcan"):
        hil._judge_tests(tmp_path, hil.Progress(io.StringIO()), {"checks": {}})
