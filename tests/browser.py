# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium driven by its own protocol over a pipe: no server, no driver, no further package."""

import base64
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--remote-debugging-pipe"),
    *("--no-first-run", "--no-default-browser-check", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--disable-quic", "--disable-extensions", "--disable-default-apps", "--hide-scrollbars"),
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",  # whatever asks for another host finds none
)
# Chromium reads commands from descriptor 3 and answers on 4.
START = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4); os.execvp(sys.argv[3], sys.argv[3:])"
)
KEYS = {"Tab": 9, "Enter": 13, "Escape": 27, "ArrowLeft": 37, "ArrowRight": 39}
PATIENCE_S = 600.0


def find_chromium() -> str | None:
    """Path of the browser; None where there is none."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Page:
    """One tab: opens pages, evaluates, presses keys; remembers what was asked for and what went wrong."""

    def __init__(self, pipe: "Pipe") -> None:
        self._pipe = pipe
        target = pipe.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = pipe.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for name in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{name}.enable")

    def call(self, method: str, **changes: Any) -> dict[str, Any]:
        return self._pipe.call(method, session=self._session, **changes)

    def open(self, url: str) -> None:
        """Open a page and wait until it is loaded."""
        self._pipe.events.clear()
        self.call("Page.navigate", url=url)
        self._pipe.wait(lambda event: event["method"] == "Page.loadEventFired")

    def reload(self) -> None:
        self._pipe.events.clear()
        self.call("Page.reload")
        self._pipe.wait(lambda event: event["method"] == "Page.loadEventFired")

    def value(self, script: str) -> Any:
        """What an expression is worth in the page."""
        given = self.call("Runtime.evaluate", expression=script, returnByValue=True, userGesture=True)
        assert "exceptionDetails" not in given, given["exceptionDetails"]
        return given["result"].get("value")

    def settled(self, script: str) -> Any:
        """What a promise comes to in the page."""
        given = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in given, given["exceptionDetails"]
        return given["result"].get("value")

    def press(self, key: str) -> None:
        """Press a key, as a hand would."""
        about = {"key": key, "code": key, "windowsVirtualKeyCode": KEYS[key]}
        text = {"text": "\r"} if key == "Enter" else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", **about, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **about)

    def hover(self, selector: str) -> None:
        """Move the pointer onto an element."""
        x, y = self.value(
            f"(() => {{ const one = document.querySelector({json.dumps(selector)});"
            " one.scrollIntoView({block: 'center'});"
            " const box = one.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2]; })()"
        )
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def width(self, px: int, *, height: int = 900) -> None:
        """Be as wide as a screen of so many pixels."""
        self.call("Emulation.setDeviceMetricsOverride", width=px, height=height, deviceScaleFactor=1, mobile=False)

    def scripts(self, *, are_on: bool) -> None:
        self.call("Emulation.setScriptExecutionDisabled", value=not are_on)

    def prefer(self, scheme: str) -> None:
        """Prefer light or dark."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def shoot(self, path: Path) -> None:
        """Write a picture of the whole page."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": min(size["height"], 6000), "scale": 1}
        given = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
        path.write_bytes(base64.b64decode(given["data"]))

    @property
    def asked(self) -> list[str]:
        """Addresses that were asked for since the page was opened."""
        return [
            event["params"]["request"]["url"]
            for event in self._pipe.events
            if event["method"] == "Network.requestWillBeSent"
        ]

    @property
    def faults(self) -> list[str]:
        """Whatever the console was told, and what failed to load."""
        kinds = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded", "Network.loadingFailed")
        return [json.dumps(event["params"]) for event in self._pipe.events if event["method"] in kinds]


class Pipe:
    """Commands to the browser, and what it tells."""

    def __init__(self, source: int, target: int) -> None:
        self._source, self._target = source, target
        self._rest, self._number = b"", 0
        self.events: list[dict[str, Any]] = []

    def call(self, method: str, *, session: str | None = None, **changes: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": changes}
        os.write(self._target, json.dumps(message | ({"sessionId": session} if session else {})).encode() + b"\0")
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            answer = self._read()
            if answer.get("id") == self._number:
                assert "error" not in answer, (method, answer["error"])
                return dict(answer["result"])
        raise TimeoutError(method)

    def wait(self, is_it: Callable[[dict[str, Any]], bool]) -> None:
        until = time.monotonic() + PATIENCE_S
        while not any(map(is_it, self.events)):
            if time.monotonic() > until:
                raise TimeoutError(self.events[-3:])
            self._read()

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            more = os.read(self._source, 2**16)
            if not more:
                raise EOFError("the browser has gone")
            self._rest += more
        text, _, self._rest = self._rest.partition(b"\0")
        record = dict(json.loads(text))
        if "method" in record:
            self.events.append(record)
        return record


@contextmanager
def browser(chromium: str, profile: Path) -> Iterator[Page]:
    """Start the browser with a fresh profile, and end it."""
    theirs_in, ours_out = os.pipe()
    ours_in, theirs_out = os.pipe()
    command = [
        sys.executable,
        "-c",
        START,
        str(theirs_in),
        str(theirs_out),
        chromium,
        *FLAGS,
        f"--user-data-dir={profile}",
    ]
    running = subprocess.Popen(  # noqa: S603 - the browser that was found
        command, pass_fds=(theirs_in, theirs_out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    for end in (theirs_in, theirs_out):
        os.close(end)
    pipe = Pipe(ours_in, ours_out)
    try:
        yield Page(pipe)
        pipe.call("Browser.close")
    finally:
        for end in (ours_in, ours_out):
            os.close(end)
        try:
            running.wait(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()
