"""`trirail keys`: what it makes is good for what it says, private, whole or not there, and never given twice."""

from __future__ import annotations

import json
import os
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest
from control_rig import CONFIG
from cyclopts import CycloptsError
from trirail.cli import app, doctor, key_folder, probes, terminal
from trirail.cli.key_folder import KeyFolder
from trirail.config import Tls, Zenoh
from trirail.errors import RefusedError, ServiceError
from trirail.processes.session_guard import Guard
from trirail.wire.certificates import AUTHORITY_DAYS, Pair, authority, issue
from trirail.wire.credentials import Credentials, revoked
from trirail.wire.sizes import MAX_NAME
from trirail.wire.vocabulary import Role


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def keys(*arguments: str) -> int:
    return int(app.app(["keys", *arguments], exit_on_error=False, print_error=False, result_action="return_value"))


def test_robot_and_user_get_what_they_need(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert keys("init", "--robot", "demo", "--address", "192.0.2.7", "--address", "robot.example.org") == 0
    assert keys("add", "ann", "--role", "operator", "--days", "90") == 0
    said = capsys.readouterr().out
    assert '[zenoh.users]\n    ann = "operator"' in said
    robot, ann = Credentials.read(here / "keys"), Credentials.read(here / "keys/users/ann")
    assert robot.name == "demo"
    assert {"192.0.2.7", "robot.example.org", "127.0.0.1", "localhost"} <= set(robot.addresses)
    assert (ann.name, ann.addresses) == ("ann", ())
    assert abs(ann.expires - datetime.now(UTC) - timedelta(days=90)) < timedelta(minutes=1)


@pytest.mark.parametrize("length", [1, 54, 55, MAX_NAME])
def test_every_name_of_a_robot_is_good_for_certificates(here: Path, length: int) -> None:
    name = "r" * length
    assert keys("init", "--robot", name) == 0
    assert keys("robot", "x" * length) == 0
    assert keys("add", "u" * length, "--role", "viewer") == 0
    assert Credentials.read(here / "keys").name == name


def test_openssl_finds_each_good_for_its_purpose_and_no_other(here: Path) -> None:
    keys("init")
    keys("add", "ann", "--role", "viewer")

    def good(folder: str, purpose: str) -> bool:
        command = ("openssl", "verify", "-x509_strict", "-CAfile", "keys/ca.pem", "-purpose", purpose)
        return subprocess.run([*command, f"{folder}/cert.pem"], capture_output=True, check=False).returncode == 0

    assert good("keys", "sslserver")
    assert good("keys", "sslclient")
    assert good("keys/users/ann", "sslclient")
    assert not good("keys/users/ann", "sslserver")  # nobody passes himself off as the robot


def test_private_keys_are_for_their_owner_alone(here: Path) -> None:
    before = os.umask(0)
    try:
        keys("init")
        keys("add", "ann", "--role", "viewer")
        keys("renew", "ann")
    finally:
        os.umask(before)
    private = sorted(here.rglob("*key.pem"))
    assert len(private) == 3
    assert {path.stat().st_mode & 0o777 for path in private} == {0o600}
    assert {path.stat().st_mode & 0o022 for path in here.rglob("*")} == {0}


def test_renewing_keeps_the_key_and_the_addresses(here: Path) -> None:
    keys("init", "--address", "192.0.2.7", "--days", "20")
    keys("add", "ann", "--role", "viewer", "--days", "20")
    (here / "keys/users/ann/key.pem").rename(here / "kept.pem")  # he has it, so it need not be here
    for name, folder in (("ann", here / "keys/users/ann"), ("demo", here / "keys")):
        assert keys("renew", name, "--days", "300") == 0
        if name == "ann":
            (here / "kept.pem").rename(folder / "key.pem")
        credentials = Credentials.read(folder)
        assert credentials.expires - datetime.now(UTC) > timedelta(days=299)
        assert credentials.warning() == ""
    assert "192.0.2.7" in Credentials.read(here / "keys").addresses


@pytest.mark.parametrize("left", [-1, 20])
def test_no_certificate_lives_longer_than_its_authority(
    here: Path, capsys: pytest.CaptureFixture[str], left: int
) -> None:
    ends = datetime.now(UTC) + timedelta(days=left)
    by = authority("demo", ends - timedelta(days=AUTHORITY_DAYS))
    keys("init")
    for name, content in (("ca.pem", by.certificate), ("ca-key.pem", by.key)):
        (here / "keys" / name).write_bytes(content)
    tried = (("renew", "demo", "--days", "100"), ("add", "ann", "--role", "viewer", "--days", "100"))
    if left < 0:
        for arguments in tried:
            with pytest.raises(ServiceError, match=r"the authority expired on .*: create a new one in another folder"):
                keys(*arguments)
        return
    for arguments in tried:
        capsys.readouterr()
        keys(*arguments)
        assert f"valid until {ends:%Y-%m-%d}" in capsys.readouterr().out
    capsys.readouterr()
    keys("list", "--json")
    shown = [each["expires"] for each in json.loads(capsys.readouterr().out)["certificates"]]
    assert [each[:10] for each in shown] == [f"{ends:%Y-%m-%d}"] * 2


def test_who_is_revoked_is_never_made_again(here: Path) -> None:
    keys("init")
    keys("add", "ann", "--role", "viewer")
    keys("add", "eva", "--role", "viewer")
    assert keys("revoke", "ann") == 0
    assert keys("revoke", "eva") == 0
    assert revoked(here / "keys") == {"ann", "eva"}
    with pytest.raises(ServiceError, match="ann was revoked"):
        keys("add", "ann", "--role", "viewer")


def test_a_user_whose_folder_was_moved_away_is_revoked_by_name(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keys("init")
    keys("add", "ann", "--role", "viewer")
    keys("add", "eva", "--role", "viewer")
    (here / "keys/users/ann").rename(here / "her-machine")
    capsys.readouterr()
    assert keys("revoke", "ann") == 0
    assert "keys has no folder of ann: check that this is the name" in capsys.readouterr().out
    assert keys("revoke", "eva") == 0
    assert "no folder" not in capsys.readouterr().out
    with pytest.raises(RefusedError, match="not a valid name"):
        keys("revoke", "bob\nmax")
    assert revoked(here / "keys") == {"ann", "eva"}
    with pytest.raises(ServiceError, match="ann was revoked"):
        keys("add", "ann", "--role", "viewer")


def test_an_authority_whose_robot_has_its_certificate_elsewhere_serves_all_users(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keys("init", "--robot", "demo")
    (here / "usb").mkdir()
    for name in ("ca.pem", "ca-key.pem"):
        (here / "keys" / name).rename(here / "usb" / name)
    away = ("--folder", "usb")
    assert keys("add", "ann", "--role", "viewer", *away) == 0
    assert keys("renew", "ann", *away) == 0
    for words in (("add", "demo", "--role", "viewer"), ("revoke", "demo")):
        with pytest.raises(ServiceError, match="demo is the "):
            keys(*words, *away)
    capsys.readouterr()
    assert keys("list", "--json", *away) == 0
    assert [each["name"] for each in json.loads(capsys.readouterr().out)["certificates"]] == ["ann"]
    assert keys("revoke", "ann", *away) == 0
    assert revoked(here / "usb") == {"ann"}


def test_a_damaged_certificate_of_one_user_does_not_keep_others_from_being_revoked(here: Path) -> None:
    keys("init")
    for name in ("ann", "bob"):
        keys("add", name, "--role", "viewer")
    (here / "keys/users/ann/cert.pem").write_bytes(b"-----BEGIN CERT")
    assert keys("renew", "bob") == 0
    assert keys("revoke", "bob") == 0
    assert keys("revoke", "ann") == 0
    assert revoked(here / "keys") == {"ann", "bob"}
    assert list((here / "keys/users").iterdir()) == []


def test_what_there_is_is_listed(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keys("init", "--robot", "demo")
    keys("add", "ann", "--role", "viewer")
    keys("add", "eva", "--role", "viewer")
    keys("revoke", "eva")
    capsys.readouterr()
    assert keys("list", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [(each["name"], each["robot"]) for each in found["certificates"]] == [("demo", True), ("ann", False)]
    assert found["revoked"] == ["eva"]
    assert keys("list") == 0
    assert "eva    revoked" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("init",), "keys already exists"),
        (("add", "ann", "--role", "viewer"), "users/ann already exists: extend the certificate with"),
        (("add", "demo", "--role", "viewer"), "demo is the name of the robot"),
        (("renew", "bob"), "there is no user bob"),
        (("revoke", "demo"), "demo is the robot itself, and cannot be revoked"),
        (("list", "--folder", "none"), "none/cert.pem: No such file or directory"),
        (("add", "bob", "--role", "viewer", "--folder", "none"), "none/cert.pem: No such file or directory"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(here: Path, arguments: tuple[str, ...], said: str) -> None:
    keys("init", "--robot", "demo")
    keys("add", "ann", "--role", "viewer")
    before = {path: path.read_bytes() for path in here.rglob("*.*") if path.is_file()}
    with pytest.raises(ServiceError) as caught:
        keys(*arguments)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert {path: path.read_bytes() for path in here.rglob("*.*") if path.is_file()} == before


@pytest.mark.parametrize("days", ["0", "1e-9", "3651"])
@pytest.mark.parametrize("command", ["init", "add bob --role viewer", "robot second", "renew ann"])
def test_days_that_no_certificate_can_have_change_no_file(here: Path, command: str, days: str) -> None:
    folder = "new" if command == "init" else "keys"
    keys("init", "--robot", "demo")
    keys("add", "ann", "--role", "viewer")
    before = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    with pytest.raises(CycloptsError, match=r"use 0\.01 to 3650"):
        keys(*command.split(), "--days", days, "--folder", folder)
    assert {path: path.read_bytes() for path in here.rglob("*") if path.is_file()} == before


def test_a_folder_is_whole_or_not_there(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[Path] = []
    write = key_folder._write

    def full_disk(file: Path, content: bytes, mode: int) -> None:
        written.append(file)
        if len(written) == 3:
            raise OSError(28, "No space left on device", str(file))
        write(file, content, mode)

    monkeypatch.setattr(key_folder, "_write", full_disk)
    with pytest.raises(ServiceError, match="No space left on device"):
        KeyFolder(here / "keys").create("demo", ["localhost"], 10.0)
    assert list(here.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("key.pem", None, "key.pem: No such file or directory; trirail keys creates"),
        ("cert.pem", b"not PEM", "must be PEM"),
        ("key.pem", "other", "key.pem is not the key of cert.pem"),
        ("ca.pem", "other", "cert.pem is not signed by the authority of ca.pem"),
    ],
)
def test_credentials_that_do_not_fit_are_refused(here: Path, name: str, content: bytes | str | None, said: str) -> None:
    keys("init")
    keys("init", "--folder", "others")
    keys("add", "ann", "--role", "viewer")
    file = here / "keys/users/ann" / name
    file.unlink()
    if content is not None:
        file.write_bytes(content if isinstance(content, bytes) else (here / "others" / name).read_bytes())
    with pytest.raises(ServiceError) as caught:
        Credentials.read(here / "keys/users/ann")
    assert said in str(caught.value)


def test_the_end_is_told_thirty_days_before(here: Path) -> None:
    keys("init")
    keys("add", "ann", "--role", "viewer", "--days", "100")
    credentials = Credentials.read(here / "keys/users/ann")
    assert credentials.warning(credentials.expires - timedelta(days=30, minutes=1)) == ""
    said = credentials.warning(credentials.expires - timedelta(days=29, hours=23))
    assert said.endswith("users/ann: expires in 29 days; renew it with: trirail keys renew")
    for left, words in ((timedelta(hours=23, minutes=30), "23 h 30 min"), (timedelta(minutes=-1), "0 h 0 min")):
        assert f" expires in {words};" in credentials.warning(credentials.expires - left)
    with pytest.raises(ServiceError, match="expired on"):
        Credentials.read(here / "keys/users/ann", credentials.expires + timedelta(seconds=1))
    with pytest.raises(ServiceError, match=r"check this machine.s clock"):
        Credentials.read(here / "keys/users/ann", datetime.now(UTC) - timedelta(days=1))


def test_what_is_expired_and_who_has_no_certificate_stand_out(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal.out, "width", 200)
    keys("init")
    for name in ("ann", "bob"):
        keys("add", name, "--role", "viewer")
    keys("robot", "left")
    by = Pair((here / "keys/ca.pem").read_bytes(), (here / "keys/ca-key.pem").read_bytes())
    past = issue(by, "ann", 1.0, now=datetime.now(UTC) - timedelta(days=2))
    (here / "keys/users/ann/cert.pem").write_bytes(past.certificate)
    (here / "keys/users/ghost").mkdir()
    keys("add", "half", "--role", "viewer")
    damaged = here / "keys/users/half/cert.pem"
    damaged.write_bytes(damaged.read_bytes()[:100])
    capsys.readouterr()
    assert keys("list", "--json") == 0
    listed = {each["name"]: each for each in json.loads(capsys.readouterr().out)["certificates"]}
    troubles = {
        "demo": "",
        "ann": "expired: trirail keys renew ann makes a new one",
        "bob": "",
        "ghost": "no valid cert.pem: delete keys/users/ghost, then trirail keys add ghost --role ROLE",
        "half": "no valid cert.pem: delete keys/users/half, then trirail keys add half --role ROLE",
        "left": "",
    }
    assert {name: each["trouble"] for name, each in listed.items()} == troubles
    assert [name for name, each in listed.items() if each["robot"]] == ["demo", "left"]
    assert keys("list") == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert all(trouble in lines[name] for name, trouble in troubles.items())

    users = dict.fromkeys(("ann", "bob", "ghost", "nobody"), Role.VIEWER)
    zenoh = Zenoh(listen=("tls/127.0.0.1:7447",), tls=Tls(str(here / "keys")), users=users)
    config = msgspec.structs.replace(CONFIG, zenoh=zenoh)
    told = doctor.without_certificate(Guard(config).users, probes.issued(config))
    assert [(check.verdict, check.found) for check in told] == [
        ("warning", f"ann cannot connect: {troubles['ann']}"),
        ("warning", f"ghost cannot connect: {troubles['ghost'].replace('keys/users', f'{here}/keys/users')}"),
        ("warning", "nobody has a role, but this machine has no copy of a certificate of nobody"),
    ]
    (here / "keys/ca-key.pem").unlink()  # the authority is on another machine
    assert doctor.without_certificate(Guard(config).users, probes.issued(config)) == []


@pytest.mark.parametrize(
    "address", ["not an address!", "192.0.2.7:7447", "tls/192.0.2.7", "300.0.0.1", "a..b", "-a", ""]
)
@pytest.mark.parametrize("words", [("init",), ("robot", "left")])
def test_an_address_that_is_none_is_refused(here: Path, words: tuple[str, ...], address: str) -> None:
    with pytest.raises(CycloptsError, match="is not a host name or IP address such as"):
        keys(*words, f"--address={address}")
    assert list(here.iterdir()) == []
