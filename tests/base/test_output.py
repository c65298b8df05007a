"""A command deletes what its folder's listing says that it wrote, and writes nowhere else."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from patchproof.base.errors import Refused
from patchproof.base.folder_lock import LISTING_FILE, lock_folder
from patchproof.base.output import (
    check_folder,
    clear_folder,
    new_folder,
    refuse_other_files,
    write_atomically,
    write_files_atomically,
    write_pictures,
)

OWN = ("a.txt", "inner*")


@pytest.fixture
def out(tmp_path) -> Path:
    """A folder as a command leaves it, beside one of somebody's own."""
    folder, theirs = tmp_path / "out", tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "a.txt").write_text("theirs")
    with new_folder(folder, OWN) as part:
        (part / "inner").mkdir()
        (part / "inner" / "b.txt").write_text("1")
        write_atomically(part / "a.txt", "1")
    return folder


def everything(folder: Path) -> dict[str, str]:
    """All files below a folder but for listings, with their text."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != LISTING_FILE)
    return {path.relative_to(folder).as_posix(): path.read_text() for path in paths}


def overwrite(out: Path) -> None:
    with new_folder(out, OWN, overwrite=True) as part:
        (part / "a.txt").write_text("2")


def test_what_was_written_is_replaced(out, tmp_path):
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    overwrite(out)
    assert everything(tmp_path) == {"out/a.txt": "2", "theirs/a.txt": "theirs"}
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def a_file_of_a_user(out: Path) -> None:
    (out / "inner" / "mine.txt").write_text("mine")


def a_linked_folder(out: Path) -> None:
    (out / "inner" / "more").symlink_to(out.parent / "theirs")


def a_link_in_place_of_a_folder(out: Path) -> None:
    (out / "inner" / "b.txt").unlink()
    (out / "inner").rmdir()
    (out / "inner").symlink_to(out.parent / "theirs")


def a_listing_of_a_sender(out: Path) -> None:
    """It names a file that the command never writes, and some elsewhere."""
    (out / "thesis.txt").write_text("mine")
    (out / LISTING_FILE).write_text('["a.txt", "inner/b.txt", "thesis.txt", "../theirs/a.txt", "/etc/passwd"]\n7\n[[')


def no_listing(out: Path) -> None:
    (out / LISTING_FILE).unlink()


def a_listing_elsewhere(out: Path) -> None:
    (out / LISTING_FILE).rename(out.parent / "theirs" / "list")
    (out / LISTING_FILE).symlink_to(out.parent / "theirs" / "list")


FOREIGN = (
    *(a_file_of_a_user, a_linked_folder, a_link_in_place_of_a_folder),
    *(a_listing_of_a_sender, no_listing, a_listing_elsewhere),
)


@pytest.mark.parametrize("change", FOREIGN, ids=lambda each: each.__name__)
def test_a_folder_with_anything_else_is_left_as_it_is(out, tmp_path, change):
    change(out)
    before = everything(tmp_path)
    with pytest.raises(Refused, match="nothing but what this command wrote"):
        overwrite(out)
    assert everything(tmp_path) == before


def test_a_link_to_a_folder_is_not_overwritten(out, tmp_path):
    (tmp_path / "link").symlink_to(out)
    with pytest.raises(Refused, match="a link to another folder"):
        overwrite(tmp_path / "link")
    assert everything(out) == {"a.txt": "1", "inner/b.txt": "1"}


def test_what_came_in_meanwhile_stays(out):
    with pytest.raises(Refused, match=r"late\.txt"), new_folder(out, OWN, overwrite=True):
        (out / "late.txt").write_text("mine")
    assert everything(out) == {"a.txt": "1", "inner/b.txt": "1", "late.txt": "mine"}


def test_an_input_in_the_folder_is_refused(out, tmp_path):
    """Also by another name of the same folder."""
    (tmp_path / "link").symlink_to(out)
    for path in (out, out / "a.txt", tmp_path / "link" / "a.txt", str(out / "inner")):
        with pytest.raises(Refused, match="inputs that lie outside of what is written"):
            check_folder(out, OWN, overwrite=True, inputs=(None, np.zeros(3), path))
    check_folder(out, OWN, overwrite=True, inputs=(tmp_path / "theirs", "coated", 3))


def test_folders_that_are_written_in_place_list_their_files(tmp_path):
    """Also those of commands within, and what a killed one left; what is kept stays listed."""
    out = tmp_path / "out"
    with lock_folder(out):
        out.mkdir()
        write_atomically(out / "a.txt", "1")
        write_pictures([np.zeros((2, 2, 3), np.uint8)], out / "inner")
        write_atomically(tmp_path / "beside.txt", "1")
    lines = [json.loads(line) for line in (out / LISTING_FILE).read_text().split("\n") if line]
    assert lines == [["a.txt"], [f"inner/{LISTING_FILE}"]]
    (out / ".a.txt.part").write_text("half")
    with (out / LISTING_FILE).open("a") as listing:
        listing.write('["cut off')
    with lock_folder(out):
        write_atomically(out / "inner" / "b.txt", "1")
    check_folder(out, OWN, overwrite=True)
    clear_folder(out, keep=lambda name: name == "a.txt")
    assert everything(tmp_path) == {"out/a.txt": "1", "out/.a.txt.part": "half", "beside.txt": "1"}
    clear_folder(out)
    assert everything(tmp_path) == {"beside.txt": "1"} and not out.exists()


@pytest.mark.parametrize("write", [write_atomically, lambda path, text: write_files_atomically({path: text.encode()})])
def test_a_link_in_place_of_a_temporary_file_leads_nowhere(out, tmp_path, write, monkeypatch):
    monkeypatch.setattr("os.getpid", lambda: 7)
    for name in (".a.txt.part", ".a.txt.7.part"):
        (out / name).symlink_to(tmp_path / "theirs" / "a.txt")
    write(out / "a.txt", "2")
    assert (tmp_path / "theirs" / "a.txt").read_text() == "theirs" and (out / "a.txt").read_text() == "2"


def test_links_in_place_of_temporary_folders_and_listings_lead_nowhere(out, tmp_path):
    theirs = tmp_path / "theirs"
    (theirs / LISTING_FILE).write_text('["a.txt"]')
    for name in (".new.part", ".new.old"):
        (tmp_path / name).symlink_to(theirs)
    with new_folder(tmp_path / "new", OWN) as part:
        (part / "a.txt").write_text("2")
    assert everything(theirs) == {"a.txt": "theirs"} and not (tmp_path / "new").is_symlink()
    (out / LISTING_FILE).unlink()
    (out / LISTING_FILE).symlink_to(theirs / "a.txt")
    with lock_folder(out), pytest.raises(Refused, match="which is not one"):
        write_atomically(out / "a.txt", "2")
    assert everything(theirs) == {"a.txt": "theirs"} and everything(out)["a.txt"] == "1"


def test_a_link_in_place_of_the_sorted_listing_leads_nowhere(out, tmp_path):
    """Every command that locks a received folder sorts its listing at the end, also one that only adds a file."""
    (out / f"{LISTING_FILE}.part").symlink_to(tmp_path / "theirs" / "a.txt")
    with lock_folder(out):
        write_atomically(out / "inner" / "c.txt", "3")
    assert (tmp_path / "theirs" / "a.txt").read_text() == "theirs"
    assert (out / LISTING_FILE).read_text() == '["a.txt"]\n["inner/b.txt"]\n["inner/c.txt"]\n'


def test_folders_in_place_of_temporary_files_are_refused_or_left(out):
    (out / ".a.txt.part").mkdir()
    with pytest.raises(Refused, match="a folder that can be written to"):
        write_atomically(out / "a.txt", "2")
    clear_folder(out)
    assert not out.exists()


def a_file(path: Path) -> None:
    path.write_text("mine")


def a_link_to_nothing(path: Path) -> None:
    path.symlink_to(path.parent / "nothing")


def a_folder_with_files(path: Path) -> None:
    path.mkdir()
    a_file(path / "mine.txt")


@pytest.mark.parametrize(
    ("name", "make", "sentence"),
    [
        ("new", a_file, "a folder to write to, got .*new, which is not a folder"),
        ("new", a_link_to_nothing, "a folder to write to, got .*new, which is not a folder"),
        ("new", os.mkfifo, "a folder to write to, got .*new, which is not a folder"),
        (".new.old", a_file, r"a folder that can be replaced, got .*\.new\.old"),
        (".new.old", a_folder_with_files, r"a folder that can be replaced, got .*\.new\.old .*not empty"),
        (".new.lock.part", os.mkfifo, r"a lock file of this program at .*\.new\.lock\.part, got something else"),
        (".new.lock.part", lambda path: path.write_text("a longer text of somebody's"), "a lock file of this program"),
    ],
)
def test_what_lies_in_the_way_of_a_new_folder_is_refused_and_stays(tmp_path, name, make, sentence):
    if name != "new":
        (tmp_path / "new").mkdir()
    make(tmp_path / name)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(Refused, match=sentence), new_folder(tmp_path / "new", OWN) as part:
        (part / "a.txt").write_text("1")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", [".", "..", "/", "x/.."])
def test_a_folder_without_a_name_cannot_be_replaced(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Refused, match="a folder by its name"), new_folder(name, OWN, overwrite=True):
        pass


def test_a_folder_that_is_continued_has_no_links(out, tmp_path):
    """What is written would go where they lead, and what they lead to would be read into reports."""
    refuse_other_files(out, OWN)
    (out / "a.txt").unlink()
    (out / "a.txt").symlink_to(tmp_path / "theirs" / "a.txt")
    with pytest.raises(Refused, match=r"with a\.txt"):
        refuse_other_files(out, OWN)
    (out / "a.txt").unlink()
    a_linked_folder(out)
    with pytest.raises(Refused, match="with inner/more"):
        refuse_other_files(out, OWN)
