"""What users get wrong, through the commands themselves: one clear line, the right exit code, no half-written file.

`tests/prep` has the same for the stage's own checks of images (no RPC, another place, truncated, no data, one image).
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sattools.cli import main
from sattools.runlog import NAME
from sattools.scene import Scene

QUICK = ["--resolution", "2", "--coarsest", "2", "--epochs", "2"]


def prep(*arguments: Any) -> Any:
    return CliRunner().invoke(main, ["prep", *map(str, arguments)])


def run(command: Any, *arguments: Any, text: Any = "") -> Any:
    return CliRunner().invoke(main, [command, *map(str, arguments)], input=text)


def files(folder: Path) -> list[str]:
    """All but the log, which tells of runs that failed, too."""
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name != NAME)


def assert_refused(result: Any, command: Any, *words: Any, code: Any = 1) -> None:
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith(f"sattools {command}: error: ")
    for word in words:
        assert word in lines[0]


@pytest.fixture
def town(make_town: Any) -> Any:
    return make_town()


@pytest.fixture
def images(town: Any) -> Any:
    return sorted((town.root / "images").glob("*.tif"))


@pytest.fixture
def out(tmp_path: Path) -> Any:
    return tmp_path / "out"


# ---- prep -----------------------------------------------------------------------------------------------


def rewrite(path: Any, change: Any, tags: Any = True) -> None:
    """Write an image anew with changed pixels [B, H, W] and, unless told otherwise, its RPC."""
    with rasterio.open(path) as data:
        pixels, profile, rpc = data.read(), data.profile, data.tags(ns="RPC")
    pixels = change(pixels)
    profile.update(
        count=pixels.shape[0], height=pixels.shape[1], width=pixels.shape[2], dtype=pixels.dtype, predictor=1
    )
    path.unlink()
    with rasterio.open(path, "w", **profile) as data:
        data.write(pixels)
        if tags:
            data.update_tags(ns="RPC", **rpc)


def test_images_without_rpc(images: Any, out: Any) -> None:
    rewrite(images[2], lambda p: p, tags=False)
    assert_refused(prep(*images, "--out", out), "prep", "TOWN_003.tif: found no RPC")
    assert files(out) == []


def test_a_truncated_image(images: Any, out: Any) -> None:
    images[1].write_bytes(images[1].read_bytes()[:20000])
    assert_refused(prep(*images, "--out", out), "prep", "TOWN_002.tif: found")
    assert files(out) == []


def test_a_band_without_data(images: Any, out: Any) -> None:
    rewrite(images[0], lambda p: np.zeros_like(p))
    assert_refused(prep(*images, "--out", out), "prep", "TOWN_001.tif: found")
    assert files(out) == []


def test_an_image_file_that_is_not_there(images: Any, out: Any) -> None:
    assert_refused(prep(*images, out / "none.tif", "--out", out), "prep", "none.tif: ")
    assert files(out) == []


def test_an_archive_that_is_not_there_leaves_not_even_folders(out: Any) -> None:
    names = [f"/vsizip/{out}.zip/{name}.tif" for name in ("a", "b")]
    # in a process of its own: what it made it takes back when it ends
    command = [sys.executable, "-m", "sattools", "prep", *names, "--id", "x", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "a.tif: cannot be opened (not there, or not of a format that is read" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not out.exists()


def test_a_folder_instead_of_an_image(images: Any, out: Any) -> None:
    # it stands for its images, which are then given twice
    assert_refused(prep(*images, images[0].parent, "--out", out), "prep", "TOWN_001.tif", "found this image twice")
    empty = out.with_name("empty")
    empty.mkdir()
    assert_refused(prep(*images, empty, "--out", out), "prep", "empty: found a folder without images")
    assert files(out) == []


def test_an_area_outside_the_images(images: Any, out: Any, tmp_path: Path) -> None:
    far = {"type": "Polygon", "coordinates": [[[8.0, 47.0], [8.01, 47.0], [8.01, 47.01], [8.0, 47.0]]]}
    path = tmp_path / "aoi.geojson"
    path.write_text(json.dumps(far))
    assert_refused(prep(*images, "--aoi", path, "--out", out), "prep", "images")
    assert_refused(prep(*images, "--bounds", "8", "47", "8.01", "47.01", "--out", out), "prep", "images")
    assert files(out) == []


@pytest.mark.parametrize("text", ["{nonsense", '{"type": "Point", "coordinates": [1, 2]}', ""])
def test_an_area_that_cannot_be_read(images: Any, out: Any, tmp_path: Path, text: Any) -> None:
    path = tmp_path / "aoi.geojson"
    path.write_text(text)
    assert_refused(prep(*images, "--aoi", path, "--out", out), "prep", "aoi.geojson: found")
    assert files(out) == []


def test_metadata_that_cannot_be_read(images: Any, out: Any, tmp_path: Path) -> None:
    folder = tmp_path / "metadata"
    folder.mkdir()
    (folder / "TOWN_002.json").write_text("{nonsense")
    assert_refused(prep(*images, "--metadata", folder, "--out", out), "prep", "TOWN_002.json: found")
    assert files(out) == []


@pytest.mark.parametrize("name", ["../escape", "a/b", "x" * 200])
def test_an_id_that_is_no_name(images: Any, out: Any, name: Any) -> None:
    assert_refused(prep(*images, "--id", name, "--out", out), "prep", "found id")
    assert not out.exists() or files(out) == []
    assert not (out.parent / "escape").exists()


@pytest.mark.parametrize(
    ("crs", "told"),
    [("EPSG:4326", "found one that is not projected in metres"), ("nonsense", "found none that is known")],
)
def test_a_crs_that_is_none_of_metres_is_wrong_usage(images: Any, out: Any, crs: str, told: str) -> None:
    result = prep(*images, "--crs", crs, "--out", out)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.splitlines()[-1].startswith(f"Error: CRS '{crs}': {told}")
    assert not out.exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_under_stdout(town: Any) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "sattools", "info", str(town.root / "scene.json")],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 1
    assert done.stderr == "sattools: error: stdout: cannot be written (No space left on device)\n"


# ---- fit ------------------------------------------------------------------------------------------------


def test_fit_of_nothing() -> None:
    assert_refused(run("fit"), "fit", "stdin: found nothing")


def test_fit_of_a_document_that_is_no_scene() -> None:
    assert_refused(
        run("fit", text='{"type": "FeatureCollection", "features": []}'), "fit", "stdin line 1", "'sattools'"
    )


def test_fit_of_one_image(town: Any) -> None:
    town.items = town.items[:1]
    assert_refused(run("fit", *QUICK, text=town.to_json()), "fit", "found 1 training image")
    assert not (town.root / "fit/model.safetensors").exists()


def test_fit_of_a_truncated_image(town: Any, images: Any) -> None:
    images[3].write_bytes(images[3].read_bytes()[:20000])
    assert_refused(run("fit", *QUICK, text=town.to_json()), "fit", "TOWN_004.tif: found")
    assert not (town.root / "fit/model.safetensors").exists()


def test_fit_of_an_image_without_any_data(town: Any, images: Any) -> None:
    rewrite(images[3], lambda p: np.full(p.shape, np.nan, np.float32))
    assert_refused(run("fit", *QUICK, text=town.to_json()), "fit", "TOWN_004")
    assert not (town.root / "fit/model.safetensors").exists()


def test_fit_of_an_image_with_nan_pixels(town: Any, images: Any) -> None:
    def holes(pixels: Any) -> Any:
        pixels = pixels.astype(np.float32)
        pixels[:, 20:60, 30:50] = np.nan
        return pixels

    rewrite(images[3], holes)
    result = run("fit", *QUICK, text=town.to_json())
    assert result.exit_code == 0, result.output
    from sattools.fit.checkpoint import load

    tensors, _ = load(town.root / "fit/model.safetensors")
    assert all(np.isfinite(t.numpy()).all() for t in tensors.values())


def test_fit_of_images_with_different_bands(town: Any, images: Any) -> None:
    rewrite(images[3], lambda p: p[:1])
    assert_refused(
        run("fit", *QUICK, text=town.to_json()), "fit", "found 1 band, expected 3 as most of the other images have"
    )


def test_fit_of_an_image_that_does_not_show_the_grid(town: Any) -> None:
    moved = town.root / "rpc/TOWN_002_RPC.TXT"
    text = moved.read_text().replace("LAT_OFF: ", "LAT_OFF: 4")
    assert text != moved.read_text()
    moved.write_text(text)
    assert_refused(run("fit", *QUICK, text=town.to_json()), "fit", "TOWN_002")
    assert not (town.root / "fit/model.safetensors").exists()


def test_fit_of_a_scene_whose_camera_is_damaged(town: Any) -> None:
    (town.root / "rpc/TOWN_002_RPC.TXT").write_text("LINE_OFF: many")
    assert_refused(run("fit", *QUICK, text=town.to_json()), "fit", "TOWN_002_RPC.TXT: ")


def test_fit_where_nothing_can_be_written(town: Any) -> None:
    (town.root / "fit").write_text("a file where the folder should be")
    assert_refused(run("fit", *QUICK, text=town.to_json()), "fit", f"{town.root}/fit")


def test_fit_on_a_full_disk(town: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: Any, **keywords: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    before = files(town.root)
    assert_refused(
        run("fit", *QUICK, "--prior-weight", "0", text=town.to_json()),
        "fit",
        "model.safetensors: cannot be written (No space left",
    )
    assert files(town.root) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_fit_below_a_root_that_is_read_only(town: Any) -> None:
    town.root.chmod(0o555)
    try:
        assert_refused(run("fit", *QUICK, text=town.to_json()), "fit", "expected a writable root")
    finally:
        town.root.chmod(0o755)


def test_of_two_scenes_the_broken_one_fails_and_the_other_is_fitted(make_town: Any) -> None:
    good, bad = make_town("GOOD"), make_town("BAD")
    bad.path("images/TOWN_001.tif").unlink()
    result = run("fit", *QUICK, text=f"{bad.to_json()}\n{good.to_json()}\n")
    assert result.exit_code == 3
    assert [json.loads(line)["id"] for line in result.stdout.splitlines()] == ["GOOD"]
    assert result.stderr.count("\n") == 1


def test_a_reference_that_is_not_there(town: Any) -> None:
    result = run("fit", *QUICK, "--reference", town.root / "none.tif", text=town.to_json())
    assert_refused(result, "fit", "none.tif: ")
    assert not (town.root / "fit/model.safetensors").exists()


# ---- export and compare ---------------------------------------------------------------------------------


def test_export_before_fit(town: Any) -> None:
    assert_refused(run("export", text=town.to_json()), "export", "found no product 'model'")


def test_export_of_a_damaged_model(town: Any) -> None:
    result = run("fit", *QUICK, text=town.to_json())
    scene = Scene.from_json(result.stdout)
    model = scene.path(scene.products["model"])
    model.write_bytes(model.read_bytes()[:50])
    assert_refused(run("export", text=scene.to_json()), "export", "model.safetensors: found no sattools model")
    assert not (scene.root / "export").exists()


def test_compare_before_export(town: Any) -> None:
    assert_refused(run("compare", text=town.to_json()), "compare", "found no DSM")


def test_compare_with_a_reference_of_another_place(town: Any, tmp_path: Path) -> None:
    from sattools.scene import Grid
    from sattools.scene.raster import write_cog

    here = town.products["truth_dsm"]
    write_cog(tmp_path / "far.tif", np.zeros((50, 50)), Grid("EPSG:32617", 500000, 3000000, 0.5, 50, 50))
    result = run("compare", "--predicted", town.path(here), "--dsm", tmp_path / "far.tif")
    assert_refused(result, "compare", "expected overlap")


def test_names_that_the_locale_cannot_read(tmp_path: Path) -> None:
    ascii_only = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    names = [str(tmp_path / name).encode() for name in ("Größe.tif", "b.tif")]
    done = subprocess.run([sys.executable, "-m", "sattools", "prep", *names], capture_output=True, env=ascii_only)
    assert done.returncode == 1
    assert done.stderr.count(b"\n") == 1
    assert b"found a name that ascii cannot read, expected UTF-8 (PYTHONUTF8=1)" in done.stderr
