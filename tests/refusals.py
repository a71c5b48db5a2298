"""Refusals as programs know them: by their code. Their words are tested where they are made."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.packets import Answer, Refused


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
