"""Random looks of alignments, as clients may tell of them."""

from __future__ import annotations

from typing import get_args

from hypothesis import strategies as st
from trirail.wire.looks import MAX_MARKS, AlignmentLook, LookEnd, LookError, LookPurpose, SeenMark
from trirail.wire.messages import Event
from trirail.wire.text import is_id

names = st.text(min_size=1, max_size=64).filter(is_id)
metres = st.floats(-1e3, 1e3)
pixels = st.floats(-1e9, 1e9)
triples = st.tuples(metres, metres, metres)
marks = st.builds(SeenMark, names, st.tuples(pixels, pixels), st.none() | st.tuples(metres, metres))
looks = st.builds(
    AlignmentLook,
    id=names,
    purpose=st.sampled_from(get_args(LookPurpose)),
    number=st.integers(1, 1_000_000),
    marks=st.lists(marks, max_size=6, unique_by=lambda mark: mark.name).map(tuple),
    error=st.none() | st.builds(LookError, metres, st.tuples(metres, metres), metres, metres, metres),
    pose=st.none() | triples,
    correction=st.none() | triples,
    end=st.none() | st.sampled_from(get_args(LookEnd)),
    words=st.text(max_size=100),
    noise=st.none() | pixels,
    seconds=st.floats(0.0, 1e6),
)
LARGEST = AlignmentLook(
    "\U0001f916" * 64,
    "alignment",
    1_000_000,
    tuple(
        SeenMark(f"{n:02}" + "\U0001f916" * 62, (-1.2345678901234567e8,) * 2, (-123.45678901234567,) * 2)
        for n in range(MAX_MARKS)
    ),
    LookError(-123.45678901234567, (-123.45678901234567,) * 2, -123.45678901234567, 0.1, 0.1),
    (-123.45678901234567,) * 3,
    (-123.45678901234567,) * 3,
    "corrections",
    "\U0001f916" * 512,
    0.1,
    123456.78901234567,
)


def told(number: int, look: AlignmentLook, user: str = "ann") -> Event:
    """Return the event of a look, so many milliseconds after the loop's start."""
    t = number * 1e-3
    return Event(
        "alignment", "info", "a look", user=user, alignment=look, seq=number, t=t, cycle=number, time=1.8e9 + t
    )
