"""Parts of the tests: each file is in exactly one of them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts import part_of


@given(st.lists(st.text()), st.integers(1, 6))
def test_each_file_is_in_exactly_one_part(files: list[str], number: int) -> None:
    parts = [part_of(files, f"{k}/{number}") for k in range(1, number + 1)]
    assert sorted(name for part in parts for name in part) == sorted(set(files))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("part", ["0/4", "5/4", "x", "2", "1/0"])
def test_a_part_that_does_not_exist_is_refused(part: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        part_of(["a"], part)
