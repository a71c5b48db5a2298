"""What each role may on the network: with real certificates, every message, every key, each direction by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh
from certificates import ROLES, tls_config, user
from trirail.config import Config
from trirail.wire import zenoh_session
from trirail.wire.access import access_control, least_role
from trirail.wire.credentials import Credentials
from trirail.wire.vocabulary import Command, Role

MESSAGES = ("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token",
            "liveliness_query", "declare_liveliness_subscriber")  # fmt: skip
"""All that Zenoh's access control tells apart."""
FLOWS = ("ingress", "egress")

PUBLISHED = {"state", "summary", "event", "records"}
OPERATORS = {"enable", "disable", "quick_stop", "pause", "resume", "override", "set_output", "acquire", "release"}
MAINTAINERS = {"reset", "home"}

KEYS = [
    *PUBLISHED, "info", "alive", "role/ME", "role/bob", "goal/ME", "goal/bob", "goal/*",
    "alignment/ME", "alignment/bob", "alignment/*", "check/ME", "check/bob", "check/*",
    *(f"cmd/{who}/{name}" for who in ("ME", "bob", "*") for name in Command), "cmd/ME/dance", "cmd/*/*", "role/*",
    "here/ME", "here/bob",
    "poses", *(f"{what}/{who}/pick" for what in ("teach", "forget") for who in ("ME", "bob", "*")), "teach/*/*",
    "event/@adv/pub/1/2/_", "nothing", "../other/state", "../../elsewhere", "../../@/1/peer/config",
]  # fmt: skip
"""Below trirail/demo; ME is the user."""


def allowed(role: Role | None, flow: str, message: str) -> set[str]:
    """Return what is allowed to a role, key by key: written once more, by hand."""
    asking, seeing = role is not None, role is not None
    sends = role in (Role.OPERATOR, Role.MAINTAINER)
    mine = (
        ({"cmd/ME/stop"} if asking else set())
        | ({f"cmd/ME/{name}" for name in OPERATORS} | {"goal/ME", "check/ME", "alignment/ME"} if sends else set())
        | ({f"cmd/ME/{name}" for name in MAINTAINERS} if role is Role.MAINTAINER else set())
        | ({"teach/ME/pick", "forget/ME/pick"} if role is Role.MAINTAINER else set())
    )
    roles = {"role/ME", "role/bob", "role/*"}
    of_all = {key for key in KEYS if key.split("/")[0] in ("goal", "check", "alignment", "cmd", "teach", "forget")}
    told, here = {"info", "poses"}, {"here/ME", "here/bob"}
    adv = {"event/@adv/pub/1/2/_"}
    table: dict[tuple[str, str], set[str]] = {
        ("ingress", "query"): roles | (mine | told | adv if seeing else set()),
        ("ingress", "put"): {"goal/ME"} if sends else set(),
        ("ingress", "declare_subscriber"): PUBLISHED | adv | {"../other/state"} if seeing else set(),
        ("ingress", "liveliness_token"): {"here/ME"} if seeing else set(),
        ("ingress", "liveliness_query"): {"alive"} | here | adv if seeing else set(),
        ("ingress", "declare_liveliness_subscriber"): {"alive"} | here | adv if seeing else set(),
        ("egress", "put"): PUBLISHED | adv if seeing else set(),
        ("egress", "reply"): roles | (of_all | told | {"alive"} | here | PUBLISHED | adv if seeing else set()),
        ("egress", "declare_subscriber"): {"goal/ME", "goal/bob", "goal/*"} if seeing else set(),
        ("egress", "declare_queryable"): roles | (of_all | told | adv if seeing else set()),
        ("egress", "liveliness_token"): {"alive"} | here | adv if seeing else set(),
    }
    return table.get((flow, message), set())


def callback(take: Callable[[Any], None]) -> zenoh.handlers.Callback[Any]:
    return zenoh.handlers.Callback(take, indirect=False)


def matches(sender: Any) -> bool:
    """Whether somebody listens; zenoh's stub takes the status for a bool."""
    return bool(sender.matching_status.matching)


class Line:
    """A service's session and a client's, and what of a message passes from one to the other."""

    def __init__(self, service: zenoh.Session, client: zenoh.Session, name: str, stack: ExitStack) -> None:
        self.service, self.client, self._name, self._stack = service, client, name, stack

    def passed(self, flow: str, message: str) -> set[str]:
        sender, receiver = (self.client, self.service) if flow == "ingress" else (self.service, self.client)
        look = getattr(self, f"_{message}")
        passed: set[str] = look(sender, receiver, flow)
        return passed

    def _key(self, key: str) -> str:
        """The whole key; `../` leaves the robot's."""
        parts = ["trirail", "demo"]
        for part in key.replace("ME", self._name or "x").split("/"):
            if part == "..":
                parts.pop()
            else:
                parts.append(part)
        return "/".join(parts)

    def _by_key(self) -> dict[str, str]:
        return {self._key(key): key for key in KEYS}

    def _settle(self) -> None:
        """Have everything arrive that was sent before: an answer comes behind it."""
        for asker in (self.client, self.service):
            assert [reply.ok for reply in asker.get("settle", timeout=10.0)]

    def _put(self, sender: zenoh.Session, receiver: zenoh.Session, _: str, *, delete: bool = False) -> set[str]:
        heard: set[str] = set()

        def note(whole: str, key: str, sample: zenoh.Sample) -> None:
            if str(sample.key_expr) == whole:
                heard.add(key)

        for whole, key in self._by_key().items():
            self._stack.enter_context(receiver.declare_subscriber(whole, callback(partial(note, whole, key))))
        self._settle()
        for whole in self._by_key():
            (sender.delete if delete else lambda key: sender.put(key, b"x"))(whole)
        self._settle()
        return heard

    def _delete(self, sender: zenoh.Session, receiver: zenoh.Session, flow: str) -> set[str]:
        return self._put(sender, receiver, flow, delete=True)

    def _queried(self, receiver: zenoh.Session) -> dict[str, list[str]]:
        """Declare a queryable for each key, that answers and notes who was asked."""
        asked: dict[str, list[str]] = {key: [] for key in KEYS}

        def answer(key: str, query: zenoh.Query) -> None:
            asked[key].append(str(query.key_expr))
            with query:
                query.reply(query.key_expr, b"yes")

        for whole, key in self._by_key().items():
            self._stack.enter_context(receiver.declare_queryable(whole, callback(partial(answer, key))))
        self._settle()
        return asked

    def _query(self, sender: zenoh.Session, receiver: zenoh.Session, _: str) -> set[str]:
        asked = self._queried(receiver)
        for whole in self._by_key():
            list(sender.get(whole, timeout=10.0))
        return {key for key in KEYS if self._key(key) in asked[key]}

    def _reply(self, sender: zenoh.Session, receiver: zenoh.Session, _: str) -> set[str]:
        self._queried(sender)
        answered = set()
        for whole, key in self._by_key().items():
            replies = receiver.get(whole, timeout=10.0, target=zenoh.QueryTarget.ALL)
            if any(reply.ok is not None and str(reply.ok.key_expr) == whole for reply in replies):
                answered.add(key)
        return answered

    def _declare_subscriber(self, sender: zenoh.Session, receiver: zenoh.Session, _: str) -> set[str]:
        for whole in self._by_key():
            self._stack.enter_context(sender.declare_subscriber(whole, callback(lambda _: None)))
        publishers = {key: receiver.declare_publisher(whole) for whole, key in self._by_key().items()}
        self._settle()
        return {key for key, publisher in publishers.items() if matches(publisher)}

    def _declare_queryable(self, sender: zenoh.Session, receiver: zenoh.Session, _: str) -> set[str]:
        self._queried(sender)
        queriers = {key: receiver.declare_querier(whole) for whole, key in self._by_key().items()}
        self._settle()
        return {key for key, querier in queriers.items() if matches(querier)}

    def _tokens(self, sender: zenoh.Session) -> None:
        for whole, key in self._by_key().items():
            if "*" not in key:
                self._stack.enter_context(sender.liveliness().declare_token(whole))

    def _liveliness_token(self, sender: zenoh.Session, receiver: zenoh.Session, _: str) -> set[str]:
        self._tokens(sender)
        self._settle()
        return self._seen_by(receiver)

    def _liveliness_query(self, sender: zenoh.Session, receiver: zenoh.Session, _: str) -> set[str]:
        self._tokens(receiver)
        self._settle()
        return self._seen_by(sender)

    def _seen_by(self, session: zenoh.Session) -> set[str]:
        seen = set()
        for whole, key in self._by_key().items():
            if "*" not in key and any(reply.ok for reply in session.liveliness().get(whole, timeout=10.0)):
                seen.add(key)
        return seen

    def _declare_liveliness_subscriber(self, sender: zenoh.Session, receiver: zenoh.Session, _: str) -> set[str]:
        seen: set[str] = set()

        def note(key: str, _: zenoh.Sample) -> None:
            seen.add(key)

        for whole, key in self._by_key().items():
            if "*" not in key:
                take = callback(partial(note, key))
                self._stack.enter_context(sender.liveliness().declare_subscriber(whole, take))
        self._settle()
        self._tokens(receiver)
        self._settle()
        return seen


def opened_but_for(rules: dict[str, Any], flow: str = "", message: str = "") -> dict[str, Any]:
    """Allow all but one message in one direction, which stays as it was: so it is that alone which is tried."""
    rest = [
        {"id": f"open {way}", "permission": "allow", "flows": [way], "key_exprs": ["**", "**/@adv/**", "@/**"],
         "messages": [name for name in MESSAGES if (way, name) != (flow, message)]}
        for way in FLOWS
    ]  # fmt: skip
    settle = {"id": "settle", "permission": "allow", "flows": list(FLOWS), "key_exprs": ["settle"],
              "messages": ["query", "reply", "declare_queryable"]}  # fmt: skip
    every = {"rules": ["open ingress", "open egress", "settle"], "subjects": ["every certificate"]}
    return rules | {"rules": [*rules["rules"], *rest, settle], "policies": [*rules["policies"], every]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tls")


@pytest.fixture(scope="module")
def config(folder: Path) -> Config:
    return tls_config(folder)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


# Zenoh sends none of these from a peer to its clients; that no rule allows them is held below.
UNSENT = {("egress", "liveliness_query"), ("egress", "declare_liveliness_subscriber")}


SENT = [(flow, message) for flow in FLOWS for message in MESSAGES if (flow, message) not in UNSENT]


def connect(config: Config, folder: Path, stack: ExitStack, name: str, rules: dict[str, Any]) -> Line:
    """Open a service with these rules, and a user's session to it."""
    robot, credentials = Credentials.read(folder / "keys"), Credentials.read(user(folder, name))
    service = stack.enter_context(zenoh_session.open_service(config.zenoh.listen, robot, rules))
    client = stack.enter_context(zenoh_session.open_client(config.zenoh.listen[0], credentials))

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply("settle", b"")

    for session in (service, client):
        stack.enter_context(session.declare_queryable("settle", callback(answer)))
    return Line(service, client, credentials.name, stack)


@pytest.mark.parametrize("name", [*ROLES, "una", "nobody"])
@pytest.mark.parametrize(("flow", "message"), SENT)
def test_each_role_may_what_the_table_says_and_no_more(
    config: Config, folder: Path, stack: ExitStack, name: str, flow: str, message: str
) -> None:
    line = connect(config, folder, stack, name, opened_but_for(access_control("demo", ROLES), flow, message))
    assert line.passed(flow, message) == allowed(ROLES.get(name), flow, message)


@pytest.mark.parametrize(("flow", "message"), SENT)
def test_what_is_tried_does_pass_where_it_is_allowed(
    config: Config, folder: Path, stack: ExitStack, flow: str, message: str
) -> None:
    line = connect(config, folder, stack, "una", opened_but_for(access_control("demo", ROLES)))
    assert line.passed(flow, message) >= {"state", "goal/bob", "cmd/ME/reset", "alive", "role/bob", "../other/state"}


@pytest.mark.parametrize(
    "key", ["info", "poses", *(key for key in KEYS if "/ME" in key and key not in ("here/ME", "cmd/ME/dance"))]
)
def test_a_client_is_told_the_least_role_that_may(key: str) -> None:
    may = [role for role in Role if key in allowed(role, "ingress", "query")]
    assert least_role(*key.split("/")) is may[0]
    assert all(role.includes(may[0]) == (role in may) for role in Role)


def test_a_service_never_asks_its_clients() -> None:
    rules = access_control("demo", ROLES)["rules"]
    sent = {(flow, message) for rule in rules for flow in rule["flows"] for message in rule["messages"]}
    assert not sent & (UNSENT | {("egress", "query"), ("ingress", "reply"), ("ingress", "declare_queryable")})
