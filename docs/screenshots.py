"""The README's pictures of a run's page, drive.png and learning.gif, and its curves: python docs/screenshots.py RUN

Chromium draws them from `RUN/drive.html`. README.md shows those of the default run with --seed 0.
"""

from __future__ import annotations

import base64
import io
import shutil
import sys
import tempfile
from pathlib import Path

from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))
from browser import Browser  # noqa: E402

SIZE = (900, 640)
FRAMES, STEP_S, SHOWN_MS = 60, 4.0, 120  # of the film; a drive takes four minutes
MOMENT = "#t=76&all&paused"


def shot(browser: Browser) -> Image.Image:
    """What the browser shows."""
    data = browser._call("Page.captureScreenshot", format="png")["data"]
    return Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")


def main() -> int:
    """Write the pictures."""
    if len(sys.argv) != 2 or not (run := Path(sys.argv[1]).resolve()).joinpath("drive.html").is_file():
        print(f"{__doc__.splitlines()[0]}\nRUN is a finished run's folder", file=sys.stderr)
        return 2
    address = (run / "drive.html").as_uri()
    screen = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1, "mobile": False}
    profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)  # Chromium may still write as it ends
    with profile, Browser("about:blank", profile.name) as browser:
        browser._call("Emulation.setDeviceMetricsOverride", **screen)
        browser._call("Page.navigate", url=address + MOMENT)
        browser.wait_for("typeof drives === 'object' && at > 0")
        shot(browser).save(HERE / "drive.png", optimize=True)
        browser.run("look()")
        film = []
        for k in range(FRAMES):
            browser.run(f"at = {k * STEP_S}; draw()")
            film.append(shot(browser))
    palette = film[FRAMES // 2].quantize(96)  # one for all frames, so that only what moves takes space
    film = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in film]
    film[0].save(HERE / "learning.gif", save_all=True, append_images=film[1:], duration=SHOWN_MS, loop=0, optimize=True)
    shutil.copy(run / "curves.png", HERE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
