"""Signs of life, counted by who watches: in its own turns, from the first beat to the last."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from trirail.processes.heartbeats import PROCESSES, Effort, HangWatch, Heartbeats, Watch


def test_each_process_has_its_own_and_all_share_them() -> None:
    one = Heartbeats.create()
    other = Heartbeats(one.descriptor)
    for name in PROCESSES:
        assert other.heart(name).count == 0
        one.heart(name).beat()
        assert other.heart(name).count > 0
    one.heart("loop").rest()
    assert [name for name in PROCESSES if not other.heart(name).count] == ["loop"]


ACTIONS = st.lists(st.sampled_from(["beat", "rest"]), max_size=4)
"""What a process and those after it do between two checks: a restart is a rest before a beat."""


@given(patience=st.integers(1, 10), turns=st.lists(ACTIONS, max_size=60))
def test_it_is_silent_after_more_checks_than_there_is_patience(patience: int, turns: list[list[str]]) -> None:
    heart = Heartbeats.create().heart("gateway")
    watch = Watch(heart, patience)
    silence: int | None = None
    for actions in turns:
        for action in actions:
            getattr(heart, action)()
        if actions:
            silence = 0 if actions[-1] == "beat" else None
        elif silence is not None:
            silence += 1
        assert watch.silent() == (silence is not None and silence > patience)
        assert watch.has_beat == (actions[-1:] == ["beat"])


@given(beats=st.integers(1, 50), again=st.integers(1, 50))
def test_a_process_that_replaces_a_hung_one_does_not_inherit_its_silence(beats: int, again: int) -> None:
    heart = Heartbeats.create().heart("planner")
    for _ in range(beats):
        heart.beat()
    hang, watch = HangWatch(heart, 0.7, 0.1, lambda _: Effort("S", 0.0)), Watch(heart, 7)
    for _ in range(10):
        hung, silent = hang.hangs(1), watch.silent()
    assert hung
    assert silent
    heart.rest()
    for _ in range(again):  # ready, and checked only after as many beats as the process before had given
        heart.beat()
    assert not hang.hangs(2)
    assert not watch.silent()
