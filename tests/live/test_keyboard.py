"""The live page without a mouse, in a browser where there is one: every control is named and reached, keys do what they say."""

import json
import re
import shutil
import subprocess

import jax.numpy as jnp
import pytest

from physjax import Particles, Scene, explore, forces, methods
from physjax.live.pages import read_live_file, write_page

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PROBE = """<script>
const wait = ms => new Promise(done => setTimeout(done, ms));
addEventListener("load", async () => {
  const frame = document.querySelector("iframe");
  while (!frame.contentDocument?.getElementById("time")?.textContent) await wait(20);
  const inner = frame.contentDocument, told = {}, play = inner.getElementById("play");
  const press = async (target, key, more) => {
    const { KeyboardEvent } = target.ownerDocument.defaultView;
    const event = new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...more });
    target.dispatchEvent(event);
    await wait(30);
    return [event.defaultPrevented, inner.getElementById("time").textContent, play.textContent];
  };
  const controls = [...inner.querySelectorAll("canvas[tabindex], button, input, select"),
    ...document.querySelectorAll("button, input, select")];
  told.names = controls.map(control => [control.computedRole, control.computedName, control.tabIndex]);
  told.sliders = [...document.querySelectorAll("input")].map(input => input.getAttribute("aria-valuetext"));
  told.start = await press(document.body, "Shift");
  told.right = await press(document.body, "ArrowRight");
  told.left = await press(document.body, "ArrowLeft");
  told.ctrl = await press(document.body, "ArrowLeft", { ctrlKey: true });
  told.onSlider = await press(document.querySelector("input"), "ArrowRight");
  told.space = await press(document.querySelector("input"), " ");
  told.again = await press(document.body, " ");
  told.onButton = await press(document.querySelector("button"), " ");
  told.inFrame = await press(inner.getElementById("slider"), " ");
  told.stop = await press(inner.body, " ");
  const picture = () => inner.getElementById("scene").toDataURL(), before = picture();
  told.zoom = await press(inner.getElementById("scene"), "+");
  const zoomed = picture();
  told.turn = await press(inner.getElementById("scene"), "ArrowUp", { shiftKey: true });
  told.moved = [before !== zoomed, zoomed !== picture()];
  told.time = inner.getElementById("slider").getAttribute("aria-valuetext");
  const result = document.createElement("pre");
  result.id = "told"; result.textContent = JSON.stringify(told);
  document.body.append(result);
});
</script>"""


def ask(page, path):
    path.write_text(page + PROBE, encoding="utf-8")
    options = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    flags = ["--enable-blink-features=ComputedAccessibilityInfo", "--virtual-time-budget=8000", "--dump-dom"]
    done = subprocess.run([CHROMIUM, *options, *flags, path.as_uri()], capture_output=True, text=True, timeout=60)
    return json.loads(re.search(r'<pre id="told">(.*?)</pre>', done.stdout, re.S)[1].replace("&gt;", ">"))


def throw(speed, angle):
    launch = speed * jnp.array([jnp.cos(angle), jnp.sin(angle), 0.1])
    return Scene(Particles(jnp.zeros(3), launch), forces=(forces.Gravity(),))


@pytest.fixture(scope="module")
def page():
    explorer = explore(throw, speed=(10, 50), angle=(0.1, 1.4), duration=3.0, methods=[methods.verlet, methods.rk4])
    return write_page(explorer._spec, channel="{ send: () => {}, listen: () => {} }")


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_every_control_has_a_name_and_the_keys_do_what_they_say(page, tmp_path):
    told = ask(page, tmp_path / "page.html")
    roles = {name: role for role, name, place in told["names"] if place == 0}
    assert len(roles) == len(told["names"]), "each has a name of its own, and a place in the order of Tab"
    assert "" not in roles
    assert {roles[name] for name in ("speed", "angle", "step dt [s]", "time")} == {"slider"}
    assert roles["method"] == "combobox"
    assert {roles[name] for name in ("reset", "code", "play", "reset view")} == {"button"}
    assert told["sliders"][0] == "30"
    _, start, _ = told["start"]
    assert told["right"][0]
    assert told["right"][1] > start
    assert told["left"] == [True, start, "play"]
    assert told["ctrl"] == told["onSlider"] == [False, start, "play"], "these are the browser's and the slider's"
    assert told["space"][0]
    assert told["space"][2] == "pause"
    assert told["again"][2] == "play"
    assert not told["onButton"][0]
    assert told["inFrame"][2] == "pause"
    assert told["stop"][2] == "play"
    assert told["moved"] == [True, True], "plus zooms, shift and an arrow turn"
    assert told["time"] == told["turn"][1], "who hears the slider of time is told the moment"


def test_a_view_leaves_the_keys_of_a_notebook_alone():
    program = read_live_file("live.js")
    assert "mount(root, spec, channel, keys = root)" in program
    assert 'return mount(el, model.get("spec"), { send: request => model.send(request), listen });' in program
    assert ", __CHANNEL__, document);" in read_live_file("live.html"), "a page of its own has them all"
