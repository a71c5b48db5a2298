"""A browser for the tests of the panel's page."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from chromium import Page, chromium


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium("chromium", tmp_path_factory.mktemp("profile"), ["--disable-gpu"]) as page:
        yield page
