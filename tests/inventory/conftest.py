"""No test here looks at drawings."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.pictures import blank


@pytest.fixture(scope="package", autouse=True)
def blank_pictures() -> Iterator[None]:
    with blank():
        yield
