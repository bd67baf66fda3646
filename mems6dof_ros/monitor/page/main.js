// The live page: what is shown, and when it is drawn.

import { CycleChart } from "./charts.js";
import { setUpController, showController } from "./controller.js";
import { exportCsv, exportPng } from "./export.js";
import { History } from "./history.js";
import { Link } from "./link.js";
import { PathMap } from "./maps.js";
import { Micrograph } from "./micrograph.js";
import { $, addEvents, clearEvents, setUpLimits, showDiagnostics, showFigures, showLimits, showStatus, showTiming } from "./panels.js";
import { QUANTITIES, number, readColours } from "./quantities.js";

// Drawing takes at most this share of the time, whatever the machine and whoever else wants it, so that a
// page does not slow the measurement beside it; data comes in always. Ten drawings a second look alive.
const DRAWING_SHARE = 0.15;
const MIN_DRAW_MS = 95;
const PANELS_MS = 900;

readColours();

let hello = null, state = null, epoch = -1, open = false;
let histories = new Map();  // by number of the body
let body = 0;
let window_ = 400;  // cycles; 0: all
let frozen = null;  // [low, high] cycles while zoomed or paused, else null: follow
let paused = false;
let stale = false;  // the plots do not show what they should
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
    clearEvents();
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
      change();
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
    if (frozen) schedule();  // only figures change
    else showHistory();
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

let timer = 0, nextDraw = 0, nextPanels = 0;  // timer: of the drawing to come, 0: none

// Asks for an animation frame only when one is due: each costs, drawn upon or not.
function schedule() {
  if (timer) return;
  timer = setTimeout(() => requestAnimationFrame(show), Math.max(nextDraw - performance.now(), 0));
}

function show() {
  timer = 0;
  const { history } = view;
  if (!history?.length || !state) return;
  const started = performance.now();
  if (stale) {
    stale = false;
    chooseRange();
    for (const chart of charts) chart.draw();
    for (const map of maps) map.draw();
  }
  if (!paused) showFigures(history, state);
  if (started >= nextPanels) {
    nextPanels = started + PANELS_MS;
    showTiming(history, ...history.range(view.low, view.high), state);
    if (paused) $("pause").textContent = `Resume, ${history.end - history.find(frozen[1] + 0.5)} cycles later`;
  }
  nextDraw = started + MIN_DRAW_MS;
  // A task of its own comes after the browser has put what was drawn on the screen, most of the work.
  setTimeout(() => { nextDraw = Math.max(nextDraw, started + (performance.now() - started) / DRAWING_SHARE); });
}

function change() { stale = true; schedule(); }

// At once, for what the user has asked for.
function redraw() {
  clearTimeout(timer);
  timer = nextDraw = nextPanels = 0;
  change();
}

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
  change();
}

// Where the controller takes the body that is shown; null: nowhere.
function showTarget() {
  const { controller } = state;
  view.target = controller && controller.body === bodyName() ? controller.target : null;
  change();
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

// For the browser test, which asks whether things move.
window.mems6dof = { charts, link, maps, micrograph, view };
