"""A router between robots and users, with real certificates: users have their roles there, robots obey it alone."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
import zenoh
from certificates import ROLES, user
from control_rig import CONFIG
from ports import free_port
from trirail.cli import router, router_command
from trirail.cli.key_folder import KeyFolder
from trirail.cli.router import RouterConfig
from trirail.config import Config, Tls, Zenoh
from trirail.errors import ConfigError, ServiceError
from trirail.processes.name_conflict import NameConflict
from trirail.processes.session_guard import Guard
from trirail.wire import zenoh_session
from trirail.wire.credentials import Credentials
from trirail.wire.vocabulary import Role
from waiting import WITHIN, wait_until

pytestmark = pytest.mark.long

ROBOTS = ("demo", "other")
LOCAL = ("127.0.0.1", "localhost")


class Net(NamedTuple):
    """A router's configuration, and where its authority's folder is."""

    config: RouterConfig
    folder: Path
    name: str = "hub"

    @property
    def locator(self) -> str:
        return self.config.zenoh.listen[0]

    def robot(self, name: str) -> Config:
        """A robot that dials it, and listens for users of its own."""
        own = Zenoh(
            listen=(f"tls/127.0.0.1:{free_port()}",), connect=(self.locator,), router=self.name,
            tls=Tls(str(user(self.folder, name))), users={"max": Role.MAINTAINER},
        )  # fmt: skip
        renamed = msgspec.structs.replace(CONFIG.robot, name=name)
        return msgspec.structs.replace(CONFIG, robot=renamed, zenoh=own)

    def session(self, name: str, locator: str = "") -> zenoh.Session:
        """A user's session, through the router if nothing else is said."""
        return zenoh_session.open_client(locator or self.locator, Credentials.read(user(self.folder, name)))


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Net:
    folder = tmp_path_factory.mktemp("net")
    keys = KeyFolder(folder / "keys")
    keys.create("hub", LOCAL, 100.0)
    for name in (*ROBOTS, "stray", "north"):
        keys.add(name, 100.0, LOCAL)
    for name in (*ROLES, "una"):
        keys.add(name, 100.0)
    listen = (f"tls/127.0.0.1:{free_port()}",)
    return Net(RouterConfig(Zenoh(listen=listen, tls=Tls(str(keys.folder)), users=ROLES), ROBOTS), folder)


@contextmanager
def routing(config: RouterConfig) -> Iterator[None]:
    """Route as zenohd does with the printed configuration."""
    with router_of(router.settings(config)):
        yield


def router_of(settings: dict[str, Any]) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(msgspec.json.encode(settings).decode()))


@pytest.fixture
def routed(net: Net) -> Iterator[Net]:
    with routing(net.config):
        yield net


def listening(session: zenoh.Session, key: str) -> Any:
    return session.declare_subscriber(key, zenoh.handlers.RingChannel(100))


def heard(subscriber: object, publish: object) -> str:
    """Publish until something is heard; return its key, "" for nothing."""
    enough = threading.Event()
    for _ in range(round(WITHIN / 0.1)):
        publish()  # type: ignore[operator]
        enough.wait(0.1)
        if (sample := subscriber.try_recv()) is not None:  # type: ignore[attr-defined]
            return str(sample.key_expr)
    return ""


def answers(session: zenoh.Session, key: str) -> list[bytes]:
    return [bytes(reply.ok.payload) for reply in session.get(key, timeout=WITHIN) if reply.ok]


def until_answered(session: zenoh.Session, key: str) -> bytes:
    """Ask until somebody answers."""
    enough = threading.Event()
    for _ in range(round(WITHIN / 0.1)):
        if found := answers(session, key):
            return found[0]
        enough.wait(0.1)
    raise AssertionError(f"nobody answers {key}")


class Robot:
    """A robot's session that dials the router, and answers what it is asked with its name."""

    def __init__(self, net: Net, name: str) -> None:
        self.config = net.robot(name)
        self.guard = Guard(self.config)
        self.session = self.guard.open()
        self.asked: list[str] = []
        for key in ("goal/*", "cmd/*/*", "info", "role/*"):
            callback = zenoh.handlers.Callback(self._answer, indirect=False)
            self.session.declare_queryable(zenoh_session.key(name, *key.split("/")), callback)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            self.asked.append(str(query.key_expr))
            query.reply(query.key_expr, self.config.robot.name.encode())

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None:
        zenoh_session.close(self.session)


def test_each_role_may_through_the_router_what_it_may_with_the_robot(routed: Net) -> None:
    with Robot(routed, "demo") as demo, Robot(routed, "other"):
        for name, role in ROLES.items():
            with routed.session(name) as session:
                for robot in ROBOTS:
                    assert until_answered(session, f"trirail/{robot}/info") == robot.encode()
                tried = {
                    "stop": Role.VIEWER, "enable": Role.OPERATOR, "reset": Role.MAINTAINER,
                }  # fmt: skip
                for command, least in tried.items():
                    found = answers(session, f"trirail/demo/cmd/{name}/{command}")
                    assert bool(found) == role.includes(least), (name, command)
                assert bool(answers(session, f"trirail/demo/goal/{name}")) == role.includes(Role.OPERATOR)
                assert not answers(session, "trirail/demo/cmd/bob/stop")  # nobody speaks in another's name
                assert answers(session, f"trirail/demo/role/{name}") == [b"demo"]  # the robot tells it
        assert not [key for key in demo.asked if "bob" in key]
        with routed.session("una") as session:
            assert until_answered(session, "trirail/demo/role/una") == b"demo"
            assert not answers(session, "trirail/demo/info")


def test_what_robots_publish_reaches_users_and_nobody_publishes_for_them(routed: Net) -> None:
    with Robot(routed, "demo") as demo, Robot(routed, "other") as other, routed.session("eva") as eva:
        for name in ("state", "summary", "event", "records"):
            subscriber = listening(eva, f"trirail/*/{name}")
            key = f"trirail/demo/{name}"
            assert heard(subscriber, partial(demo.session.put, key, b"x")) == key
        false = listening(eva, "trirail/demo/summary")
        with routed.session("max") as forger:
            for _ in range(5):
                forger.put("trirail/demo/summary", b"false")
                other.session.put("trirail/demo/summary", b"false")  # nor does another robot
        # An answer comes behind what was sent before it.
        until_answered(eva, "trirail/other/info")
        true = heard(false, lambda: demo.session.put("trirail/demo/summary", b"true"))
        assert true == "trirail/demo/summary"
        samples = []
        while (sample := false.try_recv()) is not None:
            samples.append(bytes(sample.payload))
        assert b"false" not in samples


def test_a_robot_obeys_its_router_alone_and_its_own_users(routed: Net) -> None:
    with Robot(routed, "demo") as demo:
        own = demo.config.zenoh.listen[0]
        with routed.session("max", own) as local:
            assert answers(local, "trirail/demo/cmd/max/reset")
        with routed.session("ann", own) as elsewhere:  # an operator at the router, nobody at the robot
            assert not answers(elsewhere, "trirail/demo/cmd/ann/enable")
        with routed.session("stray", own) as robot:
            assert not answers(robot, "trirail/demo/cmd/stray/enable")


def test_a_robot_is_there_before_its_router_and_after_it_is_gone(net: Net) -> None:
    with Robot(net, "demo") as demo:
        own = demo.config.zenoh.listen[0]
        for _ in range(2):
            with net.session("max", own) as local:
                assert answers(local, "trirail/demo/info") == [b"demo"]
            with routing(net.config), net.session("eva") as eva:
                assert until_answered(eva, "trirail/demo/info") == b"demo"


@pytest.mark.parametrize(
    ("impostor", "why"),
    [
        ("", "connection refused"),
        ("stray", "the server's certificate has the name stray, expected hub"),  # another robot's
        ("ann", "the server's certificate is not trusted: unsuitable certificate purpose"),  # a user's
    ],
)
def test_a_robot_says_why_it_has_no_router_and_obeys_nobody_in_its_place(net: Net, impostor: str, why: str) -> None:
    with ExitStack() as opened, Robot(net, "demo") as demo:
        assert demo.guard.linked(demo.session) == set()
        if impostor:
            theirs = Credentials.read(user(net.folder, impostor))
            opened.enter_context(router_of(zenoh_session.router([net.locator], theirs, None, [], {})))
        assert demo.guard.why_not_linked(net.locator).startswith(why)
        if impostor:  # it is dialled every 0.2 to 1 s
            with (
                zenoh_session.open_client(net.locator, Credentials.read(user(net.folder, "max")))
                if (impostor == "stray")
                else nullcontext() as asking
            ):
                threading.Event().wait(2.0)
                assert asking is None or not answers(asking, "trirail/demo/cmd/max/stop")
        assert demo.guard.linked(demo.session) == set()


@pytest.mark.core
def test_a_link_to_the_router_comes_and_goes(net: Net) -> None:
    with Robot(net, "demo") as demo:
        for there in (True, False):
            with routing(net.config) if there else nullcontext():
                enough = threading.Event()
                for _ in range(round(WITHIN / 0.1)):
                    if (demo.guard.linked(demo.session) == {net.locator}) is there:
                        break
                    enough.wait(0.1)
                assert demo.guard.linked(demo.session) == ({net.locator} if there else set())
                assert demo.guard.why_not_linked(net.locator) == ("" if there else "connection refused")


def test_routers_make_a_tree_and_each_speaks_for_its_own_robots_alone(net: Net) -> None:
    own = (f"tls/127.0.0.1:{free_port()}",)
    tls = Tls(str(user(net.folder, "north")))
    north = Net(RouterConfig(Zenoh(own, (net.locator,), "hub", tls=tls, users=ROLES), ROBOTS), net.folder, "north")
    top = RouterConfig(net.config.zenoh, routers={"north": ("demo",)})
    with (
        routing(top), routing(north.config), Robot(north, "demo") as demo, Robot(north, "other") as other,
        net.session("max") as above, net.session("eva") as eva, north.session("max") as below,
    ):  # fmt: skip
        assert until_answered(above, "trirail/demo/info") == b"demo"
        assert answers(above, "trirail/demo/cmd/max/reset") == [b"demo"]
        assert not answers(eva, "trirail/demo/cmd/eva/reset")
        assert answers(above, "trirail/demo/role/max") == [b"demo"]
        assert until_answered(below, "trirail/other/info") == b"other"
        assert not answers(above, "trirail/other/info")  # for the top, north does not speak for this one
        summaries = listening(eva, "trirail/*/summary")
        for _ in range(5):
            other.session.put("trirail/other/summary", b"x")
        assert heard(summaries, partial(demo.session.put, "trirail/demo/summary", b"x")) == "trirail/demo/summary"


def test_the_state_is_thinned_for_each_robot_by_itself(net: Net) -> None:
    config = msgspec.structs.replace(net.config, state_hz=0.01)
    with routing(config), Robot(net, "demo") as demo, Robot(net, "other") as other, net.session("eva") as eva:
        subscribers = [listening(eva, f"trirail/*/{name}") for name in ("state", "summary")]

        def publish() -> None:
            for robot in (demo, other):
                for name in ("state", "summary"):
                    robot.session.put(f"trirail/{robot.config.robot.name}/{name}", b"x")

        for robot in ROBOTS:
            until_answered(eva, f"trirail/{robot}/info")
        found: list[str] = []
        for _ in range(200):
            publish()
            threading.Event().wait(0.02)
            for subscriber in subscribers:
                while (sample := subscriber.try_recv()) is not None:
                    found.append(str(sample.key_expr))
            if min(found.count(f"trirail/{robot}/summary") for robot in ROBOTS) >= 10:
                break
        for robot in ROBOTS:
            assert found.count(f"trirail/{robot}/summary") >= 10
            assert found.count(f"trirail/{robot}/state") == 1  # the first; the next is due in 100 s


def test_two_robots_of_one_name_know_of_each_other_through_the_router(routed: Net) -> None:
    with Robot(routed, "demo") as one, Robot(routed, "demo") as two, Robot(routed, "other") as other:
        conflicts = [
            NameConflict(
                robot.session, robot.config.robot.name, run, partial(robot.guard.linked, robot.session),
                robot.guard.open_client, lambda _: None,
            )
            for run, robot in (("1", one), ("2", two), ("3", other))
        ]  # fmt: skip

        def known() -> list[bool]:
            for conflict in conflicts:
                conflict.poll()
            return [bool(conflict._tokens) for conflict in conflicts]

        wait_until(lambda: known() == [True, True, False])
        with routed.session("max") as forger, forger.liveliness().declare_token("trirail/other/run/4"):
            until_answered(forger, "trirail/other/info")
            assert known() == [True, True, False]  # users are no services
        for conflict in conflicts:
            conflict.close()


def test_what_is_printed_is_a_configuration_of_zenohd(
    net: Net, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "router.toml"
    file.write_text(
        f'robots = ["demo"]\n[zenoh]\nlisten = ["{net.locator}"]\n[zenoh.tls]\ndirectory = "{net.folder / "keys"}"\n'
    )
    assert router_command.router(file) == 0
    printed = capsys.readouterr().out
    whole = msgspec.json.decode(printed)
    assert whole["mode"] == "router"
    assert whole["access_control"]["default_permission"] == "deny"
    assert whole["transport"]["link"]["tls"]["enable_mtls"] is True
    zenoh.Config.from_json5(printed)  # raises for a key that Zenoh does not know


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('robots = ["demo"]', "zenoh: missing section"),
        ('robots = []\n[zenoh]\nlisten = ["tcp/127.0.0.1:1"]', "robots"),
        ('robots = ["a b"]\n[zenoh]\n', r"robots\[0\] = 'a b': expected"),
        ('robots = "demo"\n[zenoh]\n', "robots = 'demo': expected array of length 0 to 10000"),
        (
            'robots = ["demo"]\nodd = 1\n[zenoh]\n',
            "odd: unknown section; allowed are zenoh, robots, routers, state_hz",
        ),
        (
            'robots = ["demo"]\n[zenoh]\nlisten = "tls/x:1"',
            "listen = 'tls/x:1': expected array of length 1 to 64",
        ),
        (
            'robots = ["demo"]\n[zenoh]\nlisten = ["tls/x:1"]\n[zenoh.users]\nann = "boss"',
            "users.ann = 'boss': expected one of 'viewer'",
        ),
        ('state_hz = "fast"\nrobots = ["demo"]\n[zenoh]', "state_hz = 'fast': expected number > 0 and ≤ 200"),
        ('robots = ["demo"]\n[zenoh]\n[routers]\nnorth = 7', "routers.north = 7: expected array"),
        ('robots = ["demo"]\n[zenoh]\n[routers]\nnorth = ["a b"]', r"routers.north\[0\] = 'a b': expected"),
        ('robots = ["demo"]\n[zenoh]\nlisten = ["tcp/0.0.0.0:7447"]', "insecure = true"),
        (
            'robots = ["ann"]\n[zenoh]\nlisten = ["tls/0.0.0.0:7447"]\n[zenoh.tls]\n[zenoh.users]\nann = "viewer"',
            "names",
        ),
        ('robots = ["a"]\n[routers]\nnorth = ["b", "a"]\n[zenoh]', "a is given twice"),
        ("robots = [", "not TOML: Invalid"),
    ],
)
def test_a_routers_file_that_is_wrong_is_refused_with_its_name(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "router.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said) as refused:
        router.load(path)
    assert str(refused.value).startswith(str(path))
    assert "`" not in str(refused.value)
    assert " - at " not in str(refused.value)


def test_zenohd_finds_the_keys_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = 'robots = ["demo"]\n[zenoh]\nlisten = ["tls/127.0.0.1:7447"]\n[zenoh.tls]\ndirectory = "keys"'
    (tmp_path / "router.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    tls = router.load(Path("router.toml")).zenoh.tls
    assert tls is not None
    assert tls.directory == str(tmp_path / "keys")


@pytest.mark.parametrize("name", [ROBOTS[0], "north"])
def test_a_robot_or_router_that_is_revoked_is_not_let_in(net: Net, tmp_path: Path, name: str) -> None:
    """Its certificate may be in anybody's hands: who has it would answer in its name."""
    keys = KeyFolder(shutil.copytree(net.folder / "keys", tmp_path / "keys"))
    keys.revoke(name)
    zenoh_table = Zenoh(listen=(f"tls/127.0.0.1:{free_port()}",), tls=Tls(str(keys.folder)), users=ROLES)
    config = RouterConfig(zenoh_table, ROBOTS, {"north": ("far",)})
    with pytest.raises(ServiceError, match=f"{name}: revoked"), routing(config):
        pass
    without = msgspec.structs.replace(
        config,
        robots=tuple(robot for robot in config.robots if robot != name),
        routers={router: robots for router, robots in config.routers.items() if router != name},
    )
    with routing(without):
        pass


def test_neither_a_robot_nor_a_router_obeys_a_router_that_is_revoked(net: Net, tmp_path: Path) -> None:
    """Who has its certificate would send goals to the robot in the name of every user."""
    keys = KeyFolder(shutil.copytree(net.folder / "keys", tmp_path / "keys"))
    keys.revoke("north")
    own = Path(shutil.copytree(keys.folder, tmp_path / "own"))
    for name in ("cert.pem", "key.pem"):
        shutil.copy(user(tmp_path, "demo") / name, own / name)
    at = (f"tls/127.0.0.1:{free_port()}",)
    table = Zenoh(listen=at, connect=(net.locator,), router="north", tls=Tls(str(own)), users=ROLES)
    with pytest.raises(ServiceError, match=r"north: revoked, but still listed in zenoh\.router"):
        Guard(msgspec.structs.replace(CONFIG, zenoh=table))
    with pytest.raises(ServiceError, match="north: revoked, but still listed in robots, routers or"):
        router.settings(RouterConfig(table, ("far",)))
    Guard(msgspec.structs.replace(CONFIG, zenoh=msgspec.structs.replace(table, router="hub")))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("ann", "ann/cert.pem: the certificate of user ann is not valid for a robot or router"),
        ("demo", "demo: this is the certificate of demo, which is behind this router"),
        ("other", "other: this is the certificate of other, which is behind this router"),
    ],
)
def test_a_router_does_not_start_as_a_user_or_as_one_of_its_robots(net: Net, name: str, said: str) -> None:
    table = msgspec.structs.replace(net.config.zenoh, tls=Tls(str(user(net.folder, name))))
    behind = {"routers": {"north": ("other",)}, "robots": ("demo",)}
    with pytest.raises(ServiceError, match=said):
        router.settings(msgspec.structs.replace(net.config, zenoh=table, **behind))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("ann", "the certificate of user ann is not valid for a robot or router"),
        (
            "other",
            "the certificate has the name other, but a router accepts robot demo only with a certificate of the name "
            "demo",
        ),
    ],
)
def test_a_robot_does_not_start_as_a_user_nor_behind_a_router_as_another(net: Net, name: str, said: str) -> None:
    config = net.robot("demo")
    table = msgspec.structs.replace(config.zenoh, tls=Tls(str(user(net.folder, name))))
    with pytest.raises(ServiceError, match=said):
        Guard(msgspec.structs.replace(config, zenoh=table))


def test_a_router_that_cannot_start_has_no_configuration(
    net: Net, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "router.toml"
    ann = user(net.folder, "ann")
    file.write_text(f'robots = ["demo"]\n[zenoh]\nlisten = ["tls/127.0.0.1:1"]\n[zenoh.tls]\ndirectory = "{ann}"\n')
    with pytest.raises(ServiceError, match="the certificate of user ann"):
        router_command.router(file)
    assert capsys.readouterr().out == ""
