"""What is left out of PyTorch is gone from its folder and from its list of files, and nothing else is."""

import importlib.metadata
import subprocess
import sys
from pathlib import Path, PurePosixPath

import pytest

from sattools.errors import SattoolsError
from sattools.slim import for_developers, leave_out

FILES = {
    "torch/__init__.py": "x = 1\n",
    "torch/bin/torch_shm_manager": "s",
    "torch/bin/test_api": "abc",
    "torch/bin/protoc": "de",
    "torch/include/ATen/cpu/vec.h": "f",
    "torch/test/List_test": "ghij",
    "torch/lib/libtorch.so": "k",
}


@pytest.fixture
def installed(tmp_path: Path) -> importlib.metadata.PathDistribution:
    about = tmp_path / "torch-2.13.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: torch\nVersion: 2.13.0\n")
    (about / "INSTALLER").write_text("pip\n")
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    own = [f"{about.name}/{name}" for name in ("METADATA", "INSTALLER", "RECORD")]
    (about / "RECORD").write_text("".join(f"{name},,\n" for name in [*FILES, *own]))
    return importlib.metadata.PathDistribution(about)


def test_tests_and_headers_go_and_the_list_says_so(
    installed: importlib.metadata.PathDistribution, tmp_path: Path
) -> None:
    assert leave_out(installed) == 10
    left = sorted(str(path.relative_to(tmp_path)) for path in (tmp_path / "torch").rglob("*") if path.is_file())
    assert left == ["torch/__init__.py", "torch/bin/torch_shm_manager", "torch/lib/libtorch.so"]
    assert not (tmp_path / "torch/include").exists()
    listed = [str(name) for name in installed.files or ()]
    assert [name for name in listed if name.startswith("torch/")] == [
        "torch/__init__.py",
        "torch/bin/torch_shm_manager",
        "torch/lib/libtorch.so",
    ]
    assert all(Path(str(installed.locate_file(name))).is_file() for name in listed)
    assert leave_out(installed) == 0, "a second time nothing is left to remove"


@pytest.mark.parametrize("installer", ["conda", ""])
def test_what_another_installer_keeps_track_of_is_not_touched(
    installed: importlib.metadata.PathDistribution, tmp_path: Path, installer: str
) -> None:
    (tmp_path / "torch-2.13.0.dist-info/INSTALLER").write_text(installer)
    with pytest.raises(SattoolsError, match=f"found it installed by {installer or 'nobody'}, expected pip or uv"):
        leave_out(installed)
    assert all((tmp_path / name).is_file() for name in FILES)


def test_torch_imports_nothing_of_what_is_left_out() -> None:
    """No module of Python lies there, and no library that this process has loaded."""
    names = [PurePosixPath(str(name)) for name in importlib.metadata.files("torch") or ()]
    assert not [str(name) for name in names if for_developers(name) and name.suffix in (".py", ".so")]
    look = "import torch; print(torch.ones(2).sum()); print(open('/proc/self/maps').read())"
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert not [part for part in ("/torch/test/", "/torch/bin/", "/torch/include/") if part in done.stdout]
