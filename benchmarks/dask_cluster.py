"""A Dask scheduler and workers over TCP that can be killed."""

from __future__ import annotations

import subprocess
import sys


class Cluster:
    """A scheduler and a worker, or more of them, processes of their own on the loopback interface."""

    def __init__(self, workers: int = 1) -> None:
        self.workers: list[subprocess.Popen[bytes]] = []
        self.wanted = workers

    def __enter__(self) -> Cluster:
        code = (
            "import asyncio\nfrom distributed import Scheduler\n"
            "async def main():\n async with Scheduler(host='127.0.0.1', port=0, dashboard=False) as s:\n"
            "  print(s.address, flush=True)\n  await s.finished()\nasyncio.run(main())"
        )
        self.scheduler = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.scheduler.stdout is not None
        self.address = self.scheduler.stdout.readline().strip()
        for _ in range(self.wanted):
            self.start_worker()
        return self

    @property
    def worker(self) -> subprocess.Popen[bytes]:
        """The one started last."""
        return self.workers[-1]

    def start_worker(self) -> None:
        code = (
            "import asyncio, sys\nfrom distributed import Worker\n"
            "async def main():\n async with Worker(sys.argv[1], nthreads=1) as w:\n  await w.finished()\n"
            "asyncio.run(main())"
        )
        self.workers.append(subprocess.Popen([sys.executable, "-c", code, self.address], stderr=subprocess.DEVNULL))

    def __exit__(self, *_: object) -> None:
        for process in self.workers:
            process.kill()
            process.wait()
        self.scheduler.kill()
        self.scheduler.wait()
