"""What tests of pages share."""

import io

import pytest
from PIL import Image

from sattools.report import page


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of one pixel in the place of figures, for tests of what a page says: figures take most of its time."""
    stream = io.BytesIO()
    Image.new("RGB", (1, 1)).save(stream, "png")
    monkeypatch.setattr(page, "_png", lambda figure, dpi: stream.getvalue())
