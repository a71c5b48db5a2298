"""What a client promises whoever else speaks on its robot's keys; no service is needed for that."""

from __future__ import annotations

import asyncio
import itertools
import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh
from refusals import refused_as
from trirail.client import async_client
from trirail.client.async_client import AsyncRobot
from trirail.client.client import GoalHandle, Robot
from trirail.client.connection import Connection
from trirail.client.goal import AsyncGoalHandle
from trirail.errors import RefusalCode, ServiceError, WaitTimeoutError
from trirail.wire import boundary, zenoh_session
from trirail.wire.credentials import Credentials
from trirail.wire.messages import CommandReply, Event, RoleReply
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import Role
from trirail.wire.zenoh_session import open_service
from waiting import WITHIN

TIMEOUT = 0.3
NEWEST = Event(seq=7, t=0.0, cycle=0, time=5.0, kind="service", level="info", message="the newest there is")
OLDER = msgspec.structs.replace(NEWEST, seq=3, time=2.0)
ENDED = msgspec.structs.replace(NEWEST, seq=5, time=3.0, kind="goal", id="another", outcome="done")


@pytest.fixture
def noisy(tmp_path: Path) -> Iterator[Robot]:
    """A robot on whose keys somebody publishes junk and the same events for ever, and answers queries with junk."""
    locator = f"unixsock-stream/{tmp_path}/zenoh"
    over = threading.Event()

    def answer(query: zenoh.Query) -> None:
        with query:
            while not over.wait(0.01):
                query.reply(query.key_expr, b"junk")

    def publish(session: zenoh.Session) -> None:
        for content in itertools.cycle((b"junk", *map(msgspec.json.encode, (NEWEST, OLDER, ENDED)), b"{}")):
            for key in ("event", "state", "records"):
                session.put(f"trirail/demo/{key}", content)
            if over.wait(0.01):
                return

    with open_service([locator]) as session, session.declare_queryable("trirail/demo/**", answer):
        publisher = threading.Thread(target=publish, args=(session,))
        publisher.start()
        try:
            with Robot("demo", locator) as robot:
                yield robot
        finally:
            over.set()
            publisher.join()


def unheard(robot: Robot) -> GoalHandle:
    """A goal of which nobody tells anything."""
    inner = robot._robot
    goal = AsyncGoalHandle("mine", inner.command, inner.role, lambda: inner._is_present("mine"))
    return GoalHandle(goal, robot._loop, robot.command)


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda robot: list(robot.events(timeout=TIMEOUT)), None),
        (lambda robot: list(robot.events(history=True, timeout=TIMEOUT)), None),
        (lambda robot: list(robot.states(timeout=TIMEOUT)), None),
        (lambda robot: robot.state(timeout=TIMEOUT), ServiceError),
        (lambda robot: unheard(robot).wait(timeout=TIMEOUT), WaitTimeoutError),
        (lambda robot: robot.stop(), ServiceError),
        (lambda robot: robot.home(), ServiceError),
    ],
)
def test_a_call_ends_by_its_timeout_whatever_arrives(
    noisy: Robot, monkeypatch: pytest.MonkeyPatch, call: Callable[[Robot], object], error: type[Exception] | None
) -> None:
    monkeypatch.setattr(async_client, "REPLY_WITHIN", TIMEOUT)
    monkeypatch.setattr(async_client, "HOME_WITHIN", TIMEOUT)
    monkeypatch.setattr(async_client, "ENABLE_WITHIN", TIMEOUT)
    ended = threading.Event()
    raised: list[type[BaseException] | None] = []

    def run() -> None:
        try:
            call(noisy)
            raised.append(None)
        except (ServiceError, WaitTimeoutError) as found:
            raised.append(type(found))
        ended.set()

    threading.Thread(target=run, daemon=True).start()
    assert ended.wait(WITHIN), "it waits for ever"
    assert raised == [error]


def test_events_are_told_once_and_in_order_whatever_comes_again(noisy: Robot) -> None:
    told: list[int] = []
    while NEWEST.seq not in told:
        told = [event.seq for event in itertools.islice(noisy.events(timeout=TIMEOUT), 10)]
        assert told == sorted(set(told))


def test_a_service_that_does_not_answer_in_time_is_told_as_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(async_client, "REPLY_WITHIN", TIMEOUT)
    monkeypatch.setattr(async_client, "ENABLE_WITHIN", TIMEOUT)
    locator, mute = f"unixsock-stream/{tmp_path}/zenoh", list[zenoh.Query]()
    with open_service([locator]) as session, session.declare_queryable("trirail/demo/**", mute.append):
        with Robot("demo", locator) as robot:
            for order in (robot.stop, robot.enable):
                with pytest.raises(ServiceError, match=rf"robot 'demo' at {locator} has not answered in time"):
                    order()
        mute.clear()


@pytest.mark.long
@pytest.mark.parametrize("kind", [Robot, AsyncRobot])
def test_the_environment_says_which_robot_and_where_as_in_a_shell(
    kind: type[Robot | AsyncRobot], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    nowhere = f"unixsock-stream/{tmp_path}/none"
    monkeypatch.setenv("TRIRAIL_CONNECT", nowhere)
    monkeypatch.setenv("TRIRAIL_ROBOT", "left")

    async def enter(robot: AsyncRobot) -> None:
        async with robot:
            pass

    def opened(**given: str) -> None:
        robot = kind(**given)
        if isinstance(robot, AsyncRobot):
            asyncio.run(enter(robot))

    with pytest.raises(ServiceError, match=rf"no service at {nowhere}: no such file or directory; .*connect="):
        opened()
    with pytest.raises(ServiceError, match=r"no service at tcp/127.0.0.1:1: connection refused"):
        opened(connect="tcp/127.0.0.1:1")  # what is given counts
    monkeypatch.setenv("TRIRAIL_ROBOT", "a/b")
    with refused_as(RefusalCode.BAD_NAME):
        kind()
    monkeypatch.setenv("TRIRAIL_CONNECT", "tls/127.0.0.1:1")
    monkeypatch.setenv("TRIRAIL_TLS", str(tmp_path / "keys"))
    with pytest.raises(ServiceError, match=f"{tmp_path}/keys/ca.pem"):
        kind("left")


@pytest.mark.parametrize("argument", ["name", "user"])
def test_an_empty_name_selects_no_other_robot_or_user(monkeypatch: pytest.MonkeyPatch, argument: str) -> None:
    monkeypatch.setenv("TRIRAIL_ROBOT", "another")
    with refused_as(RefusalCode.BAD_NAME):
        AsyncRobot(**{argument: ""})


def test_a_callback_of_records_cannot_wait_for_the_robot(tmp_path: Path) -> None:
    locator = f"unixsock-stream/{tmp_path}/zenoh"
    errors: list[str] = []

    def deliver(_: bytes) -> None:
        try:
            robot.state()
        except ServiceError as error:
            errors.append(str(error))

    with open_service([locator]) as session, Robot("demo", locator) as robot, robot.records(deliver):
        while not errors:
            session.put("trirail/demo/records", np.zeros(1, DTYPE).tobytes())
    assert "must not call the robot" in errors[0]


def test_the_users_of_a_robot_that_is_not_there_are_an_error(tmp_path: Path) -> None:
    locator = f"unixsock-stream/{tmp_path}/zenoh"
    with open_service([locator]), Robot("demo", locator) as robot, pytest.raises(ServiceError, match="no robot 'demo'"):
        robot.users()


@pytest.mark.parametrize(("left", "is_told"), [(timedelta(seconds=-1), True), (timedelta(days=1), False)])
def test_no_answer_to_a_user_whose_certificate_has_expired_is_told_as_that(
    tmp_path: Path, left: timedelta, is_told: bool
) -> None:
    """The service ends the session of such a user."""
    locator = f"unixsock-stream/{tmp_path}/zenoh"
    with open_service([locator]):
        connection = Connection("demo", locator)
        connection._credentials = Credentials(tmp_path / "ann", "ann", datetime.now(UTC) + left, ())
        error = connection.why_nobody(("cmd", "ann", "stop"), None)
        connection.close()
    assert (f"the certificate in {tmp_path}/ann has expired; renew it" in str(error)) == is_told


@pytest.mark.parametrize("token", ["\x1b[31mred", "two\nlines", "x" * 3000, "\u202eabc"])
def test_only_names_are_users(tmp_path: Path, token: str) -> None:
    """Any session may declare a token with any name."""
    locator = f"unixsock-stream/{tmp_path}/zenoh"
    key = zenoh_session.key("demo", "role", "*")
    with open_service([locator]) as session, Robot("demo", locator) as robot:
        role = boundary.encode(RoleReply(robot.user, Role.OPERATOR))
        queryable = session.declare_queryable(key, lambda query: query.reply(query.key_expr, role))
        declared = session.liveliness().declare_token(zenoh_session.key("demo", "here", token))
        assert token not in robot.users()
        del queryable, declared


def test_a_stop_with_any_content_goes_out(tmp_path: Path) -> None:
    locator = f"unixsock-stream/{tmp_path}/zenoh"
    contents: list[bytes] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            contents.append(query.payload.to_bytes() if query.payload is not None else b"")
            query.reply(query.key_expr, msgspec.json.encode(CommandReply("stop", "holding", 1)))

    with (
        open_service([locator]) as session,
        session.declare_queryable("trirail/demo/**", answer),
        Robot("demo", locator) as robot,
    ):
        robot.command("stop", b"\xff")
    assert contents == [b"\xff"]
