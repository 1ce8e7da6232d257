"""Batches whose tasks are done one after the other in this process, for what does not depend on who does them."""

import os
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from click.testing import CliRunner, Result

from sattools.batch.task import perform
from sattools.cli import main


class Here:
    """Stands for a `Launcher`."""

    def run(self, arguments: list[str], *_: Any) -> Iterator[str | int]:
        done = CliRunner().invoke(main, arguments)
        yield from done.stderr.splitlines(keepends=True)
        yield done.exit_code


def _run(jobs: list, options: Any, share: Any, finished: Any, told: Any) -> None:
    """Stands for the cluster's; what tasks wait for comes before them."""
    waiting = deque(jobs)
    while waiting:
        task = waiting.popleft().task
        waiting.extend(finished(task, perform(task, 1, None, lambda *_: None, launcher=Here())))


def batch_here(folder: Path, *arguments: str) -> Result:
    """`sattools batch` in a folder."""
    before = os.getcwd()
    os.chdir(folder)
    try:
        with patch("sattools.batch.stage.run", _run):
            return CliRunner().invoke(main, ["--threads", "1", "--progress", "json", "batch", *arguments])
    finally:
        os.chdir(before)
