"""Animations as GIF files or as single HTML pages, which need no network."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from jaxvib.errors import written

_MAX_COLORS = 64
"""Maximum number of colours of an animation."""

_MIN_COLOR_DIFFERENCE = 10
"""Smallest difference of two colours of the palette, in levels of 255."""

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>body{{font-family:sans-serif;margin:1em auto;max-width:{width}px;padding:0 .5em}}img{{width:100%;height:auto}}
.bar{{display:flex;gap:.6em;align-items:center}}input{{flex:1}}button{{min-width:5em}}</style></head>
<body><img id="image" alt="{title}"><div class="bar"><button id="run">Pause</button>
<input id="place" type="range" min="0" max="{last}" value="0" aria-label="frame">
<label>speed <select id="speed"><option value="0.25">1/4</option><option value="0.5">1/2</option>
<option value="1" selected>1</option><option value="2">2</option></select></label></div>
<script>
const frames = [{frames}].map(data => "data:image/png;base64," + data);
const image = document.getElementById("image"), place = document.getElementById("place");
const run = document.getElementById("run"), speed = document.getElementById("speed");
let running = true, timer = null;
function show(k) {{ place.value = k; image.src = frames[k]; }}
function step() {{ show((+place.value + 1) % frames.length); timer = setTimeout(step, {pause} / +speed.value); }}
run.onclick = () => {{ running = !running; run.textContent = running ? "Pause" : "Play";
  if (running) step(); else clearTimeout(timer); }};
place.oninput = () => {{ if (running) run.onclick(); show(+place.value); }};
show(0); timer = setTimeout(step, {pause});
</script></body></html>
"""


class Animation(FuncAnimation):
    """Animation of matplotlib in which only some artists move; its method `save` draws the other artists only once.

    **Arguments**: `figure`; `update`: function that moves the artists to their positions in frame k; `moving`: these artists;
    `count`: number of frames; `fps`: frames per second.
    """

    def __init__(self, figure: Figure, update: Callable[[int], object], moving: Sequence[Artist], count: int, fps: float):
        super().__init__(figure, lambda k: [update(k), moving][1], frames=count, interval=1000.0 / fps, blit=False)
        self._draw_was_started = True  # suppresses matplotlib's warning about an animation that was never shown
        self.figure, self._update, self._moving, self.count, self.fps = figure, update, list(moving), count, fps

    def frames(self) -> Iterator[Image.Image]:
        """Yield every frame; artists that do not move are drawn once."""
        canvas = self.figure.canvas
        assert isinstance(canvas, FigureCanvasAgg)
        for artist in self._moving:
            artist.set_animated(True)
        canvas.draw()
        still = canvas.copy_from_bbox(self.figure.bbox)
        ordered = sorted(self._moving, key=lambda artist: artist.get_zorder())
        for k in range(self.count):
            self._update(k)
            canvas.restore_region(still)
            for artist in ordered:
                self.figure.draw_artist(artist)
            yield Image.fromarray(np.asarray(canvas.buffer_rgba()).copy()).convert("RGB")
        for artist in self._moving:
            artist.set_animated(False)

    def save(self, filename: str | Path, *rest: Any, **options: Any) -> None:
        """Write a GIF file (".gif") or a single HTML page that contains the frames (".html", ".htm").

        Other formats, and calls with further arguments, are passed to matplotlib's `FuncAnimation.save`.

        **Raises** `InputError` if the file cannot be written.
        """
        path = Path(filename)
        if path.suffix.lower() not in (".gif", ".html", ".htm") or rest or options:
            super().save(str(filename), *rest, **options)
            return
        with written(path) as part:
            if path.suffix.lower() == ".gif":
                self._write_gif(part)
            else:
                part.write_text(self._page(path.stem), encoding="utf-8")

    def _write_gif(self, path: Path) -> None:
        first, *others = self._frames_with_palette()
        # The unit of pauses in a GIF is a hundredth of a second.
        pause = max(20, round(100.0 / self.fps) * 10)
        first.save(path, save_all=True, append_images=others, duration=pause, loop=0, optimize=True, disposal=1)

    def _frames_with_palette(self) -> list[Image.Image]:
        """Return all frames with a common palette, which is computed from a few frames, without dithering.

        Parts that do not move therefore have the same pixels in all frames.
        """
        frames = list(self.frames())
        sampled = frames[:: max(1, len(frames) // 4)]
        strip = Image.new("RGB", (sampled[0].width, sampled[0].height * len(sampled)))
        for k, each in enumerate(sampled):
            strip.paste(each, (0, k * each.height))
        # The most frequent colours, such as white, come first and are not changed.
        colours, counts = np.unique(np.asarray(strip).reshape(-1, 3), axis=0, return_counts=True)
        chosen: list[np.ndarray] = []
        for colour in colours[np.argsort(-counts, kind="stable")].astype(int):
            # A colour that is close to one in the palette would only take the place of another colour.
            if len(chosen) < _MAX_COLORS and all(np.max(np.abs(colour - other)) > _MIN_COLOR_DIFFERENCE for other in chosen):
                chosen.append(colour)
        palette = Image.new("P", (1, 1))
        palette.putpalette([int(level) for colour in chosen for level in colour])
        return [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]

    def _page(self, title: str) -> str:
        coded = []
        for each in self._frames_with_palette():
            with io.BytesIO() as memory:
                each.save(memory, "PNG", optimize=False)
                coded.append('"' + base64.b64encode(memory.getvalue()).decode("ascii") + '"')
        width = int(self.figure.bbox.width)
        settings = {"title": html.escape(title, quote=True), "width": width, "last": self.count - 1}
        return _PAGE.format(frames=",".join(coded), pause=round(1000.0 / self.fps), **settings)
