"""`trirail demo align`: every part lies right, and pictures, marks and residuals are in the recording."""

import re
from pathlib import Path

import patient
import pytest
from rerun.chunk import RrdReader
from trirail.cli import demo_align
from trirail.cli.config_commands import shipped_file
from trirail.errors import ServiceError

pytestmark = pytest.mark.slow


def test_pictures_that_exist_are_kept(tmp_path: Path) -> None:
    pictures = tmp_path / "align-pictures.rrd"
    pictures.write_bytes(b"RRF2")
    with pytest.raises(ServiceError, match=r"align-pictures\.rrd already exists"):
        demo_align.run(shipped_file("uvw"), tmp_path / "align.rrd")
    assert pictures.read_bytes() == b"RRF2"


def test_parts_are_laid_right_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = patient.write(tmp_path, "uvw.toml", f"unixsock-stream/{tmp_path}/zenoh")
    assert demo_align.run(config, tmp_path / "align.rrd", parts=2) == 0
    said = capsys.readouterr().out
    assert len(re.findall("part [12]: .* reached", said)) == 2
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "align-pictures.rrd").stream()}
    for camera in ("left", "right"):
        for part in ("", "/mark", "/target", "/residual"):
            assert f"/cameras/{camera}{part}" in entities
    assert {"/alignments", "/residual/worst_um", "/residual/turn_urad"} <= entities
