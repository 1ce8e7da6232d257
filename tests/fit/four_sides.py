"""A house of 10 m under noise, as four images see it; the last one knows no sun."""

import numpy as np
import torch

from sattools.camera.view_direction import ViewDirection
from sattools.field.surface_base import SurfaceBase
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.options import FitOptions
from sattools.fit.rays.stage import STEPS, FieldSteps
from sattools.fit.rays.start import box_over, make_field, ray_set
from sattools.fit.rays.trainer import RayTrainer
from sattools.scene import Grid
from sattools.views import View

CELLS = 24
GRID = Grid("EPSG:32633", 0.0, 0.0, 1.0, CELLS, CELLS)
Z_RANGE = (-5.0, 25.0)
SLOPES = ((0.45, 0.1), (-0.4, 0.2), (0.1, -0.45), (0.0, 0.0))
SUNS = ((0.0, 0.6, 0.8), (0.8, 0.3, 0.52), (-0.9, 0.1, 0.42), None)


def a_house(bands: int = 3) -> tuple[list[View], DepthPrior, SurfaceBase]:
    """Its views, its prior, and the surface that a field begins as."""
    random = np.random.default_rng(7)
    height = torch.zeros(CELLS, CELLS)
    height[8:16, 10:20] = 10.0
    pixels = random.uniform(0.1, 0.9, (len(SLOPES), CELLS, CELLS, bands)).astype(np.float32)
    seen = np.ones(GRID.shape, np.uint8)
    views = [View(str(k), pixels[k], seen, ViewDirection(*slope), 2.0, SUNS[k], 0.0) for k, slope in enumerate(SLOPES)]
    base = SurfaceBase(box_over(GRID, Z_RANGE), height, torch.from_numpy(pixels[0]), 0.5)
    return views, DepthPrior(height, torch.full(GRID.shape, 0.5), GRID), base


def house_trainer(options: FitOptions, bands: int = 3, from_base: bool = True) -> RayTrainer:
    """What trains a field of that house by its rays; without its base from noise."""
    views, prior, base = a_house(bands)
    field = make_field(options, GRID, Z_RANGE, 2.0, bands, prior, base=base if from_base else None)
    ones, steps = torch.ones(len(views), bands), STEPS.get(options.field, FieldSteps())
    return RayTrainer(field, ray_set(views, GRID, Z_RANGE, prior), options, ones, 0 * ones, steps)
