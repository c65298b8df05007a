"""Many photographs: what was finished survives a kill, memory does not grow, and no file stops the others."""

from __future__ import annotations

import json
import os
import shutil
import signal
import weakref
from concurrent.futures import Future
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_photos import make_manifest, save

from patchproof.app.verify import CaptureInfo, verify
from patchproof.base.errors import Refused, WorkerDied
from patchproof.base.workers import can_fork
from patchproof.channel.printer import identity_printer
from patchproof.classifier import Classifier
from patchproof.evidence import batch, measure
from patchproof.evidence.batch import FinishedPhoto, Journal, file_sha256
from patchproof.evidence.gather import gather_evidence
from patchproof.evidence.results import PhotoEntry
from patchproof.evidence.task import Options, task_of
from patchproof.photo.read import HEIC_ADVICE, read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import dump_manifest
from test_verify_run import NET, promise, shot

WRITTEN = ("report.json", "report.csv", "report.html", "photos.jsonl")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    photos = tmp_path_factory.mktemp("photos")
    for i in range(3):
        save(shot(8 * i - 20, 500 + 20 * i, seed=i, noise=0.003), photos / f"b{i}.jpg")
    (photos / "a.JPG").write_text("no picture")
    return photos


@pytest.fixture(scope="module")
def sheet(tmp_path_factory) -> Path:
    """A sheet that promises something of the built-in network."""
    from patchproof.classifier.load import load_classifier

    near, far = (
        dict(px_per_mm=s, tilt_deg=t, azimuth_deg=a, contrast=0.8, blur_px=0.5)
        for s, t, a in ((0.2, 0.0, -80.0), (9.0, 70.0, 80.0))
    )
    said = promise([near, far])
    network = load_classifier("builtin", Path("."))
    said["models"][0] |= {"name": "builtin", "sha256": network.sha256}
    said["target"] |= {"label": network.labels[0]}
    path = tmp_path_factory.mktemp("sheet") / "sheet.json"
    path.write_text(dump_manifest(make_manifest(said)), encoding="utf-8")
    return path


def killed_after_three(folder: Path, sheet: Path, out: Path) -> None:
    def die(stage, done, total):
        if done == 3:
            os.kill(os.getpid(), signal.SIGKILL)

    verify(folder, sheet, out, progress=die)


def test_a_kill_costs_what_was_in_work_and_not_the_report(folder, sheet, tmp_path):
    verify(folder, sheet, tmp_path / "whole", ledger_photos=2)
    out = tmp_path / "killed"
    process = get_context("fork" if can_fork() else "spawn").Process(
        target=killed_after_three, args=(folder, sheet, out)
    )
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert len((out / "photos.jsonl").read_text().splitlines()) == 3 and not (out / "report.json").exists()
    with pytest.raises(Refused, match="which is unfinished: continue with --resume"):
        verify(folder, sheet, out)
    with open(out / "photos.jsonl", "a") as file:
        file.write('{"file": "b2.jpg", "sha')  # a line that the kill cut short
    verify(folder, sheet, out, resume=True, ledger_photos=2)
    for name in WRITTEN:
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    pictures = {p.name: p.read_bytes() for p in (out / "pictures").iterdir()}
    assert pictures == {p.name: p.read_bytes() for p in (tmp_path / "whole" / "pictures").iterdir()}


def test_resuming_measures_only_what_is_new_or_differs(tmp_path, folder, monkeypatch):
    photos, opened = tmp_path / "photos", []
    photos.mkdir()
    for name in ("a.JPG", "b0.jpg", "b1.jpg"):
        (photos / name).write_bytes((folder / name).read_bytes())
    monkeypatch.setattr(batch, "read_photo", lambda path: opened.append(path.name) or read_photo(path))

    def judged(resume=True, progress=lambda done, total: None, **options):
        opened.clear()
        options = Options([NET], identity_printer(), ledger_photos=0, **options)
        kept = dict(journal=tmp_path / "photos.jsonl", resume=resume, advance=progress)
        return gather_evidence(photos, make_manifest(promise()), options, **kept)

    first = judged()
    assert len(opened) == 3
    assert judged() == first and opened == []
    (photos / "b1.jpg").write_bytes((photos / "b0.jpg").read_bytes())
    save(shot(3, 520), photos / "c.jpg")
    assert len(judged().photos) == 4 and opened == ["b1.jpg", "c.jpg"]
    (photos / "c.jpg").unlink()
    assert len(judged().photos) == 3 and opened == []
    judged(scan_dpi=100.0)
    assert len(opened) == 3  # another option, another result
    judged(resume=False)
    assert len(opened) == 3
    controls = {"controls": photos}
    assert judged(**controls).controls == judged(**controls).controls and opened == []
    steps = []
    judged(**controls, progress=lambda done, total: steps.append((done, total)))
    assert steps == [(6, 6)]  # what an earlier run did counts as done


def test_squares_do_not_wait_for_each_other(folder, monkeypatch):
    alive, most = [], []
    squares_of = batch.squares_of

    def watched(srgb, sizes_px):
        squares = {size: square.copy() for size, square in squares_of(srgb, sizes_px).items()}
        alive.extend(weakref.ref(square) for square in squares.values())
        return squares

    def network(photos):
        most.append(sum(ref() is not None for ref in alive))
        return torch.zeros(len(photos), 2)

    monkeypatch.setattr(batch, "squares_of", watched)
    net = Classifier("net", "ab" * 32, 32, ("bright", "dark"), network)
    gather_evidence(folder, make_manifest(promise()), Options([net], identity_printer(), ledger_photos=0))
    assert len(alive) == 3 and max(most) == 1


class Deadly:
    """Workers of which one file kills each."""

    def completed(self, function, items):
        for number, item in enumerate(items):
            future = Future()
            if item.path.name == "b2.jpg":
                future.set_exception(WorkerDied("a", "b", "c"))
            else:
                future.set_result(function(item))
            yield number, future


def test_a_photograph_that_ends_its_process_each_time_is_rejected_and_the_others_go_on(folder):
    task = task_of(make_manifest(promise()), Options([NET], identity_printer()), None)
    items = [batch.PhotoItem(path, path.name) for path in sorted(folder.iterdir())]
    photos = batch.measure_all(task, items, None, Deadly(), None, lambda *_: None, lambda *_: None)
    codes = {photo.entry.file: (photo.entry.status, photo.entry.code) for photo in photos}
    assert codes.pop("b2.jpg") == ("rejected", "unreadable") and codes.pop("a.JPG") == ("rejected", "unreadable")
    assert set(codes.values()) == {("measured", None)}


def test_a_figure_that_is_no_number_costs_one_photograph(folder, monkeypatch):
    names = []

    def wrong(view, name, *rest):
        names.append(name)
        return measure.measure(view, name, *rest)

    blur_px = measure.blur_px
    monkeypatch.setattr(batch, "measure", wrong)
    monkeypatch.setattr(measure, "blur_px", lambda m: float("nan") if names[-1] == "b2.jpg" else blur_px(m))
    options = Options([NET], identity_printer(), ledger_photos=0)
    found = gather_evidence(folder, make_manifest(promise()), options).photos
    assert [p.file for p in found if p.status == "rejected"] == ["a.JPG", "b2.jpg"]


def test_a_journal_forgets_other_keys_and_other_bytes(tmp_path):
    photo, path = tmp_path / "a.jpg", tmp_path / "photos.jsonl"
    entry = PhotoEntry(file="a.jpg", status="judged", sha256="a" * 64)
    finished = FinishedPhoto(entry=entry, counted=True, light=None, pictures=False)
    photo.write_bytes(b"one")
    for key, again in (("k", True), ("other", False)):
        journal = Journal(path, "k", resume=False)
        journal.add("a.jpg", file_sha256(photo), finished)
        journal.close()
        journal = Journal(path, key, resume=True)
        assert (journal.find("a.jpg", photo) == finished) is again
        journal.close()
    photo.write_bytes(b"two")
    journal = Journal(path, "k", resume=True)
    assert journal.find("a.jpg", photo) is None
    journal.close()


def test_a_folder_of_somebody_else_is_not_resumed(folder, sheet, tmp_path):
    (tmp_path / "thesis.txt").write_text("x")
    for resume in (True, False):
        with pytest.raises(Refused, match="a folder with this command's own output only" if resume else "1 files"):
            verify(folder, sheet, tmp_path, resume=resume)
    with pytest.raises(Refused, match=r"thesis\.txt"):
        verify(folder, sheet, tmp_path, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_resolution_that_no_scan_has_and_empty_arrays_are_refused(folder, sheet, tmp_path):
    with pytest.raises(Refused, match="from 30 to 4800 dpi, got 0: correct"):
        verify(folder, sheet, tmp_path / "out", capture=CaptureInfo(scan_dpi=0))
    with pytest.raises(Refused, match=r"got uint8 \(0, 0, 3\) at index 0"):
        verify([np.zeros((0, 0, 3), np.uint8)], sheet, tmp_path / "out")


def test_a_report_of_another_sheet_is_not_resumed(folder, sheet, tmp_path):
    verify(folder, sheet, tmp_path / "out", ledger_photos=0)
    before = {p: p.read_bytes() for p in (tmp_path / "out").rglob("*.*")}
    other = json.loads(sheet.read_text())
    (tmp_path / "other.json").write_text(json.dumps(other | {"sheet_id": other["sheet_id"][::-1]}))
    with pytest.raises(Refused, match=rf"Expected the sheet {other['sheet_id']} of the report in .*out, got "):
        verify(folder, tmp_path / "other.json", tmp_path / "out", resume=True, ledger_photos=0)
    assert {p: p.read_bytes() for p in (tmp_path / "out").rglob("*.*")} == before


def test_photographs_of_a_kind_whose_library_is_missing_are_read_again(tmp_path, folder, monkeypatch):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "b0.heic").write_bytes((folder / "b0.jpg").read_bytes())

    def refuse(path):
        raise PhotoRejected("unreadable", None, None, HEIC_ADVICE)

    found = []
    for read in (refuse, lambda path: read_photo(folder / "b0.jpg")):
        monkeypatch.setattr(batch, "read_photo", read)
        options = Options([NET], identity_printer(), ledger_photos=0)
        kept = dict(journal=tmp_path / "photos.jsonl", resume=True)
        found.append(gather_evidence(tmp_path / "photos", make_manifest(promise()), options, **kept).summary.judged)
    assert found == [0, 1]


def test_a_received_report_is_not_resumed_through_links_or_over_photographs(folder, sheet, tmp_path):
    (tmp_path / "photos.jsonl").touch()
    (tmp_path / "pictures").mkdir()
    shutil.copy(next(folder.rglob("*.jpg")), tmp_path / "pictures" / "1.photo.jpg")
    with pytest.raises(Refused, match="inputs that lie outside of what is written"):
        verify(tmp_path / "pictures", sheet, tmp_path, resume=True)
    (tmp_path / "report.html").symlink_to(sheet)
    with pytest.raises(Refused, match=r"own output only .*with report\.html"):
        verify(folder, sheet, tmp_path, resume=True)


def test_names_of_any_length_and_bytes_are_reported(folder, sheet, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, source in ((b"\xff" * 9, "b0.jpg"), (b"x" * 245, "b1.jpg")):
        (photos / os.fsdecode(name + b".jpg")).write_bytes((folder / source).read_bytes())
    report = verify(photos, sheet, tmp_path / "report", ledger_photos=0)
    assert sorted(p.file for p in report.photos) == ["\\udcff" * 9 + ".jpg", "x" * 245 + ".jpg"]
    assert {p.code for p in report.photos} == {None} and len(list((tmp_path / "report" / "pictures").iterdir())) >= 4


def test_lines_of_the_journal_that_are_not_its_own_are_done_again(tmp_path, folder):
    options, manifest = Options([NET], identity_printer(), ledger_photos=0), make_manifest(promise())
    photo, journal = folder / "b0.jpg", tmp_path / "photos.jsonl"
    first = gather_evidence(photo, manifest, options, journal=journal)
    line = json.loads(journal.read_text())
    entry = line["result"]["entry"]
    others = [
        line | {"result": {}},
        line | {"result": line["result"] | {"counted": "perhaps"}},
        line | {"result": line["result"] | {"light": {"paper": [1, 2], "ink": 3}}},
        line | {"result": line["result"] | {"entry": entry | {"tilt_deg": "steep"}}},
        line | {"result": line["result"] | {"entry": entry | {"file": "c.jpg"}}},
        line | {"result": line["result"] | {"entry": entry | {"predictions": {"other": entry["predictions"]["net"]}}}},
        {"key": line["key"], "file": ["b0.jpg"], "sha256": 1, "result": {}},
        [line],
    ]
    for other in others:
        journal.write_text(json.dumps(other) + "\n")
        assert gather_evidence(photo, manifest, options, journal=journal, resume=True) == first
    journal.write_text("[" * 100_000 + "\n\x00\n" + json.dumps(line))
    assert gather_evidence(photo, manifest, options, journal=journal, resume=True) == first
