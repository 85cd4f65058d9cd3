"""Laws of the package as a whole: what importing costs, which names there are, what the wheel holds."""

import json
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

import openvocab_occ

ROOT = Path(openvocab_occ.__file__).resolve().parents[1]
HEAVY = ("torch", "open3d", "viser", "onnxruntime", "cv2", "numba", "scipy", "pyarrow", "matplotlib", "tensorstore")


def python(*arguments: str, cwd: Path = ROOT, executable: str = sys.executable) -> str:
    return subprocess.run([executable, *arguments], cwd=cwd, check=True, capture_output=True, text=True).stdout


def test_import_is_light() -> None:
    """The least of five imports, so that a busy machine does not count as a heavy package."""
    code = (
        "import time, sys; t = time.perf_counter(); import openvocab_occ; t = time.perf_counter() - t\n"
        f"print(t, [m for m in {HEAVY} if m in sys.modules])"
    )
    runs = [python("-c", code).split(maxsplit=1) for _ in range(5)]
    assert {loaded.strip() for _, loaded in runs} == {"[]"}
    assert min(float(seconds) for seconds, _ in runs) < 0.3


@pytest.mark.parametrize("name", openvocab_occ.__all__)
def test_every_public_name_loads(name: str) -> None:
    assert getattr(openvocab_occ, name).__doc__


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        openvocab_occ.no_such_name  # noqa: B018


def test_reading_a_map_loads_nothing_heavy() -> None:
    """A machine that only asks a saved map needs no network, no viewer and no renderer."""
    code = (
        "import sys, openvocab_occ as ovo; ovo.SceneMap, ovo.find, ovo.render_depth\n"
        "print([m for m in ('torch', 'open3d', 'viser', 'onnxruntime') if m in sys.modules])"
    )
    assert python("-c", code).strip() == "[]"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = f"import hatchling.build as b; print(b.build_wheel({str(folder)!r}))"
    return folder / python("-c", build).split()[-1]


def test_wheel_holds_the_package_alone(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"openvocab_occ"}
    assert "openvocab_occ/segmentation/demo/segmenter.onnx" in names
    assert "openvocab_occ/py.typed" in names


def test_wheel_runs_where_it_is_installed(wheel: Path, tmp_path: Path) -> None:
    """Installed with --no-deps beside the packages of this environment, the demo works far from the checkout."""
    venv.create(tmp_path / "env", with_pip=False)
    bin_ = tmp_path / "env" / "bin"
    lib = Path(
        python("-c", "import sysconfig; print(sysconfig.get_path('purelib'))", executable=str(bin_ / "python")).strip()
    )
    main = python("-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    python("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(lib), str(wheel), cwd=tmp_path)
    (lib / "zz_main_environment.pth").write_text(main + "\n")  # read last: the wheel's package comes first
    where = python(
        "-c", "import openvocab_occ; print(openvocab_occ.__file__)", cwd=tmp_path, executable=str(bin_ / "python")
    )
    assert Path(where.strip()).is_relative_to(lib)
    out = python("-m", "openvocab_occ", "demo", "--no-view", "--json", "--out", str(tmp_path / "out"), cwd=tmp_path,
                 executable=str(bin_ / "python"))  # fmt: skip
    report = json.loads(out)
    assert report["synthetic"]
    assert report["answer"]["verdict"] == "found"
