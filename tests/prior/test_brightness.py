"""How bright images show blocks of cells, read from their files."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sattools.prior.brightness import brightness_of_blocks
from sattools.prior.tones import LINEAR_TONE, toned
from sattools.prior.water import block_of
from sattools.scene import Scene
from sattools.views import load_sources, open_images, views_on


@pytest.mark.parametrize(("cell", "cells"), [(0.5, 8), (1.0, 4), (4.0, 1), (6.0, 1)])
def test_blocks_are_four_metres_wide_or_a_cell(cell: float, cells: int) -> None:
    assert block_of(cell) == cells


def test_blocks_show_the_mean_of_their_pixels_with_their_tone(make_town: Callable[[str], Scene]) -> None:
    scene = make_town("BLOCKS")
    items, grid = scene.train_items(), scene.require_grid()
    looks = brightness_of_blocks(scene, items, open_images(scene, items), grid)
    size = block_of(grid.cell_size)
    rows, cols = slice(3, 10), slice(5, 11)
    found = looks(rows, cols, 10.0)
    assert found.shape == (len(items), 7, 6)
    sources = load_sources(scene, items)
    for shown, source, view in zip(
        found, sources, views_on(sources, grid, 10.0, scene.require_height_range()), strict=True
    ):
        grey = toned(view.target, LINEAR_TONE if source.linear else 1.0).mean(axis=-1)
        blocks = grey[3 * size : 10 * size, 5 * size : 11 * size].reshape(7, size, 6, size).mean(axis=(1, 3))
        seen = np.isfinite(shown)
        assert seen.mean() > 0.5
        # a wide cell's mean is weighted by a bell, and its tone is that of the mean: beside edges they differ
        assert np.median(np.abs(shown - blocks)[seen] / blocks[seen]) < 0.1


def test_places_that_no_image_shows_are_not_known(make_town: Callable[[str], Scene]) -> None:
    scene = make_town("BEYOND")
    items, grid = scene.train_items(), scene.require_grid()
    far = replace(grid, left=grid.left + 5000.0)
    looks = brightness_of_blocks(scene, items, open_images(scene, items), far)
    assert np.isnan(looks(slice(0, 8), slice(0, 8), 0.0)).all()
