"""Pages as a browser shows them, where one is installed: on a telephone, without scripts, with nothing from elsewhere."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

from experiments.report import Figure, Report, Table, page
from mjxgrad.report import svg
from mjxgrad.rollouts.render import write_video

BROWSER = os.environ.get("CHROME_BIN") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no browser is installed: CHROME_BIN names one")

WIDTH = 390  # of a telephone, in pixels
# The page's own scripts, if it had any, would be refused; this one alone may run.
PROBE = """\
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data: file:; media-src data: file:; style-src 'unsafe-inline'; script-src 'nonce-probe'">
<script nonce="probe">
addEventListener("load", () => {
  const zoom = document.querySelector(".zoom svg");
  const loaded = [...document.images].every(one => one.naturalWidth > 0);
  const found = {width: innerWidth, beyond: document.documentElement.scrollWidth - innerWidth, loaded};
  if (zoom) {
    found.before = zoom.getBoundingClientRect().width;
    found.hint = getComputedStyle(zoom.parentElement, "::before").content;
    found.shade = getComputedStyle(document.querySelector(".scroll:has(> table)")).backgroundImage;
  }
  parent.postMessage(JSON.stringify(found), "*");
});
</script>
"""
# A window without a screen is never narrower than 500 pixels; a frame is what it is told to be.
FRAME = """\
<!DOCTYPE html>
<html><body><script>addEventListener("message", event => document.body.append("FOUND " + event.data + " END"))</script>
<iframe src="probed.html" width="{width}" height="800" style="border: 0"></iframe></body></html>
"""


def opened(text: str, place: Path, width: int = WIDTH) -> tuple[dict[str, Any], str]:
    """Open a page and read what the probe found, and what the browser complained of."""
    (place / "probed.html").write_text(text.replace("<head>", f"<head>\n{PROBE}", 1), encoding="utf-8")
    (place / "frame.html").write_text(FRAME.format(width=width), encoding="utf-8")
    command = [
        str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={place / 'profile'}",
        "--window-size=1280,800", "--enable-logging=stderr", "--dump-dom", (place / "frame.html").as_uri(),
    ]  # fmt: skip
    found = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    complaints = "\n".join(line for line in found.stderr.splitlines() if "CONSOLE" in line)
    told = re.search(r"FOUND (\{.*?\}) END", found.stdout)
    assert told is not None, found.stderr
    return json.loads(told[1]), complaints


@pytest.fixture
def report(tmp_path):
    """A report of every part there is, with words and tables too wide for a telephone."""
    (tmp_path / "picture.svg").write_text(svg(lambda: plt.figure(figsize=(11, 4)), "Nothing"))
    write_video(tmp_path / "video.mp4", np.zeros((3, 64, 96, 3), np.uint8), fps=30)
    wide = [f"column{i}" for i in range(30)]
    made = Report(
        answer="First order, `discrete`, up to 100 1/s².",
        verdict="It is so.",
        findings=["With `mjxgrad.diagnostics.first_order_samples_of_everything_that_there_is_to_be_found`."],
        figures=[Figure("picture.svg", "Picture", "All of it."), Figure("picture.svg", "Once more", "As above.")],
        tables=[Table(wide, [["1.234"] * 30], "Wide."), Table(wide, [["1.234"] * 30] * 20, "Wide and long.")],
        metrics=[],
        video="video.mp4",
        video_caption="It moves.",
        warnings=["hopper: the time step is too long."],
    )
    about, config = {"Made with": {"command": "x" * 90}}, "a_key_that_is_longer_than_most = " + "9" * 80
    told = {"question": "Does it hold on a telephone?", "expected": "yes", "about": about, "config": config}
    return page(made, tmp_path, name="made up", **told)


def test_a_report_fits_a_telephone_can_be_read_there_runs_nothing_and_fetches_nothing(report, tmp_path):
    found, complaints = opened(report, tmp_path)
    assert not complaints
    assert found["width"] == WIDTH
    assert found["beyond"] <= 0, "pixels that the body is too wide"
    assert found["loaded"]
    # The smallest letters of a picture, 8 points of its 11 inches, are 6 pixels high; at the width of the page they were 3.
    assert found["before"] >= 640
    assert "sideways" in found["hint"], "what goes on sideways has a sign"
    assert "gradient" in found["shade"]
