"""Draw the pictures of the README again: `python benchmarks/results/pictures/draw.py` from the repository's root.

Every block of Python there is run by itself, and what it draws becomes the picture below it. The film at its top is four
scenes next to each other; the page of `explore` is photographed by a Chromium, if there is one.
"""

import io
import re
import shutil
import subprocess
import threading
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from PIL import Image

from physjax import Scene, animate, emitters, forces, lattices, methods, scenes, simulate

FOLDER = Path(__file__).parent
README = FOLDER.parents[2] / "README.md"
SHOWN = re.compile(r"```python\n(.*?)```\n\n!\[[^\]]*\]\(benchmarks/results/pictures/(\w+\.\w+)\)", re.DOTALL)
FPS, SECONDS = 12, 3.0
PANEL = (400, 290)


def draw_blocks():
    for source, name in list_blocks():
        if name != "explore.png":
            exec(source.replace(f'"{name}"', repr(str(FOLDER / name))), {})
        if plt.get_fignums():
            plt.gcf().savefig(FOLDER / name, dpi=80, bbox_inches="tight")
            plt.close("all")
            shrink(FOLDER / name)


def list_blocks():
    """The source of each block of Python in the README with the name of the picture below it."""
    return SHOWN.findall(README.read_text(encoding="utf-8"))


def shrink(path):
    """At most 256 colours: a third of the bytes."""
    Image.open(path).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def build_films():
    """Four films of three seconds: rigid bodies, cloth, contact in space, particles."""
    wrecking_ball = scenes.SCENES["wrecking_ball"]().scene
    run = simulate(wrecking_ball, methods.semi_implicit_euler, dt=1 / 480, duration=SECONDS, save_every=40)
    yield animate.bodies(run, fps=FPS)
    sheet = lattices.cloth(1.5, 1.0, 20, 30, mass=0.15, structural=400.0, shear=100.0, bend=5.0, damping=0.02)
    pushes = (forces.Gravity(), sheet.springs, sheet.wind((6.0, 0.0, 0.5)))
    flag = Scene(sheet.state, mass=sheet.mass, pinned=sheet.nodes["left"], forces=pushes)
    yield animate.cloth(simulate(flag, methods.rk4, dt=1 / 2400, duration=SECONDS, save_every=200), sheet, fps=FPS)
    marbles = scenes.SCENES["marbles"]().scene
    run = simulate(marbles, methods.semi_implicit_euler, dt=1 / 480, duration=SECONDS / 2, save_every=20)
    yield animate.bodies(run, fps=FPS, speed=0.5)
    source = emitters.Disc((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.02)
    jet = emitters.Emitter(
        480, source, key=1, life=1.2, rate=400.0, speed=6.0, direction=(0, 1, 0), cone=0.15, size=0.02
    )
    fountain = Scene(jet.unborn(), mass=1e-3, forces=(forces.Gravity(),), emitter=jet)
    yield animate.particles(simulate(fountain, methods.rk4, dt=1 / 120, duration=SECONDS, save_every=10), fps=FPS)


def draw_film():
    """All pictures of the four films side by side, as one GIF."""
    films = [list_pictures(film) for film in build_films()]
    length = max(map(len, films))
    pictures = []
    for number in range(length):
        picture = Image.new("RGB", (2 * PANEL[0], 2 * PANEL[1]), "white")
        for i, film in enumerate(films):
            panel = film[min(number, len(film) - 1)]
            corner = [PANEL[k] * (i % 2, i // 2)[k] + (PANEL[k] - panel.size[k]) // 2 for k in (0, 1)]
            picture.paste(panel, tuple(corner))
        pictures.append(picture)
    palette = build_palette(pictures[length // 2], 200)
    first, *others = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    first.save(FOLDER / "physjax.gif", save_all=True, append_images=others, duration=round(1000 / FPS), loop=0)


def build_palette(picture, count):
    """Colours of a picture; those that are almost white are white, as its background is."""
    palette = picture.quantize(count)
    colours = palette.getpalette()[: 3 * count]
    for i in range(0, len(colours), 3):
        if min(colours[i : i + 3]) > 246:
            colours[i : i + 3] = [255, 255, 255]
    palette.putpalette(colours)
    return palette


def list_pictures(film):
    gif = Image.open(io.BytesIO(film.gif()))
    pictures = []
    for number in range(gif.n_frames):
        gif.seek(number)
        picture = gif.convert("RGB")
        picture.thumbnail(PANEL, Image.Resampling.LANCZOS)
        pictures.append(picture)
    return pictures


def photograph_explore(chromium):
    source = next(source for source, name in list_blocks() if name == "explore.png")
    names = {}
    exec(source.replace("explore(throw", "view = explore(throw"), names)
    view = names["view"]
    view.engine.find_limit(view.first)  # before the page asks
    options = (
        "--headless",
        "--no-sandbox",
        "--hide-scrollbars",
        "--window-size=1000,760",
        "--virtual-time-budget=20000",
    )
    with view.start_server() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        command = [chromium, *options, f"--screenshot={FOLDER / 'explore.png'}", server.address]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        server.shutdown()
    shrink(FOLDER / "explore.png")


if __name__ == "__main__":
    draw_blocks()
    draw_film()
    if chromium := shutil.which("chromium"):
        photograph_explore(chromium)
