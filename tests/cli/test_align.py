"""`trirail align`: marks from a program and from pictures, with a whole service; what a person gets wrong is named."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from trirail.alignment.images import CameraView
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera
from trirail.cli import mark_source
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.errors import TrirailError

WITHIN = 60.0
MARKS = """
import json, sys
from pathlib import Path
import numpy as np
from trirail import Robot
from trirail.alignment.calibration import placed
from trirail.alignment.images import CameraView, pixels
with Robot("demo", sys.argv[1]) as robot:
    for _ in sys.stdin:
        pose, seen = robot.state().pose, {}
        for name, place in json.loads(Path(sys.argv[2]).read_text()).items():
            if name == "left":
                view = CameraView((-0.06, 0.01), (900.0, 700.0), ((2.5e5, 1e4), (1e4, -2.5e5)))
            else:
                view = CameraView((0.06, 0.01), (900.0, 700.0), ((-2.5e5, 1e4), (1e4, 2.5e5)))
            seen[name] = pixels(view, placed(place, pose)[None])[0].tolist()
        print(json.dumps(seen), flush=True)
"""


@pytest.fixture(scope="module")
def locator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("al")
    config, locator = own_service.private(folder)
    with own_service.service(config, folder / "align.rrd"):
        yield locator


def trirail(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "trirail", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WITHIN, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.mark.slow
def test_calibrate_check_run(locator: str, tmp_path: Path) -> None:
    script, part, kept = tmp_path / "marks.py", tmp_path / "part.json", tmp_path / "camera.json"
    script.write_text(MARKS, encoding="utf-8")
    part.write_text(json.dumps({"left": [-0.06, 0.01], "right": [0.06, 0.01]}), encoding="utf-8")
    with Robot("demo", locator) as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN)
    marks = ("--program", f"{sys.executable} {script} {locator} {part}", "--connect", locator)
    told = trirail("align", "calibrate", kept, *marks).stdout
    assert "look 7 of 7" in told
    assert "3.9" in told  # µm a pixel
    part.write_text(json.dumps({"left": [-0.0597, 0.0103], "right": [0.0603, 0.0106]}), encoding="utf-8")
    checked = json.loads(trirail("align", "check", kept, *marks, "--json").stdout)
    assert checked["turn"] == pytest.approx(-0.0025, rel=0.05)
    loose = ("--tolerance", "20um", "--angle", "1mrad")
    found = json.loads(trirail("align", "run", kept, *marks, *loose, "--json").stdout)
    assert found["reached"]
    assert len(found["corrections"]) == 1
    assert json.loads(kept.read_text(encoding="utf-8"))["calibration"]["confirmed"]
    assert "the part lies right" in trirail("align", "run", kept, *marks, *loose).stdout
    part.write_text(json.dumps({"left": [-0.06, 0.01], "right": [0.061, 0.01]}), encoding="utf-8")
    refused = trirail("align", "run", kept, *marks, *loose, code=1).stderr
    assert "ppm from their distance" in " ".join(refused.split())


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("echo nonsense", "wanted is"),
        ("true", "has ended with exit code 0"),
        ("/no/such/program", "cannot run"),
        ("""echo '{"left": [1, "a"]}'""", "wanted is"),
    ],
)
def test_a_program_that_tells_no_marks_is_named_with_what_is_wanted(program: str, words: str) -> None:
    def look() -> None:
        with mark_source.program(program) as ask:
            ask()

    with pytest.raises(TrirailError, match=words):
        look()


def test_marks_of_pictures_are_found_and_older_pictures_are_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(mark_source, "NEWER_WITHIN", 0.1)
    view = CameraView((0.0, 0.0), (160.0, 120.0), ((2.5e5, 0.0), (0.0, -2.5e5)))
    camera = SimulatedCamera(view, {"m": DrawnMark(MarkShape("cross", 200e-6), (1e-4, 0.0))}, 320, 240, noise=1.0)
    picture = camera.picture(lambda _: (0.0, 0.0, 0.0), 0.0, np.random.default_rng(0))
    cv2.imwrite(str(tmp_path / "left.png"), picture)
    with mark_source.folder(tmp_path, MarkShape("cross", 50.0), 0.0) as look:
        assert look() == {"left": pytest.approx((185.0, 120.0), abs=0.05)}
        with pytest.raises(TrirailError, match="no newer pictures"):
            look()
        cv2.imwrite(str(tmp_path / "left.png"), np.full_like(picture, 90))
        assert look() == {}


def test_marks_of_what_opencv_opens_are_found_in_pictures_that_are_newer_than_the_look(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    view = CameraView((0.0, 0.0), (160.0, 120.0), ((2.5e5, 0.0), (0.0, -2.5e5)))
    camera = SimulatedCamera(view, {"m": DrawnMark(MarkShape("disc", 200e-6), (0.0, 0.0))}, 320, 240)
    for n in range(4):  # OpenCV takes numbered pictures for a film
        x = 1e-4 * n
        picture = camera.picture(lambda _: (x, 0.0, 0.0), 0.0, np.random.default_rng(0))  # noqa: B023
        cv2.imwrite(str(tmp_path / f"film_{n:02d}.png"), picture)
    with mark_source.cameras({"m": str(tmp_path / "film_%02d.png")}, MarkShape("disc", 50.0), 0.0) as look:
        assert look() == {"m": pytest.approx((185.0, 120.0), abs=0.05)}
        assert look() == {"m": pytest.approx((235.0, 120.0), abs=0.05)}
        with pytest.raises(TrirailError, match="gives no picture any more"):
            look()


def test_a_camera_that_is_not_there_is_named() -> None:
    pytest.importorskip("cv2")
    with pytest.raises(TrirailError, match="cannot open camera /no/such of left"):
        mark_source.cameras({"left": "/no/such"}, MarkShape("disc", 50.0), 0.0).__enter__()


@pytest.mark.parametrize("given", [(), ("--program", "true", "--pictures", "x")], ids=["no source", "two of them"])
def test_one_source_of_marks_is_wanted(given: tuple[str, ...], tmp_path: Path) -> None:
    done = trirail("align", "calibrate", tmp_path / "camera.json", *given, code=1)
    assert "give one of them" in done.stderr
