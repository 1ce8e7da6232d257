"""Plans of batches, and the contest's folders to make them of."""

from pathlib import Path
from typing import Any

from sattools.batch.configuration import Configuration
from sattools.batch.options import BatchOptions
from sattools.batch.queue import make_plan

DEFAULT = Configuration("default")


def keys(tmp_path: Path, scene: Any, *configurations: Any) -> Any:
    plan = make_plan(BatchOptions(out=str(tmp_path / "out")), [scene], configurations or [DEFAULT])
    return [job.task.key for job in plan.jobs]


def contest(root: Path) -> Path:
    """The contest's folders with images of two areas, a reference of the first, crops of a third."""
    for name in (
        "Track3-RGB-1/JAX_004_006_RGB.tif",
        "Track3-RGB-2/JAX_004_007_RGB.tif",
        "Track3-MSI-1/JAX_004_006_MSI.tif",
        "Track3-RGB-1/JAX_070_001_RGB.tif",
        "Track3-RGB-crops/JAX_068/JAX_068_001_RGB.tif",
        "Track3-RGB-3/JAX_068_001_RGB.tif",
        "Track3-Truth/JAX_004_DSM.tif",
    ):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(name.encode())
    return root
