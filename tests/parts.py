"""Parts of a long run: --part=2/4 runs the second of four parts of the selected tests, and each file is in one part."""

from __future__ import annotations

from collections.abc import Sequence

import pytest


def part_of(files: Sequence[str], part: str) -> set[str]:
    """Return the files of a part, such as "2/4". Raises ValueError if there is no such part."""
    number, _, parts = part.partition("/")
    if not 1 <= int(number) <= int(parts):
        raise ValueError(f"{part}: expected a part such as 2/4")
    return set(sorted(set(files))[int(number) - 1 :: int(parts)])


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option."""
    parser.addoption("--part", metavar="K/N", default="1/1", help="run part K of N of the selected tests")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests of other parts, after all other selections."""
    chosen = part_of([str(item.path) for item in items], config.getoption("part"))
    config.hook.pytest_deselected(items=[item for item in items if str(item.path) not in chosen])
    items[:] = [item for item in items if str(item.path) in chosen]
