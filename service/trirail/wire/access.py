"""Permissions on the network, as rules for Zenoh's access control that are derived from the users' roles.

Zenoh applies one set of rules to each common name in a certificate, and another set to every certificate. Zenoh drops a
message that no rule allows, and does not inform the sender. A rule applies to one direction. The robot's publications
may leave the service but not enter it, so no user can forge a state, event or reply. Queries of clients may enter the
service but not leave it. A rule applies to a message if the rule's key expression includes the key expression of the
message; permission for `goal/ann` therefore does not permit `goal/*`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from trirail.wire.vocabulary import Command, Role
from trirail.wire.zenoh_session import key

GOAL_ROLE = Role.OPERATOR
"""Lowest role that may send and check goals, and report the looks of an alignment, since an alignment sends goals."""
POSE_ROLE = Role.MAINTAINER
"""Lowest role that may teach and remove poses."""

PUBLISHED = ("state", "summary", "event", "records")
"""Keys on which only the robot publishes."""

_Rule = dict[str, Any]


def least_role(*parts: str) -> Role:
    """Return the lowest role that may query the key that consists of `parts`, such as ("cmd", user, "enable")."""
    if parts[0] in ("goal", "check", "alignment"):
        return GOAL_ROLE
    if parts[0] in ("teach", "forget"):
        return POSE_ROLE
    return Command(parts[2]).role if parts[0] == "cmd" else Role.VIEWER


def access_control(robot: str, users: Mapping[str, Role], router: str | None = None) -> dict[str, Any]:
    """Return the section access_control of Zenoh's configuration for the service of a robot.

    Users can send messages only under their own name, because the key of a message contains the user's name and the
    rule for this key applies only to the certificate with the same common name. The owner of
    any certificate may query the role of a user name, so that a user whose requests are denied can find out that the
    role does not permit them. Messages through a router do not carry a user's certificate. The service therefore lets
    the router send under every name, and the router enforces the rules of its users.
    """
    asking, using = list(_certificate_rules(robot)), list(_viewer_rules(robot))
    rules, policies = asking + using, [_policy("every certificate", asking)]
    if router is not None:
        through = list(_router_rules(robot))
        rules += through
        policies.append(_policy(router, using + through))
    for user, role in users.items():
        own = list(_user_rules(robot, user, role))
        rules += own
        policies.append(_policy(user, using + own))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {"id": "every certificate", "link_protocols": ["tls"]},  # cannot be a user, since names have no spaces
            *map(_subject, (*users, *([router] if router is not None else []))),
        ],
        "policies": policies,
    }


def router_access_control(
    behind: Mapping[str, Sequence[str]], users: Mapping[str, Role], router: str | None = None
) -> dict[str, Any]:
    """Return the section access_control of Zenoh's configuration for a router between robots and users.

    Parameters
    ----------
    behind
        Names of the robots that can be reached through each peer of the router, by the peer's common name. A peer is a
        robot, which reaches only itself, or another router. The rules for a peer mirror the rules of a robot for its
        router, but only for the keys of these robots.
    users
        Roles of the users, which apply to every robot. The robot, not the router, answers queries for a role.
    router
        Common name of another router to which this router connects.
    """
    section = access_control("*", users, router)
    for name, robots in behind.items():
        through: list[_Rule] = []
        for robot in robots:
            rules = (*_certificate_rules(robot), *_viewer_rules(robot), *_router_rules(robot))
            through += [_mirrored(f"{name}: {robot}", rule) for rule in rules]
        section["rules"] += through
        section["policies"].append(_policy(name, through))
        section["subjects"].append(_subject(name))
    return section


def _certificate_rules(robot: str) -> Iterator[_Rule]:
    role = key(robot, "role", "*")
    yield _rule("ask for a role", "ingress", ("query",), role)
    yield _rule("answer with a role", "egress", ("declare_queryable", "reply"), role)


def _router_rules(robot: str) -> Iterator[_Rule]:
    """Yield the rules that apply only to a router, which may forward messages of every user, and of other services."""
    yield from _user_rules(robot, "*", Role.MAINTAINER)
    run = key(robot, "run", "*")
    yield _rule("watch other services", "egress", ("declare_liveliness_subscriber", "liveliness_token"), run)
    yield _rule("other services are there", "ingress", ("liveliness_token",), run)


def _mirrored(name: str, rule: _Rule) -> _Rule:
    """Return the matching rule for the other end of the connection.

    The direction is reversed, and the id begins with `name`.
    """
    (flow,) = rule["flows"]
    return rule | {"id": f"{name}: {rule['id']}", "flows": ["egress" if flow == "ingress" else "ingress"]}


def _viewer_rules(robot: str) -> Iterator[_Rule]:
    """Yield the rules for every user: a viewer's permissions for keys without a user name, and the robot's replies."""
    published = [key(robot, name) for name in PUBLISHED]
    # Keys of Zenoh's advanced publisher, with its history, its liveliness token and the number of its last event.
    past, alive = key(robot, "event", "@adv", "**"), key(robot, "alive")
    info_keys = [key(robot, "info"), key(robot, "poses")]
    taught = [key(robot, name, "*", "*") for name in ("teach", "forget")]
    sent = [key(robot, name, "*") for name in ("goal", "check", "alignment")]
    asked = [*sent, key(robot, "cmd", "*", "*"), *taught, *info_keys]
    yield _rule("publish", "egress", ("put",), *published, past)
    yield _rule("subscribe", "ingress", ("declare_subscriber",), *published, past)
    # A fleet client subscribes to all robots with one key expression. This service sends only its own publications.
    yield _rule("subscribe to all", "ingress", ("declare_subscriber",), *(key("*", name) for name in PUBLISHED))
    yield _rule("ask", "ingress", ("query",), *info_keys, past)
    yield _rule("listen", "egress", ("declare_queryable",), *asked, past)
    yield _rule("listen to puts", "egress", ("declare_subscriber",), key(robot, "goal", "*"))
    yield _rule("answer", "egress", ("reply",), *asked, past, *published)
    # Clients query the liveliness of all robots with one key expression. This service sends only its own token.
    presence = ("liveliness_query", "declare_liveliness_subscriber")
    here = key(robot, "here", "*")
    yield _rule("look who is there", "ingress", presence, key("*", "alive"), here, past)
    yield _rule("be there", "egress", ("liveliness_token", "reply"), alive, here, past)


def _user_rules(robot: str, user: str, role: Role) -> Iterator[_Rule]:
    """Yield the rules for keys that contain a user's name."""
    commands = [key(robot, "cmd", user, command) for command in Command if role.includes(command.role)]
    yield _rule(f"{user} commands", "ingress", ("query",), *commands)
    yield _rule(f"{user} is there", "ingress", ("liveliness_token",), key(robot, "here", user))
    if role.includes(POSE_ROLE):
        poses = [key(robot, name, user, "*") for name in ("teach", "forget")]
        yield _rule(f"{user} teaches poses", "ingress", ("query",), *poses)
    if role.includes(GOAL_ROLE):
        yield _rule(f"{user} sends goals", "ingress", ("query", "put"), key(robot, "goal", user))
        yield _rule(f"{user} checks goals", "ingress", ("query",), key(robot, "check", user))
        yield _rule(f"{user} aligns", "ingress", ("query",), key(robot, "alignment", user))


def _rule(name: str, flow: str, messages: tuple[str, ...], *keys: str) -> _Rule:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys)}


def _subject(name: str) -> dict[str, Any]:
    return {"id": name, "link_protocols": ["tls"], "cert_common_names": [name]}


def _policy(subject: str, rules: Iterable[_Rule]) -> dict[str, list[str]]:
    return {"rules": [rule["id"] for rule in rules], "subjects": [subject]}
