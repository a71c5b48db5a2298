"""Stop sent by a program that has no Zenoh session yet; a flooded port may delay the opening of a session."""

from __future__ import annotations

import asyncio
import queue
import threading
from pathlib import Path

from trirail.client.async_connection import AsyncConnection
from trirail.client.connection import REPLY_WITHIN, Connection
from trirail.client.identity import identity
from trirail.client.stop_call import Outcome, Outcomes, StopOrder
from trirail.errors import ServiceError, TrirailError
from trirail.wire.credentials import Credentials
from trirail.wire.messages import CommandReply


class NewStop:
    """Stop, quick_stop or disable that is sent to the stop port while a session opens, and then over the session.

    Raises the same errors as Robot.
    """

    def __init__(
        self, name: str, robot: str | None = None, connect: str | None = None, tls: Path | str | None = None
    ) -> None:
        robot, connect, user, credentials = identity(robot, connect, None, tls)
        stop = StopOrder.create(robot, user, name, None, REPLY_WITHIN)
        self._came: queue.SimpleQueue[Outcome] = queue.SimpleQueue()
        self._at_door = stop.at_door(connect, credentials, self._came.put)
        self._outcomes = Outcomes(1 if self._at_door is None else 2)
        self._confirmed = False
        self.opening = threading.Thread(target=self._query, args=(stop, connect, credentials), daemon=True)
        """Thread that opens the session and sends the stop; Zenoh cannot cancel the opening of a session."""
        try:
            self.opening.start()
        except RuntimeError:  # no thread can be started, as in StopOrder.at_door
            self._query(stop, connect, credentials)

    def wait(self) -> CommandReply:
        """Return the first reply. Raises RefusedError if the service refuses, ServiceError if there is no reply."""
        while (reply := self._outcomes.decide(self._came.get())) is None:
            pass
        self._confirmed = True
        if self._at_door is not None:
            self._at_door.cancel()
        return reply

    def _query(self, stop: StopOrder, connect: str, credentials: Credentials | None) -> None:
        try:
            connection = Connection(stop.robot, connect, credentials)
            try:
                if not self._confirmed:  # otherwise the robot may move again
                    self._came.put(asyncio.run(_fetch(connection, stop)))
            finally:
                connection.close()
        except TrirailError as error:
            self._came.put(error)
        except Exception as error:  # noqa: BLE001 - the waiting thread must get an outcome in any case
            self._came.put(ServiceError(f"no session at {connect}: {error!r}"))


async def _fetch(connection: Connection, stop: StopOrder) -> CommandReply:
    asking = AsyncConnection(connection)
    return await asking.fetch(stop.parts, CommandReply, stop.content, stop.within, copy=stop.id)
