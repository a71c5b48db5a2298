"""Access control for the gateway's Zenoh session and its stop port, according to [zenoh] in the configuration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import zenoh

from trirail.config import Config
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.processes.sockets import SOCKET_MODE, connections, disconnect
from trirail.processes.stop_port import Answer, StopPort
from trirail.wire import tls, zenoh_session
from trirail.wire.access import access_control
from trirail.wire.credentials import Admission, Credentials
from trirail.wire.dialling import connection_problem
from trirail.wire.endpoints import ReachableBy, reach, same_port, socket_file, tcp_address
from trirail.wire.stop_protocol import StopRequest, command_of, stop_address
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Role

_NO_STOP_PORT = "no stop port at"
_REMEDY = "when other ports are flooded, new stops cannot get through; free this port, or change zenoh.listen"


class Guard:
    """Guard, which opens the Zenoh session and the stop port, and checks the roles of users.

    Raises ServiceError if the certificates cannot be used.
    """

    def __init__(self, config: Config, admission: Admission | None = None) -> None:
        """Read the configuration. `admission` contains the credentials; if it is None, they are read from the files."""
        self._robot = config.robot.name
        self._listen, self._connect, self._router = config.zenoh.listen, config.zenoh.connect, config.zenoh.router
        self.credentials: Credentials | None = None
        """Credentials of the robot; None for a service without certificates."""
        self.users: dict[str, Role] = {}
        """Role of each user who has a role."""
        self._gone: list[str] = []
        telemetry = config.telemetry
        self._others = (("127.0.0.1", telemetry.live_port), (telemetry.metrics_address, telemetry.metrics_port))
        self._without_stop_port: list[str] = []
        if config.zenoh.tls is not None:
            folder = Path(config.zenoh.tls.directory)
            admission = admission or Admission.read(folder, config.zenoh.users, self._router)
            self.credentials = admission.credentials.in_memory()
            if self._connect and self.credentials.name != self._robot:
                raise ServiceError(
                    f"{folder}: the certificate has the name {self.credentials.name}, but a router accepts robot "
                    f"{self._robot} "
                    f"only with a certificate of the name {self._robot}: create one with trirail keys robot "
                    f"{self._robot}"
                )
            self.users = admission.users
            self._gone = [user for user in config.zenoh.users if user not in self.users]

    def open(self) -> zenoh.Session:
        """Open the session. Raises ServiceError if listening on an address fails."""
        if self.credentials is None:
            opened = zenoh_session.open_service(self._listen, connect=self._connect)
        else:
            rules = access_control(self._robot, self.users, self._router)
            opened = zenoh_session.open_service(self._listen, self.credentials, rules, self._connect)
        for path in filter(None, map(socket_file, self._listen)):
            path.chmod(SOCKET_MODE)
        return opened

    def open_client(self, endpoint: str) -> zenoh.Session:
        """Open a client session to a router with the service's certificate. Raises ServiceError."""
        return zenoh_session.open_client(endpoint, self.credentials)

    def stop_port(self, take: Callable[[StopRequest, Answer], None]) -> StopPort:
        """Open a stop port for each endpoint. `warnings` lists the endpoints for which that failed."""

        def ask(shown: str, request: StopRequest, answer: Answer) -> None:
            user, command = command_of(request, self._robot)
            if self.credentials is not None and user != shown:
                raise RefusedError(
                    RefusalCode.NOT_ALLOWED,
                    f"the certificate of {quoted(shown) or 'no user'} cannot be used to send as {user}",
                )
            self.check(user, command.role, command)
            take(request, answer)

        secured = None if self.credentials is None else tls.server(self.credentials)
        port, self._without_stop_port = StopPort(secured, ask), []
        for address in filter(None, map(stop_address, self._listen)):
            if not isinstance(address.where, str) and any(same_port(address.where, at) for at in self._others):
                self._without_stop_port.append(f"{_NO_STOP_PORT} {address}, which [telemetry] uses: {_REMEDY}")
                continue
            try:
                port.listen(address)
            except OSError as error:
                self._without_stop_port.append(
                    f"{_NO_STOP_PORT} {address} ({(error.strerror or str(error)).lower()}): {_REMEDY}"
                )
        port.start()
        return port

    def links(self, opened: zenoh.Session) -> dict[str, str | None]:
        """Return the name in the certificate of each link, by address; None for a link without a certificate."""
        return {str(link.dst): link.auth_identifier for link in opened.info.links()}

    def unopened(self, linked: Iterable[str]) -> Counter[str]:
        """Return the number of connections to TLS endpoints that have not opened a session, by host.

        `linked` contains the addresses that have a session.
        """
        ports = {at[1] for at in map(tcp_address, self._listen) if at is not None} if self.credentials else set()
        known = {at[1] for at in map(tcp_address, linked) if at is not None}
        return Counter(host for host, port in (connections(ports) if ports else ()) if port not in known)

    def disconnect(self, addresses: Iterable[str]) -> None:
        """End the sessions of the peers at these addresses."""
        # Zenoh has no function that closes a peer's session, so shut down the peer's connection.
        disconnect(set(filter(None, map(tcp_address, addresses))))

    def linked(self, opened: zenoh.Session) -> set[str]:
        """Return those endpoints in `connect` at which the session has a link to the configured router."""
        return zenoh_session.linked(opened, self._connect, self._router)

    def why_not_linked(self, endpoint: str) -> str:
        """Return the reason why there is no link to an endpoint, or "" if none is found. This may take seconds."""
        return connection_problem(endpoint, self.credentials, self._router)

    def role(self, user: str) -> Role | None:
        """Return the role of a user, or None if the user has no role.

        If the service does not use certificates, every user has the highest role.
        """
        return Role.MAINTAINER if self.credentials is None else self.users.get(user)

    def check(self, user: str, needed: Role, action: str) -> None:
        """Raise RefusedError if a user's role does not include the role `needed` for an action."""
        role = self.role(user)
        if role is None or not role.includes(needed):
            state = f"is {role}" if role is not None else "has no role"
            problem = f"{user} {state} at robot {self._robot}: {action} needs the role {needed}"
            raise RefusedError(RefusalCode.NOT_ALLOWED, problem)

    def warnings(self) -> tuple[str, ...]:
        """Return warnings about insecure endpoints, the stop port and certificates, as lines that state the remedy."""
        insecure = [
            f"insecure: anyone who can reach {endpoint} can move the robot; make certificates with trirail keys init"
            for endpoint in (*self._listen, *self._connect)
            if reach(endpoint) is ReachableBy.NETWORK
        ]
        return (*insecure, *self._without_stop_port, *self.certificate_warnings())

    def certificate_warnings(self) -> tuple[str, ...]:
        """Return warnings about a certificate that expires soon, and about revoked users in the configuration."""
        soon = [] if self.credentials is None else [self.credentials.warning()]
        gone = [f"{user} is revoked and has no role; remove this user from [zenoh.users]" for user in self._gone]
        return (*filter(None, soon), *gone)
