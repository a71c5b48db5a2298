"""Who may do what on the network: the roles, and Zenoh's access control made of them.

Zenoh has one set of rules for each certificate's common name and one for every certificate; what no rule allows is
dropped, without a word to whoever sent it. Each direction is a rule of its own: what the robot publishes may leave and
not come in, so nobody else's state, event or answer reaches a client; what clients ask may come in and not leave.
A rule holds where its key includes the message's: who asks for `goal/*` is not allowed for being allowed `goal/ann`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from trirail.wire.vocabulary import Command, Role
from trirail.wire.zenoh_session import key

GOALS = Role.OPERATOR
"""The least role that may send goals, and tell of the looks of an alignment, which sends some."""
POSES = Role.MAINTAINER
"""The least role that may teach and remove poses."""

PUBLISHED = ("state", "summary", "event", "records")
"""What the robot alone publishes."""

_Rule = dict[str, Any]


def least_role(*parts: str) -> Role:
    """Return the least role that may use the resource of these parts of a robot's key, as ("cmd", user, "enable")."""
    if parts[0] in ("goal", "alignment"):
        return GOALS
    if parts[0] in ("teach", "forget"):
        return POSES
    return Command(parts[2]).role if parts[0] == "cmd" else Role.VIEWER


def access_control(robot: str, users: Mapping[str, Role], router: str | None = None) -> dict[str, Any]:
    """Return section access_control of Zenoh's configuration for the service of a robot with these users.

    A user sends in his own name only: the key has it, and the rule is for the certificate of that common name. Every
    certificate may ask for its role, so that who is denied all else can learn why. What comes through a router has no
    user's certificate: the certificate of that common name may all, in every name, and has its users' rules itself.
    """
    asking, using = list(_of_every_certificate(robot)), list(_of_every_user(robot))
    rules, policies = asking + using, [_policy("every certificate", asking)]
    if router is not None:
        through = list(_of_router(robot))
        rules += through
        policies.append(_policy(router, using + through))
    for user, role in users.items():
        own = list(_of_user(robot, user, role))
        rules += own
        policies.append(_policy(user, using + own))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {"id": "every certificate", "link_protocols": ["tls"]},  # no user is called so: his name has no space
            *map(_subject, (*users, *([router] if router is not None else []))),
        ],
        "policies": policies,
    }


def router_access_control(
    behind: Mapping[str, Sequence[str]], users: Mapping[str, Role], router: str | None = None
) -> dict[str, Any]:
    """Return section access_control for a router between robots and users.

    Its users may with every robot what they may with one. `behind` has who dials it: a robot with itself, or another
    router with the robots behind that. Either may what robots let their router do, the other way round, and that with
    keys of these robots only. The robot that is asked tells a user's role. `router` is one that it dials itself, as a
    robot does.
    """
    section = access_control("*", users, router)
    for name, robots in behind.items():
        through: list[_Rule] = []
        for robot in robots:
            rules = (*_of_every_certificate(robot), *_of_every_user(robot), *_of_router(robot))
            through += [_mirrored(f"{name}: {robot}", rule) for rule in rules]
        section["rules"] += through
        section["policies"].append(_policy(name, through))
        section["subjects"].append(_subject(name))
    return section


def _of_every_certificate(robot: str) -> Iterator[_Rule]:
    role = key(robot, "role", "*")
    yield _rule("ask for a role", "ingress", ("query",), role)
    yield _rule("answer with a role", "egress", ("declare_queryable", "reply"), role)


def _of_router(robot: str) -> Iterator[_Rule]:
    """Yield what only a router may beside what every user may: pass on what users send, in the name of each."""
    yield from _of_user(robot, "*", Role.MAINTAINER)


def _mirrored(name: str, rule: _Rule) -> _Rule:
    """A rule of a robot's, as its other side has it: what may leave here comes in there."""
    (flow,) = rule["flows"]
    return rule | {"id": f"{name}: {rule['id']}", "flows": ["egress" if flow == "ingress" else "ingress"]}


def _of_every_user(robot: str) -> Iterator[_Rule]:
    """Yield what a viewer may, but for what has his name in its key; and what the robot may send to him."""
    published = [key(robot, name) for name in PUBLISHED]
    # Of the advanced publisher: its past, that it is there, and the number of its last event.
    past, alive = key(robot, "event", "@adv", "**"), key(robot, "alive")
    told = [key(robot, "info"), key(robot, "poses")]
    taught = [key(robot, name, "*", "*") for name in ("teach", "forget")]
    asked = [key(robot, "goal", "*"), key(robot, "alignment", "*"), key(robot, "cmd", "*", "*"), *taught, *told]
    yield _rule("publish", "egress", ("put",), *published, past)
    yield _rule("subscribe", "ingress", ("declare_subscriber",), *published, past)
    # A fleet's clients subscribe to all robots at once; what they then see of this one is its own.
    yield _rule("subscribe to all", "ingress", ("declare_subscriber",), *(key("*", name) for name in PUBLISHED))
    yield _rule("ask", "ingress", ("query",), *told, past)
    yield _rule("listen", "egress", ("declare_queryable",), *asked, past)
    yield _rule("listen to puts", "egress", ("declare_subscriber",), key(robot, "goal", "*"))
    yield _rule("answer", "egress", ("reply",), *asked, past, *published)
    # Clients look for every robot's at once; what they then see of this one is its own.
    looked = ("liveliness_query", "declare_liveliness_subscriber")
    here = key(robot, "here", "*")
    yield _rule("look who is there", "ingress", looked, key("*", "alive"), here, past)
    yield _rule("be there", "egress", ("liveliness_token", "reply"), alive, here, past)


def _of_user(robot: str, user: str, role: Role) -> Iterator[_Rule]:
    """Yield what has a user's name in its key."""
    commands = [key(robot, "cmd", user, command) for command in Command if role.includes(command.role)]
    yield _rule(f"{user} commands", "ingress", ("query",), *commands)
    yield _rule(f"{user} is there", "ingress", ("liveliness_token",), key(robot, "here", user))
    if role.includes(POSES):
        poses = [key(robot, name, user, "*") for name in ("teach", "forget")]
        yield _rule(f"{user} teaches poses", "ingress", ("query",), *poses)
    if role.includes(GOALS):
        yield _rule(f"{user} sends goals", "ingress", ("query", "put"), key(robot, "goal", user))
        yield _rule(f"{user} aligns", "ingress", ("query",), key(robot, "alignment", user))


def _rule(name: str, flow: str, messages: tuple[str, ...], *keys: str) -> _Rule:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys)}


def _subject(name: str) -> dict[str, Any]:
    return {"id": name, "link_protocols": ["tls"], "cert_common_names": [name]}


def _policy(subject: str, rules: Iterable[_Rule]) -> dict[str, list[str]]:
    return {"rules": [rule["id"] for rule in rules], "subjects": [subject]}
