"""What one test's commands are asked to tell is no matter of the tests beside it."""

import logging

import pytest
from click.testing import CliRunner

from sattools.cli import main


@pytest.fixture(scope="module")
def quiet_command() -> None:
    """A fixture of many tests runs a command that is asked to be quiet."""
    CliRunner().invoke(main, ["--quiet", "doctor", "--json"])


def test_a_quiet_fixture_leaves_warnings_audible(quiet_command: None, caplog: pytest.LogCaptureFixture) -> None:
    logging.getLogger("sattools.any").warning("heard")
    assert "heard" in caplog.text


def test_so_does_a_quiet_test_before_it(caplog: pytest.LogCaptureFixture) -> None:
    CliRunner().invoke(main, ["--quiet", "doctor", "--json"])
    assert logging.getLogger("sattools").level == logging.ERROR


def test_even_right_after_it(caplog: pytest.LogCaptureFixture) -> None:
    logging.getLogger("sattools.any").warning("heard")
    assert "heard" in caplog.text
