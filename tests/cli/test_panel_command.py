"""`trirail panel` before it serves: it waits for its service, and its address can be fixed by a file."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.cli.panel_command import read_token, wait_for_robot
from trirail.errors import ConfigError, RefusalCode, RefusedError, ServiceError


def robot(closed: list[bool], answers: bool) -> Any:
    def info() -> None:
        if not answers:
            raise ServiceError("nobody answers")

    return closing(cast(Any, SimpleNamespace(info=info, close=lambda: closed.append(True))))


@given(st.lists(st.sampled_from(["absent", "silent"]), max_size=4))
def test_it_waits_for_a_service_that_is_not_up_yet(states: list[str]) -> None:
    closed: list[bool] = []
    waited: list[float] = []
    up = robot(closed, True)
    coming = iter([*states, "up"])

    def open_session() -> Any:
        state = next(coming)
        if state == "absent":
            raise ServiceError("no service at tcp/127.0.0.1:7447")
        return up if state == "up" else robot(closed, False)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("trirail.cli.panel_command.time.sleep", waited.append)
        wait_for_robot(cast(Any, SimpleNamespace(open=open_session)))
    assert len(waited) == len(states)
    assert len(closed) == states.count("silent") + 1


def test_a_refusal_is_not_waited_for() -> None:
    def open_session() -> Any:
        raise RefusedError(RefusalCode.NOT_ALLOWED, "the certificate is of another robot")

    with pytest.raises(RefusedError):
        wait_for_robot(cast(Any, SimpleNamespace(open=open_session)))


def test_a_token_is_made_once_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "panel.token"
    token = read_token(file)
    assert len(token) >= 16
    assert file.stat().st_mode & 0o777 == 0o600
    assert read_token(file) == token


def test_a_token_that_others_may_read_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "panel.token"
    read_token(file)
    file.chmod(0o640)
    with pytest.raises(ConfigError, match=r"other users can read this token \(mode 640\): run chmod 600"):
        read_token(file)


@pytest.mark.parametrize("text", ["", "short", "with space in it 1234", "slash/slash/slash/slash", "ü" * 20])
def test_a_file_without_a_token_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "panel.token"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(ConfigError, match="not a valid token"):
        read_token(file)


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere/token"):
        read_token(tmp_path / "nowhere" / "token")
