"""The algorithms in a real QGIS, without a screen: same results as the command line."""

import filecmp
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest
from click.testing import CliRunner
from patience import HANGING_S

from sattools.cli import main
from sattools.scene.raster import read_raster, write_cog

QGIS = shutil.which("qgis_process.bin") or shutil.which("qgis_process")
ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.qgis, pytest.mark.skipif(QGIS is None, reason="QGIS is not installed")]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory, quick_program: Path) -> Any:
    """Variables for a QGIS of its own profile that finds the plugin and the executable."""
    folder = tmp_path_factory.mktemp("qgis")
    runtime = folder / "runtime"
    runtime.mkdir(mode=0o700)
    found = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "QT_", "GDAL_", "PROJ_", "LD_"))}
    found |= {
        "QT_QPA_PLATFORM": "offscreen",
        "XDG_RUNTIME_DIR": str(runtime),
        "QGIS_CUSTOM_CONFIG_PATH": str(folder / "profile"),
        "QGIS_PLUGINPATH": str(ROOT / "qgis_plugin"),
        # QGIS takes the first python3 on PATH for its own: the system's has to come before any other
        "PATH": f"/usr/bin:/bin:{quick_program}",
    }
    subprocess.run([QGIS, "plugins", "enable", "sattools_qgis"], env=found, check=True, capture_output=True)
    return found


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A small simulated city's folder."""
    folder = tmp_path_factory.mktemp("city")
    sattools("simulate", "--out", folder, "--id", "TOWN", "--size", "32", "--views", "4", "--dates", "2")
    return folder / "TOWN"


def sattools(*arguments: Any) -> Any:
    done = CliRunner().invoke(main, ["-q", *map(str, arguments)])
    assert done.exit_code == 0, done.stderr
    return done.stdout


def process(environment: Any, algorithm: Any, **parameters: Any) -> Any:
    """Run an algorithm; returns (exit code, its results, everything it said)."""
    given = [
        f"--{k}={v}" for k, values in parameters.items() for v in (values if isinstance(values, list) else [values])
    ]
    done = subprocess.run(
        [QGIS, "run", f"sattools:{algorithm}", "--json", *given], env=environment, capture_output=True, text=True
    )
    said = done.stdout + done.stderr
    start = done.stdout.find("{\n")
    results = json.loads(done.stdout[start:])["results"] if done.returncode == 0 else {}
    return done.returncode, results, said


def test_prepare_fit_export_compare_give_what_the_command_line_gives(
    environment: Any, city: Any, tmp_path: Path
) -> None:
    images = sorted(str(p) for p in (city / "images").glob("*.tif"))
    metadata, truth = str(city / "metadata"), str(city / "truth" / "TOWN_DSM.tif")
    (tmp_path / "cli").mkdir()
    (tmp_path / "qgis").mkdir()
    sattools("prep", *images, "--metadata", metadata, "--id", "TOWN", "--out", tmp_path / "cli")
    scene = tmp_path / "cli" / "TOWN" / "scene.json"
    sattools("fit", scene, "--epochs", "2")
    sattools("export", scene)
    figures = json.loads(sattools("compare", scene, "--dsm", truth))

    code, results, said = process(
        environment, "prep", IMAGES=images, METADATA=metadata, ID="TOWN", OUT=str(tmp_path / "qgis")
    )
    assert code == 0, said
    document = results["SCENE_DOCUMENT"]
    assert process(environment, "fit", SCENE=document, EPOCHS="2")[0] == 0
    code, maps, said = process(environment, "export", SCENE=document)
    assert code == 0, said
    code, scores, said = process(environment, "compare", SCENE=document, DSM=truth)
    assert code == 0, said
    assert filecmp.cmp(maps["DSM"], tmp_path / "cli" / "TOWN" / "export" / "dsm.tif", shallow=False)
    assert scores["MAE"] == figures["mae"]
    code, moved, said = process(environment, "align", SCENE=document, TO=truth)
    assert code == 0, said
    assert Path(moved["DSM"]) == tmp_path / "qgis" / "TOWN" / "align" / "1" / "dsm.tif"
    assert Path(moved["DSM"]).is_file()


def test_run_all_replaces_a_scene_of_other_images_only_where_that_is_asked_for(
    environment: Any, city: Any, tmp_path: Path
) -> None:
    """Two deliveries with files of equal names have scenes of equal names; what was made of the first goes, too."""
    images = sorted(str(p) for p in (city / "images").glob("*.tif"))
    given = {"IMAGES": images, "METADATA": str(city / "metadata"), "ID": "TOWN", "OUT": str(tmp_path)}
    sattools("prep", *images, "--metadata", city / "metadata", "--id", "TOWN", "--out", tmp_path, "--cell-size", "2")
    document = tmp_path / "TOWN" / "scene.json"
    sattools("fit", document, "--epochs", "1")
    sattools("export", document)
    before = document.read_bytes()
    code, _, said = process(environment, "runall", **given)
    assert code != 0
    assert "exists already; give --overwrite to replace it" in said
    assert document.read_bytes() == before
    code, results, said = process(environment, "runall", **given, CELL_SIZE="1", OVERWRITE="true")
    assert code == 0, said
    assert Path(results["SCENE_DOCUMENT"]) == document
    assert read_raster(Path(results["DSM"]))[1].cell_size == 1.0


def test_two_dates_are_compared_beside_the_earlier_one(environment: Any, city: Any, tmp_path: Path) -> None:
    heights, grid = read_raster(city / "truth" / "TOWN_DSM.tif")
    (tmp_path / "a").mkdir()
    write_cog(tmp_path / "a" / "before.tif", heights, grid)
    later = heights.copy()
    later[0, 10:30, 10:30] += 9
    write_cog(tmp_path / "after.tif", later, grid)
    code, results, said = process(
        environment, "change", BEFORE=str(tmp_path / "a/before.tif"), AFTER=str(tmp_path / "after.tif")
    )
    assert code == 0, said
    assert results["REGIONS"] == 1
    assert Path(results["HEIGHT_CHANGE"]) == tmp_path / "a" / "change" / "height_change.tif"
    for name in ("HEIGHT_CHANGE", "SIGNIFICANCE", "CHANGES"):
        assert Path(results[name]).is_file()
    said = in_python(
        environment,
        "from sattools_qgis.processing.styles import dress\n"
        f"layer = QgsRasterLayer({results['HEIGHT_CHANGE']!r}, 'height_change'); dress(layer, 'height_change')\n"
        "print('ends', layer.renderer().classificationMin(), layer.renderer().classificationMax())\n"
        f"layer = QgsVectorLayer({results['CHANGES']!r}, 'changes', 'ogr'); dress(layer, 'changes')\n"
        "print('regions', layer.featureCount(), layer.renderer().type())\n"
        "layer = None",
    )
    assert "ends -5.0 5.0" in said
    assert "regions 1 singleSymbol" in said


def in_python(environment: Any, program: str, **more: str) -> str:
    """What a program printed in QGIS's own Python, `provider` being loaded and `window` None."""
    start = (
        "import sys\n"
        "from qgis.core import *\n"
        f"sys.path[:0] = ['/usr/share/qgis/python/plugins', {str(ROOT / 'qgis_plugin')!r}]\n"
        "app = QgsApplication([], True); app.initQgis()\n"
        "import processing.core.ProcessingConfig\n"
        "from sattools_qgis.processing.provider import SattoolsProvider\n"
        "provider = SattoolsProvider(); provider.load(); QgsApplication.processingRegistry().addProvider(provider)\n"
    )
    done = subprocess.run(
        ["/usr/bin/python3", "-c", start + program + "\nprovider = None; app.exitQgis()\n"],
        env=environment | more, capture_output=True, text=True, timeout=HANGING_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_places_are_chosen_with_the_widgets_of_qgis(environment: Any) -> None:
    said = in_python(
        environment,
        "for name in ('prep', 'runall', 'fit'):\n"
        "    algorithm = provider.algorithm(name)\n"
        "    for p in algorithm.parameterDefinitions():\n"
        "        print(name, p.name(), p.type(), bool(p.flags() & p.FlagAdvanced), algorithm.group(), sep='|')",
    )
    found = {tuple(line.split("|")[:2]): line.split("|")[2:] for line in said.splitlines() if line.count("|") == 4}
    for name, advanced in (("prep", False), ("runall", False)):
        group = "Steps" if name == "prep" else "All in one"
        assert found[name, "AOI"] == ["vector", str(advanced), group]
        assert found[name, "BOUNDS"] == ["extent", str(advanced), group]
        assert found[name, "CRS"] == ["crs", str(advanced), group]
    assert found["runall", "CELL_SIZE"][:2] == ["number", "False"]
    assert found["runall", "VERTICAL"][:2] == ["enum", "False"]
    assert found["runall", "MASK"][:2] == ["multilayer", "True"]
    assert found["runall", "DSM"][0] == "raster"
    assert found["fit", "STEPS"][1] == "True"


def test_an_extent_in_any_crs_and_a_layer_in_memory_become_what_prep_takes(environment: Any) -> None:
    said = in_python(
        environment,
        "from sattools_qgis.processing.parameters import read\n"
        "from sattools_qgis.forms import arguments\n"
        "algorithm = provider.algorithm('prep').create()\n"
        "layer = QgsVectorLayer('Polygon?crs=EPSG:32631', 'area', 'memory')\n"
        "feature = QgsFeature(); feature.setGeometry(QgsGeometry.fromWkt('POLYGON((0 0, 9 0, 9 9, 0 0))'))\n"
        "layer.dataProvider().addFeature(feature); QgsProject.instance().addMapLayer(layer)\n"
        "context = QgsProcessingContext(); context.setProject(QgsProject.instance())\n"
        "given = {'BOUNDS': '500000,500100,4000000,4000100 [EPSG:32631]', 'AOI': layer.id(), 'MASK': [layer.id()]}\n"
        "feedback = QgsProcessingFeedback()\n"
        "def line(given):\n"
        "    form = algorithm.form\n"
        "    return ' '.join(arguments(form, {f['key']: read(algorithm, f, given, context, feedback) for f in form}))\n"
        "print('degrees:', line(given)); given['CRS'] = 'EPSG:32631'; print('metres:', line(given))\n"
        "for wrong in ({'AOI': '/nowhere.gpkg'}, {'MASK': [layer.id(), '/nowhere.gpkg']}):\n"
        "    try:\n"
        "        print('ignored', line(wrong))\n"
        "    except QgsProcessingException as error:\n"
        "        print('refused', error)\n",
    )
    assert [x.split(":")[0] for x in said.splitlines() if x.startswith(("ignored", "refused"))] == [
        "refused AOI", "refused MASK",
    ]  # fmt: skip
    degrees, metres = (next(x for x in said.splitlines() if x.startswith(n)).split() for n in ("degrees:", "metres:"))
    west, south, east, north = map(float, degrees[degrees.index("--bounds") + 1 :][:4])
    assert west == pytest.approx(3.0, abs=1e-6)  # the zone's middle
    assert 36.0 < south < north < 36.3
    assert east - west == pytest.approx(100 / 111320 / 0.807, rel=0.01)
    place = metres.index("--bounds")
    assert metres[place + 1 : place + 5] == ["500000", "4000000", "500100", "4000100"]
    assert metres[metres.index("--crs") + 1] == "EPSG:32631"
    for flag in ("--aoi", "--mask"):
        copy = metres[metres.index(flag) + 1]
        assert copy.endswith(".gpkg")


def test_results_stand_in_a_group_in_their_order_and_no_map_is_black(environment: Any, tmp_path: Path) -> None:
    import numpy as np
    import rasterio
    from affine import Affine

    rng = np.random.default_rng(1)
    maps = {"albedo": rng.random((40, 40)), "dsm": rng.random((40, 40)), "dsm_std": rng.random((40, 40))}
    maps["dsm_std"][0, 0] = 330.0
    for name, values in maps.items():
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", width=40, height=40, count=1, dtype="float32",
            crs="EPSG:32631", transform=Affine(1, 0, 5e5, 0, -1, 4e6),
        ) as file:  # fmt: skip
            file.write(values.astype("float32"), 1)
    said = in_python(
        environment,
        "from processing.gui.Postprocessing import handleAlgorithmResults\n"
        "algorithm = provider.algorithm('export').create()\n"
        "QgsProject.instance().setCrs(QgsCoordinateReferenceSystem('EPSG:4979'))\n"
        "for _ in range(2):  # the second time replaces the first\n"
        "    context = QgsProcessingContext(); context.setProject(QgsProject.instance())\n"
        f"    files = {{n: '{tmp_path}/' + n + '.tif' for n in ('dsm', 'dsm_std', 'albedo')}}\n"
        "    algorithm.load(files, context, 'TOWN')\n"
        "    print('well', handleAlgorithmResults(algorithm, context, QgsProcessingFeedback()))\n"
        "    for _ in range(5):  # QGIS drops layers that are in no tree when it has time to\n"
        "        app.processEvents()\n"
        "group = QgsProject.instance().layerTreeRoot().findGroup('TOWN')\n"
        "print('tree', [(n.name(), n.itemVisibilityChecked()) for n in group.children()])\n"
        "print('layers', len(QgsProject.instance().mapLayers()))\n"
        "layer = QgsProject.instance().mapLayersByName('dsm_std')[0]\n"
        "print('high', layer.renderer().classificationMax())\n"
        "print('crs', QgsProject.instance().crs().authid())\n"
        "QgsProject.instance().clear()",
    )
    lines = dict(
        line.split(" ", 1) for line in said.splitlines() if line.split(" ", 1)[0] in ("tree", "high", "layers", "crs")
    )
    assert said.count("well True") == 2, said
    assert lines["tree"] == "[('dsm', True), ('dsm hillshade', True), ('albedo', False), ('dsm_std', False)]"
    assert int(lines["layers"]) == 4
    assert lines["crs"] == "EPSG:32631"
    assert 0.9 < float(lines["high"]) < 1.1


def test_colours_of_four_bands_are_their_own(environment: Any, tmp_path: Path) -> None:
    import numpy as np

    from sattools.scene import Grid

    grid = Grid("EPSG:32631", 5e5, 4e6, 1.0, 40, 40)
    names = [f"albedo {name}" for name in ("blue", "green", "red", "nir08")]
    values = np.random.default_rng(1).random((4, 40, 40)).astype(np.float32)
    write_cog(tmp_path / "albedo.tif", values, grid, descriptions=names)
    said = in_python(
        environment,
        "from sattools_qgis.processing.styles import natural\n"
        f"layer = QgsRasterLayer('{tmp_path}/albedo.tif', 'albedo')\n"
        "natural(layer)\n"
        "shown = layer.renderer()\n"
        "print('shown', shown.redBand(), shown.greenBand(), shown.blueBand(), flush=True)\n"
        "shown = layer = None",  # before QGIS goes
    )
    assert "shown 3 2 1" in said


def test_without_the_executable_the_toolbox_says_so_and_asks_for_it(environment: Any) -> None:
    said = in_python(
        environment,
        "print('shown', [(a.name(), a.displayName()) for a in provider.algorithms()])\n"
        "print('warning', provider.warningMessage())\n"
        "algorithm = provider.algorithm('setup').create()\n"
        "class Feedback(QgsProcessingFeedback):\n"
        "    def reportError(self, text, fatalError=False):\n"
        "        print('error', text)\n"
        "print('ran', algorithm.run({'EXECUTABLE': '/nowhere'}, QgsProcessingContext(), Feedback())[1])\n",
        PATH="/usr/bin:/bin",
    )
    assert "shown [('setup', 'Set up: the sattools executable is missing')]" in said
    assert "warning found no sattools executable; install it" in said
    assert "ran False" in said


def test_the_report_is_written_from_the_toolbox(environment: Any, city: Any, tmp_path: Path) -> None:
    shutil.copytree(city, tmp_path / "moved")
    code, results, said = process(environment, "report", SCENE=str(tmp_path / "moved" / "scene.json"))
    assert code == 0, said
    assert Path(results["REPORT"]) == tmp_path / "moved" / "report.html"
    assert Path(results["REPORT"]).is_file()


def test_bad_input_fails_with_the_commands_message(environment: Any, tmp_path: Path) -> None:
    wrong = tmp_path / "scene.json"
    wrong.write_text("{}")
    code, _, said = process(environment, "fit", SCENE=str(wrong))
    assert code == 1
    assert "sattools fit: error:" in said
    assert "scene.json" in said


def test_cancelling_a_fit_leaves_no_process_and_no_half_file(environment: Any, city: Any, tmp_path: Path) -> None:
    sattools(
        "prep",
        *sorted((city / "images").glob("*.tif")),
        "--metadata",
        city / "metadata",
        "--id",
        "TOWN",
        "--out",
        tmp_path,
    )
    scene = tmp_path / "TOWN" / "scene.json"
    before = scene.read_bytes()
    program = (
        "import sys, threading\n"
        "from qgis.core import QgsApplication, QgsProcessingContext, QgsProcessingFeedback\n"
        f"sys.path[:0] = ['/usr/share/qgis/python/plugins', {str(ROOT / 'qgis_plugin')!r}]\n"
        "app = QgsApplication([], False); app.initQgis()\n"
        "import processing.core.ProcessingConfig\n"
        "from sattools_qgis.processing.provider import SattoolsProvider\n"
        "provider = SattoolsProvider(); QgsApplication.processingRegistry().addProvider(provider)\n"
        "class Impatient(QgsProcessingFeedback):\n"
        "    def pushInfo(self, text):\n"
        "        if 'epoch' in text:\n"
        "            self.cancel()\n"
        "feedback = Impatient()\n"
        "late = threading.Timer(100, feedback.cancel); late.daemon = True; late.start()\n"
        f"given = {{'SCENE': {str(scene)!r}, 'EPOCHS': '100000'}}\n"
        "algorithm = provider.algorithm('fit').create()\n"
        "_, well = algorithm.run(given, QgsProcessingContext(), feedback)\n"
        "print('finished', well)\n"
        "provider = algorithm = None; late.cancel(); app.exitQgis()\n"
    )
    installed = environment | {"PATH": f"/usr/bin:/bin:{Path(sys.executable).parent}"}
    done = subprocess.run(
        ["/usr/bin/python3", "-c", program], env=installed, capture_output=True, text=True, timeout=HANGING_S
    )
    assert "finished False" in done.stdout, done.stdout + done.stderr
    left = [p.info["cmdline"] for p in psutil.process_iter(["cmdline"]) if str(scene) in (p.info["cmdline"] or [])]
    assert left == []
    assert scene.read_bytes() == before
    assert not [p for p in (tmp_path / "TOWN").rglob("*") if p.name.startswith(".") or p.suffix in (".part", ".tmp")]
    assert not (tmp_path / "TOWN" / "fit" / "model.safetensors").exists()


def test_the_provider_loads_without_heavy_libraries(environment: Any) -> None:
    program = (
        "import sys\n"
        "from qgis.core import QgsApplication\n"
        f"sys.path[:0] = ['/usr/share/qgis/python/plugins', {str(ROOT / 'qgis_plugin')!r}]\n"
        "app = QgsApplication([], False); app.initQgis()\n"
        "import processing.core.ProcessingConfig\n"
        "from sattools_qgis.processing.provider import SattoolsProvider\n"
        "provider = SattoolsProvider(); provider.load()\n"
        "print(len(provider.algorithms()), sorted({'torch', 'sattools', 'numba'} & set(sys.modules)))\n"
        "provider = None; app.exitQgis()\n"
    )
    done = subprocess.run(["/usr/bin/python3", "-c", program], env=environment, capture_output=True, text=True)
    count, heavy = done.stdout.splitlines()[-1].split(maxsplit=1)
    assert int(count) >= 7
    assert heavy == "[]"
