"""Outputs are whole or not there; nothing foreign is lost."""

import hashlib
from pathlib import Path

import pytest

from openvocab_occ.errors import AlreadyExistsError, NotFoundError
from openvocab_occ.io.files import existing, sha256, written_file, written_folder


class BrokenOff(Exception):
    pass


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_a_file_appears_whole(tmp_path):
    with written_file(tmp_path / "deep" / "a.txt") as scratch:
        scratch.write_text("new")
        assert names(tmp_path / "deep") == [scratch.name]
        assert scratch.suffix == ".txt"
    assert names(tmp_path / "deep") == ["a.txt"]
    assert (tmp_path / "deep" / "a.txt").read_text() == "new"


@pytest.mark.parametrize("before", [None, "old"])
def test_a_file_broken_off_leaves_what_was(tmp_path, before):
    target = tmp_path / "a.txt"
    if before:
        target.write_text(before)

    def write() -> None:
        with written_file(target) as scratch:
            scratch.write_text("half")
            raise BrokenOff

    with pytest.raises(BrokenOff):
        write()
    assert names(tmp_path) == (["a.txt"] if before else [])
    assert not before or target.read_text() == before


def test_a_folder_appears_whole_and_is_replaced_whole(tmp_path):
    target = tmp_path / "map"
    for text in ("one", "two"):
        with written_folder(target, marker="manifest") as scratch:
            (scratch / "manifest").write_text(text)
            (scratch / "sub").mkdir()
            (scratch / "sub" / text).write_text(text)
        assert names(tmp_path) == ["map"]
        assert names(target / "sub") == [text]
        assert (target / "manifest").read_text() == text


@pytest.mark.parametrize("before", [False, True])
def test_a_folder_broken_off_leaves_what_was(tmp_path, before):
    target = tmp_path / "map"
    if before:
        target.mkdir()
        (target / "manifest").write_text("old")

    def write() -> None:
        with written_folder(target, marker="manifest") as scratch:
            (scratch / "manifest").write_text("half")
            raise BrokenOff

    with pytest.raises(BrokenOff):
        write()
    assert names(tmp_path) == (["map"] if before else [])
    assert not before or (target / "manifest").read_text() == "old"


@pytest.mark.parametrize("kind", ["folder", "empty folder", "file"])
def test_what_is_not_ours_is_not_replaced(tmp_path, kind):
    target = tmp_path / "photos"
    if kind == "file":
        target.write_text("mine")
    else:
        target.mkdir()
    if kind == "folder":
        (target / "holiday.jpg").write_text("mine")

    def write() -> None:
        with written_folder(target, marker="manifest"):
            pytest.fail("the body ran")

    with pytest.raises(
        AlreadyExistsError, match=r"photos exists and is not ours to replace: expected a folder with manif"
    ):
        write()
    assert names(tmp_path) == ["photos"]
    assert kind != "folder" or names(target) == ["holiday.jpg"]


def test_existing_returns_the_path(tmp_path):
    assert existing(str(tmp_path), "data") == tmp_path


def test_existing_names_what_lies_beside(tmp_path):
    (tmp_path / "lables.npz").touch()
    with pytest.raises(
        NotFoundError, match=r"labels not found: expected .*labels\.npz, got 1 others there, such as lables\.npz; check"
    ):
        existing(tmp_path / "labels.npz", "labels")
    with pytest.raises(NotFoundError, match=r"labels not found: expected .*, got no folder .*nowhere"):
        existing(tmp_path / "nowhere" / "labels.npz", "labels")


def test_sha256_is_of_the_content(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert sha256(tmp_path / "a") == hashlib.sha256(b"abc").hexdigest()
