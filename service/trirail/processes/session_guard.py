"""Who may open the gateway's session and what each may do there, from [zenoh] of the configuration."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import zenoh

from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.processes.sockets import SOCKET_MODE, disconnect
from trirail.processes.stop_door import Answer, StopDoor
from trirail.wire import tls, zenoh_session
from trirail.wire.access import access_control
from trirail.wire.credentials import Credentials, with_role
from trirail.wire.dialling import why_not
from trirail.wire.endpoints import ReachableBy, reach, same_port, socket_file, tcp_address
from trirail.wire.stop_protocol import StopRequest, command_of, stop_address
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Role

_NO_DOOR = "no door for stops at"
_MEANS = "who floods the service's other ports keeps new stops out; end what is there, or move zenoh.listen"


class Guard:
    """The door to the robot. Raises ServiceError where its certificates cannot be used."""

    def __init__(self, config: Config) -> None:
        self._robot = config.robot.name
        self._listen, self._connect, self._router = config.zenoh.listen, config.zenoh.connect, config.zenoh.router
        self._credentials: Credentials | None = None
        self.users: dict[str, Role] = {}
        """The role of each user who has one."""
        self._gone: list[str] = []
        telemetry = config.telemetry
        self._others = (("127.0.0.1", telemetry.live_port), (telemetry.metrics_address, telemetry.metrics_port))
        self._without_door: list[str] = []
        if config.zenoh.tls is not None:
            folder = Path(config.zenoh.tls.directory)
            self._credentials = Credentials.read_server(folder)
            if self._connect and self._credentials.name != self._robot:
                raise ServiceError(
                    f"{folder}: the certificate of {self._credentials.name}, and a router takes robot {self._robot} "
                    f"by its name alone: trirail keys robot {self._robot} makes its own"
                )
            self.users = with_role(config.zenoh.users, folder)
            self._gone = [user for user in config.zenoh.users if user not in self.users]

    def open(self) -> zenoh.Session:
        """Open the session. Raises ServiceError where an address cannot be listened on."""
        if self._credentials is None:
            opened = zenoh_session.open_service(self._listen, connect=self._connect)
        else:
            rules = access_control(self._robot, self.users, self._router)
            opened = zenoh_session.open_service(self._listen, self._credentials, rules, self._connect)
        for path in filter(None, map(socket_file, self._listen)):
            path.chmod(SOCKET_MODE)
        return opened

    def stop_door(self, take: Callable[[StopRequest, Answer], None]) -> StopDoor:
        """Open the door for stops beside each endpoint; `warnings` tells where none can be."""

        def ask(shown: str, request: StopRequest, answer: Answer) -> None:
            user, command = command_of(request, self._robot)
            if self._credentials is not None and user != shown:
                raise RefusedError(RefusalCode.NOT_ALLOWED, f"{quoted(shown) or 'nobody'} cannot send as {user}")
            self.check(user, command.role, command)
            take(request, answer)

        secured = None if self._credentials is None else tls.server(self._credentials)
        door, self._without_door = StopDoor(secured, ask), []
        for address in filter(None, map(stop_address, self._listen)):
            if not isinstance(address.where, str) and any(same_port(address.where, at) for at in self._others):
                self._without_door.append(f"{_NO_DOOR} {address}, where [telemetry] listens: {_MEANS}")
                continue
            try:
                door.listen(address)
            except OSError as error:
                self._without_door.append(f"{_NO_DOOR} {address} ({(error.strerror or str(error)).lower()}): {_MEANS}")
        door.start()
        return door

    def links(self, opened: zenoh.Session) -> dict[str, str | None]:
        """Return the name in the certificate of each who is connected, by his address; None where he shows none."""
        return {str(link.dst): link.auth_identifier for link in opened.info.links()}

    def disconnect(self, addresses: Iterable[str]) -> None:
        """End the sessions of these addresses. Zenoh has no word for it: their connections are shut down."""
        disconnect(set(filter(None, map(tcp_address, addresses))))

    def linked(self, opened: zenoh.Session) -> set[str]:
        """Return to which endpoints of `connect` a session has a link to the router that is obeyed."""
        return zenoh_session.linked(opened, self._connect, self._router)

    def why_not_linked(self, endpoint: str) -> str:
        """Return what keeps from a link to an endpoint of `connect`, "" where nothing is seen; it may take seconds."""
        return why_not(endpoint, self._credentials, self._router)

    def role(self, user: str) -> Role | None:
        """Return what a user may: all where nobody is asked for a certificate, nothing where he is not named."""
        return Role.MAINTAINER if self._credentials is None else self.users.get(user)

    def check(self, user: str, needed: Role, what: str) -> None:
        """Raise RefusedError where a user's role does not allow what is asked."""
        role = self.role(user)
        if role is None or not role.includes(needed):
            his = f"is {role}" if role is not None else "has no role"
            problem = f"{user} {his} at {self._robot}: {what} needs {needed}"
            raise RefusedError(RefusalCode.NOT_ALLOWED, problem)

    def warnings(self) -> tuple[str, ...]:
        """Return what people should know of the door, one line each, with the remedy."""
        insecure = [
            f"insecure: whoever reaches {endpoint} can move the robot; trirail keys init makes certificates"
            for endpoint in (*self._listen, *self._connect)
            if reach(endpoint) is ReachableBy.NETWORK
        ]
        return (*insecure, *self._without_door, *self.certificate_warnings())

    def certificate_warnings(self) -> tuple[str, ...]:
        """Return which certificate expires soon, and who is revoked though a role is given to him."""
        soon = [] if self._credentials is None else [self._credentials.warning()]
        gone = [f"{user} is revoked and has no role; take him out of [zenoh.users]" for user in self._gone]
        return (*filter(None, soon), *gone)
