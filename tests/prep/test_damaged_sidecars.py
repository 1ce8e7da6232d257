"""A damaged metadata file beside an image is named, with what was found in it and what was expected."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from synthetic_views import cubic_rpc

from sattools.cli import main
from sattools.errors import InputError
from sattools.prep.loading import load_source
from sattools.scene.sensor_files import write_sensor_image

PIXELS = np.zeros((1, 8, 8), np.uint8)
CUT_TEXT = cubic_rpc().to_rpc_txt().partition("LINE_NUM_COEFF_16")[0]
COEFFICIENTS = {
    "LINENUMCOEF": "LINE_NUM_COEFF",
    "LINEDENCOEF": "LINE_DEN_COEFF",
    "SAMPNUMCOEF": "SAMP_NUM_COEFF",
    "SAMPDENCOEF": "SAMP_DEN_COEFF",
}


def digitalglobe(terms: int) -> str:
    """DigitalGlobe's XML with that many coefficients of each polynomial."""
    tags = cubic_rpc().to_tags()
    own = {key.replace("_OFF", "OFFSET").replace("_", ""): text for key, text in tags.items() if "COEFF" not in key}
    members = "".join(f"<{name}>{text}</{name}>" for name, text in own.items())
    for name, key in COEFFICIENTS.items():
        values = " ".join(tags[key].split()[:terms])
        members += f"<{name}List><{name}>{values}</{name}></{name}List>"
    return f"<isd><RPB><SATID>WV02</SATID><IMAGE><ERRBIAS>1</ERRBIAS><ERRRAND>0</ERRRAND>{members}</IMAGE></RPB></isd>"


def image(folder: Path, tags: dict[str, str] | None = None, name: str = "a.tif") -> Path:
    write_sensor_image(folder / name, PIXELS, tags)
    return folder / name


CASES = [
    ("a_RPC.TXT", CUT_TEXT, "a_RPC.TXT: found 15 usable LINE_NUM_COEFF members of 15, expected 20 finite numbers"),
    ("a.RPB", "lineOffset = 1;\n", "a.RPB: found an RPC without SAMP_OFF, expected all of LINE_OFF, SAMP_OFF, LAT_OFF"),
    ("a.XML", digitalglobe(16), "a.XML: found 16 usable LINE_NUM_COEFF members of 16, expected 20 finite numbers"),
    ("a.XML", digitalglobe(20)[:300], "a.XML: found unreadable XML ("),
    ("a.xml", "<VRTDataset/>", "a.tif: found no RPC, nor one in "),
]


@pytest.mark.parametrize(("name", "text", "told"), CASES)
def test_the_only_camera_of_an_image_is_damaged(tmp_path: Path, name: str, text: str, told: str) -> None:
    image(tmp_path)
    image(tmp_path, cubic_rpc().to_tags(), "b.tif")
    (tmp_path / name).write_text(text)
    result = CliRunner().invoke(main, ["prep", str(tmp_path), "--out", str(tmp_path / "out"), "--id", "A"])
    assert (result.exit_code, result.stdout) == (1, "")
    last = result.stderr.splitlines()[-1]
    assert told in last
    assert name in last
    assert "internal error" not in last


@pytest.mark.parametrize(("name", "text"), [("a_RPC.TXT", CUT_TEXT), ("a.RPB", "lineOffset = 1;\n")])
def test_a_damaged_camera_is_not_replaced_by_the_images_own_silently(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=rf"{name}: found "):
        load_source(image(tmp_path, cubic_rpc().to_tags()), "a", None)


@pytest.mark.parametrize("text", ["<VRTDataset/>", digitalglobe(20)[:300]])
def test_an_image_with_a_camera_of_its_own_may_lie_beside_anything_else(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.xml").write_text(text)
    source = load_source(image(tmp_path, cubic_rpc().to_tags()), "a", None)
    assert (source.rpc.row_offset, source.rpc.col_scale) == (9000.25, 11000.0)


def test_a_whole_file_beside_an_image_is_its_camera(tmp_path: Path) -> None:
    (tmp_path / "a.XML").write_text(digitalglobe(20))
    source: Any = load_source(image(tmp_path), "a", None)
    assert (source.rpc.to_tags(), source.notes) == (cubic_rpc().to_tags(), [])
