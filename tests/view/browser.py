"""A headless Chromium, driven through its DevTools protocol by the standard library alone."""

from __future__ import annotations

import base64
import json
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.picture import BROWSERS

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--disable-dev-shm-usage", "--hide-scrollbars", "--remote-debugging-port=0",
)  # fmt: skip
# A view's first picture is drawn, or a message stands in its place.
_PICTURE, _MESSAGE = (f"document.getElementById('{name}')" for name in ("picture", "message"))
DRAWN = f"{_PICTURE}?.dataset.ready === 'true' || {_MESSAGE}?.hidden === false"
PATIENCE = 60.0  # s for a page to be ready on a busy machine


def found() -> str | None:
    """The program of a Chromium; None where there is none."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


class Socket:
    """A client's side of a WebSocket (RFC 6455), for texts."""

    def __init__(self, address: str) -> None:
        url = urllib.parse.urlparse(address)
        self.raw = socket.create_connection((url.hostname, url.port), timeout=PATIENCE)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [f"GET {url.path} HTTP/1.1", f"Host: {url.netloc}", "Upgrade: websocket", "Connection: Upgrade"]
        lines += [f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "", ""]
        self.raw.sendall("\r\n".join(lines).encode())
        self.held = b""
        while b"\r\n\r\n" not in self.held:
            self.held += self.raw.recv(4096)
        head, _, self.held = self.held.partition(b"\r\n\r\n")
        assert b" 101 " in head.splitlines()[0], head

    def send(self, text: str) -> None:
        data, mask = text.encode(), os.urandom(4)
        size = len(data)
        length = struct.pack("!BH", 0xFE, size) if size < 2**16 else struct.pack("!BQ", 0xFF, size)
        length = bytes([0x80 | size]) if size < 126 else length
        masked = bytes(byte ^ mask[i % 4] for i, byte in enumerate(data))
        self.raw.sendall(b"\x81" + length + mask + masked)

    def receive(self) -> str:
        """The next text; a text may come in several frames."""
        text = b""
        while True:
            first, size = self._read(2)
            size &= 0x7F
            if size > 125:
                size = struct.unpack("!H" if size == 126 else "!Q", self._read(2 if size == 126 else 8))[0]
            part, kind = self._read(size), first & 0x0F
            if kind == 8:
                raise ConnectionError("the browser closed the connection")
            text += part if kind in (0, 1) else b""
            if first & 0x80 and kind in (0, 1):
                return text.decode()

    def _read(self, count: int) -> bytes:
        while len(self.held) < count:
            part = self.raw.recv(2**16)
            if not part:
                raise ConnectionError("the browser closed the connection")
            self.held += part
        part, self.held = self.held[:count], self.held[count:]
        return part


class Tab:
    """A page in the browser, and what it said and asked for.

    Attributes:
        errors: texts of console errors and of exceptions.
        requests: addresses that were asked for.
    """

    def __init__(self, address: str) -> None:
        self.socket, self.number = Socket(address), 0
        self.errors: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.receive())
            if message.get("id") == self.number:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        about, method = message.get("params", {}), message.get("method")
        if method == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(about["exceptionDetails"])[:2000])
        elif method == "Runtime.consoleAPICalled" and about["type"] in ("error", "assert", "warning"):
            self.errors.append(json.dumps(about["args"])[:2000])
        elif method == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.errors.append(about["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(about["request"]["url"])

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript, awaited."""
        done = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def wait(self, expression: str) -> Any:
        """The expression's value, as soon as it is true."""
        end = time.monotonic() + PATIENCE
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < end, f"never: {expression}; {self.errors}"
            time.sleep(0.02)
        return value

    def open(self, page: Path, fragment: str = "", ready: str = DRAWN) -> None:
        """Open a file, and wait until it is `ready`. The tab comes to the front: others draw nothing."""
        self.call("Page.bringToFront")
        self.call("Page.navigate", url="about:blank")
        self.wait("location.href === 'about:blank'")
        self.call("Page.navigate", url=page.resolve().as_uri() + fragment)
        self.wait(f"document.readyState === 'complete' && ({ready})")

    def size(self, width: int, height: int, scale: float = 1.0) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)

    def dark(self, on: bool) -> None:
        scheme = {"name": "prefers-color-scheme", "value": "dark" if on else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def screenshot(self, form: str = "png", **options: Any) -> bytes:
        """The picture of the tab, once what has changed is drawn."""
        self.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return base64.b64decode(self.call("Page.captureScreenshot", format=form, **options)["data"])

    def press(self, key: str) -> None:
        text = {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, **(text if kind == "keyDown" else {}))

    def mouse(self, kind: str, x: float, y: float, **options: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **options)

    def click(self, element: str) -> None:
        """Click in the middle of the first element that a selector finds."""
        script = f"(() => {{ const e = document.querySelector({json.dumps(element)}); e.scrollIntoView(); "
        script += "const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        x, y = self.evaluate(script)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)


@contextmanager
def browser(program: str) -> Iterator[Callable[[], Tab]]:
    """A running Chromium; calling what this gives opens a tab. It ends, with all its files, behind the block."""
    with tempfile.TemporaryDirectory(prefix="chromium", ignore_cleanup_errors=True) as folder:
        command = [program, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            mark = Path(folder) / "DevToolsActivePort"
            end = time.monotonic() + PATIENCE
            while not (mark.is_file() and mark.read_text().strip()):
                assert process.poll() is None and time.monotonic() < end, "Chromium doesn't start"
                time.sleep(0.05)
            port = int(mark.read_text().split()[0])

            tabs: list[Tab] = []

            def tab() -> Tab:
                request = urllib.request.Request(f"http://127.0.0.1:{port}/json/new?about:blank", method="PUT")
                with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
                    tabs.append(Tab(json.load(answer)["webSocketDebuggerUrl"]))
                return tabs[-1]

            yield tab
            for one in tabs:
                one.socket.raw.close()
        finally:
            process.terminate()
            process.wait(timeout=PATIENCE)
