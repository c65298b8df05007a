"""A headless Chromium that is spoken to through pipes, in its own protocol."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

FLAGS = """--headless --no-sandbox --disable-gpu --no-first-run --remote-debugging-pipe --disable-background-networking
    --disable-component-update --disable-sync --disable-quic""".split()


# what is cut or too wide, text too small to read, and pictures that did not load
PROBE = """(screen => {
const all = [...document.querySelectorAll("main *")].filter(e => !e.closest("svg") && e.getClientRects().length);
const names = elements => elements.map(e => e.tagName);
return {
  wide: names(all.filter(e => e.getBoundingClientRect().right > screen + 1 || e.scrollWidth > e.clientWidth + 1
    && getComputedStyle(e).overflowX != "visible" && getComputedStyle(e).textOverflow != "ellipsis")),
  small: all.filter(e => e.innerText && parseFloat(getComputedStyle(e).fontSize) < 11).length,
  broken: [...document.images].filter(i => i.loading != "lazy" && (!i.complete || !i.naturalWidth)).length,
  images: document.images.length, width: document.scrollingElement.scrollWidth, inner: innerWidth};
})"""


class Browser:
    """One page of it, as wide as a phone; a context that ends the browser. `said` are its events and errors."""

    def __init__(self, folder: Path):
        program = shutil.which("chromium") or shutil.which("google-chrome")
        if program is None:
            pytest.skip("no Chromium here to look at the page")
        (their_in, self._out), (self._in, their_out) = os.pipe(), os.pipe()
        command = [program, *FLAGS, f"--user-data-dir={folder / 'user'}", "about:blank"]
        script = f'exec "$@" 3<&{their_in} 4>&{their_out}'
        self._process = subprocess.Popen(
            ["bash", "-c", script, "bash", *command], pass_fds=(their_in, their_out), stderr=subprocess.DEVNULL
        )
        os.close(their_in)
        os.close(their_out)
        self._number, self._rest, self._session, self.said = 0, b"", None, []
        (target,) = [t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        attached = self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=2, mobile=True)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._in)
        os.close(self._out)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to one command."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._rest:
                self._rest += os.read(self._in, 1 << 16)
            text, _, self._rest = self._rest.partition(b"\0")
            answer = json.loads(text)
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self.said.append(answer)

    def evaluate(self, expression: str) -> Any:
        """The JSON value of a script."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def look_at(self, page: Path, width_px: int) -> dict[str, Any]:
        """What `PROBE` and the console say of the page on a screen of that width, and what it asked for."""
        mobile, self.said = width_px < 500, []
        screen = {"width": width_px, "height": 844, "deviceScaleFactor": 1, "mobile": mobile}
        self.call("Emulation.setDeviceMetricsOverride", **screen)
        self.call("Page.navigate", url=page.as_uri())
        self.wait_for("document.readyState == 'complete'")
        asked = [url for url in self.requested if not url.startswith("data:") and url != page.as_uri()]
        errors = [event for event in self.troubles if event.get("entry", {}).get("source") != "network"]
        return self.evaluate(f"{PROBE}({width_px})") | {"errors": errors, "fetched": asked}

    def wait_for(self, expression: str, seconds: float = 60) -> Any:
        """The script's value once it is true."""
        end = time.monotonic() + seconds
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < end, f"{expression} is still {value!r}"
            time.sleep(0.1)
        return value

    def choose(self, selector: str, *files: Path) -> None:
        """Files for an `<input type=file>`, as if a person had picked them."""
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        node = self.call("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.call("DOM.setFileInputFiles", nodeId=node, files=[str(file) for file in files])

    def screenshot(self, path: Path, dark: bool = False) -> None:
        """The whole page as a PNG."""
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=scheme)
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"]))

    @property
    def troubles(self) -> list[dict[str, Any]]:
        """What the console holds for an error."""
        wrong = ("Runtime.exceptionThrown", "Log.entryAdded")
        return [event["params"] for event in self.said if event.get("method") in wrong]

    @property
    def requested(self) -> list[str]:
        """Every address that the page asked for."""
        sent = (event for event in self.said if event.get("method") == "Network.requestWillBeSent")
        return [event["params"]["request"]["url"] for event in sent]
