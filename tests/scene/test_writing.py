"""Files are complete or not there, inputs survive, and several files appear together or not at all."""

import contextvars
import errno
import os
import resource
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from patience import HANGING_S

from sattools.errors import OutputExistsError, OutputIsInputError, SattoolsError
from sattools.scene import Grid
from sattools.scene import files as module
from sattools.scene.files import (
    all_or_nothing,
    check_outputs,
    digest,
    locked,
    remove,
    remove_orphans,
    write_bytes,
    write_figure,
    write_text,
)
from sattools.scene.raster import write_cog
from sattools.scene.sensor_files import write_sensor_image
from sattools.scene.vectors import Features, geopackage

pytestmark = pytest.mark.drawn

GRID = Grid("EPSG:32617", 0.0, 0.0, 1.0, 120, 120)
NOISE = np.random.default_rng(0).normal(size=GRID.shape).astype(np.float32)


def names(folder: Any) -> Any:
    return sorted(path.name for path in folder.iterdir())


def figure() -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = Figure()
    FigureCanvasAgg(found)
    return found


def model(path: Any) -> None:
    import torch

    from sattools.fit import checkpoint

    checkpoint.save(path, {"height": torch.from_numpy(NOISE)}, {"field": "surface"})


def lines(path: Any) -> None:
    """500 lines as a GeoPackage; SQLite on a full disk left a database without tables, and no error."""
    steps = shapely.linestrings(np.stack([NOISE[:, ::12], NOISE[:, 1::12]], axis=-1).reshape(-1, 2, 2)[:500])
    made = geopackage(Features(list(steps), {"height": np.arange(500.0)}, GRID.crs), "contours", "LineString")
    write_bytes(path, made)


WRITERS = {
    "a.txt": lambda path: write_text(path, "new" * 50_000),
    "a.tif": lambda path: write_cog(path, NOISE, GRID),
    "b.tif": lambda path: write_sensor_image(path, NOISE[None]),
    "a.png": lambda path: write_figure(path, figure()),
    "a.gpkg": lines,
    "a.safetensors": model,
}


@pytest.mark.parametrize("name", WRITERS)
def test_on_a_full_disk_the_old_file_stands_whatever_its_format(tmp_path: Path, name: Any) -> None:
    """A limit on the size of files fails as a full disk does; GDAL would close a truncated file without an error."""
    path = tmp_path / name
    path.write_text("old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        with pytest.raises(SattoolsError, match=f"{name}: cannot be written"):
            WRITERS[name](path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (names(tmp_path), path.read_text()) == ([name], "old")


def test_what_reads_back_differently_is_not_given_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.txt").write_text("old")
    real = open

    def losing(path: Any, mode: Any = "r", *rest: Any) -> Any:
        file = real(path, mode, *rest)
        if mode == "xb":
            write = file.write
            return type("Lossy", (), {
                "__enter__": lambda self: self, "__exit__": lambda self, *_: file.close(), "flush": file.flush,
                "fileno": file.fileno, "write": lambda self, data: write(bytes(data)[:-1] + b"?"),
            })()  # fmt: skip
        return file

    monkeypatch.setattr(module, "open", losing, raising=False)
    with pytest.raises(SattoolsError, match=r"a\.txt: cannot be written \(found other bytes than were written\)"):
        write_text(tmp_path / "a.txt", "new")
    monkeypatch.undo()
    assert (names(tmp_path), (tmp_path / "a.txt").read_text()) == (["a.txt"], "old")


def test_an_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(number: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_text(tmp_path / "a.txt", "half")
    assert names(tmp_path) == []


def test_a_folder_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").mkdir()
    with pytest.raises(SattoolsError, match=r"a\.txt: cannot be written \(is a folder\)"):
        write_text(tmp_path / "a.txt", "a")


# ---- several files together ---------------------------------------------------------------------------------------


def test_files_appear_together_at_the_end(tmp_path: Path) -> None:
    with all_or_nothing():
        write_text(tmp_path / "a.txt", "a")
        write_text(tmp_path / "b.txt", "b")
        assert not [name for name in names(tmp_path) if not name.startswith(".")]
        assert digest(tmp_path / "a.txt") == "ca978112ca1bbdcafac231b39a23dc4da786eff8147c4e72b9807785afee48bb"
    assert names(tmp_path) == ["a.txt", "b.txt"]


def test_a_file_that_goes_stays_until_the_new_ones_appear(tmp_path: Path) -> None:
    old, new = tmp_path / "old.txt", tmp_path / "new.txt"
    old.write_text("old")
    with pytest.raises(SattoolsError), all_or_nothing():  # noqa: PT012
        remove(old)
        write_text(tmp_path, "a folder")
    assert old.read_text() == "old"
    with all_or_nothing():
        remove(old)
        write_text(new, "new")
        assert (old.exists(), new.exists()) == (True, False)
    assert (old.exists(), new.exists()) == (False, True)
    with pytest.raises(OutputIsInputError), all_or_nothing([new], overwrite=True):
        remove(new)
    assert new.exists()


def test_a_failure_at_the_last_file_leaves_the_first_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(OSError, match="later"), all_or_nothing():  # noqa: PT012
        write_text(tmp_path / "a.txt", "new")
        write_text(tmp_path / "b.txt", "new")
        raise OSError(errno.EIO, "later")
    assert (names(tmp_path), (tmp_path / "a.txt").read_text()) == (["a.txt"], "old")


def test_an_interrupt_while_files_get_their_names_waits_for_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the first would be new and the last old, and what is new of the last would be gone."""
    replace = os.replace

    def interrupted(source: Any, target: Any) -> None:
        replace(source, target)
        if Path(target).name == "b":
            raise SystemExit(143)

    @all_or_nothing()
    def write_all() -> None:
        for name in "abc":
            write_text(tmp_path / name, "new")

    for name in "abc":
        (tmp_path / name).write_text("old")
    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(SystemExit):
        write_all()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "new", "b": "new", "c": "new"}


def test_threads_take_part_in_a_copy_of_the_context(tmp_path: Path) -> None:
    with pytest.raises(KeyError), all_or_nothing():  # noqa: PT012
        run = contextvars.copy_context().run
        thread = threading.Thread(target=run, args=(write_text, tmp_path / "a.txt", "a"))
        thread.start()
        thread.join()
        raise KeyError
    assert names(tmp_path) == []


def test_a_held_back_file_in_the_way_of_another_is_found_before_any_is_renamed(tmp_path: Path) -> None:
    (tmp_path / "b.txt").write_text("old")
    with pytest.raises(OutputExistsError, match=r"b\.txt: exists already"), all_or_nothing(inputs=()):  # noqa: PT012
        write_text(tmp_path / "a.txt", "new")
        write_text(tmp_path / "b.txt", "new")
    assert (names(tmp_path), (tmp_path / "b.txt").read_text()) == (["b.txt"], "old")


# ---- what a killed process leaves ---------------------------------------------------------------------------------


def test_what_a_killed_process_left_is_removed_by_the_next_write(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path; from sattools.scene import files;"
        "os.fsync = lambda n: os.kill(os.getpid(), signal.SIGKILL); files.write_text(Path(sys.argv[1]), 'half')"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.txt")], check=False)
    assert done.returncode == -signal.SIGKILL
    (left,) = names(tmp_path)
    assert left.startswith(".a.txt.")
    write_text(tmp_path / "b.txt", "another file is left alone")
    assert left in names(tmp_path)
    write_text(tmp_path / "a.txt", "whole")
    assert names(tmp_path) == ["a.txt", "b.txt"]


def test_orphans_anywhere_in_a_folder_can_be_removed_but_not_those_of_others(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    ours = module._host()
    (tmp_path / "export").mkdir()
    for name in (f".a.tif.{ours}-{dead.pid}-00.tmp-sattools", f".a.tif.{ours}-{os.getpid()}-00.tmp-sattools",
                 f".a.tif.aaaaaa-{dead.pid}-00.tmp-sattools"):  # fmt: skip
        (tmp_path / "export" / name).write_text("")
    remove_orphans(tmp_path)
    assert names(tmp_path / "export") == sorted(
        [f".a.tif.{ours}-{os.getpid()}-00.tmp-sattools", f".a.tif.aaaaaa-{dead.pid}-00.tmp-sattools"]
    )


def test_files_of_a_process_that_is_about_to_end_are_waited_for(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE)
    (tmp_path / f".a.tif.{module._host()}-{process.pid}-00.tmp-sattools").write_text("")
    remove_orphans(tmp_path)
    assert len(names(tmp_path)) == 1
    process.stdin.close()
    remove_orphans(tmp_path, patience_s=HANGING_S)  # nobody has asked for its status yet
    assert names(tmp_path) == []
    process.wait()


# ---- what must not be written -------------------------------------------------------------------------------------


def link(kind: Any, source: Any, target: Any) -> None:
    (target.symlink_to if kind == "symbolic" else target.hardlink_to)(source)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("kind", ["itself", "symbolic", "hard", "another way"])
def test_an_output_that_is_an_input_is_refused_whatever_is_asked_for(tmp_path: Path, kind: Any, overwrite: Any) -> None:
    source = tmp_path / "original.tif"
    source.write_text("pixels")
    target = tmp_path / "out.tif"
    if kind == "itself":
        target = source
    elif kind == "another way":
        (tmp_path / "folder").symlink_to(tmp_path, target_is_directory=True)
        target = tmp_path / "folder" / "original.tif"
    else:
        link(kind, source, target)
    with pytest.raises(OutputIsInputError, match="nothing was written"):
        check_outputs([target], [source], overwrite)


def test_existing_outputs_need_overwrite_and_all_are_checked(tmp_path: Path) -> None:
    (tmp_path / "b.tif").write_text("")
    outputs = [tmp_path / "a.tif", tmp_path / "b.tif"]
    with pytest.raises(OutputExistsError, match=r"b\.tif: exists already; give --overwrite"):
        check_outputs(outputs)
    check_outputs(outputs, overwrite=True)


def test_a_link_that_leads_nowhere_is_somebodys(tmp_path: Path) -> None:
    (tmp_path / "a.tif").symlink_to(tmp_path / "unmounted" / "a.tif")
    with pytest.raises(OutputExistsError):
        check_outputs([tmp_path / "a.tif"])


def test_one_file_for_two_outputs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputIsInputError, match="would be written twice"):
        check_outputs([tmp_path / "a.tif", tmp_path / "a.tif"])


def test_missing_inputs_are_somebody_elses_error(tmp_path: Path) -> None:
    check_outputs([tmp_path / "a.tif"], [tmp_path / "missing.tif", Path("a\0b")])


# ---- one process at a time ----------------------------------------------------------------------------------------


def test_a_second_process_waits_and_a_killed_one_is_not_waited_for(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from sattools.scene.files import locked\n"
        "with locked(Path(sys.argv[1])):\n    print('locked', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "locked\n"
    order = []

    def second() -> None:
        with locked(tmp_path):
            order.append("second")

    thread = threading.Thread(target=second)
    thread.start()
    order.append("killed")
    other.kill()
    thread.join(600)
    other.communicate()
    assert order == ["killed", "second"]
    assert names(tmp_path) == []


def test_a_large_file_is_known_by_samples_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_WHOLE", 1000)
    monkeypatch.setattr(module, "_PIECE", 100)
    path = tmp_path / "large"
    path.write_bytes(bytes(5000))
    before = digest(path)
    path.write_bytes(bytes(2500) + b"\1" + bytes(2499))
    assert digest(path) != before
    assert digest(tmp_path / "missing") is None


def test_bytes_of_any_buffer_are_written(tmp_path: Path) -> None:
    write_bytes(tmp_path / "a", np.arange(4, dtype=np.uint16).data)
    assert (tmp_path / "a").read_bytes() == b"\0\0\1\0\2\0\3\0"


def test_a_kernel_that_cannot_be_kept_runs_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sattools import compiled

    @compiled.njit(cache=True)
    def twice(x: Any) -> Any:
        return 2 * x

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(type(twice._cache._cache_file), "save", full)
    assert twice(21) == 42


def test_what_an_interrupted_cleaning_leaves_is_removed_when_the_program_ends(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from sattools.scene import files\n"
        "files._discard = lambda path, whole=files._discard: sys.exit(143)\n"
        "try:\n  with files.all_or_nothing():\n    files.write_text(Path(sys.argv[1]), 'x'); raise ValueError\n"
        "finally:\n  files._discard = files._discard.__defaults__[0]"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "x")], stderr=subprocess.DEVNULL, check=False)
    assert done.returncode == 143
    assert names(tmp_path) == []


def test_a_forked_child_leaves_its_parents_unfinished_files(tmp_path: Path) -> None:
    with all_or_nothing():
        write_text(tmp_path / "x", "x")
        if (child := os.fork()) == 0:
            module._discard_all()
            os._exit(0)
        os.waitpid(child, 0)
    assert names(tmp_path) == ["x"]


def test_names_that_differ_in_case_only_are_refused_where_they_mean_one_file(tmp_path: Path) -> None:
    """As on many a Mac, where the second image would take the place of the first."""
    plain, either = tmp_path / "plain", tmp_path / "Either"
    plain.mkdir()
    either.mkdir()
    (tmp_path / "eITHER").symlink_to(either)  # as its file system shows it
    check_outputs([plain / "A.tif", plain / "a.tif"])
    with pytest.raises(OutputIsInputError, match=r"a\.tif: would be one file with .*A\.tif here, expected different"):
        check_outputs([either / "images/A.tif", either / "images/a.tif"])
