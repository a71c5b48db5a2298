"""The examples do what they say: all of them against one service of their own."""

import ast
import csv
import math
import os
import pty
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import nbformat
import pytest
from trirail import Robot
from trirail.client import own_service
from trirail.client.async_client import AsyncRobot
from trirail.panel.server import Panel

EXAMPLES = Path(__file__).parents[2] / "tools/examples"
WITHIN = 300.0
"""A busy machine may take so long for an example [s]."""


class Service(NamedTuple):
    """A service that nobody else can reach."""

    locator: str
    recording: Path


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    folder = tmp_path_factory.mktemp("ex")
    config, locator = own_service.private(folder)
    recording = folder / "examples.rrd"
    with own_service.service(config, recording):
        yield Service(locator, recording)


def run(name: str | Path, *arguments: object) -> list[str]:
    """Run an example to its end; return the lines that it prints."""
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WITHIN, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout.splitlines()


def patient(name: str, folder: Path, before: str, after: str) -> Path:
    """Return an example that a busy machine may keep waiting for longer than it waits itself."""
    text = (EXAMPLES / name).read_text(encoding="utf-8")
    assert before in text
    path = folder / name
    path.write_text(text.replace(before, after), encoding="utf-8")
    return path


def pose(service: Service) -> tuple[float, float, float]:
    with Robot("demo", service.locator) as robot:
        return robot.state().commanded.pose


def test_each_is_short_begins_with_what_it_does_and_is_run_here() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES.glob("*.ipynb"):
        assert f'"{path.name}"' in here, f"{path.name} is not run by any test"
    for path in EXAMPLES.glob("*.js"):
        assert path.read_text(encoding="utf-8").startswith("// "), path.name
        assert f'"{path.name}"' in here, f"{path.name} is not run by any test"
    for path in EXAMPLES.glob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 40, path.name
        assert ast.get_docstring(ast.parse(text)), path.name
        assert f'"{path.name}"' in here, f"{path.name} is not run by any test"


def test_the_kinematics_alone() -> None:
    lines = run("kinematics_alone.py")
    assert float(lines[2].split(":")[1].split()[0]) < 1e-12
    assert float(lines[3].split(":")[1]) < 1e-12
    assert lines[4].startswith("leg A: edge parallel to its rail at phi = 60°")


@pytest.mark.slow
def test_move_and_wait(service: Service) -> None:
    assert "done: arrived, settled after" in run("move_and_wait.py", "demo", service.locator)[-1]
    assert pose(service) == pytest.approx((0.02, -0.01, 0.1), abs=1e-9)


@pytest.mark.slow
def test_move_and_wait_with_asyncio(service: Service) -> None:
    *watched, last = run("move_and_wait_async.py", "demo", service.locator)
    assert last.startswith("done goal")
    assert all(line.startswith("x ") for line in watched)
    assert len(watched) >= 2
    assert pose(service) == pytest.approx((-0.02, 0.01, -0.1), abs=1e-9)


@pytest.mark.slow
def test_a_goal_that_is_refused_is_said_and_the_exit_code_tells(service: Service, tmp_path: Path) -> None:
    script = tmp_path / "far.py"
    script.write_text((EXAMPLES / "move_and_wait.py").read_text(encoding="utf-8").replace("x=0.02", "x=2.0"))
    command = [sys.executable, str(script), "demo", service.locator]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WITHIN, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("refused (")


@pytest.mark.slow
def test_a_stream_of_goals_blends(service: Service) -> None:
    with Robot("demo", service.locator) as robot:
        robot.override(10.0)  # all of them are sent before the first is reached
        lines = run("stream_of_goals.py", "demo", service.locator)
        robot.override(100.0)
    assert ["passed on the way" in line for line in lines] == [True, True, True, False]
    assert pose(service) == pytest.approx((0.03, 0.03, 0.0), abs=1e-9)


@pytest.mark.slow
def test_a_jog_lasts_while_the_key_is_held(service: Service, tmp_path: Path) -> None:
    with Robot("demo", service.locator) as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN)
    ours, theirs = pty.openpty()
    jog = patient("jog_with_a_key.py", tmp_path, "phi=phi)", "phi=phi, timeout=2.0)")
    command = [sys.executable, str(jog), "demo", service.locator]
    with subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, text=True) as jogging:
        assert jogging.stdout is not None
        assert jogging.stdout.readline() == "hold a key\n"
        os.write(ours, b"d")  # and then no more: the key has been let go
        words, x, y, phi = jogging.stdout.readline().rsplit(maxsplit=3)
        os.write(ours, b"x")
        assert jogging.wait(WITHIN) == 0
    os.close(ours)
    os.close(theirs)
    assert words == "stands at"
    assert 0.005 < float(x) < 0.1
    assert abs(float(y)) < 1e-4
    assert abs(float(phi)) < 1e-3


@pytest.mark.slow
@pytest.mark.alone
def test_a_camera_is_followed(service: Service, tmp_path: Path) -> None:
    with Robot("demo", service.locator) as robot:
        robot.enable()
        robot.move_to(x=0.02, y=0.0, phi=0.0).wait(WITHIN)
    follow = patient("follow_a_camera.py", tmp_path, "robot.track()", "robot.track(timeout=1.0)")
    followed, stands = run(follow, "demo", service.locator)
    assert followed.startswith("400 updates, at most ")
    assert float(followed.split()[4]) < 20.0  # it has followed; how closely, simulated time tells
    words, x, y, phi = stands.rsplit(maxsplit=3)
    assert words == "stands at"
    assert math.hypot(float(x), float(y)) == pytest.approx(0.02, abs=5e-3)
    assert abs(float(phi)) < 1e-3


@pytest.mark.slow
def test_a_file_is_followed(service: Service) -> None:
    lines = run("follow_a_file.py", EXAMPLES / "circle.csv", "demo", service.locator)
    assert lines[0] == "41 points in 4.0 s"
    assert "done: arrived, settled after" in lines[1]


@pytest.mark.slow
def test_what_is_watched_is_logged(service: Service, tmp_path: Path) -> None:
    run("watch_and_log.py", tmp_path / "log.csv", 2.0, "demo", service.locator)
    with (tmp_path / "log.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["t"]) - float(rows[0]["t"]) >= 0.4
    assert {row["mode"] for row in rows} <= {"holding", "disabled"}


@pytest.mark.slow
def test_a_recording_is_read_while_it_is_written(service: Service) -> None:
    lines = run("recording_to_numpy.py", service.recording)
    assert "cycles" in lines[0]
    assert lines[1].count("µm") == 3


def cells(name: str) -> list[str]:
    """Return what the cells of a notebook run, one after the other, as Jupyter runs them."""
    notebook = nbformat.read(EXAMPLES / name, as_version=4)  # type: ignore[no-untyped-call]
    nbformat.validate(notebook)
    runs = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in runs), "clear its outputs"
    return [cell.source for cell in runs]


@pytest.mark.slow
def test_a_scan_in_a_notebook(service: Service) -> None:
    """Every reading is drawn, every goal reached, and the recording shows the poses that were sent."""
    jupyter = """
class Shown:
    updates = 0
    def update(self, figure):
        figure.canvas.draw()
        Shown.updates += 1
def display(figure, display_id):
    return Shown()
"""
    checks = """
print(len(goals), Shown.updates, np.isfinite(found).all(), (found < 100.0).all())
at = scan.records["pose"][:, :2]
print(all(np.min(np.hypot(*(at - pose).T)) < 1e-4 for pose in poses))
print([len(line.get_ydata()) > 10 for line in axes.lines], "disabled" in str(Robot()))
"""
    recording = str(service.recording)
    environment = {"MPLBACKEND": "Agg", "TRIRAIL_CONNECT": service.locator, "RECORDINGS": f"{recording}:{recording}"}
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([jupyter, *cells("scan.ipynb"), checks])],
        env=os.environ | environment,
        capture_output=True, text=True, timeout=WITHIN, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["15 15 True True", "True", "[True, True] True"]


@pytest.mark.slow
def test_the_notebook_plots_a_recording(service: Service) -> None:
    """Every axis has something finite drawn in it."""
    drawn = """
for axes in (axes for number in plt.get_fignums() for axes in plt.figure(number).axes):
    curves = [line.get_ydata() for line in axes.lines] or [[patch.get_height() for patch in axes.patches]]
    print("drawn", axes.get_ylabel(), all(np.all(np.isfinite(curve)) and len(curve) > 10 for curve in curves))
"""
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([*cells("plot_recording.ipynb"), drawn])],
        env=os.environ | {"MPLBACKEND": "Agg", "RECORDING": str(service.recording)},
        capture_output=True, text=True, timeout=WITHIN, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said = [line for line in done.stdout.splitlines() if line.startswith("drawn")]
    names = ("x [mm]", "y [mm]", "φ [°]", "y [mm]", "following error [µm]", "cycles")
    assert said == [f"drawn {name} True" for name in names]


@pytest.mark.slow
def test_a_scan_with_bluesky(service: Service) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(cells("bluesky.ipynb"))],
        env=os.environ | {"ROBOT": "demo", "LOCATOR": service.locator},
        capture_output=True, text=True, timeout=WITHIN, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("refused: ") and "150 mm" in line]
    assert lines[-1].endswith("readings, x from 0.10 to 0.00 m") or lines[-1].endswith("to -0.00 m")
    assert sum(line.startswith("|") and ":" in line for line in lines) == 9
    assert pose(service) == pytest.approx((0.0, 0.0, 0.1), abs=1e-9)


@pytest.mark.slow
def test_zenoh_and_json_alone_are_enough(service: Service) -> None:
    lines = run("plain_zenoh.py", "demo", service.locator)
    assert lines[-1].startswith("done goal")
    assert pose(service) == pytest.approx((0.0, 0.02, -0.1), abs=1e-9)


NODE = os.environ | {"NODE_PATH": "/usr/share/nodejs"}
"""Where Debian has Node's packages."""


def _has_node() -> bool:
    if shutil.which("node") is None:
        return False
    program = "globalThis.WebSocket ?? require('ws')"
    return subprocess.run(["node", "-e", program], env=NODE, capture_output=True, check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not _has_node(), reason="no Node.js with ws: make ci-packages installs them on Debian")
@pytest.mark.parametrize(("pose_there", "said", "code"), [(None, "done goal", 0), ("[0.5, 0, 0]", "refused: ", 1)])
def test_javascript_and_json_alone_are_enough(
    service: Service, tmp_path: Path, pose_there: str | None, said: str, code: int
) -> None:
    program = tmp_path / "move_and_wait.js"
    text = (EXAMPLES / "move_and_wait.js").read_text(encoding="utf-8")
    program.write_text(text if pose_there is None else text.replace("[0.01, 0.02, 0.1]", pose_there))
    with Panel(AsyncRobot("demo", service.locator), 0) as panel:
        command = ["node", str(program), panel.url]
        done = subprocess.run(command, env=NODE, capture_output=True, text=True, timeout=WITHIN, check=False)
    assert done.stdout.startswith(said), done.stdout + done.stderr
    assert done.returncode == code
    if code == 0:
        assert pose(service) == pytest.approx((0.01, 0.02, 0.1), abs=1e-9)


@pytest.mark.slow
@pytest.mark.skipif(not _has_node(), reason="no Node.js with ws: make ci-packages installs them on Debian")
def test_javascript_says_that_nobody_is_there() -> None:
    command = ["node", str(EXAMPLES / "move_and_wait.js"), "http://127.0.0.1:1/token/"]
    done = subprocess.run(command, env=NODE, capture_output=True, text=True, timeout=WITHIN, check=False)
    assert done.returncode == 1
    assert done.stdout.startswith("no panel at http://127.0.0.1:1/token/")


ALIGN = ["align_with_two_cameras.py", "align_with_one_camera.py", "align_with_a_moved_camera.py"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ALIGN)
def test_parts_are_laid_right_wherever_the_robot_is(name: str, service: Service) -> None:
    with Robot("demo", service.locator) as robot:
        robot.enable()
        robot.move_to(x=0.01, y=-0.02, phi=0.1).wait(WITHIN)
    *_, last = run(name, "demo", service.locator)
    assert float(last.split(" µm")[0].split()[-1]) < 20.0
    assert max(map(abs, pose(service))) > 1e-4
