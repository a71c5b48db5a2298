"""The lease as a client holds it: signs of life while its context lasts, and no longer."""

from __future__ import annotations

import asyncio
import queue
import signal
import threading
from collections.abc import Iterator

import msgspec
import pytest
from refusals import refused_as
from trirail.client.blocking import Lease, LoopThread
from trirail.client.lease import SIGNS, AsyncLease
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.messages import CommandReply
from trirail.wire.vocabulary import AcquireLease, Command, Mode, ReleaseLease
from waiting import WITHIN

OVER = RefusedError(RefusalCode.LEASE_OVER, "it is over")


class Service:
    """Confirms what it is asked, or raises what it is told to; keeps what it was asked."""

    def __init__(self, loop: LoopThread, mode: str = "holding") -> None:
        self._loop = loop
        self.asked: queue.Queue[tuple[Command, bytes]] = queue.Queue()
        self.refusal: Exception | None = None
        self.mode = mode

    async def command(self, name: Command, content: bytes) -> CommandReply:
        self.asked.put((name, content))
        if self.refusal is not None:
            raise self.refusal
        return CommandReply(name, self.mode, 0)

    def next(self) -> tuple[Command, bytes]:
        return self.asked.get(timeout=WITHIN)

    def lease(self, **how: bool) -> Lease:
        return Lease(AsyncLease(self.command, force=how.get("force", False), timeout=0.1), self._loop)


@pytest.fixture
def loop() -> Iterator[LoopThread]:
    loop = LoopThread()
    yield loop
    loop.close()


def sign(content: bytes) -> AcquireLease:
    return msgspec.json.decode(content, type=AcquireLease)


def test_it_is_asked_for_kept_by_the_same_and_given_back(loop: LoopThread) -> None:
    service = Service(loop)
    with service.lease(force=True):
        name, content = service.next()
        first = sign(content)
        assert (name, first.force, first.timeout) == (Command.ACQUIRE, True, 0.1)
        for _ in range(2 * SIGNS):
            name, content = service.next()
            assert name is Command.ACQUIRE
            assert sign(content) == AcquireLease(first.id, 0.1)  # to keep it takes nothing over
    *_, last = [service.next() for _ in range(service.asked.qsize())]
    assert last[0] is Command.RELEASE
    assert msgspec.json.decode(last[1], type=ReleaseLease).id == first.id


def test_each_lease_has_an_id_of_its_own(loop: LoopThread) -> None:
    service = Service(loop)
    ids = set()
    for _ in range(2):
        with service.lease():
            ids.add(sign(service.next()[1]).id)
        while not service.asked.empty():
            service.next()
    assert len(ids) == 2


def test_entering_returns_when_what_others_had_under_way_stands(loop: LoopThread) -> None:
    service = Service(loop, "stopping")
    with service.lease():
        asked = {service.next()[0] for _ in range(service.asked.qsize())}
    assert Command.STOP in asked


@pytest.mark.parametrize("error", [OVER, ServiceError("nobody answers")])
def test_what_ends_it_is_kept_and_nothing_is_asked_any_more(loop: LoopThread, error: Exception) -> None:
    service = Service(loop)
    with service.lease() as lease:
        assert lease.lost is None
        service.refusal = error
        assert lease.wait(WITHIN)
        assert lease.lost is error
    assert {service.next()[0] for _ in range(service.asked.qsize())} == {Command.ACQUIRE}


def test_a_lease_ends_with_its_time_out_if_the_service_does_not_answer(loop: LoopThread) -> None:
    asked: list[Command] = []

    async def command(name: Command, _content: bytes) -> CommandReply:
        asked.append(name)
        if asked.count(Command.ACQUIRE) > 2 and name is Command.ACQUIRE:
            await asyncio.Event().wait()
        return CommandReply(name, Mode.HOLDING, 0)

    with Lease(AsyncLease(command, force=False, timeout=0.5), loop) as lease:
        assert lease.wait(10.0), "it counts as held"
        assert isinstance(lease.lost, ServiceError)


PASSING = [
    ServiceError("no robot 'demo' answers"),
    RefusedError(RefusalCode.BUSY, "64 commands are already in progress"),
    RefusedError(RefusalCode.TIMEOUT, "the request was not carried out in time"),
]


@pytest.mark.parametrize("error", PASSING)
def test_a_lease_that_is_never_renewed_is_over_with_its_time_out(loop: LoopThread, error: TrirailError) -> None:
    service = Service(loop)
    with service.lease() as lease:
        service.refusal = error
        assert lease.wait(WITHIN)
        assert lease.lost is error


def test_who_does_not_get_it_keeps_nothing_up(loop: LoopThread) -> None:
    service = Service(loop)
    service.refusal = RefusedError(RefusalCode.LEASED, "bob holds the lease")
    before = threading.active_count()
    with refused_as(RefusalCode.LEASED), service.lease():
        raise AssertionError
    assert threading.active_count() <= before  # of other tests some may end meanwhile
    assert service.asked.qsize() == 1


class Silent(Service):
    """Grants the lease, but its reply to that does not come until it is told to; nor that to the release, if `deaf`."""

    def __init__(self, loop: LoopThread, *, deaf: bool) -> None:
        super().__init__(loop)
        self.deaf = deaf

    async def command(self, name: Command, content: bytes) -> CommandReply:
        self.asked.put((name, content))
        if self.deaf or name is Command.ACQUIRE:
            await asyncio.Event().wait()
        return CommandReply(name, self.mode, 0)


@pytest.mark.parametrize("deaf", [False, True])
def test_who_is_cancelled_while_the_lease_is_granted_gives_it_back(loop: LoopThread, deaf: bool) -> None:
    service = Silent(loop, deaf=deaf)

    async def cancelled() -> bool:
        entering = asyncio.create_task(AsyncLease(service.command, force=False, timeout=0.1).__aenter__())
        while service.asked.empty():
            await asyncio.sleep(0.0)
        entering.cancel()
        await asyncio.wait([entering])
        return entering.cancelled()

    assert loop.call(cancelled())
    (acquire, asked), (release, given) = [service.next() for _ in range(service.asked.qsize())]
    assert (acquire, release) == (Command.ACQUIRE, Command.RELEASE)
    assert msgspec.json.decode(given, type=ReleaseLease).id == sign(asked).id


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_who_is_cancelled_while_the_lease_ends_gives_it_back_all_the_same(turns: int) -> None:
    asked: list[Command] = []

    async def command(name: Command, _content: bytes) -> CommandReply:
        asked.append(name)
        if name is Command.RELEASE:
            await asyncio.Event().wait()
        return CommandReply(name, Mode.HOLDING, 0)

    async def main() -> None:
        lease = await AsyncLease(command, force=False, timeout=WITHIN).__aenter__()
        leaving = asyncio.create_task(lease.__aexit__())
        for _ in range(turns):
            await asyncio.sleep(0)
        leaving.cancel()
        await asyncio.wait([leaving])
        assert leaving.cancelled()
        await asyncio.sleep(0)
        assert asyncio.all_tasks() == {asyncio.current_task()}

    asyncio.run(main())
    assert asked == [Command.ACQUIRE, Command.RELEASE]


def test_ctrl_c_while_the_lease_is_granted_gives_it_back(loop: LoopThread) -> None:
    service = Silent(loop, deaf=False)

    def interrupt() -> None:
        assert service.next()[0] is Command.ACQUIRE
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt), service.lease():
        raise AssertionError
    assert service.next()[0] is Command.RELEASE


def test_who_cannot_wait_for_the_standstill_gives_it_back(loop: LoopThread) -> None:
    service = Service(loop, "stopping")

    async def command(name: Command, content: bytes) -> CommandReply:
        if name is Command.STOP:
            raise ServiceError("nobody answers")
        return await service.command(name, content)

    with pytest.raises(ServiceError), Lease(AsyncLease(command, force=False, timeout=10.0), loop):
        raise AssertionError
    assert [service.next()[0] for _ in range(2)] == [Command.ACQUIRE, Command.RELEASE]


@pytest.mark.parametrize("error", PASSING)
@pytest.mark.long
def test_a_lease_outlasts_a_gateway_that_is_busy_or_restarted_within_its_time_out(error: TrirailError) -> None:
    """The loop still holds the lease: one of the four renewals within a time-out is enough."""
    asked: list[Command] = []
    lost = SIGNS + 3
    """Number of the request that meets no gateway: a renewal, later than the first time-out."""

    async def command(name: Command, _content: bytes) -> CommandReply:
        asked.append(name)
        if len(asked) == lost:
            raise error
        return CommandReply(name, Mode.HOLDING, 0)

    async def hold() -> None:
        async with AsyncLease(command, force=False, timeout=2.0) as lease:
            while len(asked) <= lost and lease.lost is None:
                await asyncio.sleep(0.01)
            assert lease.lost is None

    asyncio.run(hold())
    assert asked == [Command.ACQUIRE] * (lost + 1) + [Command.RELEASE]
