"""Pages in headless Chromium: what a script in them sees.

The browser is Debian's ``chromium``, or what the environment variable CHROMIUM names.
"""

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

BEFORE = """<script>
const complaints = [];
addEventListener("error", (event) => complaints.push(event.message));
for (const kind of ["error", "warn"]) console[kind] = (...words) => complaints.push(words.join(" "));
</script>"""

HELPERS = """
const drawing = (id) => document.getElementById(id);
const readout = (id) => document.querySelector(`#${id} ~ .readout`).textContent;
const press = (id, key) => { drawing(id).dispatchEvent(new KeyboardEvent("keydown", { key })); return readout(id); };
const point = (id, x, y) => {  // in units of the drawing
  const svg = drawing(id).querySelector("svg"), place = new DOMPoint(x, y).matrixTransform(svg.getScreenCTM());
  svg.dispatchEvent(new PointerEvent("pointermove", { clientX: place.x, clientY: place.y, bubbles: true }));
  return readout(id);
};
const background = getComputedStyle(document.body).backgroundColor;
"""


def browsed(page: Path, script: str, *, width: int = 1100, scheme: str = "light") -> Any:
    """What a script returns in a copy of a page, which loads nothing and complains about nothing."""
    command = os.environ.get("CHROMIUM") or shutil.which("chromium")
    if not command:
        pytest.skip("no browser on this machine (install Debian's package chromium, or set CHROMIUM)")
    loaded = "performance.getEntriesByType('resource').map((each) => each.name)"
    found = f"JSON.stringify([complaints, {loaded}, (() => {{ {HELPERS} {script} }})()])"
    copy = page.with_name(f"{page.stem}-browsed.html")
    text = page.read_text("utf-8").replace("<head>", f"<head>{BEFORE}")
    copy.write_text(text.replace("</body>", f"<script>document.title = {found};</script></body>"), "utf-8")
    words = [command, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    words += [f"--user-data-dir={page.parent / 'profile'}", f"--window-size={width},900"]
    words += ["--blink-settings=preferredColorScheme=0"] if scheme == "dark" else []
    done = subprocess.run([*words, "--dump-dom", copy.as_uri()], capture_output=True, text=True, timeout=60, check=True)
    title = re.search("<title>(.*?)</title>", done.stdout, re.DOTALL)
    assert title is not None
    complaints, requests, value = json.loads(html.unescape(title[1]))
    assert (complaints, requests) == ([], [])
    return value
