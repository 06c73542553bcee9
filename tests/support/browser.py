"""Chromium, that shows a page as a user's browser would."""

import itertools
import json
import os
import shutil
import subprocess
import time

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--window-size=1900,1000")
needs_chromium = pytest.mark.skipif(not CHROMIUM, reason="there is no chromium")


class Browser:
    """A browser with one open page, driven by the DevTools protocol over a pipe. `faults` are its exceptions, console
    errors and what its policy blocked, `requests` the addresses that it asked for."""

    def __init__(self, address, profile):
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()
        shell = f'exec {CHROMIUM} "$@" 3<&{to_browser} 4>&{from_browser}'
        command = ["bash", "-c", shell, "chromium", *FLAGS, "--remote-debugging-pipe", f"--user-data-dir={profile}"]
        self._process = subprocess.Popen(command, pass_fds=(to_browser, from_browser), stderr=subprocess.DEVNULL)
        os.close(to_browser)
        os.close(from_browser)
        self._number, self._buffer, self._session = itertools.count(), b"", {}
        self.faults, self.requests = [], []
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Runtime", "Log", "Network", "Page"):
            self._call(f"{domain}.enable")
        self._call("Page.navigate", url=address)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.wait()
        os.close(self._out)
        os.close(self._in)

    def run(self, script):
        return self._call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait_for(self, script, seconds=30.0):
        ends = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < ends, (script, self.faults)
            time.sleep(0.1)

    def wait_for_text(self, text, seconds=60.0):
        self.wait_for(f"document.documentElement.outerHTML.includes({json.dumps(text)})", seconds)

    def _call(self, method, **parameters):
        number = next(self._number)
        message = {"id": number, "method": method, "params": parameters, **self._session}
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._buffer:
                part = os.read(self._in, 1 << 16)
                assert part, "the browser is gone"
                self._buffer += part
            first, _, self._buffer = self._buffer.partition(b"\0")
            answer = json.loads(first)
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer.get("method"), answer.get("params"))

    def _note(self, method, parameters):
        if method == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif method == "Runtime.exceptionThrown" or (parameters or {}).get("entry", {}).get("level") == "error":
            self.faults.append(parameters)
