"""Sessions and descriptors that are nearly used up: whose session ends, and what is told, once."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import uncoded
from trirail.processes import sockets
from trirail.processes.zenoh_links import CHECK_PERIOD_S, PROTECTED_SESSIONS, LinkMonitor, surplus
from trirail.wire.messages import Notice

USERS = frozenset({"ann", "eva", "max"})
MOST = 100


@given(names=st.lists(st.sampled_from(["ann", "eva", "eva", "eva", "max", "gone", "una"]), max_size=MOST))
def test_the_newest_of_whom_has_most_end_and_no_more_than_are_too_many(names: list[str]) -> None:
    links = {f"at {number}": name for number, name in enumerate(names)}
    ending = surplus(links, USERS, MOST)
    before, left = Counter(names), Counter(name for at, name in links.items() if at not in ending)
    assert len(ending) <= max(0, len(links) - 90)
    if len(ending) < len(links) - 90:
        assert all(left[name] <= PROTECTED_SESSIONS for name in USERS)
        assert set(left) <= USERS
    for name in USERS:
        assert left[name] >= min(before[name], PROTECTED_SESSIONS)
        if left[name] < before[name]:  # nobody's without a role are left, and nobody has more
            assert set(left) <= USERS
            assert max(left.values()) <= left[name] + 1
    for name in before:
        own = [at for at, by in links.items() if by == name]
        assert [at for at in own if at in ending] == own[left[name] :]


class Crowd:
    """Links that come and go, before a clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.links: dict[str, str | None] = {}
        self.ended: list[str] = []
        self.told: list[Notice] = []
        self.descriptors = 10
        monkeypatch.setattr(sockets, "descriptors_used", lambda: self.descriptors)
        monkeypatch.setattr(sockets, "descriptor_limit", lambda: 1000)
        self.unopened: Counter[str] = Counter()
        self.crowding = LinkMonitor(
            lambda: self.links,
            self.ended.extend,
            USERS,
            MOST,
            self.told.append,
            lambda: self.now,
            lambda _: self.unopened,
        )

    def look(self, links: int, descriptors: int = 10, name: str | None = "eva") -> tuple[str, ...]:
        self.links = {f"at {number}": name for number in range(links)}
        self.descriptors = descriptors
        self.now += CHECK_PERIOD_S
        self.crowding.poll()
        return self.crowding.warnings()


@pytest.fixture
def crowd(monkeypatch: pytest.MonkeyPatch) -> Crowd:
    return Crowd(monkeypatch)


def test_what_is_nearly_used_up_is_told_once_and_warned_of_until_it_is_over(crowd: Crowd) -> None:
    assert crowd.look(79) == ()
    (warning,) = crowd.look(80)
    assert warning.startswith("80 of 100 sessions of the gateway are in use, 80 by eva")
    crowd.look(81)
    assert crowd.look(73) != ()
    assert crowd.look(71) == ()
    assert [remark.level for remark in crowd.told] == ["warning"]
    (warning,) = crowd.look(1, descriptors=800)
    assert warning.startswith("800 of 1000 descriptors")
    assert len(crowd.told) == 2
    assert crowd.crowding.use == (1, MOST, 800, 1000, 0)


def test_connections_that_open_no_session_are_told_once_with_the_wait_that_they_are(crowd: Crowd) -> None:
    crowd.unopened = Counter({"192.0.2.7": 15, "192.0.2.8": 4})
    assert crowd.look(1) == ()
    crowd.unopened["192.0.2.7"] = 600
    (warning,) = crowd.look(1)
    assert warning == (
        "604 connections to the gateway have not opened a session (600 from 192.0.2.7): new ones wait 60 s; stops do "
        "not"
    )
    assert crowd.crowding.use.unopened == 604
    crowd.unopened = Counter({"192.0.2.7": 18})
    assert len(crowd.look(1)) == 1
    crowd.unopened = Counter({"192.0.2.7": 17})
    assert crowd.look(1) == ()
    assert uncoded(crowd.told) == [Notice("service", "warning", warning)]


def test_who_shows_no_certificate_is_told_of_and_not_ended(crowd: Crowd) -> None:
    (warning,) = crowd.look(100, name=None)
    assert "100 of 100 sessions of the gateway are in use: " in warning
    assert crowd.ended == []
    crowd.look(100)
    assert len(crowd.ended) == 10


def test_it_is_not_looked_more_often_than_is_said(crowd: Crowd) -> None:
    crowd.look(90)
    crowd.links = {}
    crowd.crowding.poll()
    assert crowd.crowding.use.sessions == 90
