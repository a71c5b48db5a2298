"""`trirail demo align`: every part lies right, and pictures, marks and residuals are in the recording."""

import re
from pathlib import Path

import pytest
from rerun.chunk import RrdReader
from trirail.cli import demo_align
from trirail.client import own_service
from trirail.config import SIM

pytestmark = pytest.mark.slow


def test_parts_are_laid_right_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = SIM.with_name("uvw.toml").read_text(encoding="utf-8")
    changes = {"listen": f'["unixsock-stream/{tmp_path}/zenoh"]'} | own_service.PATIENT
    for key, value in changes.items():
        text = re.sub(rf"^{key} = [^#\n]*", f"{key} = {value} ", text, flags=re.MULTILINE)
    config = tmp_path / "uvw.toml"
    config.write_text(text.replace("[telemetry]", "[telemetry]\nlive_port = 0"), encoding="utf-8")
    assert demo_align.run(config, tmp_path / "align.rrd", parts=2) == 0
    said = capsys.readouterr().out
    assert len(re.findall("part [12]: .* reached", said)) == 2
    entities = {chunk.entity_path for chunk in RrdReader(tmp_path / "align-pictures.rrd").stream()}
    for camera in ("left", "right"):
        for part in ("", "/mark", "/target", "/residual"):
            assert f"/cameras/{camera}{part}" in entities
    assert {"/alignments", "/residual/worst_um", "/residual/turn_urad"} <= entities
