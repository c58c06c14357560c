"""A page in headless Chromium: `python -m experiments.reporting.browser --page=report.html --out=shots/`.

Renders it at the width of a desktop and of a phone, writes a screenshot of each, and ends with status 2 where
the page is wider than its window, logs an error or asks for anything from outside. Needs chromium and
chromedriver, which it talks to in WebDriver's JSON.
"""

import base64
import contextlib
import json
import shutil
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from absl import flags

from srl_jax.errors import ConfigError

from .. import flags as config_flags

FLAGS = flags.FLAGS
WIDTHS = {"desktop": 1280, "phone": 390}
"""In CSS pixels."""
SWITCHES = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars"
).split()


class Rendered(NamedTuple):
    """What the browser made of a page.

    Attributes:
        width: of the window, in CSS pixels.
        content: of what is in it; wider where it overflows.
        wider: the elements that reach beyond the window and are not within a box that scrolls.
        errors: what the console has of warnings and errors.
        requests: addresses that it asked for, without the page itself and data URIs.
        images: how many there are, and how many of them could not be drawn.
        screenshot: PNG.
    """

    width: int
    content: int
    wider: list[str]
    errors: list[str]
    requests: list[str]
    images: tuple[int, int]
    screenshot: bytes


_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))

_MEASURE = """
const width = window.innerWidth, wider = [];
for (const e of document.querySelectorAll('body *')) {
  const right = e.getBoundingClientRect().right;
  if (right > width + 1 && !e.closest('.scroll')) wider.push(e.outerHTML.slice(0, 120));
}
const images = [...document.images];
return {width, content: document.scrollingElement.scrollWidth, height: document.scrollingElement.scrollHeight,
        wider: wider.slice(0, 5), images: [images.length, images.filter(i => !i.naturalWidth).length]};
"""


def installed() -> bool:
    """Whether there is a Chromium and its driver."""
    return bool(_chromium() and shutil.which("chromedriver"))


def _chromium() -> str | None:
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def render(
    page: Path, widths: Sequence[int] = tuple(WIDTHS.values()), scheme: str = "light"
) -> list[Rendered]:
    """Opens a file at several widths.

    Args:
        page: the HTML file.
        widths: CSS pixels.
        scheme: of its colours, "light" or "dark".

    Raises:
        ConfigError: the browser does not start or does not answer.
    """
    with _session() as call:
        found = []
        for width in widths:
            phone = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
            call("goog/cdp/execute", cmd="Emulation.setDeviceMetricsOverride", params=phone)
            features = [{"name": "prefers-color-scheme", "value": scheme}]
            call("goog/cdp/execute", cmd="Emulation.setEmulatedMedia", params={"features": features})
            call("url", url="about:blank")
            call("se/log", type="browser")  # what there was before, the browser's own first page
            call("se/log", type="performance")
            call("url", url=page.resolve().as_uri())
            time.sleep(0.3)
            about = call("execute/sync", script=_MEASURE, args=[])
            console = [entry["message"] for entry in call("se/log", type="browser")]
            messages = [json.loads(e["message"])["message"] for e in call("se/log", type="performance")]
            sent = [m["params"] for m in messages if m["method"] == "Network.requestWillBeSent"]
            asked = [params["request"]["url"] for params in sent]
            own = page.resolve().as_uri()
            asked = [url for url in asked if not url.startswith("data:") and url.partition("#")[0] != own]
            clip = {"x": 0, "y": 0, "width": width, "height": about["height"], "scale": 1}
            shot = call(
                "goog/cdp/execute",
                cmd="Page.captureScreenshot",
                params={"format": "png", "captureBeyondViewport": True, "clip": clip},
            )
            images = tuple(about["images"])
            screenshot = base64.b64decode(shot["data"])
            found.append(
                Rendered(width, about["content"], about["wider"], console, asked, images, screenshot)
            )
        return found


@contextlib.contextmanager
def _session() -> Iterator[Any]:
    """A function that calls the driver: a command of the session and its arguments -> its value."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        driver = subprocess.Popen(
            [shutil.which("chromedriver") or "chromedriver", "--port=0"],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        try:
            port = next(
                (line.split()[-1].rstrip(".") for line in driver.stdout if "successfully on port" in line),
                None,
            )
            if port is None:
                raise ConfigError("chromedriver did not start")
            options = {"args": [*SWITCHES, f"--user-data-dir={profile}"], "binary": _chromium()}
            wanted = {
                "goog:chromeOptions": options,
                "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
            }
            base = f"http://127.0.0.1:{port}/session"
            made = _post(base, {"capabilities": {"alwaysMatch": wanted}})
            base = f"{base}/{made['sessionId']}"
            try:
                yield lambda command, **given: _post(f"{base}/{command}", given)
            finally:
                with contextlib.suppress(OSError):
                    _DIRECT.open(urllib.request.Request(base, method="DELETE"), timeout=20).close()
        finally:
            driver.terminate()
            driver.wait()
            driver.stdout.close()


def _post(url: str, given: dict) -> Any:
    request = urllib.request.Request(
        url, json.dumps(given).encode(), {"Content-Type": "application/json"}, method="POST"
    )
    try:
        with _DIRECT.open(request, timeout=120) as answer:
            return json.load(answer)["value"]
    except urllib.error.HTTPError as error:
        raise ConfigError(f"the browser: {error.read().decode()[:500]}") from None
    except OSError as error:
        raise ConfigError(f"the browser does not answer: {error}") from None


def problems(found: Rendered) -> list[str]:
    """What is wrong with the page at a width, a line each."""
    lines = [f"logs: {text}" for text in found.errors]
    lines += [f"asks for {url}" for url in found.requests]
    if found.content > found.width:
        lines.append(f"is {found.content} pixels wide: {'; '.join(found.wider)}")
    if found.images[1]:
        lines.append(f"{found.images[1]} of {found.images[0]} pictures cannot be drawn")
    return [f"at {found.width} pixels, the page {line}" for line in lines]


def main(argv: list[str]) -> int:
    """The entry point."""
    del argv
    if not FLAGS.page or not Path(FLAGS.page).is_file():
        raise ConfigError("--page: name an HTML file")
    if not installed():
        raise ConfigError("needs chromium and chromedriver, Debian's chromium and chromium-driver")
    out = config_flags.check_place("out", FLAGS.out) if FLAGS.out else None
    wrong = []
    for name, found in zip(WIDTHS, render(Path(FLAGS.page), scheme=FLAGS.scheme), strict=True):
        wrong += problems(found)
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            (out / f"{name}.png").write_bytes(found.screenshot)
            print(out / f"{name}.png")
    print("\n".join(wrong) or "nothing is wrong")
    return 2 if wrong else 0


if __name__ == "__main__":
    flags.DEFINE_string("page", None, "HTML file to open")
    flags.DEFINE_string("out", None, "directory for the screenshots; none if not given")
    flags.DEFINE_enum("scheme", "light", ["light", "dark"], "colours that the reader prefers")
    config_flags.run(main)
