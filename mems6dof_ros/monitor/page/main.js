// The live page: what is shown, and when it is drawn.

import { CycleChart } from "./charts.js";
import { setUpController, showController } from "./controller.js";
import { exportCsv, exportPng } from "./export.js";
import { History } from "./history.js";
import { Link } from "./link.js";
import { PathMap } from "./maps.js";
import { Micrograph } from "./micrograph.js";
import { $, addEvents, setUpLimits, showDiagnostics, showFigures, showLimits, showStatus, showTiming } from "./panels.js";
import { QUANTITIES, number, readColours } from "./quantities.js";

// Drawing takes at most this share of the time, whatever the machine; data comes in always. Fifteen
// drawings a second look alive; without a graphics card, more of them would cost a core.
const DRAWING_SHARE = 0.3;
const MIN_DRAW_MS = 66;
const PANELS_MS = 400;

readColours();

let hello = null, state = null, epoch = -1, open = false;
let histories = new Map();  // by number of the body
let body = 0;
let window_ = 400;  // cycles; 0: all
let frozen = null;  // [low, high] cycles while zoomed or paused, else null: follow
let paused = false;
let fresh = false;
const view = { history: null, low: 0, high: 1, limits: new Map(), target: null };

// What comes in ------------------------------------------------------------------------------------

const link = new Link({
  open(now) {
    open = now;
    $("offline").hidden = now || !hello;
    showStatus(open, state, body);
    wantPictures();
  },
  hello(message) {
    hello = message;
    histories = new Map();
    showHistory();
    setUpLimits(hello.limitable, (request) => link.send(request));
    $("events").replaceChildren();
    wantPictures();
  },
  state(message) {
    const before = state;
    state = message;
    const changed = (key) => JSON.stringify(before?.[key]) !== JSON.stringify(state[key]);
    showStatus(open, state, body);
    view.aligned = state.aligned?.[bodyName()];
    if (changed("bodies")) showBodies();
    if (changed("limits")) {
      view.limits = new Map(state.limits.map((limit) => [limit.quantity, limit]));
      showLimits(state.limits, (quantity) => link.send({ type: "remove_limit", quantity }));
      fresh = true;
    }
    if (changed("controller") || changed("services")) showController(state.controller, state.services);
    if (changed("controller") || changed("bodies")) showTarget();
    if (changed("diagnostics")) showDiagnostics(state.diagnostics ?? []);
    if (changed("services")) {
      for (const button of serviceButtons) button.disabled = !state.services?.[button.dataset.service];
    }
  },
  events(message) { addEvents(message.events); },
  rows(newEpoch, table) {
    if (newEpoch !== epoch) {
      epoch = newEpoch;
      for (const history of histories.values()) history.clear();
      follow();
    }
    const names = Object.keys(hello.columns);
    const bodyColumn = names.indexOf("body");
    for (let row = 0; row < table.rows; row++) {
      const number_ = table.values[row * table.columns + bodyColumn];
      if (!histories.has(number_)) histories.set(number_, new History(names, hello.capacity));
      histories.get(number_).append(table, row);
    }
    showHistory();
  },
  async picture(overlay, jpeg) {
    if (!paused) await micrograph.setPicture(overlay, jpeg);
    link.send({ type: "seen" });
  },
});

// A page that nobody sees asks for no pictures, so that none are made.
function wantPictures() { link.send({ type: "pictures", on: !document.hidden && !paused }); }
document.addEventListener("visibilitychange", wantPictures);

// What is drawn ------------------------------------------------------------------------------------

const micrograph = new Micrograph($("micrograph-canvas"), $("tooltip"), $("picture-caption"));
const charts = [...document.querySelectorAll(".chart")].map((root) => new CycleChart(root, view, freeze, follow));
const maps = [
  new PathMap($("centre-map"), "Path of the centre", ["dx", "dy"], view, (history, row) =>
    `${number(1e9 * Math.hypot(history.columns.dx[row], history.columns.dy[row]), 1)} nm from zero`),
  new PathMap($("axis-map"), "Path of the axis", ["tilt_x", "tilt_y"], view, (history, row) => {
    const figure = (key) => {
      const { label, scale, digits, unit } = QUANTITIES[key];
      const value = history.columns[key][row] * scale;
      return Number.isNaN(value) ? `${label} undetermined` : `${label} ${number(value, digits)}${unit === "°" ? "" : " "}${unit}`;
    };
    return `${figure("beta")}, ${figure("alpha")}`;
  }),
];

function chooseRange() {
  const { history } = view;
  if (frozen) {
    [view.low, view.high] = frozen;
  } else if (history?.length) {
    view.high = history.last("cycle");
    const first = history.cycle[history.first];
    view.low = window_ ? Math.max(view.high - window_ + 1, first) : first;
  }
}

let nextDraw = 0, nextPanels = 0;
function tick(now) {
  requestAnimationFrame(tick);
  const { history } = view;
  if (!history?.length || !state) return;
  if (fresh && now >= nextDraw) {
    fresh = false;
    const started = performance.now();
    chooseRange();
    for (const chart of charts) chart.draw();
    for (const map of maps) map.draw();
    if (!paused) showFigures(history, state);
    const took = performance.now() - started;
    nextDraw = now + Math.max(MIN_DRAW_MS, took / DRAWING_SHARE);
  }
  if (now >= nextPanels) {
    nextPanels = now + PANELS_MS;
    showTiming(history, ...history.range(view.low, view.high), state);
    if (paused) $("pause").textContent = `Resume, ${history.end - history.find(frozen[1] + 0.5)} cycles later`;
  }
}

function redraw() { fresh = true; nextDraw = 0; nextPanels = 0; }

function showBodies() {
  const select = $("body");
  select.hidden = state.bodies.length < 2;
  if (select.options.length !== state.bodies.length) {
    select.replaceChildren(...state.bodies.map((b) => new Option(b.name, b.number, false, b.number === body)));
  }
}
function showHistory() {
  view.history = histories.get(body) ?? null;
  document.querySelector("main").classList.toggle("waiting", !view.history?.length);
  fresh = true;
}

// Where the controller takes the body that is shown; null: nowhere.
function showTarget() {
  const { controller } = state;
  view.target = controller && controller.body === bodyName() ? controller.target : null;
  fresh = true;
}
const bodyName = () => state?.bodies.find((b) => b.number === body)?.name ?? "body";

// What the user does -------------------------------------------------------------------------------

$("body").onchange = () => {
  body = micrograph.body = Number($("body").value);
  showHistory();
  showTarget();
  showStatus(open, state, body);
  micrograph.draw();
  redraw();
};

function freeze(low, high) {
  frozen = [low, high];
  $("follow").hidden = false;
  redraw();
}

function follow() {
  if (paused) togglePause();
  frozen = null;
  $("follow").hidden = true;
  redraw();
}

function togglePause() {
  paused = !paused;
  $("pause").setAttribute("aria-pressed", paused);
  $("pause").textContent = "Pause";
  if (paused) freeze(view.low, view.high);
  else follow();
  wantPictures();
}

function setWindow(cycles) {
  window_ = cycles;
  for (const button of $("windows").querySelectorAll("button")) {
    button.setAttribute("aria-pressed", Number(button.dataset.window) === cycles);
  }
  follow();
}

$("pause").onclick = togglePause;
$("follow").onclick = follow;
for (const button of $("windows").querySelectorAll("button")) {
  button.onclick = () => setWindow(Number(button.dataset.window));
}
$("export-csv").onclick = () => view.history && exportCsv(view, hello.columns, bodyName());
$("export-png").onclick = () => exportPng(view, bodyName(), $("status-name").textContent);
$("alarm-chip").onclick = () => $("alarms").scrollIntoView({ behavior: "smooth" });
for (const what of ["particles", "identities", "residuals"]) {
  $(`show-${what}`).onchange = (event) => {
    micrograph.show[what] = event.target.checked;
    micrograph.draw();
  };
}

async function call(service, value) {
  const { success, message } = await link.call(service, value);
  $("answer").textContent = `${success ? "✓" : "✗"} ${message || service}`;
  $("answer").title = message;
}

const serviceButtons = [...document.querySelectorAll("[data-service]")];
for (const button of serviceButtons) {
  button.disabled = true;
  button.onclick = async () => {
    if ("confirm" in button.dataset && !confirm(`${button.title}?`)) return;
    button.classList.add("busy");
    await call(button.dataset.service);
    button.classList.remove("busy");
  };
}
setUpController(call);

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  readColours();
  for (const chart of charts) chart.build();
  redraw();
}
$("theme").onclick = () => {
  const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  localStorage.setItem("mems6dof-theme", theme);
  setTheme(theme);
};
matchMedia("(prefers-color-scheme: light)").addEventListener("change", ({ matches }) => {
  if (!localStorage.getItem("mems6dof-theme")) setTheme(matches ? "light" : "dark");
});

document.addEventListener("keydown", (event) => {
  if (event.target.closest("input, select, button") || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === " ") { event.preventDefault(); togglePause(); }
  if (event.key === "f") follow();
});

showLimits([], () => {});
showDiagnostics([]);
showHistory();
setWindow(window_);
requestAnimationFrame(tick);

// For the browser test, which asks whether things move.
window.mems6dof = { charts, link, micrograph, view };
