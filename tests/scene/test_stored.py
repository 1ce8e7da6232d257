"""Maps that are read and written by rows, whether they are arrays or files."""

from pathlib import Path

import numpy as np
import pytest

from sattools.errors import SattoolsError
from sattools.scene import stored
from sattools.scene.stored import StoredMap, cut, map_like, new_map, pieces


def test_a_stored_map_gives_back_what_was_written(tmp_path: Path) -> None:
    numbers = np.arange(40, dtype=np.float32).reshape(5, 8)
    map_ = StoredMap((5, 8), np.float32, tmp_path)
    map_[0:3] = numbers[:3]
    map_[slice(3, 5), slice(2, 8)] = numbers[3:, 2:]
    expected = numbers.copy()
    expected[3:, :2] = 0.0  # never written
    np.testing.assert_array_equal(np.asarray(map_), expected)
    np.testing.assert_array_equal(map_[1:3, 4:6], [[12, 13], [20, 21]])
    np.testing.assert_array_equal(map_[::2, ::4], expected[::2, ::4])
    assert list(tmp_path.iterdir()) == []  # the file has no name, and nothing stays behind


def test_a_number_fills_a_stored_part() -> None:
    map_ = StoredMap((3, 4), np.uint8)
    map_[1:2] = 7
    np.testing.assert_array_equal(np.asarray(map_).sum(axis=1), [0, 28, 0])


def test_maps_are_arrays_until_they_are_large(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(stored, "HELD", 400)
    assert isinstance(new_map((10, 10), np.float32), np.ndarray)
    large = new_map((10, 11), np.float32, tmp_path)
    assert isinstance(large, StoredMap)
    assert isinstance(map_like(large, (20, 20), np.float32), StoredMap)
    assert isinstance(map_like(np.zeros((2, 2)), (20, 20), np.float32), np.ndarray)


def test_a_folder_that_is_not_there_is_named() -> None:
    with pytest.raises(SattoolsError, match="/nowhere/at/all: a temporary file cannot be written"):
        StoredMap((3, 3), np.float32, Path("/nowhere/at/all"))


def test_a_full_disk_is_an_error_and_not_a_wrong_map() -> None:
    class Full(StoredMap):
        def __init__(self) -> None:
            super().__init__((4, 4), np.float32)
            self._file.close()
            self._file = open("/dev/full", "r+b", buffering=0)  # noqa: SIM115

    with pytest.raises(SattoolsError, match="No space left"):
        Full()[0:1] = 1.0


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (100, 3), (3, 100)])
def test_pieces_and_blocks_cover_every_cell_once(shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored, "PIECE_CELLS", 20)
    monkeypatch.setattr(stored, "AT_ONCE", 30)
    count = np.zeros(shape, int)
    for rows in pieces(shape):
        assert count[rows].size <= max(20, shape[1])
        count[rows] += 1
    for part in cut(shape, 4):
        count[part] += 1
    np.testing.assert_array_equal(count, 2)
