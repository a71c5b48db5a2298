"""A recording as a table: every number of every cycle comes back from the file, bit for bit."""

from __future__ import annotations

from pathlib import Path

import made
import numpy as np
import pytest
from pyarrow import csv, parquet
from trirail.analysis import export
from trirail.config import SIM, load
from trirail.errors import ServiceError
from trirail.telemetry.reading import Recording, read
from trirail.telemetry.recorder import Recorder
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import MODES


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("export") / "made.rrd"
    recorder = Recorder(load(SIM), path.parent, path=path, live=False)
    recorder.records(made.records(1.0).tobytes())
    recorder.close()
    return read(path)


@pytest.mark.parametrize("suffix", export.FORMATS)
def test_every_number_comes_back(suffix: str, recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / f"table{suffix}"
    assert export.write(recording, path) == len(recording.records)
    rows = csv.read_csv(path) if suffix == ".csv" else parquet.read_table(path)
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
    with pytest.raises(ServiceError, match="File exists"):
        export.write(recording, path)
    assert path.read_text() == "mine"
    with pytest.raises(ServiceError, match=r"must end in \.csv or \.parquet"):
        export.write(recording, tmp_path / "table.xls")
