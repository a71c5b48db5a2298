"""Access to the gateway's session, and the rights of each user there, from [zenoh] of the configuration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import zenoh

from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.processes.sockets import SOCKET_MODE, connections, disconnect
from trirail.processes.stop_door import Answer, StopDoor
from trirail.wire import tls, zenoh_session
from trirail.wire.access import access_control
from trirail.wire.credentials import Admission, Credentials
from trirail.wire.dialling import connection_problem
from trirail.wire.endpoints import ReachableBy, reach, same_port, socket_file, tcp_address
from trirail.wire.stop_protocol import StopRequest, command_of, stop_address
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Role

_NO_DOOR = "no door for stops at"
_MEANS = "who floods the service's other ports keeps new stops out; end what is there, or move zenoh.listen"


class Guard:
    """Guard of the session and its door. Raises ServiceError if its certificates cannot be used."""

    def __init__(self, config: Config, admission: Admission | None = None) -> None:
        """`admission` holds the credentials that a service has found at its start; without it they are read here."""
        self._robot = config.robot.name
        self._listen, self._connect, self._router = config.zenoh.listen, config.zenoh.connect, config.zenoh.router
        self._credentials: Credentials | None = None
        self.users: dict[str, Role] = {}
        """Role of each user with one."""
        self._gone: list[str] = []
        telemetry = config.telemetry
        self._others = (("127.0.0.1", telemetry.live_port), (telemetry.metrics_address, telemetry.metrics_port))
        self._without_door: list[str] = []
        if config.zenoh.tls is not None:
            folder = Path(config.zenoh.tls.directory)
            admission = admission or Admission.read(folder, config.zenoh.users)
            self._credentials = admission.credentials.in_memory()
            if self._connect and self._credentials.name != self._robot:
                raise ServiceError(
                    f"{folder}: the certificate of {self._credentials.name}, and a router takes robot {self._robot} "
                    f"by its name alone: trirail keys robot {self._robot} makes its own"
                )
            self.users = admission.users
            self._gone = [user for user in config.zenoh.users if user not in self.users]

    def open(self) -> zenoh.Session:
        """Open the session. Raises ServiceError if an address cannot be listened on."""
        if self._credentials is None:
            opened = zenoh_session.open_service(self._listen, connect=self._connect)
        else:
            rules = access_control(self._robot, self.users, self._router)
            opened = zenoh_session.open_service(self._listen, self._credentials, rules, self._connect)
        for path in filter(None, map(socket_file, self._listen)):
            path.chmod(SOCKET_MODE)
        return opened

    def stop_door(self, take: Callable[[StopRequest, Answer], None]) -> StopDoor:
        """Open the door for stops beside each endpoint; `warnings` lists endpoints without one."""

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
        """Return the name in the certificate of each link, by address; None without a certificate."""
        return {str(link.dst): link.auth_identifier for link in opened.info.links()}

    def unopened(self, linked: Iterable[str]) -> Counter[str]:
        """Return by host the number of connections to endpoints with TLS that have opened no session; `linked` have."""
        ports = {at[1] for at in map(tcp_address, self._listen) if at is not None} if self._credentials else set()
        known = {at[1] for at in map(tcp_address, linked) if at is not None}
        return Counter(host for host, port in (connections(ports) if ports else ()) if port not in known)

    def disconnect(self, addresses: Iterable[str]) -> None:
        """End the sessions of these addresses. Zenoh has no call for it: their connections are shut down."""
        disconnect(set(filter(None, map(tcp_address, addresses))))

    def linked(self, opened: zenoh.Session) -> set[str]:
        """Return the endpoints of `connect` to which a session has a link with the router that is obeyed."""
        return zenoh_session.linked(opened, self._connect, self._router)

    def why_not_linked(self, endpoint: str) -> str:
        """Return the obstacle to a link with an endpoint of `connect`, "" if none is seen; it may take seconds."""
        return connection_problem(endpoint, self._credentials, self._router)

    def role(self, user: str) -> Role | None:
        """Return a user's role: the highest if no certificates are required, None for an unknown user."""
        return Role.MAINTAINER if self._credentials is None else self.users.get(user)

    def check(self, user: str, needed: Role, what: str) -> None:
        """Raise RefusedError if a user's role does not allow an action."""
        role = self.role(user)
        if role is None or not role.includes(needed):
            his = f"is {role}" if role is not None else "has no role"
            problem = f"{user} {his} at {self._robot}: {what} needs {needed}"
            raise RefusedError(RefusalCode.NOT_ALLOWED, problem)

    def warnings(self) -> tuple[str, ...]:
        """Return warnings about the door, one line each, with the remedy."""
        insecure = [
            f"insecure: whoever reaches {endpoint} can move the robot; trirail keys init makes certificates"
            for endpoint in (*self._listen, *self._connect)
            if reach(endpoint) is ReachableBy.NETWORK
        ]
        return (*insecure, *self._without_door, *self.certificate_warnings())

    def certificate_warnings(self) -> tuple[str, ...]:
        """Return warnings of a certificate that expires soon, and of revoked users with a role."""
        soon = [] if self._credentials is None else [self._credentials.warning()]
        gone = [f"{user} is revoked and has no role; take him out of [zenoh.users]" for user in self._gone]
        return (*filter(None, soon), *gone)
