"""Reads of the page in tests: its state of rest, and positions of colours in the picture."""

from __future__ import annotations

import json

from .browser import Browser

READY = (
    "globalThis.splatlift?.lift && document.querySelector('#loading').hidden && "
    "(splatlift.viewer ? splatlift.viewer.settled : document.querySelector('#render').naturalWidth > 0)"
)
FIND_COLOUR = (
    "!document.querySelector('#stage').classList.contains('asking') && splatlift.query.questions.length && "
    "splatlift.query.questions.every(asked => asked.answer && (asked.objects.length || !asked.count)) && "
    "(!splatlift.viewer || splatlift.viewer.settled)"
)
BOTH_SETTLED = "splatlift.comparison.isLoaded && splatlift.comparison.left.settled && splatlift.viewer.settled"
AMBER, SKY = "255,176,0", "56,182,255"  # colours of the first and the second question
# Columns of the picture, in hundredths of its width, of pixels whose hue is near to a colour's.
COLUMNS = """((wanted, near, canvas) => {
  const from = document.querySelector(canvas);
  const flat = Object.assign(document.createElement('canvas'), { width: from.width, height: from.height });
  const context = flat.getContext('2d');
  context.drawImage(from, 0, 0);
  const { data } = context.getImageData(0, 0, flat.width, flat.height);
  const hue = ([r, g, b]) => Math.atan2(Math.sqrt(3) * (g - b), 2 * r - g - b);
  const found = [];
  for (let i = 0; i < data.length; i += 4) {
    const pixel = [data[i], data[i + 1], data[i + 2]];
    const most = Math.max(...pixel);
    const strong = most > 60 && most - Math.min(...pixel) > 40;
    if (wanted ? strong && Math.cos(hue(pixel) - hue(wanted)) > Math.cos(near) : most > 45) {
      found.push(Math.floor(100 * ((i / 4) % flat.width) / flat.width));
    }
  }
  return found;
})"""


def text_of(browser: Browser, selector: str) -> str:
    return browser.value(f"document.querySelector({json.dumps(selector)}).textContent")


def columns(browser: Browser, colour: str | None = None, near: float = 0.35, *, canvas: str = "#scene") -> list[int]:
    """Return the columns of the 3D picture, in hundredths of its width, with this colour; without one, with any."""
    browser.until("splatlift.viewer.settled && (!splatlift.comparison.link || splatlift.comparison.left?.settled)")
    return browser.value(f"{COLUMNS}({f'[{colour}]' if colour else 'null'}, {near}, '{canvas}')")


def splat_at(browser: Browser, row: int) -> tuple[float, float]:
    """Return the position of a splat in the 3D picture, as shares of its width and height."""
    place = f"splatlift.viewer.project([...splatlift.viewer.floats.slice(8 * {row}, 8 * {row} + 3)])"
    box = "splatlift.viewer.canvas.getBoundingClientRect()"
    x, y = browser.value(f"(({{x, y}}, box) => [x / box.width, y / box.height])({place}, {box})")
    return x, y


def ask(browser: Browser, words: str) -> None:
    browser.write("#words", words)
    browser.press("#query button.main")
    browser.until(FIND_COLOUR)
