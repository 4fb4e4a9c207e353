"""A headless Chromium that opens pages from disk, driven by the DevTools protocol over a web socket."""

from __future__ import annotations

import base64
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
PATIENCE = 120.0  # s; a machine may be busy
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run", "--mute-audio",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-extensions",
    "--remote-debugging-port=0",
)  # fmt: skip

MIN = 4.5  # contrast of text with what it stands on, WCAG 2.2 AA
# what a text is, its contrast with the nearest ground that is painted behind it, and its colours
CONTRASTS = """(() => {
  const rgb = (c) => { const v = c.match(/[\\d.]+/g).map(Number); return c.startsWith("color(srgb") ? v.map((x, k) => k < 3 ? 255 * x : x) : v; };
  const light = (c) => { const l = c.slice(0, 3).map((v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * l[0] + 0.7152 * l[1] + 0.0722 * l[2]; };
  const out = [], walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const said = walk.currentNode.textContent.trim(), e = walk.currentNode.parentElement;
    if (!said || ["SCRIPT", "STYLE", "OPTION"].includes(e.tagName) || !e.getClientRects().length) continue;
    const style = getComputedStyle(e), ink = rgb(e.namespaceURI.endsWith("svg") ? style.fill : style.color);
    let under = e, ground = [255, 255, 255, 0];
    while (under) { const g = rgb(getComputedStyle(under).backgroundColor); if (g.length < 4 || g[3] > 0) { ground = g; break; } under = under.parentElement; }
    const [a, b] = [light(ink), light(ground)], contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    out.push([said.slice(0, 40), contrast]);
  }
  return out;
})()"""


def find() -> str:
    """Where Chromium is; skips the test where it is not."""
    for name in NAMES:
        if where := shutil.which(name):
            return where
    pytest.skip("no Chromium on this machine: sudo apt-get install -y chromium")


class Page:
    """One tab. heard: the exceptions, errors and requests since the page was opened."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._count = 0
        self.heard: list[dict[str, Any]] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """The answer to a command."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == self._count:
                assert "error" not in message, message
                return message["result"]
            self.heard.append(message)

    def open(self, file: Path, width: int = 1000, height: int = 900, mobile: bool = False) -> None:
        """Load a page from disk and wait until it has been laid out."""
        self.heard.clear()
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=mobile)
        self.send("Page.navigate", url=file.resolve().as_uri())
        deadline = time.monotonic() + PATIENCE
        while self.run("document.readyState") != "complete" or self.run("location.href") != file.resolve().as_uri():
            assert time.monotonic() < deadline, f"{file} is not loaded"
            time.sleep(0.05)

    def run(self, script: str) -> Any:
        """The value of an expression."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def press(self, key: str, text: str = "") -> None:
        """Press and release a key."""
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, text=text)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    def dark(self, on: bool) -> None:
        """Pretend that the system wants dark colours, or light ones."""
        value = "dark" if on else "light"
        self.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": value}])

    def picture(self, file: Path, whole: bool = True) -> None:
        """Save what is seen as PNG."""
        answer = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        file.write_bytes(base64.b64decode(answer["data"]))

    def print(self, file: Path) -> None:
        """Save the page as PDF, as it would be printed, on the paper that it asks for."""
        answer = self.send("Page.printToPDF", printBackground=True, preferCSSPageSize=True)
        file.write_bytes(base64.b64decode(answer["data"]))

    def complaints(self) -> list[str]:
        """Exceptions, console errors and warnings since the page was opened."""
        out = []
        for message in self.heard:
            params = message.get("params", {})
            if message["method"] == "Runtime.exceptionThrown":
                out.append(json.dumps(params["exceptionDetails"]))
            if message["method"] == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
                out.append(json.dumps(params["args"]))
            if message["method"] == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
                out.append(params["entry"]["text"])
        return out

    def requests(self) -> list[str]:
        """Addresses of everything that was asked for since the page was opened."""
        return [m["params"]["request"]["url"] for m in self.heard if m["method"] == "Network.requestWillBeSent"]


@contextmanager
def browser(*flags: str) -> Iterator[Page]:
    """A tab of a Chromium of its own, ended with all its children. flags: more of its command line."""
    where = find()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(
            [where, *FLAGS, *flags, f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            with connect(_address(Path(folder), process), max_size=None, proxy=None, open_timeout=PATIENCE) as socket:
                yield Page(socket)
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _address(folder: Path, process: subprocess.Popen[bytes]) -> str:
    """Where the tab listens."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        assert process.poll() is None, "Chromium has ended"
        port = (folder / "DevToolsActivePort").read_text().split() if (folder / "DevToolsActivePort").exists() else []
        if port:
            opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
            with opener.open(f"http://127.0.0.1:{port[0]}/json/list", timeout=PATIENCE) as answer:
                tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
            if tabs:
                return str(tabs[0]["webSocketDebuggerUrl"])
        time.sleep(0.05)
    raise AssertionError("Chromium does not answer")
