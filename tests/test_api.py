"""The suite from Python does what its commands do, history included."""

import inspect
import json
import pydoc
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch

import sattools
from sattools.errors import InputError, OutputExistsError, SattoolsError, SceneError
from sattools.export.options import ExportOptions
from sattools.fit.options import FitOptions
from sattools.fit.presets import PRESETS, resolve
from sattools.reflectance import hapke, lambert, rpv

QUICK = {"resolution": 2.0, "coarsest": 2.0, "epochs": [2], "prior_weight": 0.0}
HEAVY = ("torch", "numba", "rasterio", "numpy", "scipy", "matplotlib", "geopandas", "cv2")


def test_importing_the_suite_imports_nothing_heavy() -> None:
    code = f"import sys, sattools; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_everything_that_is_promised_is_there() -> None:
    stages = ("prepare", "normalise", "match", "fit", "export", "align", "compare", "change", "simulate")
    for name in ("Scene", "Grid", "RPC", *stages):
        assert callable(getattr(sattools, name)), name
        assert name in dir(sattools)
        assert name in sattools.__all__
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        _ = sattools.fitt


def test_a_stage_is_a_package_and_a_function_whatever_was_imported_before() -> None:
    code = "import sattools.fit.stage, sattools; print(callable(sattools.fit), sattools.fit.stage.MODEL)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "fit/model.safetensors"]


@pytest.mark.parametrize("name", ["fit", "export", "align", "compare", "change", "simulate"])
def test_help_on_a_stage_says_what_the_function_takes(name: str) -> None:
    stage, function = getattr(sattools, name), getattr(sattools.api, name)
    assert inspect.signature(stage) == inspect.signature(function)
    shown = pydoc.plain(pydoc.render_doc(stage))
    assert inspect.getdoc(function).splitlines()[0] in shown
    assert f"sattools.{name}({next(iter(inspect.signature(function).parameters))}: " in shown
    assert "overwrite: replace" in shown


def test_python_does_what_the_commands_do(make_town: Any) -> None:
    town = make_town()
    told = []
    scene = sattools.fit(town.root / "scene.json", QUICK, progress=lambda share, message: told.append(share))
    scene = sattools.compare(sattools.export(scene), {"register": "none"})
    assert told[-1] == 1.0
    document = json.loads((town.root / "scene.json").read_text())["sattools"]
    assert [entry["command"] for entry in document["history"]] == ["fit", "export", "compare"]
    assert document["history"][0]["options"]["epochs"] == [2]
    assert document["history"] == scene.history
    assert scene.history[-1]["errors"]["mae"] > 0
    with pytest.raises(OutputExistsError):
        sattools.fit(scene, QUICK)
    assert sattools.fit(scene, QUICK, overwrite=True).products.keys().isdisjoint({"dsm", "errors"})


def test_a_call_that_is_interrupted_leaves_the_scene_as_it_was(make_town: Any) -> None:
    """In a notebook it goes on: it had lost its surface there, and with the next call in its document."""

    def interrupt(share: float, message: str) -> None:
        if "epoch" in message:
            raise KeyboardInterrupt

    scene = sattools.export(sattools.fit(make_town().root / "scene.json", QUICK))
    before = scene.to_json()
    with pytest.raises(KeyboardInterrupt):
        sattools.fit(scene, {**QUICK, "prior_weight": 1.0}, overwrite=True, progress=interrupt)
    assert scene.to_json() == before
    assert sattools.compare(scene).history[-1]["errors"]["mae"] > 0


def test_a_scene_is_aligned_and_compared_with_what_it_was(make_town: Any, tmp_path: Path) -> None:
    before = sattools.export(sattools.fit(make_town(), QUICK))
    dsm = before.path(before.products["dsm"])
    higher = tmp_path / "higher.tif"
    with rasterio.open(dsm) as data:
        profile, heights = data.profile, data.read()
    with rasterio.open(higher, "w", **profile) as data:
        data.write(heights + 2.0)
    with pytest.raises(InputError, match="AlignOptions: found no option 'to'"):
        sattools.align(before)
    after = sattools.align(before, {"to": str(higher), "method": "z"})
    assert after.history[-1]["command"] == "align"
    assert after.history[-1]["shift"]["up"] == pytest.approx(2.0, abs=1e-3)  # heights are numbers of 32 bits
    table = sattools.change(dsm, after, {"out": str(tmp_path / "change"), "register": "none"})
    assert table["registration"] == "none"
    with rasterio.open(tmp_path / "change/height_change.tif") as data:
        assert np.nanmedian(data.read()) == pytest.approx(2.0, abs=1e-3)


def test_images_become_a_scene(make_town: Any, tmp_path: Path) -> None:
    town = make_town()
    images = sorted((town.root / "images").glob("*.tif"))
    options = {"metadata": str(town.root / "metadata"), "out": str(tmp_path / "out"), "id": "NEW"}
    scene = sattools.prepare(images, options)
    assert (tmp_path / "out/NEW/scene.json").exists()
    assert len(scene.items) == 6
    with pytest.raises(OutputExistsError):
        sattools.prepare(images, options)


def test_an_option_that_is_not_there_is_named() -> None:
    with pytest.raises(InputError, match="FitOptions: found option 'epoch', expected some of"):
        sattools.fit("scene.json", {"epoch": 3})


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"brdf": "hapki"}, r"option 'brdf': found 'hapki', expected lambert, .*did you mean 'hapke'"),
        ({"epochs": 3}, "option 'epochs': found 3, expected a list"),
        ({"epochs": [2.5]}, r"option 'epochs'\[0\]: found 2.5, expected a whole number from 1 to 100000"),
        ({"resolution": "2"}, "option 'resolution': found '2', expected a finite number"),
        ({"resolution": float("nan")}, "option 'resolution': found nan"),
        ({"seed": None}, "option 'seed': found null"),
        ({"seed": 2.5}, "option 'seed': found 2.5, expected a whole number"),
        ({"prior-weight": 1.0}, r"found option 'prior-weight', expected some of .* \(did you mean 'prior_weight'\?\)"),
        ({"pose": "no"}, "option 'pose': found 'no', expected true or false"),
        ({"tile": "all"}, "option 'tile': found 'all', expected a finite number"),
        (FitOptions(loss="mae"), "option 'loss': found 'mae', expected mse"),
    ],
    ids=str,
)
def test_a_value_that_an_option_does_not_take_is_named(options: Any, why: str) -> None:
    with pytest.raises(InputError, match=f"FitOptions: {why}"):
        sattools.fit("scene.json", options)


@pytest.mark.parametrize("call", [sattools.fit, sattools.export, sattools.normalise])
def test_a_text_does_not_say_that_outputs_may_be_replaced(call: Any, make_hamlet: Any) -> None:
    with pytest.raises(InputError, match="overwrite: found 'no', expected true or false"):
        call(make_hamlet(), overwrite="no")
    with pytest.raises(InputError, match="overwrite: found 'no', expected true or false"):
        sattools.change("before.tif", "after.tif", overwrite="no")


def test_a_name_that_is_empty_is_not_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"option 'out': found '', expected text that is not empty$"):
        sattools.change("a.tif", "b.tif", {"out": ""})
    with pytest.raises(InputError, match=r"^found an empty text, expected a file or folder$"):
        sattools.prepare([""])
    with pytest.raises(SceneError, match=r"^found an empty text, expected the path of a scene document$"):
        sattools.fit("")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("scene", "options", "why"),
    [
        (None, None, "found NoneType, expected a Scene or the path of a scene.json"),
        ([], None, "found list, expected a Scene or the path of a scene.json"),
        (3, None, "found int, expected a Scene or the path of a scene.json"),  # no file descriptor, that it closes
        ('{"type": "FeatureCollection"}', None, r".*, expected the path .* \(`Scene.from_json` reads its text\)"),
        ("scene.json", "fast", "found str, expected FitOptions or a dict of its options"),
        ("scene.json", ExportOptions(), "found ExportOptions, expected FitOptions or a dict of its options"),
    ],
    ids=str,
)
def test_what_is_no_scene_and_no_options_is_named(scene: Any, options: Any, why: str) -> None:
    with pytest.raises(InputError, match=f"^{why}$"):
        sattools.fit(scene, options)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_options_that_are_taken(preset: str, tmp_path: Path) -> None:
    for options in (resolve(preset, {}), asdict(resolve(preset, {}))):
        with pytest.raises(SceneError, match=r"no\.json"):  # it is the scene that is missing
            sattools.fit(tmp_path / "no.json", options)


def test_options_are_python_values_of_any_make(make_town: Any) -> None:
    """Paths, whole numbers in place of others, tuples and NumPy's own."""
    town = make_town()
    options = {**QUICK, "resolution": np.float32(2), "epochs": (np.int64(1),), "tile": None, "seed": np.int64(3)}
    scene = sattools.export(sattools.fit(town, options), {"sun": [150, 40]})
    scene = sattools.compare(scene, {"dsm": town.root / "truth/TOWN_DSM.tif"})
    assert scene.history[-1]["options"]["dsm"] == str(town.root / "truth/TOWN_DSM.tif")
    with pytest.raises(InputError, match="--products: found '5', expected some of dsm"):
        sattools.export(scene, {"products": 5})


def test_a_text_is_taken_in_place_of_a_list_as_the_command_takes_it(make_town: Any) -> None:
    scene = sattools.export(sattools.fit(make_town(), QUICK), {"products": "ply,dtm"})
    assert {"points_ply", "dtm"} <= scene.products.keys()
    assert scene.history[-1]["options"]["products"] == ["ply,dtm"]
    with pytest.raises(InputError, match="--products: found 'plx', expected some of"):
        sattools.export(scene, {"products": "plx,dtm"})


def test_one_image_may_be_given_without_a_list_and_a_folder_stands_for_its_images(
    make_town: Any, tmp_path: Path
) -> None:
    town = make_town()
    options = {"metadata": str(town.root / "metadata"), "out": tmp_path / "out", "id": "FOLDER"}
    for folder in (town.root / "images", str(town.root / "images"), [town.root / "images"]):
        scene = sattools.prepare(folder, options, overwrite=True)
        assert len(scene.items) == 6
    with pytest.raises(SattoolsError, match=r"nowhere\.tif: (no such file|cannot be read)"):
        sattools.prepare("nowhere.tif", options)
    for images, what in (
        (None, "NoneType"),
        (np.zeros((2, 2)), "ndarray in a list"),
        (5, "int"),
        (["a.tif", 5], "int"),
    ):
        with pytest.raises(InputError, match=rf"prepare: found {what}.*, expected the paths of images"):
            sattools.prepare(images, options)


def test_a_number_is_taken_in_place_of_a_text_as_the_command_takes_it(make_town: Any) -> None:
    options = {"quantity": "toa_reflectance", "scale": np.float64(1 / 4095)}
    scene = sattools.normalise(make_town(), options)
    assert scene.history[-1]["options"]["scale"] == str(1 / 4095)
    for wrong in ([0.1, 0.2], np.array([0.1, 0.2]), True):
        with pytest.raises(InputError, match=r"NormaliseOptions: option 'scale': found .*, expected text"):
            sattools.normalise(scene, {"scale": wrong}, overwrite=True)


@pytest.mark.parametrize("bands", [[1, 3], 3, np.array([1, 3]), (np.uint8(1), "3")], ids=str)
def test_bands_are_numbers_or_texts(make_hamlet: Any, bands: Any) -> None:
    scene = sattools.fit(make_hamlet(), {**QUICK, "bands": bands})
    assert scene.history[-1]["options"]["bands"] == (["3"] if np.ndim(bands) == 0 else ["1", "3"])


@pytest.mark.parametrize("options", [{"seed": 3.0}, FitOptions(seed=np.int64(3)), FitOptions(seed=3.0)], ids=str)
def test_a_whole_number_is_one_whatever_its_type(make_hamlet: Any, options: Any) -> None:
    """PyTorch refuses a seed of 3.0, after the matching."""
    own = {"resolution": 4.0, "coarsest": 4.0, "epochs": [1], "prior_weight": 0.0}
    options = {**own, **options} if isinstance(options, dict) else replace(options, **own)
    scene = sattools.fit(make_hamlet(), options)
    assert repr(scene.history[-1]["options"]["seed"]) == "3"


def test_a_name_that_is_too_long_is_no_scene() -> None:
    with pytest.raises(SceneError, match="found File name too long, expected a readable file with a scene document"):
        sattools.fit(5000 * "a")


def test_the_scene_that_is_given_is_the_one_that_is_changed(make_town: Any) -> None:
    town = make_town()
    assert sattools.export(sattools.fit(town, QUICK)) is town
    assert "dsm" in town.products
    read = sattools.Scene.from_file(town.root / "scene.json")
    assert sattools.fit(read, QUICK, overwrite=True) is read
    assert "dsm" not in read.products  # of the fit before


def test_what_a_program_changes_in_a_scene_that_it_has_read_counts(make_town: Any) -> None:
    read = sattools.Scene.from_file(make_town().root / "scene.json")
    read.items[0].properties["sattools:role"] = "test"
    fitted = sattools.fit(read, QUICK)
    assert [item.id for item in fitted.items if item.role == "test"] == [read.items[0].id]
    assert len(fitted.history[-1]["made"]["fit"]["items"]) == 5


def test_a_scene_that_was_read_before_another_command_worked_on_it_catches_up(make_town: Any) -> None:
    path = make_town().root / "scene.json"
    read = sattools.Scene.from_file(path)
    sattools.fit(path, QUICK)
    before = read.to_json()
    with pytest.raises(InputError):
        sattools.export(read, {"sun": (0.0, -5.0)})
    assert read.to_json() == before
    assert "dsm" in sattools.export(read).products
    assert "model" in read.products


def test_progress_is_a_bar_on_request(make_town: Any, capsys: pytest.CaptureFixture[str]) -> None:
    sattools.fit(make_town(), QUICK, progress=True)
    assert "fit [" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # rioxarray's own
def test_products_are_data_arrays_as_rioxarray_knows_them(make_town: Any) -> None:
    pytest.importorskip("xarray")
    rioxarray = pytest.importorskip("rioxarray")
    scene = sattools.export(sattools.fit(make_town(), QUICK))
    dsm = scene.dsm()
    path = scene.path(scene.products["dsm"])
    with rioxarray.open_rasterio(path, masked=True) as other:
        np.testing.assert_array_equal(dsm.values, other.values[0])
        np.testing.assert_allclose(dsm.x, other.x)
        np.testing.assert_allclose(dsm.y, other.y)
        assert dsm.rio.crs == other.rio.crs
        assert tuple(dsm.rio.transform()) == tuple(other.rio.transform())
        assert dsm.attrs["units"] == other.attrs["units"] == "m"
        assert dsm.attrs["VERTICAL_DATUM"] == other.attrs["VERTICAL_DATUM"] == "WGS84 ellipsoid"
    albedo = scene.product("albedo")
    assert "VERTICAL_DATUM" not in albedo.attrs
    assert albedo.attrs["units"] == "1"
    assert albedo.dims == ("band", "y", "x")
    with pytest.raises(SceneError, match="found no product 'theta', expected one of"):
        scene.product("theta")


def test_without_xarray_the_extra_is_named(make_town: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    town = make_town()
    with pytest.raises(SattoolsError, match="sattools\\[notebook\\]"):
        town.product("truth_dsm")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_reflectance_of_arrays_is_an_array_of_their_type(dtype: Any) -> None:
    up = np.array([0.0, 0.0, 1.0], dtype)
    sun = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8]], dtype)
    found = hapke(up, sun, up, 0.5, 0.2, 0.4, 15.0)
    assert isinstance(found, np.ndarray)
    assert (found.dtype, found.shape) == (dtype, (2,))
    tensors = [torch.from_numpy(v) for v in (up, sun, up)]
    assert torch.equal(torch.from_numpy(found), hapke(*tensors, 0.5, 0.2, 0.4, 15.0))
    assert isinstance(rpv(up, sun, up, rho0=np.array([0.1, 0.2], dtype), k=1.0, theta=0.0, rhoc=1.0), np.ndarray)
    assert isinstance(hapke(torch.from_numpy(up), sun, up, 0.5, 0.2, 0.4, 15.0), torch.Tensor)


def test_integers_are_numbers_too() -> None:
    up = np.array([0, 0, 1])
    assert lambert(up, up, up, np.array([1])) == pytest.approx([1.0])


def test_paths_may_be_texts() -> None:
    with pytest.raises(SceneError, match=r"nowhere\.json"):
        sattools.export(str(Path("nowhere.json")))
