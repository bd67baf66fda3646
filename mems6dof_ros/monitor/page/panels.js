// The panels made of words and figures: header, timing, alarms, diagnostics, log.

import { QUANTITIES, STATUS, number } from "./quantities.js";

export const $ = (id) => document.getElementById(id);

const STALE_S = 1.5;
const LOG_LINES = 200;
const STAGES = {
  latency_capture: "capture",
  latency_frame_transport: "frame transport",
  latency_queue: "queue",
  latency_localization: "localization",
  latency_localization_transport: "transport",
  latency_pose: "pose",
};

export function text(node, value) {
  if (node.textContent !== value) node.textContent = value;
}

function element(tag, className, content) {
  const node = document.createElement(tag);
  node.className = className;
  node.textContent = content ?? "";
  return node;
}

function row(level, ...content) {
  const node = element("div", "row");
  node.dataset.level = level;
  node.append(element("span", "dot"), ...content);
  return node;
}

export function showStatus(open, state, body) {
  const known = state?.bodies.find((b) => b.number === body);
  let { name, level } = STATUS[known?.status] ?? { name: "WAITING", level: "idle" };
  let reason = known ? known.reason : state ? missing(state.rates) : "";
  if (!open) [name, level, reason] = ["OFFLINE", "alarm", "the monitor does not answer"];
  else if (known && state.stale > STALE_S) [name, level, reason] = ["STALE", "warning", `no pose for ${Math.round(state.stale)} s`];
  $("status").dataset.level = level;
  text($("status-name"), name);
  text($("status-reason"), reason);
  $("status").title = reason;
  document.title = `${name} – mems6dof`;
}

// What the instrument lacks, where there is no pose.
function missing(rates) {
  if (rates?.localizations) return "no poses come: is pose_estimator running?";
  if (rates?.frame_info) return "frames come, but no localizations: is localizer running?";
  return "nothing is heard; same ROS domain and namespace?";
}

export function showFigures(history, state) {
  const show = (id, value) => text($(`figure-${id}`), value);
  const last = (name, scale, digits) => number(history.last(name) * scale, digits);
  show("cycle", number(history.last("cycle"), 0));
  show("rate", number(state.rates?.pose_6dof ?? NaN, 1));
  show("latency", last("latency_total", 1e3, 1));
  show("lost", String(state.frames_missing));
  show("particles", `${last("particles_used", 1, 0)} / ${last("particles_expected", 1, 0)}`);
  show("residual", `${last("residual_rms_xy", 1e9, 2)} · ${last("residual_rms_z", 1e9, 0)}`);
  show("chi", last("chi_square", 1, 2));
}

// Median and 99th percentile of the rows [start, stop).
function spread(column, start, stop) {
  const values = column.slice(Math.max(start, stop - 1000), stop).filter((v) => !Number.isNaN(v)).sort();
  return [0.5, 0.99].map((q) => values[Math.min(Math.floor(q * values.length), values.length - 1)] ?? NaN);
}

export function showTiming(history, start, stop, state) {
  const rows = [...Object.entries(STAGES), ["latency_total", "frame to pose"]]
    .map(([key, name]) => ({ key, name, figures: spread(history.columns[key], start, stop) }));
  const longest = Math.max(...rows.slice(0, -1).map(({ figures }) => figures[1] || 0), 1e-6);
  const root = $("stages");
  if (!root.childElementCount) {
    for (const { name, key } of rows) {
      const node = element("div", "stage-row");
      const track = element("div", "track");
      track.append(document.createElement("u"), document.createElement("i"));
      node.classList.toggle("total", key === "latency_total");
      node.append(element("span", "", name), key === "latency_total" ? element("span") : track, element("span"));
      root.append(node);
    }
  }
  rows.forEach(({ key, figures: [median, high] }, i) => {
    const [, track, value] = root.children[i].children;
    text(value, `${number(median * 1e3, 2)} · ${number(high * 1e3, 2)} ms`);
    if (key === "latency_total") return;
    const width = (v) => `${Math.min(100 * (v || 0) / longest, 100).toFixed(1)}%`;
    track.children[0].style.width = width(high);
    track.children[1].style.width = width(median);
  });
  const rate = (topic) => `${number(state.rates?.[topic] ?? NaN, 1)} /s`;
  const pairs = [
    ["frames", rate("frame_info")], ["dropped by the source", `${state.frames_dropped ?? "–"}`],
    ["localizations", rate("localizations")], ["missing among poses", `${state.frames_missing}`],
    ["poses", rate("pose_6dof")], ["cycles kept here", `${history.length}`],
  ].flat();
  const grid = $("rates");
  while (grid.childElementCount < pairs.length) grid.append(document.createElement("span"));
  pairs.forEach((value, i) => text(grid.children[i], value));
}

export function setUpLimits(limitable, send) {
  const select = $("limit-quantity"), low = $("limit-low"), high = $("limit-high");
  select.replaceChildren(...limitable.map((key) => new Option(`${QUANTITIES[key].label}: ${QUANTITIES[key].name}`, key)));
  const unit = () => text($("limit-unit"), QUANTITIES[select.value].unit);
  select.onchange = unit;
  unit();
  const read = (input) => {
    const value = input.value.trim().replace(",", ".").replace("\u2212", "-");
    const figure = value === "" ? null : Number(value) / QUANTITIES[select.value].scale;
    input.setCustomValidity(Number.isNaN(figure) ? "a number, or nothing for no limit" : "");
    return figure;
  };
  $("limit-form").onsubmit = (event) => {
    event.preventDefault();
    const [least, most] = [read(low), read(high)];
    if (least === null && most === null) low.setCustomValidity("at least one limit");
    if (least !== null && most !== null && least > most) high.setCustomValidity("not below the lower limit");
    if (!event.target.reportValidity()) return;
    send({ type: "limit", quantity: select.value, low: least, high: most });
    event.target.reset();
    unit();
  };
  for (const input of [low, high]) input.oninput = () => { low.setCustomValidity(""); high.setCustomValidity(""); };
}

export function showLimits(limits, remove) {
  const active = limits.filter((l) => l.active).length;
  const chip = $("alarm-chip");
  chip.hidden = !active;
  text(chip, `${active} alarm${active > 1 ? "s" : ""}`);
  const root = $("limits");
  // Made anew only where limits come or go: their counts change with every cycle, and a button that is
  // replaced between press and release never hears of either.
  const names = limits.map((limit) => limit.quantity).join();
  if (root.dataset.names !== names) {
    root.dataset.names = names;
    root.replaceChildren(...limits.map(({ quantity }) => {
      const button = element("button", "", "×");
      button.title = "Remove this limit";
      button.onclick = () => remove(quantity);
      return row("idle", element("span", "label", QUANTITIES[quantity].label), element("span"), element("span", "muted"), button);
    }));
    if (!limits.length) root.append(element("div", "muted", "No limits set."));
  }
  limits.forEach((limit, i) => {
    const { unit, scale, digits } = QUANTITIES[limit.quantity];
    const bound = (v, open) => v === null ? open : number(v * scale, Math.min(digits, 3));
    const state = limit.active ? "ALARM" : limit.count ? "within again" : "kept";
    const count = limit.count ? `, ${limit.count} cycle${limit.count > 1 ? "s" : ""} outside` : "";
    const node = root.children[i];
    node.dataset.level = limit.active ? "alarm" : limit.count ? "warning" : "good";
    text(node.children[2], `${bound(limit.low, "any")} to ${bound(limit.high, "any")} ${unit}`);
    text(node.children[3], state + count);
  });
}

export function showDiagnostics(diagnostics) {
  const nodes = diagnostics.map(({ name, level, message, values }) => {
    const node = row(["good", "warning", "alarm", "warning"][level] ?? "idle", element("span", "", name),
      element("span", "muted", message));
    node.title = Object.entries(values).map(([key, value]) => `${key}: ${value}`).join("\n");
    return node;
  });
  if (!nodes.length) nodes.push(element("div", "muted", "None received."));
  $("diagnostics").replaceChildren(...nodes);
}

// All the lines that the log will ever have, empty ones hidden: a page that stays open does not grow.
export function clearEvents() {
  $("events").replaceChildren(...Array.from({ length: LOG_LINES }, () => {
    const line = element("li", "");
    line.hidden = true;
    line.append(element("time", "", " "), element("span", "dot"), element("span", "", " "));
    return line;
  }));
}

export function addEvents(events) {
  const list = $("events");
  for (const { time, level, text: words } of events) {
    const line = list.lastChild;
    line.hidden = false;
    line.dataset.level = level;
    line.children[0].textContent = new Date(time * 1000).toLocaleTimeString("en-GB");
    line.children[2].textContent = words;
    list.prepend(line);
  }
}
