"""A recording as a table: every number of every cycle comes back from the file, bit for bit."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import made
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from pyarrow import csv, parquet
from trirail.analysis import export, mcap
from trirail.cli import recording_commands
from trirail.config import SIM, load
from trirail.errors import ServiceError
from trirail.telemetry import recording as recordings
from trirail.telemetry.journal import Line
from trirail.telemetry.reading import read
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.recording import Recording
from trirail.wire.goals import MoveGoal
from trirail.wire.marks import Switch, switch_rows
from trirail.wire.messages import Event, Notice
from trirail.wire.packets import ControlInput, GoalRequest
from trirail.wire.records import DTYPE, PART_NAMES
from trirail.wire.vocabulary import MODES

ENDINGS = {"", *(f"_{end}" for end in ("x", "y", "phi", "a", "b", "c", *PART_NAMES))}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("export") / "made.rrd"
    recorder = Recorder(load(SIM), path.parent, path=path, live=False)
    recorder.records(made.records(1.0).tobytes())
    recorder.close()
    return read(path)


def read_table(path: Path) -> pa.Table:
    """Return a table that was written, by the reader of its format."""
    match path.suffix:
        case ".csv":
            return csv.read_csv(path)
        case ".parquet":
            return parquet.read_table(path)
        case _:
            array = np.load(path)
            return pa.table(
                {name: array[name].tolist() if name != "wall" else array[name] for name in array.dtype.names}
            )


@pytest.mark.parametrize("suffix", export.FORMATS)
def test_every_switch_comes_back(suffix: str, tmp_path: Path) -> None:
    config = load(SIM)
    recorder = Recorder(config, tmp_path, path=tmp_path / "made.rrd", live=False)
    recorder.records(made.records(1.0).tobytes())
    happened = [
        Switch(
            "g", k, "valve", k % 2 == 0, 100 * k, 0.1 * k, 1.8e9 + 0.1 * k, (0.01 * k, 1 / 3, 0.0), (0.1, 0.2, 0.3 / 7)
        )
        for k in range(1, 6)
    ]
    for number, part in enumerate((happened[:2], happened[2:])):
        notice = Notice("output", "info", "outputs switched", goal="g", marks=tuple(part))
        recorder.event(Event(**structs.asdict(notice), seq=number, t=0.6, cycle=600, time=1.8e9 + 0.6))
    recorder.close()
    path = tmp_path / f"switches{suffix}"
    assert export.write_switches(read(tmp_path / "made.rrd"), path) == len(happened)
    assert read_table(path).to_pylist() == switch_rows(tuple(happened))


def switched(goal: str, cycle: int) -> Switch:
    return Switch(goal, 0, "valve", True, cycle, 1e-3 * cycle, 1.8e9, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@given(
    st.lists(st.tuples(st.sampled_from(["g1", "g2"]), st.integers(0, 900), st.integers(0, 100)), max_size=10),
    st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
)
def test_switches_are_selected_by_their_own_goal_and_time(
    recording: Recording, happened: list[tuple[str, int, int]], span: tuple[float, float]
) -> None:
    """Not by the time of the event that reports them, which may be that of another goal."""
    rows, lines = list[Switch](), list[Line]()
    for seq, (goal, cycle, late) in enumerate(sorted(happened, key=lambda each: each[1]), 1):
        rows.append(switched(goal, cycle))
        t = 1e-3 * (cycle + late)
        event = Event("output", "info", "switched", goal=goal, marks=(rows[-1],), seq=seq, t=t, cycle=0, time=0.0)
        lines.append(Line(t, recording.wall[0], "INFO", "", event))
    told = recording._replace(events=lines)
    assert export.switches(told) == tuple(rows)
    assert export.switches(told, goal="g2") == tuple(row for row in rows if row.goal == "g2")
    begin, end = span
    assert export.switches(told, begin, end) == tuple(row for row in rows if begin <= row.t <= end)


def test_the_command_writes_all_switches_of_a_goal_and_no_others(tmp_path: Path) -> None:
    recorder = Recorder(load(SIM), tmp_path, path=tmp_path / "made.rrd", live=False)
    recorder.records(made.records(1.0).tobytes())
    happened = {"g1": (100, 400, 600), "g2": (500, 700)}  # a pulse of g1 ends after g1 does
    switches: list[Switch] = []
    for number, (goal, cycles) in enumerate(happened.items()):
        given_goal = GoalRequest(number, "ann", goal, MoveGoal(0.0, 0.0, 0.1), 0)
        recorder.control_input(ControlInput(number + 1, 50 + 400 * number, 0, given_goal))
        switches += [switched(goal, cycle) for cycle in cycles]
    for seq, switch in enumerate(sorted(switches, key=lambda switch: switch.cycle)):
        notice = Notice("output", "info", "switched", goal=switch.goal, marks=(switch,))
        recorder.event(Event(**structs.asdict(notice), seq=seq, t=switch.t + 0.09, cycle=switch.cycle + 90, time=0.0))
    for goal, t in (("g1", 0.45), ("g2", 0.9)):
        recorder.event(
            Event("goal", "info", "done", id=goal, outcome="done", seq=9, t=t, cycle=round(1e3 * t), time=0.0)
        )
    recorder.close()
    for goal, cycles in happened.items():
        out = tmp_path / f"{goal}.parquet"
        assert recording_commands.export(tmp_path / "made.rrd", out=out, goal=goal, switches=True) == 0
        assert [(row["goal"], row["cycle"]) for row in read_table(out).to_pylist()] == [
            (goal, cycle) for cycle in cycles
        ]


@pytest.mark.parametrize("suffix", export.FORMATS)
def test_every_number_comes_back(suffix: str, recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / f"table{suffix}"
    assert export.write(recording, path) == len(recording.records)
    rows = read_table(path)
    np.testing.assert_array_equal(rows["wall"].to_numpy().astype("datetime64[ns]"), recording.wall)
    found = rows.drop_columns(["wall"]).to_pydict()
    assert found["t"] == recording.t.tolist()
    assert found["mode"] == [MODES[number] for number in recording.records["mode"]]
    for name in ("cycle", "overruns", "progress", "remaining"):
        assert found[name] == recording.records[name].tolist()
    for name in ("pose", "commanded_pose_velocity"):
        columns = [found[f"{name}_{end}"] for end in ("x", "y", "phi")]
        np.testing.assert_array_equal(np.array(columns).T, recording.records[name])
    for name in ("position", "following_error", "drive_state"):
        columns = [found[f"{name}_{end}"] for end in "abc"]
        np.testing.assert_array_equal(np.array(columns).T, recording.records[name])
    wide = sum(DTYPE[name].shape[0] if DTYPE[name].shape else 1 for name in DTYPE.names or ())
    assert len(found) == wide + 1  # and t


def test_a_file_is_never_written_over_and_its_name_says_its_format(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("mine")
    with pytest.raises(ServiceError, match="already exists: choose another file"):
        export.write(recording, path)
    assert path.read_text() == "mine"
    with pytest.raises(ServiceError, match=r"must end in .csv, .parquet or .npy"):
        export.write(recording, tmp_path / "table.xls")


@pytest.mark.parametrize("suffix", [*export.FORMATS, ".mcap"])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_what_cannot_be_written_to_the_end_leaves_no_file(
    suffix: str, error: BaseException, recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    path, write = tmp_path / f"table{suffix}", mcap.write if suffix == ".mcap" else export.write
    with monkeypatch.context() as failing:
        failing.setitem(export._WRITERS, suffix, fail)
        failing.setattr(mcap, "_write_bag", fail)
        with pytest.raises((ServiceError, KeyboardInterrupt)):
            write(recording, path)
    assert [*tmp_path.iterdir()] == []
    assert write(recording, path) > 0


def test_what_a_full_disk_refuses_at_the_very_end_leaves_no_file(tmp_path: Path) -> None:
    """The last bytes are written when the file is closed; numpy writes to a descriptor itself, and hides errors."""
    limit = (
        "import contextlib, resource, signal; from pathlib import Path\n"
        "from trirail.errors import ServiceError\n"
        "from trirail.analysis.new_file import new_file\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
        f"path = Path({str(tmp_path)!r})\n"
        "with contextlib.suppress(ServiceError), new_file(path / 'table.csv') as file: file.write(bytes(200))\n"
        "from trirail.analysis import export; import pyarrow as pa\n"
        "export._write(path / 'table.npy', lambda: pa.table({'a': list(range(20))}))\n"
    )
    ended = subprocess.run([sys.executable, "-c", limit], capture_output=True, text=True, check=False)
    assert "ServiceError: cannot write" in ended.stderr
    assert [*tmp_path.iterdir()] == []


@given(
    begin=st.none() | st.floats(0.0, 1.2),
    end=st.none() | st.floats(0.0, 1.2),
    every=st.none() | st.sampled_from([1e-3, 2e-3, 0.01, 0.0375, 0.3, 5.0]),
)
def test_a_part_has_the_cycles_between_and_the_first_of_every_so_long(
    begin: float | None, end: float | None, every: float | None, recording: Recording
) -> None:
    first, last = begin if begin is not None else -1.0, end if end is not None else 2.0
    wanted = [t for t in recording.t.tolist() if first <= t <= last]
    said = [-0.5, *recording.t[::50].tolist(), 1.5]  # also before the first record, and after the last one
    before, after = wanted[:1] == [recording.t[0]], wanted[-1:] == [recording.t[-1]]
    kept = [t for t in said if t in wanted or (before and t < 0.0) or (after and t > 1.0)]
    if every is not None and wanted:
        starts = [int((t - wanted[0]) / every + 1e-6) for t in wanted]
        wanted = [t for number, t in enumerate(wanted) if not number or starts[number] > starts[number - 1]]
    if not wanted:
        with pytest.raises(ServiceError):
            recording.part(begin, end, every=every)
        return
    events = [Line(t, recording.wall[0], "INFO", "") for t in said]
    part = recording._replace(events=events).part(begin, end, every=every)
    assert part.t.tolist() == wanted
    np.testing.assert_array_equal(part.records, recording.records[np.isin(recording.t, wanted)])
    assert [line.t for line in part.events] == kept


def test_columns_are_names_of_fields_or_words_of_these(recording: Recording) -> None:
    every = set(recordings.table(recording).column_names)
    for name in DTYPE.names or ():
        found = set(recordings.table(recording, [name]).column_names)
        assert found - {"t"} == {column for column in every if column.removeprefix(name) in ENDINGS}
    for word in {word for name in DTYPE.names or () for word in name.split("_")} - set(DTYPE.names or ()):
        found = set(recordings.table(recording, [word]).column_names) - {"t"}
        assert found == {column for column in every if word in column.split("_")}
    assert recordings.table(recording, ["error", "following_error"]).num_columns == 4
    with pytest.raises(ServiceError, match=r"no column poze: did you mean pose\?"):
        recordings.table(recording, ["poze"])
    with pytest.raises(
        ServiceError, match="no column torque: use one of these names, or a word of one: wall, mode, cycle"
    ):
        recordings.table(recording, ["torque"])


def test_a_dataframe_is_the_table_by_time(recording: Recording) -> None:
    frame = recording.table("10ms", columns=["pose", "mode"])
    assert list(frame.columns) == ["pose_x", "pose_y", "pose_phi", "mode"]
    np.testing.assert_array_equal(frame["pose_x"], recording.records["pose"][::10, 0])
    assert frame.index.tolist() == recording.t[::10].tolist()
    assert len(recording.table(0.01)) == len(recording.table("0.01")) == len(frame)
    for nonsense in ("10 parsec", "", "-5ms", "0s"):
        with pytest.raises(ServiceError):
            recording.table(nonsense)


def test_a_goal_lasts_from_where_it_was_given_until_it_ended(recording: Recording) -> None:
    goal = GoalRequest(1, "ann", "g-17", MoveGoal(0.0, 0.0, 0.1), 0)
    ended = Event("goal", "info", "goal g-17 done", id="g-17", outcome="done", seq=1, t=0.5, cycle=500, time=0.0)
    line = Line(0.5, recording.wall[0], "INFO", "", ended)
    told = recording._replace(requests=(ControlInput(1, 200, 0, goal),), events=[line])
    part = told.part(goal="g-17")
    assert (part.records["cycle"][0], part.records["cycle"][-1], part.t[-1]) == (200, 500, 0.5)
    assert told._replace(events=[]).part(goal="g-17").t[-1] == recording.t[-1]
    with pytest.raises(ServiceError, match="the recording has no goal g-18; its newest goals: g-17"):
        told.part(goal="g-18")
