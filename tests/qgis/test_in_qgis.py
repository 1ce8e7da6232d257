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
from patience import HANGING_S

QGIS = shutil.which("qgis_process.bin") or shutil.which("qgis_process")
ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.qgis, pytest.mark.skipif(QGIS is None, reason="QGIS is not installed")]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Any:
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
        "PATH": f"/usr/bin:/bin:{Path(sys.executable).parent}",
    }
    subprocess.run([QGIS, "plugins", "enable", "sattools_qgis"], env=found, check=True, capture_output=True)
    return found


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A small simulated city's folder."""
    folder = tmp_path_factory.mktemp("city")
    sattools("simulate", "--out", folder, "--id", "TOWN", "--size", "48", "--views", "4", "--dates", "2")
    return folder / "TOWN"


def sattools(*arguments: Any) -> Any:
    command = [sys.executable, "-m", "sattools", "-q", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


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
    done = subprocess.run(
        ["/usr/bin/python3", "-c", program], env=environment, capture_output=True, text=True, timeout=HANGING_S
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
