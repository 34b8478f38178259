"""A page opened in headless Chromium, without a network, and what a script in it finds there."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

WATCH = """<script>
const complaints = [];
for (const kind of ["error", "warn"]) console[kind] = (...words) => complaints.push(words.join(" "));
window.onerror = (message) => { complaints.push(message); };
window.addEventListener("unhandledrejection", (event) => complaints.push(String(event.reason)));
</script>"""
PROBE = """<script>(async () => {
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const found = {};
try { %s } catch (error) { complaints.push(String(error)); }
const answer = document.createElement("pre");
answer.id = "answer";
answer.textContent = JSON.stringify({...found, complaints});
document.body.append(answer);
})();</script>"""
FLAGS = ("--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--host-resolver-rules=MAP * ~NOTFOUND")


def found_on(page: Path, script: str, *flags: str) -> dict[str, Any]:
    """What `script` puts into the object `found` once the page is there, and under `complaints` what the console and
    errors said. Skips, saying so, where there is no Chromium.
    """
    program = next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
    )
    if program is None:
        pytest.skip("no chromium here: pages are not opened; apt-get install chromium")
    text = page.read_text(encoding="utf-8")
    watched = page.with_name(f"watched_{page.name}")
    watched.write_text(text.replace("<head>", f"<head>{WATCH}", 1).replace("</body>", PROBE % script + "</body>"))
    profile = page.with_name("profile")
    command = [
        program,
        *FLAGS,
        *flags,
        f"--user-data-dir={profile}",
        "--timeout=90000",
        "--virtual-time-budget=30000",
    ]
    done = subprocess.run(
        [*command, "--dump-dom", watched.as_uri()], capture_output=True, text=True, timeout=180, check=False
    )
    answer = re.search(r'<pre id="answer">(.*?)</pre>', done.stdout, flags=re.DOTALL)
    assert answer is not None, done.stderr[-2000:]
    found: dict[str, Any] = json.loads(html.unescape(answer[1]))
    return found
