"""Fixtures of tests of the command line."""

import pytest


@pytest.fixture
def unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages whose pictures are empty, for what does not depend on them: painting takes longer than all the rest."""
    monkeypatch.setattr("sattools.report.page._png", lambda figure, dpi: b"")
