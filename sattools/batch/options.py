"""Options of `sattools batch`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sattools.settings import option


@dataclass(frozen=True)
class BatchOptions:
    """What `batch` does; the field's help texts are the command's help."""

    out: str = option(
        "batch",
        "Folder of the results: runs/CONFIGURATION/SCENE, table.csv, table.md, speed_error.png.",
        path="new folder",
    )
    dfc2019: str | None = option(
        None, "Root of the Data Fusion Contest 2019, track 3; its areas are named by --aoi.", path="folder"
    )
    aoi: list[str] = option([], "Area of --dfc2019 such as JAX_004; repeatable.")
    imagery: Literal["auto", "crops", "rgb", "msi"] = option(
        "auto", "Images of --dfc2019: Sat-NeRF's crops, the contest's RGB or MSI tiles; auto = the first that is there."
    )
    workers: int | None = option(
        None,
        "Tasks at a time on this machine [default: one per core, as far as there are tasks and 3.5 GB for each].",
        minimum=1,
        maximum=1024,
    )
    task_threads: int | None = option(
        None,
        "CPU threads of a task [default: cores / tasks at a time; with --scheduler the worker's own].",
        minimum=1,
        maximum=1024,
    )
    memory_limit: float | None = option(
        None,
        "Memory of a task: its tiles go by it, and above it it is stopped [MB; default: this machine's, "
        "or that of --max-memory, / workers].",
        minimum=100,
    )
    scheduler: str | None = option(
        None, "Address of a running Dask scheduler, tcp://HOST:PORT, instead of this machine."
    )
    gpu: bool = option(False, "Every fit asks for one GPU (Dask resource GPU=1); on this machine one worker per GPU.")
    join: bool = option(
        False,
        "Join the surfaces of all scenes of a configuration into one, joined/CONFIGURATION/dsm.tif, and say how far "
        "neighbours are from each other; with a table [align] each is moved onto the reference before.",
    )
    retries: int = option(2, "How often a task is started again whose worker was lost.", minimum=0, maximum=100)


__all__ = ["BatchOptions"]
