"""When a network begins to cast shadows: from noise with its surface, from a surface at once."""

from typing import Any

import pytest
import torch
from four_sides import house_trainer

from sattools.fit.presets import resolve
from sattools.fit.rays.trainer import RayTrainer


def trainer(start: str, steps: int) -> RayTrainer:
    options = resolve("eonerf", {"width": 16, "steps": steps, "rays": 32, "transient": "off", "start": start})
    return house_trainer(options, from_base=start == "prior")


def depends_on_the_sun(one: RayTrainer, share: float) -> bool:
    """Whether colours change as the sun goes round, after a share of the training."""

    def shown(azimuth: float) -> Any:
        to_sun = torch.tensor([0.8, azimuth, 0.6]) / torch.tensor([0.8, azimuth, 0.6]).norm()
        one.rays.suns[torch.isfinite(one.rays.suns[:, 0])] = to_sun
        return one.predict(torch.arange(64), 2, share, None).colour

    with torch.no_grad():
        return not torch.equal(shown(-1.0), shown(1.0))


@pytest.mark.parametrize(
    ("start", "steps", "before", "after"),
    [
        ("noise", 1000, 0.49, 0.51),  # half of a short training
        ("noise", 300_000, 0.033, 0.034),  # 10,000 steps of the papers' own
        ("prior", 1000, None, 0.0),
    ],
)
def test_shadows_come_in_with_the_surface(start: str, steps: int, before: float | None, after: float) -> None:
    """Earlier the haze of noise shades itself everywhere: a town of 64 m ended as an empty scene (10.4 m, now 7.5)."""
    one = trainer(start, steps)
    assert before is None or not depends_on_the_sun(one, before)
    assert depends_on_the_sun(one, after)


def test_a_plan_that_changes_moves_them() -> None:
    one = trainer("noise", 1000)
    one.plan(40_000)
    assert not depends_on_the_sun(one, 0.24)
    assert depends_on_the_sun(one, 0.26)
