"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real images, RPCs and lidar (`SATTOOLS_DATA`); tests that need it are skipped without it."""
    value = os.environ.get("SATTOOLS_DATA")
    if not value:
        pytest.skip("SATTOOLS_DATA is not set")
    folder = Path(value)
    if not folder.is_dir():
        pytest.fail(f"SATTOOLS_DATA={value} is not a folder")
    return folder
