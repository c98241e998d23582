"""Time from a key press that moves a slider of the explorer until its page is updated, in headless Chromium.

    pip install selenium                    # and Chromium with ChromeDriver
    python benchmarks/explore/moves.py two_mass linear_screen --moves 20 --figure out/page.png

For each template, each slider is moved by the arrow keys. A move ends at the last change of the page (in all shadow trees), if
half a second without a change follows. Prints median and maximum of each template in seconds.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from selenium import webdriver
from selenium.common.exceptions import WebDriverException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

from jaxvib.machine.templates import SCREENS, TEMPLATES

FLAGS = (
    "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking disable-component-update "
    "disable-sync window-size=1600,1200"
)
WATCH = """
window.seen = new WeakSet(); window.pressed = 0; window.changed = 0;
function watch(root) {
  if (seen.has(root)) return; seen.add(root);
  const observer = new MutationObserver(changes => {
    if (changes.some(change => change.target.nodeName !== 'LINK')) changed = performance.now();  // LINK: icon of the tab
    for (const change of changes) for (const node of change.addedNodes) search(node); });
  observer.observe(root, {subtree: true, childList: true, attributes: true, characterData: true});
  search(root);
}
function search(node) {
  if (node.shadowRoot) watch(node.shadowRoot);
  if (node.querySelectorAll) for (const each of node.querySelectorAll('*')) if (each.shadowRoot) watch(each.shadowRoot);
}
watch(document);
document.addEventListener('keydown', () => { pressed = changed = performance.now(); }, true);
"""
THUMBS = """
const found = [];
(function search(root) { for (const each of root.querySelectorAll('*')) {
  if (each.getAttribute('role') === 'slider') found.push(each); if (each.shadowRoot) search(each.shadowRoot); } })(document);
return found;
"""


def update_time(driver: webdriver.Chrome, quiet: float = 500.0, limit: float = 60.0) -> float:
    """Wait until the page has been unchanged for `quiet` ms. Return the time from the key press to the last change, s."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        ago, took = driver.execute_script("return [performance.now() - changed, changed - pressed];")
        if ago > quiet:
            return 1e-3 * took
        time.sleep(0.05)
    raise TimeoutError(f"the page still changes after {limit} s")


def measure(kind: str, moves: int, port: int, command: str, figure: str) -> list[float]:
    """Return the times of `moves` moves of the sliders of one template."""
    options = webdriver.ChromeOptions()
    for flag in FLAGS.split():
        options.add_argument(f"--{flag}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine.toml"
        path.write_text({**TEMPLATES, **SCREENS}[kind])
        started = [command, "explore", str(path), "--port", str(port), "--no-browser"]
        server = subprocess.Popen(started, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        driver = webdriver.Chrome(options=options)
        try:
            address = next(line for line in server.stdout or () if "http://" in line).split("at ")[1].split(";")[0]
            for _ in range(100):  # the address is printed before the server listens
                try:
                    driver.get(address)
                    break
                except WebDriverException:
                    time.sleep(0.2)
            while len(driver.execute_script(THUMBS)) < 2:
                time.sleep(0.2)
            time.sleep(30.0)  # programs for other numbers of loads are compiled in this time
            driver.execute_script(WATCH)
            thumbs, took = driver.execute_script(THUMBS), []
            for k in range(moves):
                driver.execute_script("arguments[0].focus()", thumbs[k % len(thumbs)])
                key = Keys.ARROW_RIGHT if (k // len(thumbs)) % 2 == 0 else Keys.ARROW_LEFT
                ActionChains(driver).send_keys(key).perform()
                took.append(update_time(driver))
            if figure:
                driver.save_screenshot(figure)
            return took
        finally:
            driver.quit()
            server.kill()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("kinds", nargs="*", choices=[*TEMPLATES, *SCREENS], default=["two_mass"])
    parser.add_argument("--moves", type=int, default=20)
    parser.add_argument("--port", type=int, default=27300)
    parser.add_argument("--command", default=str(Path(sys.executable).with_name("jaxvib")), help="jaxvib to be measured")
    parser.add_argument("--figure", default="", help="PNG file for the page after the last move")
    given = parser.parse_args()
    for k, kind in enumerate(given.kinds):
        times = measure(kind, given.moves, given.port + k, given.command, given.figure)
        print(f"{kind:20} median {np.median(times):.3f} s, maximum {max(times):.3f} s of {len(times)} moves", flush=True)
