"""Signs of life, counted by who watches: in its own turns, from the first beat to the last."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from trirail.processes.heartbeats import PROCESSES, Heartbeats, Watch


def test_each_process_has_its_own_and_all_share_them() -> None:
    one = Heartbeats.create()
    other = Heartbeats(one.descriptor)
    for name in PROCESSES:
        assert other.heart(name).count == 0
        one.heart(name).beat()
        assert other.heart(name).count == 1
    one.heart("loop").rest()
    assert {name: other.heart(name).count for name in PROCESSES} == {name: int(name != "loop") for name in PROCESSES}


@given(patience=st.integers(1, 10), turns=st.lists(st.sampled_from(["beat", "rest", ""]), max_size=60))
def test_it_is_silent_after_more_turns_than_there_is_patience(patience: int, turns: list[str]) -> None:
    heart = Heartbeats.create().heart("gateway")
    watch = Watch(heart, patience)
    silence: int | None = None
    for turn in turns:
        if turn == "beat":
            heart.beat()
            silence = 0
        elif turn == "rest":
            heart.rest()
            silence = None
        elif silence is not None:
            silence += 1
        assert watch.silent() == (silence is not None and silence > patience)
        assert watch.has_beat == (turn == "beat")
