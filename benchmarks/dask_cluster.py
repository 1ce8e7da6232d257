"""A Dask scheduler and a worker over TCP that can be killed."""

from __future__ import annotations

import subprocess
import sys


class Cluster:
    """A scheduler and a worker, processes of their own on the loopback interface."""

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
        self.start_worker()
        return self

    def start_worker(self) -> None:
        code = (
            "import asyncio, sys\nfrom distributed import Worker\n"
            "async def main():\n async with Worker(sys.argv[1], nthreads=1) as w:\n  await w.finished()\n"
            "asyncio.run(main())"
        )
        self.worker = subprocess.Popen([sys.executable, "-c", code, self.address], stderr=subprocess.DEVNULL)

    def __exit__(self, *_: object) -> None:
        for process in (self.worker, self.scheduler):
            process.kill()
            process.wait()
