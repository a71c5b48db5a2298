"""Refusals as programs know them: by their code. Their words are tested where they are made."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator

import msgspec
import pytest
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.messages import Notice
from trirail.wire.packets import Announcement, Answer, Refused


@contextlib.contextmanager
def refused_as(code: RefusalCode) -> Iterator[pytest.ExceptionInfo[RefusedError]]:
    """What is done here is refused with this code; gives what was raised."""
    with pytest.raises(RefusedError) as caught:
        yield caught
    assert caught.value.code is code, caught.value


def refusal(answer: Answer) -> Refused:
    """Return an answer that is one."""
    assert isinstance(answer, Refused), answer
    return answer


def uncoded(announced: Iterable[object]) -> list[Notice]:
    """Return notices, announced or not, without their event codes, which tests/wire/test_event_codes.py covers."""
    notices = [each.notice if isinstance(each, Announcement) else each for each in announced]
    return [msgspec.structs.replace(each, event_code=None, params={}) for each in notices if isinstance(each, Notice)]
