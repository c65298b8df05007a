"""Capture: what is let in and what is not, nothing lost, and the verdict that `verify` gives of the same folder."""

from __future__ import annotations

import asyncio
import errno
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

import uvicorn
from browser import Browser
from synthetic_photos import make_manifest, noisy_design, photograph, save
from toy_studies import begin_with_timer

from patchproof.app.capture import album as album_module
from patchproof.app.capture import serve
from patchproof.app.capture.album import CONTROLS, MOST_BYTES, Album, UploadRefused
from patchproof.app.capture.collection import PhotoCollection, answer_of, map_views, state_of
from patchproof.app.capture.serve import server_config
from patchproof.app.cli import journey
from patchproof.app.verify import CaptureInfo, options_of
from patchproof.app.verify import verify as verify_photos
from patchproof.base.errors import Refused
from patchproof.base.workers import open_workers
from patchproof.evidence.annotations import load_corners
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import CameraPose, Geometry, PhotoEntry, Prediction
from patchproof.evidence.verdict import sessions_needed
from patchproof.sheets.manifest import ConditionClaim, Manifest, dump_manifest, load_manifest
from test_copies import seen
from test_corners import CORNERS_PX, PX_FROM_MM, SIZE_PX
from test_verify_run import NET, promise, shot

pytestmark = pytest.mark.filterwarnings("ignore:the network net:UserWarning")  # it sees no color
TOKEN = "a-token-that-is-nobodys-own"
SHOTS = 6


def condition(azimuth_deg: float, px_per_mm: float) -> dict:
    return dict(px_per_mm=px_per_mm, tilt_deg=30.0, azimuth_deg=azimuth_deg, contrast=0.8, blur_px=0.5, recognized=True)


@pytest.fixture(scope="module")
def sheet(tmp_path_factory) -> Path:
    """A sheet that promises something of `NET`, from -40° to 40°, at one to two pixels a millimeter."""
    conditions = [condition(azimuth, scale) for azimuth in (-40.0, -20.0, 0.0, 20.0, 40.0) for scale in (1.0, 1.5, 2.0)]
    said = promise([c | {"tilt_deg": tilt} for c in conditions for tilt in (0.0, 60.0)])
    path = tmp_path_factory.mktemp("sheet") / "sheet.json"
    path.write_text(dump_manifest(make_manifest(said)), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> list[bytes]:
    """What a phone that walks round the piece takes: one in too little light for `NET`, one of no piece."""
    folder = tmp_path_factory.mktemp("phone")
    looks = [dict(light=0.1 if i == 3 else 0.8, seed=i, noise=0.003) for i in range(SHOTS)]
    pictures = [shot(10 * i - 38, 450 + 60 * (i % 3), **look) for i, look in enumerate(looks)]
    pictures[5] = pictures[5] * 0 + 120
    return [save(picture, folder / f"{i}.jpg", focal_35mm=36).read_bytes() for i, picture in enumerate(pictures)]


@dataclass(frozen=True)
class Answer:
    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def json(self) -> dict:
        return json.loads(self.body)


@dataclass(frozen=True)
class Client:
    """Who has the address."""

    address: str

    @property
    def root(self) -> str:
        return urlsplit(self.address).path

    def connect(self) -> http.client.HTTPConnection:
        parts = urlsplit(self.address)
        return http.client.HTTPConnection(parts.hostname, parts.port, timeout=60)

    def get(self, path: str) -> Answer:
        return self.ask("GET", self.root + path)

    def post(self, path: str, content: bytes = b"", headers: Mapping[str, str] | None = None) -> Answer:
        return self.ask("POST", self.root + path, content, headers)

    def send(self, content: bytes, into: str = "session_01") -> Answer:
        return self.post(f"photos?{urlencode({'into': into})}", content)

    def ask(self, method: str, path: str, content: bytes = b"", headers: Mapping[str, str] | None = None) -> Answer:
        with closing(self.connect()) as connection:
            connection.request(method, path, content, dict(headers or {}))
            answered = connection.getresponse()
            return Answer(answered.status, {k.lower(): v for k, v in answered.headers.items()}, answered.read())

    def begin(self, *headers: tuple[str, str], body: bytes) -> http.client.HTTPConnection:
        """A photograph of which no more is sent than this."""
        connection = self.connect()
        connection.putrequest("POST", f"{self.root}photos?into=session_01")
        for header in headers:
            connection.putheader(*header)
        connection.endheaders(body)
        return connection


@contextmanager
def gathered_in(folder: Path, sheet: Path):
    manifest = load_manifest(sheet)
    with open_workers(1) as workers:
        with closing(PhotoCollection(Album(folder), manifest, options_of(sheet, manifest, [NET]), workers)) as gathered:
            gathered.measure(gathered.album.photos())
            yield gathered


@pytest.fixture
def client(tmp_path, sheet):
    with gathered_in(tmp_path / "photos", sheet) as gathered:
        with listening(gathered) as address:
            yield Client(address)


class Server(uvicorn.Server):
    """Ends when it is asked to: its base looks whether it is every tenth of a second."""

    async def main_loop(self) -> None:
        while not await self.on_tick(0):
            await asyncio.sleep(0.01)


@contextmanager
def listening(gathered):
    """A real server on this machine; the address it is at."""
    server = Server(server_config(gathered, TOKEN))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        while not server.started and thread.is_alive():  # else the socket closes under it, if nobody calls
            time.sleep(0.01)
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/{TOKEN}/"
        server.should_exit = True
        thread.join(20)


def files_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_two_tabs_send_a_walk_and_verify_says_what_the_page_said(tmp_path, sheet, photos):
    folder = tmp_path / "photos"
    with gathered_in(folder, sheet) as gathered, listening(gathered) as address:
        client, answers = Client(address), []

        def tab(own: list[bytes], into: str) -> None:
            for photo in own:
                answers.append(client.send(photo, into).json)

        for session, part in (("session_01", photos[: SHOTS // 2]), ("session_02", photos[SHOTS // 2 :])):
            tabs = [threading.Thread(target=tab, args=(own, session)) for own in (part[::2], part[1::2])]
            for thread in tabs:
                thread.start()
            for thread in tabs:
                thread.join()
            if session == "session_01":
                assert client.post("sessions").json["session"] == "session_02"
        dark = np.repeat(np.array([[[40, 40, 40], [60, 60, 60]]], np.uint8).repeat(600, 0), 400, 1)
        assert client.send(save(dark, tmp_path / "gray.jpg").read_bytes(), "gray").status == 200
        state = client.get("state").json
    files = [path for path in files_in(folder) if path.endswith(".jpg")]
    assert files[0] == f"controls/gray/photo_{SHOTS + 1:04}.jpg" and len(files) == SHOTS + 1
    assert sorted((folder / file).read_bytes() for file in files[1:]) == sorted(photos)  # EXIF and all
    assert len({answer["photo"]["file"] for answer in answers}) == SHOTS
    assert {answer["photo"]["code"] for answer in answers} >= {None, "too_few_markers"}
    report = verify_photos(
        folder, sheet, tmp_path / "report", models=[NET], controls=folder / "controls", ledger_photos=0
    )
    summary = report.summary
    assert (state["verdict"], state["reason"]) == (summary.verdict, summary.reason)
    assert ("may say otherwise" in state["effect"]) == (
        summary.worth is not None and summary.worth.source == "simulated"
    )
    recognized = sum(session["recognized"] for session in state["sessions"])
    assert state["judged"] == summary.judged == SHOTS - 1 == recognized + 1  # the dark one
    assert recognized == round(summary.rate * summary.judged)
    said = {(s["name"], s["recognized"], s["judged"]) for s in state["sessions"]}
    assert (
        said == {(s.name, s.recognized, s.judged) for s in summary.sessions}
        and summary.sessions_known_from == "folders"
    )
    assert state["controls"] == [{"name": "gray", "photos": 1, "recognized": 0}]
    assert sum(map(sum, state["map"]["photos"])) + state["map"]["elsewhere"] == summary.judged


def test_a_restart_goes_on_and_measures_nothing_twice(tmp_path, sheet, photos, monkeypatch):
    folder = tmp_path / "photos"
    with gathered_in(folder, sheet) as gathered:
        with listening(gathered) as address:
            for photo in photos[:3]:
                before = Client(address).send(photo).json["state"]
    (folder / "session_01" / ".photo_0009.part").write_bytes(b"of a server that was killed")
    monkeypatch.setattr("patchproof.evidence.batch.read_photo", None)  # nothing is read
    with gathered_in(folder, sheet) as gathered:
        with listening(gathered) as address:
            assert Client(address).get("state").json == before
            again = Client(address).send(photos[1]).json
            assert again["photo"]["file"] == "session_01/photo_0002.jpg" and again["state"] == before
    assert files_in(folder) == ["photos.jsonl", *(f"session_01/photo_000{i}.jpg" for i in (1, 2, 3))]


def test_only_the_token_opens_anything(client, tmp_path):
    for path in ("/", "/state", f"/{TOKEN[:-1]}/", f"/{TOKEN}x/state", "/../photos.jsonl", f"/{TOKEN.upper()}/", "/é/"):
        for method in ("GET", "POST"):
            answered = client.ask(method, quote(path), b"x" if method == "POST" else b"")
            assert answered.status == 403 and "got one without its token" in answered.json["refused"]
    for path in ("photos.jsonl", "session_01/photo_0001.jpg", "../photos.jsonl", "photos/", "state/x"):
        assert client.get(path).status == 404
    assert client.get("photos").status == 405 and client.get("state").status == 200


def test_the_token_is_compared_whatever_of_it_is_right(client, monkeypatch):
    compared = []
    monkeypatch.setattr(serve.hmac, "compare_digest", lambda a, b: compared.append((a, b)) or a == b)
    client.get("state")
    client.ask("GET", "/nothing")
    assert compared == [(TOKEN.encode(), TOKEN.encode()), (b"nothing", TOKEN.encode())]


def test_the_page_is_let_load_nothing_of_others(client):
    answered = client.get("")
    policy, text = answered.headers["content-security-policy"], answered.body.decode()
    assert "default-src 'none'" in policy and "unsafe" not in policy and "frame-ancestors 'none'" in policy
    assert answered.headers["referrer-policy"] == "no-referrer" and answered.headers["cache-control"] == "no-store"
    assert "http" not in text and TOKEN not in text
    assert client.get("").headers["content-security-policy"] != policy  # a nonce is used once


@pytest.mark.parametrize(
    ("content", "into", "status", "sentence"),
    [
        (b"no picture, whatever it is called", "session_01", 415, "a photograph (JPEG, PNG, WebP, HEIC or AVIF)"),
        (b"short", "session_01", 415, "a photograph"),
        (b"", "session_01", 415, "a photograph"),
        (b"%PDF-1.7 is a document", "session_01", 415, "a photograph"),
        (b"\xff\xd8\xff", "../../elsewhere", 404, "a session or a control of this folder"),
        (b"\xff\xd8\xff", "session_02", 404, "a session or a control"),
        (b"\xff\xd8\xff", "controls", 404, "a session or a control"),
        (b"\xff\xd8\xff", "", 404, "a session or a control"),
    ],
)
def test_what_is_no_photograph_or_goes_nowhere_leaves_nothing(client, tmp_path, content, into, status, sentence):
    answered = client.send(content, into)
    assert answered.status == status and sentence in answered.json["refused"]
    assert files_in(tmp_path) == ["photos/photos.jsonl"]


def test_names_that_come_along_mean_nothing(client, tmp_path, photos):
    part = b'Content-Disposition: form-data; name="photo"; filename="../../../evil.jpg"'
    form = b"--x\r\n" + part + b"\r\nContent-Type: image/jpeg\r\n\r\n" + photos[0] + b"\r\n--x--\r\n"
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    assert client.post("photos?into=session_01", form, headers).status == 415  # a form is no photograph
    headers = {"Content-Disposition": "attachment; filename=../../evil.jpg", "Content-Type": "text/html"}
    assert client.post("photos?into=session_01&name=../evil.jpg", photos[0], headers).status == 200
    assert files_in(tmp_path) == ["photos/photos.jsonl", "photos/session_01/photo_0001.jpg"]


def test_bytes_that_only_begin_like_a_photograph_are_listed_and_not_counted(client, photos):
    cut = client.send(photos[0][:4000]).json
    assert cut["photo"]["answer"] == "not counted" and cut["photo"]["code"] == "unreadable"
    assert "copy it again from the camera" in cut["photo"]["advice"]
    assert cut["state"]["photos"] == 1 and cut["state"]["judged"] == 0


def test_the_same_bytes_in_another_place_are_no_second_photograph(client, photos):
    assert client.send(photos[0]).status == 200
    again = client.send(photos[0], "gray")
    assert again.status == 409 and "session_01/photo_0001.jpg once more" in again.json["refused"]


def test_a_new_session_is_begun_where_the_last_one_has_photographs(client, photos):
    assert client.post("sessions").json["session"] == "session_01"
    client.send(photos[0])
    assert [client.post("sessions").json["session"] for _ in range(2)] == ["session_02", "session_02"]


def test_sizes_and_numbers_end_somewhere(tmp_path, monkeypatch):
    monkeypatch.setattr(album_module, "MOST_PHOTOS", 2)
    album = Album(tmp_path / "photos")
    with album.incoming("session_01") as incoming:
        incoming.write(b"\xff\xd8\xff" + bytes(MOST_BYTES - 3))
        with pytest.raises(UploadRefused, match="at most 40 MB"):
            incoming.write(b"x")
        assert incoming.keep().stat().st_size == MOST_BYTES
    with album.incoming("session_01") as second, pytest.raises(UploadRefused, match="at most 2 photographs"):
        second.write(b"\x89PNG\r\n\x1a\n1234")
        album.incoming("session_01")


def test_numbers_are_taken_once(tmp_path):
    album, jpeg, png = Album(tmp_path / "photos"), b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
    with album.incoming("session_01") as a, album.incoming("session_01") as b, album.incoming("gray") as c:
        for number, (incoming, head) in enumerate(((b, jpeg), (a, png), (c, jpeg))):
            incoming.write(head + bytes([number]) * 12)
        names = [incoming.keep().name for incoming in (b, a, c)]
    assert names == ["photo_0002.jpg", "photo_0001.png", "photo_0003.jpg"]
    assert [path.name for path in album.photos()] == ["photo_0001.png", "photo_0002.jpg", "photo_0003.jpg"]


def test_200_megabytes_are_refused_before_they_are_read(tmp_path, sheet):
    """With their length said, none is; without, no more than the limit and what lies in sockets."""
    with gathered_in(tmp_path / "photos", sheet) as gathered, listening(gathered) as address:
        client = Client(address)
        with closing(client.begin(("Content-Length", "200000000"), body=b"\xff\xd8\xff")) as connection:
            answered = connection.getresponse()
            assert answered.status == 413 and "got 200 MB" in json.loads(answered.read())["refused"]
        sent, block = 0, b"\xff\xd8\xff" + bytes((1 << 20) - 3)
        with closing(client.begin(("Transfer-Encoding", "chunked"), body=b"")) as connection, pytest.raises(OSError):
            for _ in range(200):
                connection.send(b"%x\r\n%s\r\n" % (len(block), block))
                sent += len(block)
        assert MOST_BYTES - (1 << 20) < sent < MOST_BYTES + (16 << 20)
    assert files_in(tmp_path) == ["photos/photos.jsonl"]


def test_a_connection_that_is_lost_or_stalls_leaves_nothing_and_the_next_one_all(tmp_path, sheet, photos, monkeypatch):
    monkeypatch.setattr(serve, "STALLED_S", 1.0)
    folder = tmp_path / "photos"
    with gathered_in(folder, sheet) as gathered, listening(gathered) as address:
        client, whole = Client(address), ("Content-Length", str(len(photos[0])))
        lost, stalled = (client.begin(whole, body=photos[0][:-500]) for _ in range(2))
        end = time.monotonic() + 20
        while len(list(folder.rglob(".*.part"))) < 2:
            assert time.monotonic() < end
            time.sleep(0.02)
        lost.close()
        answered = stalled.getresponse()
        assert answered.status == 408 and "send it again" in json.loads(answered.read())["refused"]
        stalled.close()
        while list(folder.rglob(".*.part")):
            assert time.monotonic() < end
            time.sleep(0.02)
        assert files_in(folder) == ["photos.jsonl"]
        assert client.send(photos[0]).json["photo"]["answer"] == "recognized"
    assert (folder / "session_01" / "photo_0001.jpg").read_bytes() == photos[0]


def test_a_folder_with_anything_else_in_it_is_refused(tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(Refused, match=r"this command's own output only .* with letter.txt"):
        Album(tmp_path)


def entry(azimuth_deg: float | None, px_per_mm: float) -> PhotoEntry:
    geometry = Geometry(
        residual_mm=0, px_per_mm=px_per_mm, tilt_deg=20, contrast=0.8, blur_px=1, corner_uncertainty_mm=0.1
    )
    pose = CameraPose(azimuth_uncertainty_deg=1, azimuth_deg=azimuth_deg)
    return PhotoEntry(file="a", status="measured", photo_px=(1200, 900), geometry=geometry, pose=pose)


def test_the_map_of_views_by_hand():
    """Two conditions in three in the nearest third on the left, one far on the right; distances are 1 over scale."""
    near_left, far_right = condition(-10.0, 4.0), condition(14.0, 1.0)
    conditions = [ConditionClaim(**c) for c in (near_left, near_left, far_right)]
    blind = ConditionClaim(**near_left | {"azimuth_deg": None})  # from behind: nobody can photograph that
    shown = [entry(-9.0, 3.9), entry(-30.0, 6.0), entry(13.0, 1.35), entry(None, 2.0)]
    views = map_views([*conditions, blind], shown, 12, 900.0, 90.0)
    assert views is not None and views["columns"] == ["10° left to 2° right", "2–14° right"]
    assert views["rows"] == ["20–40 %", "13–20 %", "10–13 %"] and views["of_picture"]
    assert views["wanted"] == [[8, 0], [0, 0], [0, 4]]
    assert views["photos"] == [[2, 0], [0, 1], [0, 0]] and views["elsewhere"] == 1 and views["next"] == (0, 0)
    halved = map_views(conditions, [entry(-9.0, 7.8)], 12, 450.0, 90.0)  # photographs of twice the promised size
    assert halved is not None and halved["photos"][0][0] == 1
    full = map_views(conditions, [entry(-9.0, 3.9)] * 8 + [entry(13.0, 1.0)] * 4, 12, None, 90.0)
    assert full is not None and full["next"] is None and full["rows"][0] == "2.0–4.0 px/mm"
    assert map_views([blind], shown, 12, None, 90.0) is None


def test_served_until_interrupted_and_begun_again(tmp_path, sheet, photos, monkeypatch):
    """With a process apart; what is in the folder is measured before there is an address."""
    monkeypatch.setattr(serve, "prepare_worker", begin_with_timer)
    monkeypatch.setattr(serve, "options_of", lambda sheet, manifest, *_: options_of(sheet, manifest, [NET]))
    answers, measured = [], []

    def visit(address: str) -> None:
        answers.append(Client(address).send(photos[len(answers)]).status)
        os.kill(os.getpid(), signal.SIGINT)

    def begin(address: str) -> None:
        threading.Thread(target=visit, args=(address,)).start()

    def progress(stage: str, done: int, total: int) -> None:
        measured.append((done, total))

    capture = partial(serve.serve_capture, sheet, tmp_path / "photos", progress=progress, on_address=begin)
    with monkeypatch.context() as patch:  # the first time in this process, which has imported everything
        patch.setattr(serve, "open_workers", lambda *_, **__: open_workers(1))
        patch.setattr(serve, "prepare_worker", lambda _: None)
        reports = [capture()]
    reports.append(capture())
    assert [report.summary.judged for report in reports] == [1, 2] and measured == [(0, 0), (1, 1)]
    assert answers == [200, 200] and "photos.jsonl" in files_in(tmp_path / "photos")


@pytest.fixture
def one_process(monkeypatch):
    """Serve before `NET`, without a process apart."""
    monkeypatch.setattr(serve, "options_of", lambda sheet, manifest, *_: options_of(sheet, manifest, [NET]))
    monkeypatch.setattr(serve, "open_workers", lambda *_, **__: open_workers(1))
    monkeypatch.setattr(serve, "prepare_worker", lambda _: None)


def test_it_listens_on_this_machine_unless_the_local_network_is_asked_for(tmp_path, sheet, monkeypatch, one_process):
    hosts = []
    monkeypatch.setattr(serve, "_network_address", lambda: "127.0.0.2")
    monkeypatch.setattr(serve, "_listen", lambda host: hosts.append(host) or 1 / 0)
    for lan in (False, True):
        with pytest.raises(ZeroDivisionError):
            serve.serve_capture(sheet, tmp_path / "photos", lan=lan)
    assert hosts == ["127.0.0.1", "127.0.0.2"]


def test_sheets_without_a_promise_and_machines_without_the_libraries_are_refused(tmp_path, sheet, monkeypatch):
    (tmp_path / "plain.json").write_text(dump_manifest(make_manifest()), encoding="utf-8")
    with pytest.raises(Refused, match="Expected a sheet that promises something, got the design sheet TESTSHEET0"):
        serve.serve_capture(tmp_path / "plain.json", tmp_path / "photos")
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.delitem(sys.modules, "patchproof.app.capture.serve")
    with pytest.raises(Refused, match=r"Starlette and uvicorn, got none: pip install 'patchproof\[capture\]'\."):
        journey.capture(sheet, tmp_path / "photos")
    assert not (tmp_path / "photos").exists()


def test_the_command_line_has_it_without_the_libraries():
    code = "import sys; sys.modules['starlette'] = sys.modules['uvicorn'] = None; import patchproof.app.cli; "
    code += "patchproof.app.cli.app(['capture', '--help'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "--lan" in done.stdout


def test_a_phone_shows_the_answer_and_sends_again_what_a_lost_connection_cost(tmp_path, sheet, photos, browser):
    taken = tmp_path / "IMG.jpg"
    taken.write_bytes(photos[2])
    dark = tmp_path / "dark.jpg"
    dark.write_bytes(photos[3])
    with gathered_in(tmp_path / "photos", sheet) as gathered, listening(gathered) as address:
        browser.call("Page.navigate", url=address)
        browser.wait_for("document.querySelector('#into') && document.querySelector('#into').value")
        browser.choose("#camera", taken)
        said = browser.wait_for("document.querySelector('#answer').innerText")
        assert said.startswith("recognized as bright") and "session_01/photo_0001.jpg" in said
        assert browser.evaluate("document.querySelector('#answer img').naturalWidth") > 300
        assert browser.evaluate("document.querySelector('#latest').innerText") == ""  # said once
        browser.call(
            "Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=0, uploadThroughput=0
        )
        browser.choose("#camera", dark)
        browser.wait_for("document.querySelector('#queue').innerText.includes('not sent yet')")
        browser.call(
            "Network.emulateNetworkConditions", offline=False, latency=0, downloadThroughput=-1, uploadThroughput=-1
        )
        assert browser.wait_for("document.querySelector('#answer b').innerText == 'not recognized'")
        assert browser.evaluate("document.querySelector('#queue').childElementCount") == 0
        assert browser.evaluate("document.documentElement.scrollWidth") == 390
        assert {urlsplit(url).netloc for url in browser.requested if url.startswith("http")} == {
            urlsplit(address).netloc
        }
        assert not [t for t in browser.troubles if "ERR_INTERNET_DISCONNECTED" not in json.dumps(t)]
    assert files_in(tmp_path / "photos")[1:] == ["session_01/photo_0001.jpg", "session_01/photo_0002.jpg"]
    assert set(CONTROLS) == {"bare", "mean", "gray", "noise", "blank"}


def test_silent_and_slow_connections_do_not_keep_the_owner_out(client, photos, monkeypatch):
    """80 of them, more than there are places; the oldest go first, and all in the end."""
    monkeypatch.setattr(serve, "TOKEN_SHOWN_S", 0.5)
    place = urlsplit(client.address).hostname, urlsplit(client.address).port
    silent = [socket.create_connection(place) for _ in range(80)]
    silent[-1].sendall(b"GET /without-an-end")
    assert client.get("state").status == 200 and client.send(photos[0]).status == 200
    for number, each in enumerate(silent):
        each.settimeout(0.001 if number > 80 - serve.MOST_STRANGERS else 5)
        with closing(each), suppress(ConnectionError, TimeoutError):
            assert each.recv(1) == b"" or number == 0
    last = socket.create_connection(place)
    last.settimeout(5)
    with closing(last), suppress(ConnectionError):
        assert last.recv(1) == b""


def test_a_photograph_that_drips_in_is_given_up(client, photos, monkeypatch, tmp_path):
    monkeypatch.setattr(serve, "STALLED_S", 0.3)
    with closing(client.begin(("Content-Length", str(len(photos[0]))), body=photos[0][:20])) as connection:
        for byte in photos[0][20:30]:  # one each 0.05 s: never silent for 0.3 s
            with suppress(OSError):
                connection.send(bytes([byte]))
            time.sleep(0.05)
        assert connection.getresponse().status == 408
    assert files_in(tmp_path) == ["photos/photos.jsonl"]


def test_a_full_disk_is_not_kept_full_by_what_did_not_fit(client, photos, monkeypatch, tmp_path):
    def fail(*_, **__) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def write(incoming, chunk) -> None:
        incoming._file.close()
        incoming._file = SimpleNamespace(close=fail)  # what is still to be written does not fit, either
        fail()

    for place, name, failure in ((album_module.Incoming, "write", write), (PhotoCollection, "measure", fail)):
        with monkeypatch.context() as patch:
            patch.setattr(place, name, failure)
            answered = client.send(photos[0])
        assert answered.status == 507 and "got No space left on device: make room" in answered.json["refused"]
        assert not list(tmp_path.rglob(".photo*"))
    assert client.send(photos[0]).json["photo"]["file"] == "session_01/photo_0001.jpg"


@pytest.mark.parametrize("received", ["session_x", "session_01", "controls/gray/photo_0001.jpg", "photos.jsonl"])
def test_links_and_sessions_without_a_number_are_refused(tmp_path, received):
    path = tmp_path / "photos" / received
    path.parent.mkdir(parents=True)
    if received == "session_x":
        path.mkdir()
    else:
        path.symlink_to(tmp_path)
    with pytest.raises(Refused, match=rf"got \S+{received}: move it out of the folder"):
        Album(tmp_path / "photos")


def test_a_session_that_becomes_a_link_receives_nothing(tmp_path):
    album, folder = Album(tmp_path / "photos"), tmp_path / "photos"
    (tmp_path / "elsewhere").mkdir()
    (folder / "session_02").symlink_to(tmp_path / "elsewhere")
    (folder / "session_x").mkdir()
    (folder / "controls").symlink_to(tmp_path / "elsewhere")
    assert album.sessions == ["session_01"] == [album.new_session()]
    for into in ("session_02", "session_x", "gray"):
        with pytest.raises(UploadRefused, match="a session or a control"):
            album.incoming(into)


def test_each_start_has_an_address_of_its_own_and_no_second_server(tmp_path, sheet, one_process):
    folder, addresses = tmp_path / "photos", []

    def stop(address: str) -> None:
        addresses.append(address)
        with pytest.raises(Refused, match=r"into which process \d+ writes"):  # a second server
            serve.serve_capture(sheet, folder)
        raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            serve.serve_capture(sheet, folder, on_address=stop)
    one, other = (urlsplit(address).path.strip("/") for address in addresses)
    assert one != other and min(len(one), len(other)) >= 32


def test_400_photographs_are_answered_at_once_and_as_from_scratch(tmp_path, sheet):
    """0.3 s of processor time besides measuring; copies are among them."""
    rng = np.random.default_rng(0)

    def photo(path: Path) -> MeasuredPhoto:
        distance, tilt = rng.uniform(440, 800), rng.uniform(2, 27)
        one = seen(f"session_01/{path.name}", rng.uniform(-40, 40), distance, tilt, aside=rng.uniform(-200, 200))
        answer = Prediction(label="bright", confidence=0.9, target_confidence=0.9, recognized=bool(rng.random() < 0.8))
        pose = CameraPose(azimuth_uncertainty_deg=1, azimuth_deg=rng.uniform(-40, 40))
        return replace(one, entry=one.entry.changed(predictions={"net": answer}, pose=pose))

    with gathered_in(tmp_path / "photos", sheet) as gathered, gathered_in(tmp_path / "other", sheet) as other:
        paths = [gathered.album.folder / "session_01" / f"photo_{number:04}.jpg" for number in range(1, 403)]
        gathered._measured |= {path: photo(path) for path in paths[:400]}
        state_of(gathered, 3)
        for path in paths[400:]:
            gathered.add(path, photo(path))
            start = time.process_time()
            state, answer = state_of(gathered, 3), answer_of(gathered, path)
            assert time.process_time() - start < 0.3
        other._measured, other.album = dict(gathered._measured), gathered.album
        assert (state_of(other, 3), answer_of(other, paths[-1])) == (state, answer)
        assert 300 < state["judged"] < state["photos"] == 402


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> tuple[Path, Path]:
    """A sheet without markers, and a photograph of its print."""
    folder, design = tmp_path_factory.mktemp("bare"), noisy_design(0)
    codes = (255 * design).astype(np.uint8)
    data = make_manifest(promise([condition(20.0, 1.0)]), design=codes).model_dump()
    manifest = Manifest.model_validate(data | {"markers": (), "settings": {"sheet": {"markers": False}}})
    (folder / "sheet.json").write_text(dump_manifest(manifest), encoding="utf-8")
    page = np.full((2000, 1750, 3), 0.2, np.float32)
    page[600:, 350:] = 0.02 + 0.8 * design.repeat(10, 0).repeat(10, 1) ** 2
    return folder / "sheet.json", save(photograph(page, PX_FROM_MM, SIZE_PX, noise=0.004, fine=2), folder / "a.jpg")


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser")) as begun:
        yield begun


@pytest.fixture
def browser(chromium):
    """One for all pages, each of which it forgets: to begin takes it longer than a page does."""
    yield chromium
    chromium.call("Page.navigate", url="about:blank")  # which asks no server that has ended
    chromium.said.clear()


def tapped(points, of="session_01/photo_0001.jpg", size=SIZE_PX) -> str:
    return f"corners?{urlencode({'of': of, 'numbers': ','.join(map(str, [*np.ravel(points), *size]))})}"


def test_tapped_corners_are_measured_by_kept_and_taken_by_verify(tmp_path, bare):
    sheet, photo = bare
    folder, file = tmp_path / "photos", tmp_path / "photos" / "corners.csv"
    with gathered_in(folder, sheet) as gathered, listening(gathered) as address:
        client = Client(address)
        sent = client.send(photo.read_bytes()).json["photo"]
        assert sent["code"] == "no_corners" and sent["tap"] and "--corners" in sent["advice"]
        assert client.ask("POST", f"/x/{tapped(CORNERS_PX)}").status == 403
        for hostile in (
            tapped(CORNERS_PX[::-1]),
            tapped(CORNERS_PX[[0, 2, 1, 3]]),
            tapped(CORNERS_PX - 300),
            tapped(CORNERS_PX + 300),
            tapped(CORNERS_PX * np.nan),
            tapped(CORNERS_PX[:3]),
            tapped(CORNERS_PX / 2, size=(480, 180)),
            tapped(CORNERS_PX, size=(0, 0)),
            tapped(CORNERS_PX, size=("9" * 5000, 1)),
            tapped(CORNERS_PX, of="../../etc/passwd"),
            tapped(["x"] * 8),
            "corners",
        ):
            answered = client.post(hostile)
            assert answered.status == 422 and "Expected" in answered.json["refused"], hostile
        assert not file.exists() and client.get("state").json["latest"][0]["code"] == "no_corners"
        wrong = client.post(tapped(np.roll(CORNERS_PX, 1, 0))).json["photo"]
        assert wrong["code"] == "no_corners" and wrong["tap"]  # on another corner first: may be corrected
        right = client.post(tapped(CORNERS_PX / 2 + 0.5, size=(240, 180))).json  # off by a finger, in a smaller copy
        assert right["photo"]["code"] is None and not right["photo"]["tap"] and right["state"]["judged"] == 1
        assert right["photo"]["picture"].startswith("data:image/jpeg")
        assert client.post(tapped(CORNERS_PX / 2 + 0.5, size=(240, 180))).json["state"] == right["state"]
        assert client.post(tapped(CORNERS_PX)).json["state"] == right["state"]  # what is counted stays as it is
    assert load_corners(file)["session_01/photo_0001.jpg"].numbers == pytest.approx((CORNERS_PX + 1).ravel(), abs=0.01)
    with gathered_in(folder, sheet) as gathered:  # after a restart, without measuring
        assert json.loads(json.dumps(state_of(gathered, sessions_needed(gathered.manifest.promise)))) == right["state"]
    options = {"models": [NET], "ledger_photos": 0, "capture": CaptureInfo(corners=file, find=True)}
    report = verify_photos(folder, sheet, tmp_path / "report", **options)
    assert report.summary.judged == 1 and report.photos[0].located == "corners"
    assert (report.summary.verdict, report.summary.reason) == (right["state"]["verdict"], right["state"]["reason"])


def test_corners_are_tapped_only_where_nothing_else_can_locate_a_print(client, photos, tmp_path):
    assert not client.send(photos[5]).json["photo"]["tap"]  # no piece, on a sheet with markers
    before = client.get("state").json
    assert client.post(tapped(CORNERS_PX, size=(800, 600))).json["state"] == before
    assert files_in(tmp_path) == ["photos/photos.jsonl", "photos/session_01/photo_0001.jpg"]


@pytest.mark.parametrize("markers", [True, False])
def test_a_design_without_markers_is_searched_for_first(tmp_path, sheet, bare, monkeypatch, one_process, markers):
    found = []
    monkeypatch.setattr(
        serve, "PhotoCollection", lambda album, manifest, options, *_: found.append(options.find) or 1 / 0
    )
    with pytest.raises(ZeroDivisionError):
        serve.serve_capture(sheet if markers else bare[0], tmp_path / "photos")
    assert found == [not markers]


def test_a_finger_drags_the_corners_of_a_photograph(tmp_path, bare, browser):
    sheet, photo = bare
    with gathered_in(tmp_path / "photos", sheet) as gathered, listening(gathered) as address:
        browser.call("Page.navigate", url=address)
        browser.wait_for("document.querySelector('#into') && document.querySelector('#into').value")
        assert browser.evaluate("document.querySelector('#corners').hidden")
        browser.choose("#camera", photo)
        browser.wait_for("document.querySelector('#tap img').naturalWidth == 480")
        browser.evaluate("document.querySelector('#tap').scrollIntoView({block: 'center'})")
        sides = browser.evaluate("(b => [b.left, b.top, b.width, b.height])(shown.getBoundingClientRect())")
        corner, size = np.array(sides[:2]) + 9, np.array(sides[2:])  # touched beside the points
        starts = corner + np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]]) * size
        for start, target in zip(starts, corner + CORNERS_PX / SIZE_PX * size, strict=True):
            for kind, places in (("Start", [start]), ("Move", [start + 5]), ("Move", [target]), ("End", [])):
                touched = [{"x": x, "y": y} for x, y in places]
                browser.call("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=touched)
                assert browser.evaluate("document.querySelector('#loupe').hidden") == (kind == "End")
        assert browser.evaluate("document.documentElement.scrollWidth") == 390
        browser.evaluate("document.querySelector('#send').click()")
        browser.wait_for("document.querySelector('#corners').hidden")
        said = browser.evaluate("document.querySelector('#answer').innerText")
        assert said.startswith("recognized as bright") and not browser.troubles
    numbers = load_corners(tmp_path / "photos" / "corners.csv")["session_01/photo_0001.jpg"].numbers
    assert numbers == pytest.approx(CORNERS_PX.ravel(), abs=2.0)
