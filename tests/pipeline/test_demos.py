"""The programs in demos/ do what they say."""

import runpy
from pathlib import Path

import openvocab_occ

DEMOS = Path(openvocab_occ.__file__).resolve().parents[1] / "demos"


def test_own_recording(tmp_path, capsys):
    runpy.run_path(str(DEMOS / "own_recording.py"))["main"](tmp_path)
    said = capsys.readouterr().out
    assert '"parked trucks": found, 3' in said
    assert 'not understood: "cones"' in said
    assert (tmp_path / "street.ovmap").is_dir()
