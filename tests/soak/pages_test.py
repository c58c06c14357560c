"""Pages of the campaigns in a browser, at the widths of a desk and of a phone: nothing sticks out of them.

`--pictures=FOLDER` keeps what was seen, in pieces of a screen each, to be looked at.
"""

import json
import os

import pytest

from experiments.reporting import page as pages
from tests.soak.conftest import ROOT

# Without a display; Chromium does not start in a sandbox as root.
os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ.setdefault("QTWEBENGINE_CHROMIUM_FLAGS", "--disable-gpu --no-sandbox")
pytest.importorskip("PySide6.QtWebEngineWidgets", reason="needs the extra soak", exc_type=ImportError)

import shiboken6  # noqa: E402
from PySide6.QtCore import QEventLoop, Qt, QTimer, QUrl  # noqa: E402
from PySide6.QtWebEngineWidgets import QWebEngineView  # noqa: E402
from PySide6.QtWidgets import QApplication  # noqa: E402

SCREEN = 1600
ONCE = Qt.ConnectionType.SingleShotConnection
CAMPAIGNS = sorted(path.parent for path in ROOT.glob("experiments/results/*/configs.json"))
SEEN = """
document.querySelectorAll("details").forEach(x => x.open = true);
const inside = x => x.closest(".scroll, pre, .bare, p:has(> img)");
const right = x => x.getBoundingClientRect().right;
const wide = [...document.querySelectorAll("body *")].filter(
  x => right(x) > document.documentElement.clientWidth + 1 && !inside(x));
const page = document.documentElement;
JSON.stringify({width: page.scrollWidth, height: page.scrollHeight, images: document.images.length,
  broken: [...document.images].filter(x => !x.naturalWidth).length,
  wide: wide.map(x => x.outerHTML.slice(0, 80))})
"""


def waited(start):
    """What `start` gives to the function that it is called with, later, in Qt's loop; None after a minute."""
    loop, found = QEventLoop(), []
    QTimer.singleShot(60_000, loop.quit)
    start(lambda *x: (found.extend(x), loop.quit()))
    if not found:
        loop.exec()
    return found[0] if found else None


@pytest.fixture(scope="module")
def view():
    application = QApplication.instance() or QApplication([])
    view = QWebEngineView()
    view.settings().setAttribute(view.settings().WebAttribute.ShowScrollBars, False)
    yield view
    shiboken6.delete(view)  # before the profile of its pages
    application.processEvents()


@pytest.mark.parametrize("campaign", CAMPAIGNS, ids=lambda path: path.name)
def test_nothing_sticks_out_of_a_page(campaign, view, tmp_path, pytestconfig, record_property):
    page = tmp_path / "report.html"
    page.write_text(pages.build(campaign, force=True)[0])
    for width in (1280, 390):
        view.resize(width, SCREEN)
        view.show()
        assert waited(
            lambda done: (view.loadFinished.connect(done, ONCE), view.load(QUrl.fromLocalFile(page)))
        )
        seen = json.loads(waited(lambda done: view.page().runJavaScript(SEEN, 0, done)))
        if pictures := pytestconfig.getoption("pictures"):
            pictures.mkdir(parents=True, exist_ok=True)
            for top in range(0, seen["height"], SCREEN):
                waited(lambda done, y=top: view.page().runJavaScript(f"scrollTo(0, {y})", 0, done))
                waited(lambda done: QTimer.singleShot(500, done))
                view.grab().save(str(pictures / f"{campaign.name}_{width}_{top // SCREEN:02}.png"))
        assert (seen["width"], seen["broken"], seen["wide"]) == (width, 0, [])
        record_property(f"pages {width} pixels wide", 1)
        record_property("pictures on them", seen["images"])
