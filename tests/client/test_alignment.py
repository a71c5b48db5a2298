"""Align with a whole service: one correction on simulated drives, in a thread and in an event loop; files; Ctrl-C."""

from __future__ import annotations

import asyncio
import math
import signal
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alignment.cameras import FOCUS, part_at
from processes.test_service import told, until
from trirail.alignment.calibration_procedure import DEFAULT_MOVES
from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.images import CameraView, Pair, project_points
from trirail.client import alignment, calibration_file
from trirail.client.async_client import AsyncRobot
from trirail.client.client import Robot
from trirail.errors import AlignmentError, AlignmentFault, RefusedError, TrirailError
from trirail.wire.messages import Event
from trirail.wire.vocabulary import Mode

PART: dict[str, Pair] = {"left": (-0.06, 0.01), "right": (0.06, 0.01)}
VIEWS = {
    "left": CameraView((-0.06, 0.01), (1000.0, 800.0), ((FOCUS, 2e4), (1e4, -FOCUS))),
    "right": CameraView((0.06, 0.01), (1100.0, 700.0), ((-FOCUS, 1e4), (2e4, -FOCUS))),
}
ERROR = (0.0008, -0.0006, math.radians(0.35))


def seen(part: dict[str, Pair], pose: tuple[float, float, float]) -> dict[str, Pair]:
    return {
        name: tuple(project_points(VIEWS[name], to_base_frame(q, pose)[None])[0].tolist()) for name, q in part.items()
    }


def to_go(event: Event) -> dict[str, object]:
    """What a look has left to go, by mark."""
    return {mark.name: mark.to_go for mark in event.alignment.marks} if event.alignment is not None else {}


@pytest.mark.slow
def test_one_correction_with_a_thread(locator: str) -> None:
    with Robot("demo", locator) as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(60.0)
        calibration = robot.calibrate_camera(lambda: seen(PART, robot.state().pose))
        targets = seen(PART, (0.0, 0.0, 0.0))
        lying = part_at(PART, ERROR)
        found = robot.align(lambda: seen(lying, robot.state().pose), targets, calibration, tolerance=2e-5, angle=1e-3)
        assert found.reached
        assert len(found.corrections) == 1
        assert found.confirmed
        left = found.measurements[-1].errors
        heard = told(robot, lambda heard: to_go(heard[-1]) == left)
        newest = [event for event in heard if event.kind == "goal"][-1]
        assert (newest.id or "").startswith("align-")
        before, after = [event.alignment for event in heard if event.alignment is not None][-2:]
        assert (newest.id or "").startswith(after.id)
        assert (before.correction, after.end) == (found.corrections[0].by, "reached")
        assert [{mark.name: mark.to_go for mark in look.marks} for look in (before, after)] == [
            each.errors for each in found.measurements
        ]
        now = seen(lying, robot.state().pose)
        for name in PART:
            assert now[name] == pytest.approx(targets[name], abs=2e-5 * FOCUS)


@pytest.mark.slow
def test_one_correction_in_an_event_loop_with_a_camera_that_is_waited_for(locator: str) -> None:
    async def work() -> None:
        async with AsyncRobot("demo", locator) as robot:
            await robot.enable()
            await (await robot.move_to(x=0.0, y=0.0, phi=0.0)).wait(60.0)
            part = dict(PART)

            async def look() -> dict[str, Pair]:
                return seen(part, (await robot.state()).pose)

            calibration = await robot.calibrate_camera(look, approach=(1e-3, 0.0, 0.0))
            part = part_at(PART, ERROR)
            targets = seen(PART, (0.0, 0.0, 0.0))
            found = await robot.align(look, targets, calibration, tolerance=2e-5, angle=1e-3, approach=(1e-3, 0.0, 0.0))
            assert found.reached
            assert len(found.corrections) == 1

    asyncio.run(work())


@pytest.mark.slow
def test_without_a_calibration_one_is_made_first(locator: str) -> None:
    part = part_at(PART, (0.0004, -0.0003, math.radians(0.2)))
    targets = seen(PART, (0.0, 0.0, 0.0))
    with Robot("demo", locator) as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(60.0)
        found = robot.align(lambda: seen(part, robot.state().pose), targets, tolerance=2e-5, angle=1e-3)
        assert found.reached
        assert len(found.corrections) == 1


@pytest.mark.slow
def test_what_look_raises_ends_it_and_a_correction_out_of_reach_is_refused(locator: str) -> None:
    with Robot("demo", locator) as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(60.0)
        calibration = robot.calibrate_camera(lambda: seen(PART, robot.state().pose))
        targets = seen(PART, (0.0, 0.0, 0.0))
        with pytest.raises(RefusedError, match="centre is None"):
            robot.calibrate_camera(lambda: seen(PART, robot.state().pose), lens="radial")
        with pytest.raises(ZeroDivisionError):
            robot.align(lambda: 1 / 0, targets, calibration)  # type: ignore[arg-type, return-value]
        with pytest.raises(AlignmentError) as refused:
            robot.align(dict, targets, calibration)
        assert refused.value.fault is AlignmentFault.MISSING
        far = calibration_as_confirmed(calibration)
        with pytest.raises(RefusedError):
            robot.align(lambda: seen(part_at(PART, (0.5, 0.0, 0.0)), robot.state().pose), targets, far)
        assert robot.state().pose == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)


def calibration_as_confirmed(calibration: Any) -> Any:
    import msgspec

    return msgspec.structs.replace(calibration, confirmed=True)


@pytest.mark.slow
def test_ctrl_c_in_a_motion_stops_the_robot(locator: str) -> None:
    main = threading.get_ident()

    def interrupt() -> None:
        with Robot("demo", locator) as other:
            for state in other.states(60.0):
                if state.mode == Mode.MOVING and abs(state.pose[0]) > 1e-3:
                    break
        signal.pthread_kill(main, signal.SIGINT)

    with Robot("demo", locator) as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(60.0)
        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            robot.calibrate_camera(
                lambda: seen(PART, robot.state().pose), [(0.05, 0.0, 0.0), *DEFAULT_MOVES], speed=0.02
            )
        thread.join()
        assert until(robot, lambda state: state.mode == Mode.HOLDING).pose[0] < 0.045
        told(robot, lambda heard: ended(heard[-1]) == ("failed", "KeyboardInterrupt"))


@pytest.mark.slow
@pytest.mark.parametrize("how", ["pause", "override"])
def test_a_motion_that_is_paused_for_longer_than_its_time_goes_on(
    how: str, locator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(alignment, "PROGRESS_WITHIN", 0.05)

    def pause() -> None:
        with Robot("demo", locator) as other:
            for state in other.states(60.0):
                if state.mode == Mode.MOVING and abs(state.pose[0]) > 1e-3:
                    break
            other.pause() if how == "pause" else other.override(0.0)
            began = other.state().t
            for state in other.states(60.0):
                if state.t > began + 20.0 * alignment.PROGRESS_WITHIN:
                    break
            other.resume() if how == "pause" else other.override(100.0)

    with Robot("demo", locator) as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(60.0)
        thread = threading.Thread(target=pause)
        thread.start()
        found = robot.calibrate_camera(
            lambda: seen(PART, robot.state().pose), [(0.02, 0.0, 0.0), *DEFAULT_MOVES], speed=0.05
        )
        thread.join()
        assert found.marks.keys() == PART.keys()


def ended(event: Event) -> tuple[str | None, str] | None:
    """How an alignment has ended."""
    return (event.alignment.end, event.alignment.words) if event.alignment is not None else None


def test_a_file_keeps_a_calibration_its_date_and_what_made_it(tmp_path: Path, calibrated: Any) -> None:
    path, made = tmp_path / "camera.json", datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    calibration_file.write(path, "demo", calibrated, {"left": (1.0, 2.0)}, made)
    kept = calibration_file.read(path)
    assert kept.calibration == calibrated
    assert (kept.version, kept.robot, kept.made, kept.targets) == (1, "demo", made, {"left": (1.0, 2.0)})


@pytest.fixture
def calibrated() -> Any:
    from alignment.test_calibration import two_cameras
    from trirail.alignment.procedure import calibrate_by_moves

    return two_cameras(1, noise=0.1).drive(calibrate_by_moves())


BROKEN: dict[str, Callable[[str], str]] = {
    "another version": lambda text: text.replace('"version": 1', '"version": 2'),
    "not JSON": lambda text: text[:-20],
    "an unknown field": lambda text: text.replace('"noise"', '"nose"'),
    "no number": lambda text: text.replace('"noise": 0', '"noise": "a", "no": 0'),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_file_that_is_none_is_refused_with_its_name_and_the_remedy(how: str, tmp_path: Path, calibrated: Any) -> None:
    path = tmp_path / "camera.json"
    calibration_file.write(path, "demo", calibrated, {})
    path.write_text(BROKEN[how](path.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(TrirailError, match=r"camera\.json: .*trirail align calibrate"):
        calibration_file.read(path)


def test_a_file_that_is_not_there_is_made_by_a_calibration(tmp_path: Path) -> None:
    with pytest.raises(TrirailError, match=r"camera\.json: no such file; create it with trirail align calibrate"):
        calibration_file.read(tmp_path / "camera.json")


def test_numbers_of_a_file_are_kept_to_the_last_digit(tmp_path: Path, calibrated: Any) -> None:
    path = tmp_path / "camera.json"
    calibration_file.write(path, "demo", calibrated, {})
    again = calibration_file.read(path).calibration
    assert np.array_equal(again.views["left"].matrix, calibrated.views["left"].matrix)
