"""The browser of a file's tests."""

import pytest
from browser import open_browser


@pytest.fixture(scope="module")
def browser():
    with open_browser() as opened:
        yield opened
