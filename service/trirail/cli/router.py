"""A router between robots and users: its configuration file, and the configuration of zenohd that follows from it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct
from trirail_drivers import files
from trirail_drivers.errors import FileError

from trirail.config import UserName, Zenoh, check_reach, toml_tables, wrong_values
from trirail.errors import ConfigError, ServiceError
from trirail.wire import zenoh_session
from trirail.wire.access import router_access_control
from trirail.wire.credentials import Credentials, check_not_revoked, with_role
from trirail.wire.decoding import converted, prepare


class RouterConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """A router's configuration file."""

    zenoh: Zenoh
    """Section as in a robot's file: listening address, certificates, and users of all robots behind this router.
    `connect` names another router."""
    robots: Annotated[tuple[UserName, ...], Meta(max_length=10_000)] = ()
    """Robots that may connect to the router, each by the common name of its certificate. This is also its name in every
    key."""
    routers: Annotated[dict[UserName, tuple[UserName, ...]], Meta(max_length=1000)] = {}
    """Routers that may connect to this router, by the common names of their certificates, each with the robots behind
    it."""
    state_hz: Annotated[float, Meta(gt=0.0, le=200.0)] = 5.0
    """Maximum rate at which the states of each robot are sent to a user [Hz]."""

    @property
    def behind(self) -> dict[str, tuple[str, ...]]:
        """Names of the robots and routers that may connect, each with the robots behind it; for a robot, the robot
        itself."""
        return {robot: (robot,) for robot in self.robots} | self.routers

    @property
    def all_robots(self) -> list[str]:
        """All robots that connect to this router, directly or through another router."""
        return [robot for robots in self.behind.values() for robot in robots]


prepare(RouterConfig)


def load(path: Path) -> RouterConfig:
    """Read the configuration file of a router. Raises ConfigError if it is invalid."""
    try:
        config = _parsed(files.text(path))
        check_reach(config.zenoh)
    except FileError as error:
        raise ConfigError(str(error)) from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    config = msgspec.structs.replace(config, zenoh=config.zenoh.beside(path.parent.absolute()))
    if not config.all_robots:
        raise ConfigError(f"{path}: robots, routers: name at least one robot")
    named = Counter([*config.all_robots, *config.routers, *config.zenoh.users])
    if twice := [name for name, times in named.items() if times > 1]:
        raise ConfigError(f"{path}: robots, routers, zenoh.users: {', '.join(twice)} is given twice: names must differ")
    return config


def _parsed(text: str) -> RouterConfig:
    raw = toml_tables(text)
    if wrong := wrong_values(raw, RouterConfig):
        raise ConfigError(wrong[0].text)
    return converted(raw, RouterConfig)


def settings(config: RouterConfig) -> dict[str, Any]:
    """Return the configuration of zenohd. Raises ServiceError if the certificates cannot be used."""
    thinned = {zenoh_session.key(robot, "state"): config.state_hz for robot in config.all_robots}
    listen, connect = config.zenoh.listen, config.zenoh.connect
    if config.zenoh.tls is None:
        return zenoh_session.router(listen, None, None, connect, thinned)
    folder = Path(config.zenoh.tls.directory)
    peers = [*config.behind, *([config.zenoh.router] if config.zenoh.router is not None else [])]
    check_not_revoked(peers, "robots, routers or zenoh.router", folder)
    own = Credentials.read_server(folder)
    if own.name in (*config.behind, *config.all_robots):
        raise ServiceError(
            f"{folder}: this is the certificate of {own.name}, which is behind this router; the router needs its own: "
            "create one with trirail keys init --robot or trirail keys robot"
        )
    rules = router_access_control(config.behind, with_role(config.zenoh.users, folder), config.zenoh.router)
    return zenoh_session.router(listen, own, rules, connect, thinned)
