"""A browser shared by the tests of each module."""

import pytest
from browser import open_browser


@pytest.fixture(scope="module")
def browser():
    with open_browser() as instance:
        yield instance
