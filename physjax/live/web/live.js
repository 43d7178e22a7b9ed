/* The live view: sliders beside a player, and under it what the run is worth. Works in a notebook (anywidget), and on the
page of `physjax explore`. Whoever holds the engine is behind a channel: send(request), and a function that takes messages. */

const KINDS = { int8: Int8Array, uint8: Uint8Array, int16: Int16Array, uint16: Uint16Array, int32: Int32Array, float32: Float32Array, float64: Float64Array };
/** A request that takes longer than this [ms], and than so many times the last, is overtaken by the next, which otherwise waits. */
const PATIENCE = 120, PATIENT_RATIO = 3;
/** What is set after a pause as long as this [ms] is a new setting: the one before becomes the ghost. */
const PAUSE = 900;

/** A message with its arrays put in where it says so. */
function fill(node, buffers) {
  if (Array.isArray(node)) return node.length && typeof node[0] === "object" ? node.map(part => fill(part, buffers)) : node;
  if (node === null || typeof node !== "object") return node;
  if ("array" in node && node.kind in KINDS) {
    const view = buffers[node.array], bytes = view.buffer.slice(view.byteOffset, view.byteOffset + view.byteLength);
    return new KINDS[node.kind](bytes);
  }
  return Object.fromEntries(Object.entries(node).map(([name, part]) => [name, fill(part, buffers)]));
}

function make(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) name in made ? made[name] = value : made.setAttribute(name, value);
  made.append(...children);
  return made;
}

/** Three figures, with a true minus sign. */
const show = x => String(+x.toPrecision(Math.abs(x) >= 1000 ? 4 : 3)).replace("e+", "e").replace(/-/g, "\u2212");

/** From a place on the slider to the number that it stands for, and back. */
function scale({ low, high, stops, whole, logarithmic }) {
  if (whole) return { least: low, most: high, value: at => at, place: x => x };
  const [to, from] = logarithmic ? [Math.exp, Math.log] : [x => x, x => x], [a, b] = [from(low), from(high)];
  return { least: 0, most: stops, value: at => +to(a + (b - a) * at / stops).toPrecision(4), place: x => Math.round((from(x) - a) / (b - a) * stops) };
}

function addSlider(panel, what, changed) {
  const title = what.name + (what.unit ? ` [${what.unit}]` : "");
  // a reader is told the value by the slider itself, and the name without it
  const { least, most, value, place } = scale(what), number = make("span", { className: "number", "aria-hidden": "true" });
  const input = make("input", { type: "range", min: least, max: most, step: 1, "aria-label": title });
  const set = x => { input.value = place(x); write(x); };
  const write = x => { number.textContent = show(x); input.setAttribute("aria-valuetext", `${show(x)} ${what.unit}`.trim()); };
  // another whole number is another program: it is asked for when the slider is let go
  input.addEventListener("input", () => { write(value(+input.value)); if (!what.whole) changed(value(+input.value)); });
  input.addEventListener("change", () => { if (what.whole) changed(value(+input.value)); });
  panel.append(make("label", {}, make("span", { className: "name" }, make("span", { textContent: title }), number), input));
  return { set, input };
}

/** Build the view in `root`; `spec` says what can be set and holds the first film, `channel` is null where nothing answers.
 * `keys` is where keys are heard: a page of its own has all of them, in a notebook the others are the notebook's. */
export function mount(root, spec, channel, keys = root) {
  const settings = structuredClone(spec.start), frame = make("iframe", { title: "the run", srcdoc: spec.page });
  const status = make("span", { className: "status", role: "status" }), strip = make("dl", { className: "strip", "aria-label": "what the run is worth" });
  const panel = make("div", { className: "panel", role: "group", "aria-label": "settings" });
  const code = make("pre", { hidden: true, tabIndex: 0, role: "region", "aria-label": "code of these settings" });
  const theme = findTheme();
  let ticket = 0, flying = null, waiting = null, ready = false, shown = spec.box, ghostBox = null, turn = true, changedAt = 0, lastTime = 0;
  const queue = [], since = new Map();

  root.classList.add("physjax-live");
  if (theme) root.dataset.theme = theme;
  // the code says it once more, and a notebook has a heading of its own
  if (spec.title) panel.append(make("h2", { textContent: spec.title }), make("p", { textContent: spec.summary ?? "" }));
  const sliders = new Map(spec.sliders.map(what => [what.name, addSlider(panel, what, x => { settings.numbers[what.name] = x; change(); })]));
  if (spec.methods.length > 1) {
    const choice = make("select", {}, ...spec.methods.map(name => new Option(name, name, false, name === settings.method)));
    choice.addEventListener("change", () => { settings.method = choice.value; change(); });
    panel.append(make("label", {}, make("span", { className: "name" }, "method"), choice));
    sliders.set("method", { set: name => { choice.value = name; }, input: choice });
  }
  sliders.set("dt", addSlider(panel, { ...spec.dt, name: "step dt" }, x => { settings.dt = x; change(); }));
  const reset = make("button", { type: "button", textContent: "reset", title: "all settings as they were at first" }), write = make("button", { type: "button", textContent: "code" });
  write.setAttribute("aria-expanded", "false");
  panel.append(make("div", { className: "buttons" }, reset, write, status), code);
  root.append(make("div", { className: "top" }, frame, panel), strip);
  put();
  showStrip(spec.figures);
  if (!channel) rest();

  function put() {
    for (const [name, x] of Object.entries(settings.numbers)) sliders.get(name)?.set(x);
    sliders.get("method")?.set(settings.method);
    sliders.get("dt").set(settings.dt);
  }
  /** Without an engine nothing can be set. */
  function rest() {
    for (const { input } of sliders.values()) input.disabled = true;
    reset.hidden = true;
    status.textContent = spec.note;
    code.textContent = spec.code;
    write.onclick = toggleCode;
  }
  function change() {
    const now = performance.now();
    if (now - changedAt > PAUSE) turn = true;
    changedAt = now;
    code.hidden = true; write.setAttribute("aria-expanded", "false");
    if (flying !== null && now - since.get(flying) < patience()) waiting ??= now;
    else ask(now);
  }
  function patience() { return Math.max(PATIENCE, PATIENT_RATIO * lastTime); }
  function ask(now) {
    waiting = null; flying = ++ticket;
    since.set(flying, now);
    status.textContent = "";
    channel.send({ ticket, ...structuredClone(settings), ghost_box: turn ? shown : ghostBox });
    setTimeout(() => { if (waiting !== null && flying !== null) ask(waiting); }, patience());
  }
  function landed(number) {
    if (number !== flying) return;
    flying = null;
    if (waiting !== null) ask(waiting);
  }
  function take(message, buffers) {
    const { kind, ticket: number } = message;
    if (kind === "film") {
      const film = fill(message.film, buffers);
      if (turn) ghostBox = shown;
      shown = [film.low, film.high];
      post({ film, ghost: turn, ticket: number });
      turn = false;
      landed(number);
    } else if (kind === "strip") { if (number === ticket) showStrip(message.figures); }
    else if (kind === "busy") { if (number === ticket) say(message.text + " \u2026", "busy"); }
    else if (kind === "error") { say(message.text, "bad"); landed(number); }
    else if (kind === "dropped") landed(number);
    else if (kind === "code") { code.textContent = message.text; toggleCode(); }
  }
  /** What went wrong or takes time is read out, and not that every picture has come. */
  function say(text, grade) { status.setAttribute("aria-live", grade === "good" ? "off" : "polite"); status.textContent = text; status.dataset.grade = grade; }
  function post(message) { ready ? frame.contentWindow.postMessage(message, "*") : queue.push(message); }
  function showStrip(figures) {
    strip.replaceChildren(...figures.map(figure => {
      const card = make("div", {}, make("dt", { textContent: figure.name }), make("dd", { textContent: figure.value }), make("dd", { className: "note", textContent: figure.note }));
      card.dataset.grade = figure.grade;
      return card;
    }));
  }
  function toggleCode() {
    code.hidden = !code.hidden;
    write.setAttribute("aria-expanded", String(!code.hidden));
  }
  function heard(event) {
    if (event.source !== frame.contentWindow) return;
    if (event.data.ready) { ready = true; if (theme) post({ theme }); queue.splice(0).forEach(post); }
    const number = event.data.drawn;
    if (number === undefined || !since.has(number)) return;
    const ms = performance.now() - since.get(number);
    since.delete(number);
    lastTime = ms;
    if (number === ticket) say(`picture after ${ms.toFixed(0)} ms`, "good");
    root.dispatchEvent(new CustomEvent("drawn", { detail: { ticket: number, ms } }));
  }
  addEventListener("message", heard);
  if (channel) {
    channel.listen(take);
    channel.send({ ticket, ...structuredClone(settings), figures: true });  // those that take time
    reset.onclick = () => { Object.assign(settings, structuredClone(spec.start)); put(); turn = true; change(); };
    write.onclick = () => code.hidden ? channel.send({ ticket, ...structuredClone(settings), code: true }) : toggleCode();
  }
  /** Space plays wherever it presses no button; the arrows show other moments where they move no slider and scroll no code. */
  function press(event) {
    const { key, target: { tagName } } = event, plays = key === " ", steps = key === "ArrowLeft" || key === "ArrowRight";
    if (event.shiftKey || event.ctrlKey || event.altKey || event.metaKey || ["BUTTON", "SELECT", "TEXTAREA"].includes(tagName)) return;
    if (!plays && !(steps && !["INPUT", "PRE"].includes(tagName))) return;
    event.preventDefault(); event.stopPropagation();
    post({ press: key });
  }
  keys.addEventListener("keydown", press);
  // JupyterLab takes the arrow keys of whatever is no text field, unless it says so itself
  for (const part of root.querySelectorAll("input, select, button")) part.dataset.lmSuppressShortcuts = "true";
  return () => { removeEventListener("message", heard); keys.removeEventListener("keydown", press); };
}

/** Notebooks have a theme of their own; elsewhere the system's counts. */
function findTheme() {
  const { body } = document;
  if (body.dataset.jpThemeLight) return body.dataset.jpThemeLight === "true" ? "light" : "dark";
  if (body.classList.contains("vscode-dark") || body.classList.contains("vscode-high-contrast")) return "dark";
  if (body.classList.contains("vscode-light")) return "light";
  return ["light", "dark"].includes(body.dataset.theme) ? body.dataset.theme : null;  // marimo's
}

/** The engine behind a web server on this machine: every request is answered by a stream of messages. */
export function connect(address) {
  let take = null;
  async function send(request) {
    try {
      const answer = await fetch(address, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(request) });
      if (!answer.ok) throw new Error(await answer.text());
      await read(answer.body.getReader(), take);
    } catch (error) {
      take({ kind: "error", ticket: request.ticket, text: `physjax does not answer any more (${error.message})` }, []);
    }
  }
  return { send, listen: taker => { take = taker; } };
}

async function read(reader, take) {
  let rest = new Uint8Array(0);
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const joined = new Uint8Array(rest.length + value.length);
    joined.set(rest); joined.set(value, rest.length);
    rest = joined;
    for (let whole; rest.length >= 8 && rest.length >= (whole = new DataView(rest.buffer, rest.byteOffset).getUint32(0, true)); rest = rest.slice(whole)) {
      const length = new DataView(rest.buffer, rest.byteOffset).getUint32(4, true);
      const { message, spans } = JSON.parse(new TextDecoder().decode(rest.subarray(8, 8 + length)));
      take(message, spans.map(([start, bytes]) => new DataView(rest.buffer, rest.byteOffset + 8 + length + start, bytes)));
    }
  }
}

/** What anywidget calls. */
export default {
  render({ model, el }) {
    const listen = take => model.on("msg:custom", take);
    return mount(el, model.get("spec"), { send: request => model.send(request), listen });
  },
};
