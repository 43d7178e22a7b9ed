/* What the pages of animate.view have in common: how a film is unpacked, and how its axes are marked. */
let film, middle, size;

/** Take another film; from metres to what is drawn: the middle of the box is the origin, its longest side is 1. */
function take(next) {
  film = next;
  middle = film.low.map((low, i) => (low + film.high[i]) / 2);
  size = Math.max(...film.high.map((high, i) => high - film.low[i]));
}
const drawn = point => point.map((x, i) => (x - middle[i]) / size);
take(JSON.parse(element("film").textContent));

async function inflated(text) {
  const bytes = Uint8Array.from(atob(text), sign => sign.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

/** Whole numbers of `Kind`, in rows of `width`, from the differences of the rows; they wrap around as they did. */
async function numbers(text, Kind, width) {
  if (typeof text !== "string") return text;  // a film that came as a message has its arrays as they are
  const array = new Kind(await inflated(text));
  for (let i = width; i < array.length; i++) array[i] += array[i - width];
  return array;
}

/** A colour of the page's theme by its name in the style sheet; whether the theme is dark; and what is called when it changes. */
const color = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const isDark = () => parseInt(color("--page").slice(1, 3), 16) < 128;
function onTheme(changed) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
  new MutationObserver(changed).observe(document.documentElement, { attributeFilter: ["data-theme"] });
}

/** Let the keyboard do what the mouse does on a picture: shift and the arrows call `move(aside, up)` by steps, + and - `zoom(factor)`. */
function steer(canvas, move, zoom) {
  addEventListener("keydown", event => {
    if (![document.body, canvas].includes(event.target) || event.ctrlKey || event.altKey || event.metaKey) return;
    const step = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const factor = { "+": 1.15, "=": 1.15, "-": 1 / 1.15 }[event.key];
    if (event.shiftKey && step) move(...step);
    else if (factor) zoom(factor);
    else return;
    event.preventDefault();
  });
}

/** So few nodes of springs or rods are seen as balls. */
const FEW_NODES = 40;

/** Places of one frame, as many components for each node as the box has; `hidden` lists nodes that are not to be seen. */
function unpackPlaces(array, nodes) {
  const dim = film.low.length;
  const [low, high] = film.reach;
  const scale = low.map((l, i) => (high[i] - l) / 2 / 32767 / size);
  const shift = low.map((l, i) => ((l + high[i]) / 2 - middle[i]) / size);
  const out = new Float32Array(dim * nodes), hidden = new Uint8Array(nodes);
  return frame => {
    const start = dim * nodes * frame;
    for (let n = 0; n < nodes; n++) {
      hidden[n] = array[start + dim * n] === -32768;
      for (let i = 0; i < dim; i++) out[dim * n + i] = array[start + dim * n + i] * scale[i] + shift[i];
    }
    return { out, hidden };
  };
}

/** Numbers at which an axis is marked: steps of 1, 2 or 5 times a power of ten. */
function ticks(low, high, most) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find(s => s * power >= rough), found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) found.push(+(i * step).toPrecision(10));
  return found.length > 1 ? found : ticks(low, high, 2 * most);
}

/** The colours of the strains, above what is drawn; rods have none. */
function showStrainBar(part) {
  if (part.limit === null) return;
  const bar = element("bar"), limit = +part.limit.toPrecision(2), colors = part.ramp.filter((_, i) => i % 15 === 0);
  bar.hidden = false;
  bar.innerHTML = `<i style="background:linear-gradient(90deg,${colors.map(c => `rgb(${c})`)})"></i><span><b>\u2212${limit}</b>strain [%]<b>+${limit}</b></span>`;
}

/** How a film of another box lies in the present one: `scale` and `shift` of its lengths. */
function fitBox(other) {
  return { scale: other.size / size, shift: other.middle.map((x, i) => (x - middle[i]) / size) };
}

/** The frame of a film that is nearest to a time [s]. */
function frameAt(times, time) {
  let low = 0, high = times.length - 1;
  while (low < high) { const half = (low + high) >> 1; if (times[half] < time) low = half + 1; else high = half; }
  return low && time - times[low - 1] < times[low] - time ? low - 1 : low;
}

/** Let whoever frames this page show other films in it: {film, ticket, ghost: keep the film before as a pale picture}. */
function listen(load, control) {
  addEventListener("message", async event => {
    if (event.source !== parent || parent === window) return;
    const { film: next, ghost, ticket, press, theme } = event.data;
    if (theme) document.documentElement.dataset.theme = theme;
    if (press) control.press(press);
    if (!next) return;
    await load(next, ghost);
    requestAnimationFrame(() => parent.postMessage({ drawn: ticket }, "*"));
  });
  if (parent !== window) parent.postMessage({ ready: true }, "*");
}
