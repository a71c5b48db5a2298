"""What is shipped: the wheel, built from the sdist, moves the robot beside a `service` and `drivers` of the user's."""

import json
import os
import re
import signal
import subprocess
import sys
import tarfile
import venv
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest
import trirail

ROOT = Path(__file__).parents[1]

MOVE = """
from pathlib import Path
from trirail import Robot, inverse, Geometry, read
from trirail.client import own_service

config, locator = own_service.private(Path.cwd())
recording = Path("moved.rrd")
with own_service.service(config, recording), Robot("demo", locator) as robot:
    robot.enable()
    print(robot.move_to(x=0.01, y=0.0, phi=0.05).wait(20).outcome)
way = read(recording).records["commanded_position"]
print(abs(way - inverse(Geometry.symmetric(0.3), (0.01, 0.0, 0.05)).position).max(axis=1).min() < 1e-9)
"""


def run(arguments: Sequence[object], folder: Path) -> str:
    """Run a program in a folder, as a user who has not heard of the checkout; return what it prints."""
    environment = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "VIRTUAL_ENV"}}
    words, pipe = list(map(str, arguments)), subprocess.PIPE
    with subprocess.Popen(words, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            printed, errors = process.communicate()
        except BaseException:  # a time limit: the program ends its service; if it were killed, the service would go on
            process.send_signal(signal.SIGINT)
            raise
    assert process.returncode == 0, errors + printed
    return printed


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sdist, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT], folder)
    return folder


@pytest.mark.slow
def test_the_wheel_holds_the_packages_the_configurations_and_nothing_of_the_workshop(dist: Path) -> None:
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (archive.read(name).decode() for name in names if name.endswith(".dist-info/METADATA"))
    tops = {name.split("/")[0] for name in names}
    assert tops == {"trirail", "trirail_drivers", f"trirail-{trirail.__version__}.dist-info"}
    configs = ROOT / "configs"
    shipped = {f"trirail/configs/{path.relative_to(configs)}" for path in configs.rglob("*") if path.is_file()}
    typed = {"trirail/py.typed", "trirail_drivers/py.typed"}
    data = {f"trirail_drivers/{path.relative_to(ROOT / 'drivers/trirail_drivers')}" for path in ROOT.rglob("*.eds")}
    package = ROOT / "service"
    page = {str(path.relative_to(package)) for path in (package / "trirail/panel/page").iterdir()}
    assert len(page) > 3
    assert shipped | typed | data | page <= names
    links = re.findall(r"\]\(([^)]*)\)", metadata)
    assert any(link.endswith("/service/README.md") for link in links)
    assert all(link.startswith("https://") for link in links), "an index has no files beside the page"


@pytest.mark.slow
def test_the_sdist_holds_what_a_checkout_does(dist: Path) -> None:
    (sdist,) = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"README.md", "CHANGELOG.md", "LICENSE", "configs/sim.toml", "tests/conftest.py", "Makefile"} <= names


@pytest.mark.slow
def test_installed(dist: Path, tmp_path: Path) -> None:
    """In an environment of its own; only the dependencies are those that are here."""
    (wheel,) = dist.glob("*.whl")
    venv.create(tmp_path / "env", symlinks=True)
    python = tmp_path / "env/bin/python"
    (site,) = (tmp_path / "env").glob("lib/python*/site-packages")
    run([sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", wheel], tmp_path)
    # After the installation: pip must not take the checkout's for one to be replaced.
    (site / "dependencies.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))

    user = tmp_path / "user"
    for own in ("service", "drivers"):
        (user / own).mkdir(parents=True)
        (user / own / "__init__.py").write_text(f"raise ImportError('this is the {own} of somebody else')")
    (user / "move.py").write_text(MOVE)
    command = python.with_name("trirail")

    where = "import trirail, trirail_drivers as d; print(trirail.__file__, d.__file__)"
    assert all(file.startswith(str(site)) for file in run([python, "-c", where], user).split())
    assert json.loads(run([command, "config", "--json"], user))["folder"] == str(site / "trirail/configs")
    run([command, "config", "copy", "socketcan", "robot.toml"], user)
    shown = json.loads(run([command, "config", "show", "robot.toml", "--json"], user))
    assert shown["differences"]["can.interface"] == {"value": "socketcan", "sim.toml": "simulated"}
    assert run([python, "move.py"], user).split() == ["done", "True"]
