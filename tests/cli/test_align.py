"""`trirail align`: marks from a program and from pictures, with a whole service; what a person gets wrong is named."""

from __future__ import annotations

import json
import math
import os
import queue
import subprocess
import sys
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warm
from client.test_look_reports import Told
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from trirail.alignment.calibration_procedure import calibrate_by_moves
from trirail.alignment.camera_calibration import CameraCalibration
from trirail.alignment.images import CameraView, Pair
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera
from trirail.cli import align_command, mark_source
from trirail.cli.alignment_targets import observe_targets
from trirail.cli.app import app
from trirail.cli.mark_source import MarkSource
from trirail.client import calibration_file
from trirail.client.client import Robot
from trirail.config import SIM
from trirail.errors import TrirailError
from trirail_drivers.interface import Triple
from waiting import wait_until

WITHIN = 60.0
MARKS = """
import json, sys
from pathlib import Path
import numpy as np
from trirail import Robot
from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.images import CameraView, project_points
with Robot("demo", sys.argv[1]) as robot:
    for _ in sys.stdin:
        pose, seen = robot.state().pose, {}
        for name, place in json.loads(Path(sys.argv[2]).read_text()).items():
            if name == "left":
                view = CameraView((-0.06, 0.01), (900.0, 700.0), ((2.5e5, 1e4), (1e4, -2.5e5)))
            else:
                view = CameraView((0.06, 0.01), (900.0, 700.0), ((-2.5e5, 1e4), (1e4, 2.5e5)))
            seen[name] = project_points(view, to_base_frame(place, pose)[None])[0].tolist()
        print(json.dumps(seen), flush=True)
"""


def trirail(*arguments: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = warm.trirail(*arguments)
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
    kept.write_text(taught := '{"calibration": "taught"}', encoding="utf-8")
    told = trirail("align", "calibrate", kept, *marks).stdout
    assert kept.with_name("camera.json.old").read_text(encoding="utf-8") == taught
    assert "camera.json.old" in told
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
    told = json.loads(trirail("align", "check", kept, *marks, "--moves", "--json").stdout)
    assert [(view["view"], view["changed"]) for view in told["views"]] == [("left", False), ("right", False)]
    assert told["missing"] == []
    whole = part.read_text(encoding="utf-8")
    part.write_text(json.dumps({"left": [-0.0597, 0.0103]}), encoding="utf-8")
    told = json.loads(trirail("align", "check", kept, *marks, "--moves", "--json", code=1).stdout)
    assert ([view["view"] for view in told["views"]], told["missing"]) == (["left"], ["right"])
    told = trirail("align", "check", kept, *marks, "--moves", code=1).stdout
    assert "view right: none of its marks was found" in told
    part.write_text(whole, encoding="utf-8")
    assert "the part lies right" in trirail("align", "run", kept, *marks, *loose).stdout
    # As if it had been made with another geometry: said, and unconfirmed until a correction confirms it.
    made = json.loads(kept.read_text(encoding="utf-8"))
    kept.write_text(json.dumps(made | {"geometry": "01234567"}), encoding="utf-8")
    part.write_text(json.dumps({"left": [-0.0598, 0.0104], "right": [0.0602, 0.0107]}), encoding="utf-8")
    assert "another geometry" in " ".join(trirail("align", "run", kept, *marks, *loose).stderr.split())
    again = json.loads(kept.read_text(encoding="utf-8"))
    assert (again["geometry"], again["calibration"]["confirmed"]) == (made["geometry"], True)
    part.write_text(json.dumps({"left": [-0.06, 0.01], "right": [0.061, 0.01]}), encoding="utf-8")
    refused = trirail("align", "run", kept, *marks, *loose, code=1).stderr
    assert "distance between marks" in " ".join(refused.split())


@pytest.mark.slow
def test_a_calibration_is_kept_if_the_look_after_it_fails_or_its_file_cannot_be_written(
    locator: str, tmp_path: Path
) -> None:
    script, part, kept = tmp_path / "marks.py", tmp_path / "part.json", tmp_path / "camera.json"
    ends = MARKS.replace("    for _ in", "    for number, _ in").replace("sys.stdin:", "enumerate(sys.stdin):")
    ends = ends.replace("        pose, seen", "        if number == 7: sys.exit(7)\n        pose, seen")
    script.write_text(ends, encoding="utf-8")
    part.write_text(json.dumps({"left": [-0.06, 0.01], "right": [0.06, 0.01]}), encoding="utf-8")
    with Robot("demo", locator) as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN)
    marks = ("--program", f"{sys.executable} {script} {locator} {part}", "--connect", locator)
    done = trirail("align", "calibrate", kept, *marks, code=1)
    said = " ".join(done.stderr.split())
    assert "the look after the last move has failed: " in said
    assert "has ended with exit code 7" in said
    assert "the targets are the computed positions of the marks" in said
    assert f"kept in {kept}" in " ".join(done.stdout.split())
    targets = calibration_file.read(kept).targets
    assert targets["left"] == pytest.approx((900.0, 700.0), abs=20.0)
    assert targets["right"] == pytest.approx((900.0, 700.0), abs=20.0)
    kept.with_name("camera.json.old").mkdir()  # the calibration that is replaced cannot be saved
    script.write_text(MARKS, encoding="utf-8")
    before = kept.read_text(encoding="utf-8")
    done = trirail("align", "calibrate", kept, *marks, "--json", code=1)
    found = json.loads(done.stdout)
    assert "camera.json.old" in found["errors"][0]
    assert (found["file"], kept.read_text(encoding="utf-8")) == (None, before)
    assert found["calibration"]["views"].keys() == found["targets"].keys() == {"left", "right"}
    assert "camera.json.old" in done.stderr


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("echo nonsense", "expected"),
        ("true", "has ended with exit code 0"),
        ("sleep 60", "no line in 0.05 s; check that it flushes"),
        ("/no/such/program", "cannot run"),
        ("""echo '{"left": [1, "a"]}'""", "expected"),
        (r"""printf '{"\351": [1, 2]}\n'""", "expected"),  # not in UTF-8
        (r"""printf '{"a": [1, 2]}\n{"a": [3, 4]}\n'""", "expected"),  # the second would be the answer to a later look
        (r"""sh -c 'printf "{}"; sleep 60'""", "no line in 0.05 s"),
    ],
)
def test_a_program_that_tells_no_marks_is_named_with_what_is_wanted(
    program: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "sleep" in program:
        monkeypatch.setattr(mark_source, "PICTURE_TIMEOUT_S", 0.05)

    def look() -> None:
        with mark_source.program(program) as (ask, _):
            ask()

    with pytest.raises(TrirailError, match=words):
        look()


@pytest.mark.parametrize("answers", [0, 1])
def test_a_line_that_no_look_asked_for_is_no_answer_to_a_later_one(answers: int, tmp_path: Path) -> None:
    go, ready, script = tmp_path / "go", tmp_path / "ready", tmp_path / "marks.sh"
    answer = """echo '{"a": [0, 0]}'"""
    until_go = f"until [ -e {go} ]; do sleep 0.01; done"
    script.write_text(f"{f'read look; {answer};' * answers} {until_go}; {answer}; touch {ready}; read look; {answer}")
    with mark_source.program(f"sh {script}") as (look, _):
        for _ in range(answers):
            look()
        go.touch()
        wait_until(ready.exists)
        with pytest.raises(TrirailError, match="without being asked"):
            look()


def test_all_processes_of_a_program_end_with_it(tmp_path: Path) -> None:
    script = tmp_path / "marks.sh"
    script.write_text("sleep 300 & while read look; do echo '{\"a\": [0, '$!']}'; done")
    with mark_source.program(f"sh {script}") as (look, _):
        child = int(look()["a"][1])
        os.kill(child, 0)
    wait_until(lambda: not Path(f"/proc/{child}").exists() or " Z " in Path(f"/proc/{child}/stat").read_text())


def test_marks_of_pictures_are_of_those_that_were_written_since_they_were_asked_for(tmp_path: Path) -> None:
    """What takes the pictures goes on while the robot moves: one of them was there before the look, and is too old."""
    cv2 = pytest.importorskip("cv2")
    moved, ended = threading.Event(), threading.Event()
    taken: queue.SimpleQueue[float] = queue.SimpleQueue()
    standing = threading.Lock()

    def take_pictures() -> None:
        while not ended.is_set():
            with standing:
                x = 1e-4 if moved.is_set() else 0.0
                cv2.imwrite(str(tmp_path / ".left.png"), drawn({"m": (0.0, 0.0)}, (x, 0.0, 0.0)))
                (tmp_path / ".left.png").rename(tmp_path / "left.png")
            taken.put(x)

    camera = threading.Thread(target=take_pictures)
    camera.start()
    try:
        taken.get(timeout=WITHIN)
        with mark_source.folder(tmp_path, MarkShape("disc", 40.0), 0.0) as (look, _):
            assert look() == {"left": pytest.approx((160.0, 120.0), abs=0.05)}
            while not taken.empty():
                taken.get()
            taken.get(timeout=WITHIN)  # newer than that look, and the robot has not moved yet
            with standing:
                moved.set()
            assert look() == {"left": pytest.approx((185.0, 120.0), abs=0.05)}
    finally:
        ended.set()
        camera.join()


def test_codes_of_pictures_are_named_by_their_numbers_and_no_number_may_be_there_twice(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    from trirail.alignment.coded_marks import code_shape

    view = CameraView((0.0, 0.0), (160.0, 120.0), ((2.5e5, 0.0), (0.0, -2.5e5)))

    def write(picture: str, number: int) -> None:
        marks = {"m": DrawnMark(code_shape("4x4_50", number, 300e-6), (4e-5, 0.0))}
        camera = SimulatedCamera(view, marks, 320, 240, 180.0, -120.0)
        drawn = camera.picture(lambda _: (0.0, 0.0, 0.0), 0.0, np.random.default_rng(0))
        cv2.imwrite(str(tmp_path / f"{picture}.png"), drawn)

    write("left", 3)
    write("right", 7)
    with mark_source.folder(tmp_path, MarkShape("code", 100.0), 0.0, family="4x4_50") as (look, views):
        found = look()
    assert found == {"3": pytest.approx((170.0, 120.0), abs=0.02), "7": pytest.approx((170.0, 120.0), abs=0.02)}
    assert views == {"3": "left", "7": "right"}
    write("right", 3)
    with (
        mark_source.folder(tmp_path, MarkShape("code", 100.0), 0.0, family="4x4_50") as (look, _),
        pytest.raises(TrirailError, match="left and right"),
    ):
        look()


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_pictures_of_more_than_eight_bits_keep_them(bits: int, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    view, rng = CameraView((0.0, 0.0), (160.0, 120.0), ((2.5e5, 0.0), (0.0, -2.5e5))), np.random.default_rng(bits)
    errors = []
    for place in rng.uniform(-2e-5, 2e-5, (8, 2)).tolist():
        marks = {"m": DrawnMark(MarkShape("cross", 200e-6), (place[0], place[1]))}
        camera = SimulatedCamera(view, marks, 320, 240, 60.0, 120.0)
        shown = camera.picture(lambda _: (0.0, 0.0, 0.0), 0.0, rng) + rng.normal(0.0, 1.0, (240, 320))
        cv2.imwrite(str(tmp_path / "m.png"), np.rint(shown.clip(0.0) * 2.0 ** (bits - 8)).astype(np.uint16))
        with mark_source.folder(tmp_path, MarkShape("cross", 50.0), 0.0) as (look, _):
            errors.append(np.subtract(look()["m"], camera.pixels_at((0.0, 0.0, 0.0))["m"]))
    assert np.sqrt(np.mean(np.square(errors))) < 0.01


def test_pictures_that_are_not_taken_anew_or_are_none_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(mark_source, "PICTURE_TIMEOUT_S", 0.1)
    monkeypatch.setattr(mark_source, "WRITE_TIMEOUT_S", 0.1)
    cv2.imwrite(str(tmp_path / "left.png"), np.full((240, 320), 90, np.uint8))
    with mark_source.folder(tmp_path, MarkShape("cross", 50.0), 0.0) as (look, _):
        assert look() == {}
        with pytest.raises(TrirailError, match="no newer pictures"):
            look()
        with monkeypatch.context() as waiting:  # it is written anew, after the clock was set back
            waiting.setattr("time.sleep", lambda _: os.utime(tmp_path / "left.png", (1.0, 1.0)))
            assert look() == {}
    (tmp_path / "left.png").write_bytes(b"cut off")
    with (
        mark_source.folder(tmp_path, MarkShape("cross", 50.0), 0.0) as (look, _),
        pytest.raises(TrirailError, match=r"write it as \.left\.png, then rename it"),
    ):
        look()


def drawn(places: dict[str, Pair], pose: Triple = (0.0, 0.0, 0.0)) -> NDArray[np.uint8]:
    """Return a picture of discs on the table, 320 × 240 pixels."""
    view = CameraView((0.0, 0.0), (160.0, 120.0), ((2.5e5, 0.0), (0.0, -2.5e5)))
    marks = {name: DrawnMark(MarkShape("disc", 160e-6), place) for name, place in places.items()}
    return SimulatedCamera(view, marks, 320, 240).picture(lambda _: pose, 0.0, np.random.default_rng(0))


TWO: dict[str, Pair] = {"a": (-3e-4, 0.0), "b": (3e-4, 1e-4)}
WINDOWS = {"a": (0, 0, 160, 240), "b": (160, 0, 160, 240)}


def test_several_marks_of_one_picture_are_each_found_in_its_window(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    cv2.imwrite(str(tmp_path / "top.png"), drawn(TWO))
    options = [f"{name}=top:{','.join(map(str, at))}" for name, at in WINDOWS.items()]
    with MarkSource(pictures=tmp_path, window=tuple(options), shape="disc", size=40.0).open_source() as (look, views):
        assert look() == {"a": pytest.approx((85.0, 120.0), abs=0.05), "b": pytest.approx((235.0, 95.0), abs=0.05)}
        assert views == {"a": "top", "b": "top"}
    with (
        MarkSource(pictures=tmp_path, window=("a=top:200,0,160,240",)).open_source() as (look, _),
        pytest.raises(TrirailError, match="beyond its picture of 320 × 240"),
    ):
        look()
    with (
        MarkSource(pictures=tmp_path, window=("a=side:0,0,1,1",)).open_source() as (look, _),
        pytest.raises(TrirailError, match="no picture side for mark a; there are top"),
    ):
        look()


def film(path: Path, frames: list[NDArray[np.uint8]]) -> str:
    """Write a film without loss; return its path."""
    cv2 = pytest.importorskip("cv2")
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (320, 240), False)
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no films")
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 100)
    for frame in frames:
        writer.write(frame)
    writer.release()
    return str(path)


def test_one_camera_that_shows_several_marks_is_opened_once_and_read_once_a_look(tmp_path: Path) -> None:
    """A film whose part moves: were each mark read by itself, they would be of different pictures."""
    poses = [(1e-5 * n, 0.0, 0.0) for n in range(8)]
    path = film(tmp_path / "film.avi", [drawn(TWO, pose) for pose in poses])
    windows = tuple(f"{name}={','.join(map(str, at))}" for name, at in WINDOWS.items())
    source = MarkSource(camera=(f"a={path}", f"b={path}"), window=windows, shape="disc", size=40.0)
    with source.open_source() as (look, views):
        assert views is not None
        assert len(set(views.values())) == 1
        for n in (1, 3, 5, 7):
            seen = look()
            assert seen["a"] == pytest.approx((85.0 + 2.5 * n, 120.0), abs=0.1)
            assert seen["b"] == pytest.approx((235.0 + 2.5 * n, 95.0), abs=0.1)
        with pytest.raises(TrirailError, match="no longer delivers pictures"):
            look()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"camera": ("a=0", "b=0")}, "give each a --window"),
        ({"camera": ("a=0", "b=0"), "window": ("a=0,0,9,9",)}, "give each a --window"),
        ({"camera": ("a=0",), "window": ("b=0,0,9,9",)}, "no --camera shows that mark"),
        ({"camera": ("a=0",), "window": ("a=0,0,9",)}, "expected MARK=U,V,WIDTH,HEIGHT"),
        ({"camera": ("a=0",), "window": ("a=0,0,-9,9",)}, "expected MARK=U,V,WIDTH,HEIGHT"),
        ({"camera": ("a",)}, "expected MARK=DEVICE"),
        ({"camera": ("a=/no/0", "a=/no/1")}, "--camera: mark a is given twice"),
        ({"camera": ("a=/no/0",), "window": ("a=0,0,9,9", "a=9,0,9,9")}, "--window: mark a is given twice"),
        ({"program": "true", "window": ("a=0,0,9,9",)}, "--window is only for pictures"),
        ({"pictures": SIM.parent, "size": 0.0}, "--size 0: expected a number of pixels above 0"),
        ({"pictures": SIM.parent, "size": -5.0}, "--size -5: expected a number of pixels above 0"),
        ({"pictures": SIM.parent, "size": math.nan}, "--size nan: expected a number of pixels above 0"),
        ({"pictures": SIM.parent, "turn": math.inf}, "--turn inf: expected a finite number of degrees"),
    ],
)
def test_what_cannot_be_meant_of_a_source_is_said(options: dict[str, Any], words: str) -> None:
    pytest.importorskip("cv2")
    with pytest.raises(TrirailError, match=words), MarkSource(**options).open_source():
        pass


class Camera:
    """A camera whose driver keeps pictures that nobody has read: those are handed out at once, a new one when it comes.

    Time passes as it is waited.
    """

    def __init__(self, period: float, kept: int, frames: float = -1.0) -> None:
        self._period, self._frames, self.now = period, frames, 100.0
        self._begun = [self.now - period * (n + 1) for n in range(kept)][::-1]
        self._held = -1.0
        self._phase = self.now + 0.3 * period

    def get(self, _: int) -> float:
        return self._frames

    def grab(self) -> bool:
        if self._begun:
            self._held = self._begun.pop(0)
            self.now += 1e-4
        else:
            self._held, self.now = self._phase - self._period, max(self.now, self._phase)
            self._phase += self._period
        return True

    def read(self) -> tuple[bool, float]:
        return self.grab(), self._held


@given(st.floats(0.008, 0.2), st.integers(0, 8))
def test_a_picture_of_a_camera_was_begun_after_it_was_asked_for(period: float, kept: int) -> None:
    camera = Camera(period, kept)
    begun = mark_source.newest(camera, 7, lambda: camera.now)
    assert begun >= 100.0
    assert camera.now < 100.0 + 3.0 * period


def test_marks_of_what_opencv_opens_are_found_in_pictures_that_are_newer_than_the_look(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    view = CameraView((0.0, 0.0), (160.0, 120.0), ((2.5e5, 0.0), (0.0, -2.5e5)))
    camera = SimulatedCamera(view, {"m": DrawnMark(MarkShape("disc", 200e-6), (0.0, 0.0))}, 320, 240)
    for n in range(4):  # OpenCV takes numbered pictures for a film
        x = 1e-4 * n
        picture = camera.picture(lambda _: (x, 0.0, 0.0), 0.0, np.random.default_rng(0))  # noqa: B023
        cv2.imwrite(str(tmp_path / f"film_{n:02d}.png"), picture)
    with mark_source.cameras({"m": str(tmp_path / "film_%02d.png")}, MarkShape("disc", 50.0), 0.0) as (look, _):
        assert look() == {"m": pytest.approx((185.0, 120.0), abs=0.05)}
        assert look() == {"m": pytest.approx((235.0, 120.0), abs=0.05)}
        with pytest.raises(TrirailError, match="no longer delivers pictures"):
            look()


def test_a_camera_that_is_not_there_is_named() -> None:
    pytest.importorskip("cv2")
    with pytest.raises(TrirailError, match="cannot open camera /no/such of left"):
        mark_source.cameras({"left": "/no/such"}, MarkShape("disc", 50.0), 0.0).__enter__()


@pytest.mark.parametrize("given", [(), ("--program", "true", "--pictures", "x")], ids=["no source", "two of them"])
def test_one_source_of_marks_is_wanted(given: tuple[str, ...], tmp_path: Path) -> None:
    done = trirail("align", "calibrate", tmp_path / "camera.json", *given, code=1)
    assert "give exactly one of" in done.stderr


@pytest.mark.parametrize(
    ("words", "missing"),
    [
        (("calibrate", "absent/camera.json"), r"absent/camera\.json"),
        (("geometry", SIM, "--field", "9", "9", "--calibration", "absent/camera.json"), r"absent/camera\.json"),
        (("geometry", SIM, "--field", "9", "9", "--out", "absent/new.toml"), r"absent/new\.toml"),
    ],
)
def test_a_folder_that_is_not_there_is_known_before_the_stage_moves(words: tuple[object, ...], missing: str) -> None:
    with pytest.raises(TrirailError, match=f"{missing}: there is no folder absent"):
        app(["align", *map(str, words), "--program", "true"])


@pytest.mark.parametrize("words", [("calibrate",), ("geometry", str(SIM), "--field", "9", "9", "--calibration")])
@pytest.mark.parametrize(
    "content", [SIM.read_text(encoding="utf-8"), '{"poses": {"home": [0, 0, 0]}}', "[]", "u,v\n1,2\n", "\udcff\0"]
)
def test_a_file_of_another_kind_is_not_replaced_by_a_calibration(
    words: tuple[str, ...], content: str, tmp_path: Path
) -> None:
    file = tmp_path / "robot.toml"
    file.write_bytes(written := content.encode(errors="surrogateescape"))
    with pytest.raises(TrirailError, match=f"{file} already exists and is not a camera calibration"):
        app(["align", *words, str(file), "--program", "true"])
    assert file.read_bytes() == written
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("content", ["", '{"version": 1, "calibration": {"views"', '{"calibration": 7}'])
def test_a_damaged_calibration_may_be_replaced(content: str, tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    file.write_text(content, encoding="utf-8")
    calibration_file.check_replaceable(file)


@given(st.sets(st.sampled_from(["left", "right"])), st.booleans())
def test_targets_are_those_of_the_calibrated_marks_whatever_the_last_look_shows(seen: set[str], another: bool) -> None:
    """An alignment refuses a target of a mark that is not calibrated, and cannot use a mark without a target."""
    robot = Told(7)
    calibration = robot.drive(calibrate_by_moves())
    computed = robot.stage.look()

    def look() -> dict[str, Pair]:
        marks = {name: pixel for name, pixel in robot.stage.look().items() if name in seen}
        return marks | ({"another": (5.0, 6.0)} if another else {})

    targets, failures = observe_targets(robot, look, MarkSource(), calibration)  # type: ignore[arg-type]
    assert targets.keys() == calibration.marks.keys()
    assert [pixel for name in targets for pixel in targets[name]] == pytest.approx(
        [pixel for name in targets for pixel in computed[name]], abs=1.0
    )
    unseen = [name for name in ("left", "right") if name not in seen]
    assert [str(each) for each in failures] == [
        f"marks not found after the last move: {', '.join(unseen)}; their targets are their computed positions"
    ] * bool(unseen)


def test_the_limit_of_a_correction_with_another_geometry_is_told_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    """A correction is only shortened beyond twice the moves, which for a calibration of the geometry never happens."""
    view = CameraView((0.0, 0.0), (0.0, 0.0), ((1e5, 0.0), (0.0, 1e5)))
    known = CameraCalibration({"m": view}, {}, 0.1, (), (), {}, confirmed=True)
    kept = calibration_file.CalibrationFile(1, "uvw", datetime.now(UTC), known, {}, "01234567")
    assert not align_command._checked_calibration(kept, Path("camera.json"), "89abcdef").confirmed
    said = " ".join(capsys.readouterr().err.split())
    assert "until then, a correction moves no mark farther than twice the moves of the calibration" in said


@pytest.mark.parametrize("out", [False, True])
def test_cameras_of_a_geometry_are_written_beside_its_configuration(
    out: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not to the working directory, where another stage's calibration may lie."""
    config = tmp_path / "stage" / "robot.toml"
    for folder in ("stage", "new"):
        (tmp_path / folder).mkdir()
    config.write_text(SIM.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)

    def refuse(path: Path) -> None:
        raise TrirailError(f"cameras in {path}")

    monkeypatch.setattr(calibration_file, "check_replaceable", refuse)
    words = ["--out", str(tmp_path / "new" / "new.toml")] if out else []
    expected = tmp_path / ("new" if out else "stage") / "camera.json"
    with pytest.raises(TrirailError, match=f"^cameras in {expected}$"):
        app(["align", "geometry", str(config), "--field", "9", "9", "--program", "true", *words])
