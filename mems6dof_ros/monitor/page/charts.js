// One quantity against motion cycle: line, uncertainty band, truth, limits, lost cycles.

import uPlot from "./vendor/uPlot.esm.js";
import { QUANTITIES, colour, decimals, font, number, uncertain } from "./quantities.js";

const BAND_SD = 2;

// Rows [start, stop) of `columns` reduced to what a plot `width` px wide can show: extremes survive,
// so no spike is lost. Buckets sit at fixed cycles, so that a moving plot does not shimmer.
export function reduce(history, key, start, stop, width, offset) {
  const { columns } = history;
  const value = columns[key], sd = columns[`sd_${key}`], truth = columns[`true_${key}`];
  const cycle = columns.cycle, status = columns.status;
  const { scale } = QUANTITIES[key];
  const out = { x: [], y: [], truth: [], low: [], high: [], status: [] };
  const push = (row, y, t, low, high, s) => {
    out.x.push(cycle[row]);
    out.y.push(Number.isNaN(y) ? null : y);
    out.truth.push(Number.isNaN(t) ? null : t);
    out.low.push(low);
    out.high.push(high);
    out.status.push(s);
  };
  const shown = (row) => value[row] * scale - offset(cycle[row]);
  const spread = (row) => (sd ? BAND_SD * sd[row] * scale : NaN);
  const trueShown = (row) => (truth ? truth[row] * scale - offset(cycle[row]) : NaN);
  const size = 2 ** Math.ceil(Math.log2(Math.max((stop - start) / width, 1)));
  if (size === 1) {
    for (let row = start; row < stop; row++) {
      const y = shown(row), half = spread(row);
      push(row, y, trueShown(row), y - half, y + half, status[row]);
    }
    return out;
  }
  for (let row = start; row < stop;) {
    const bucket = Math.floor(cycle[row] / size);
    let least = -1, most = -1, low = Infinity, high = -Infinity, worst = 1;
    const first = row;
    for (; row < stop && Math.floor(cycle[row] / size) === bucket; row++) {
      if (status[row] !== 1) worst = worst === 3 ? 3 : status[row];
      const y = shown(row), half = spread(row);
      if (Number.isNaN(y)) continue;
      if (least < 0 || y < shown(least)) least = row;
      if (most < 0 || y > shown(most)) most = row;
      low = Math.min(low, y - half);
      high = Math.max(high, y + half);
    }
    if (least < 0) {
      push(first, NaN, NaN, NaN, NaN, worst);
      continue;
    }
    for (const extreme of least === most ? [least] : [Math.min(least, most), Math.max(least, most)]) {
      push(extreme, shown(extreme), trueShown(extreme), low, high, worst);
    }
  }
  return out;
}

// The rotation grows by radians while its errors are microradians: without its mean they can be seen.
const CAN_DETREND = "psi";
const HAS_LEGEND = "rotation_per_cycle";
const LABELLED = ["dz", "psi", "rotation_per_cycle"];  // those with the numbers of the cycles below

export class CycleChart {
  // view: what the page shows (history, low, high, limits); onZoom(low, high), onFollow()
  constructor(root, view, onZoom, onFollow) {
    this.root = root;
    this.key = root.dataset.quantity;
    this.view = view;
    this.data = null;
    this.yRange = [0, 1];
    this.detrended = false;
    this.drawn = 0;
    const { label, name, color } = QUANTITIES[this.key];
    root.style.setProperty("--c", `var(--${color})`);
    root.innerHTML = `<div class="head"><span class="name"></span><span class="value"></span>
      <span class="note"></span></div><div class="plot"></div>`;
    [this.nameNode, this.valueNode, this.noteNode] = root.querySelectorAll("span");
    this.nameNode.textContent = label;
    this.nameNode.title = name;
    this.plotNode = root.querySelector(".plot");
    if (this.key === HAS_LEGEND) {
      this.legend = document.createElement("span");
      this.legend.className = "legend";
      root.querySelector(".head").append(this.legend);
    }
    if (this.key === CAN_DETREND) {
      const chip = document.createElement("button");
      chip.className = "chip";
      chip.textContent = "detrended";
      chip.title = "Minus the mean rotation of the cycles shown";
      chip.onclick = () => {
        this.detrended = !this.detrended;
        chip.setAttribute("aria-pressed", this.detrended);
        this.draw();
      };
      root.querySelector(".head").append(chip);
    }
    this.onZoom = onZoom;
    this.onFollow = onFollow;
    this.measure();
    this.build();
    new ResizeObserver(() => {
      this.measure();
      this.plot.setSize(this.size);
      this.draw();
    }).observe(this.plotNode);
  }

  // Kept, because to ask for it while drawing would lay out the page anew each time.
  measure() {
    this.size = { width: Math.max(this.plotNode.clientWidth, 50), height: Math.max(this.plotNode.clientHeight, 40) };
  }

  // Made anew where colours change: uPlot keeps them.
  build() {
    this.plot?.destroy();
    const { color } = QUANTITIES[this.key];
    const axis = { stroke: colour("muted"), font: font(), grid: { stroke: colour("grid"), width: 1 },
      ticks: { stroke: colour("grid"), width: 1, size: 4 }, gap: 3 };
    const size = Math.round(parseFloat(font().split(" ")[1]) * 1.9);
    this.plot = new uPlot({
      ...this.size,
      legend: { show: false },
      padding: [6, 16, 0, 0],
      cursor: {
        sync: { key: "cycles", scales: ["x", null] }, y: false, drag: { x: true, y: false, setScale: false },
        points: { size: 6 },
        bind: { dblclick: () => () => this.onFollow() },
      },
      scales: { x: { time: false, auto: false }, y: { range: () => this.yRange } },
      axes: [
        { ...axis, size: LABELLED.includes(this.key) ? size : 7, space: 70,
          values: (_, ticks) => ticks.map((t) => (Number.isInteger(t) && LABELLED.includes(this.key) ? t : "")) },
        { ...axis, size: Math.round(size * 2.6), space: 17,
          values: (_, ticks, __, ___, step) =>
            ticks.map((t) => number(t, decimals(step))) },
      ],
      series: [
        {},
        { stroke: colour("truth"), width: 4, alpha: 0.25, points: { show: false } },
        { stroke: colour(color), width: 1.4, points: { show: false } },
      ],
      hooks: {
        drawAxes: [(u) => this.drawBackground(u)],
        setCursor: [() => this.readOut()],
        setSelect: [(u) => {
          if (u.select.width > 4) {
            this.onZoom(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
          }
          u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        }],
      },
    }, [[], [], []], this.plotNode);
  }

  // Mean rotation of the cycles shown, as a line to take away; zero where not asked for.
  trend(start, stop) {
    const { cycle, [this.key]: value } = this.view.history.columns;
    let n = 0, mx = 0, my = 0, sxx = 0, sxy = 0;
    if (!this.detrended) return () => 0;
    for (let i = start; i < stop; i++) {
      if (Number.isNaN(value[i])) continue;
      n++;
      const dx = cycle[i] - mx;
      mx += dx / n;
      my += (value[i] - my) / n;
      sxx += dx * (cycle[i] - mx);
      sxy += dx * (value[i] - my);
    }
    const slope = sxx > 0 ? sxy / sxx : 0;
    return (x) => QUANTITIES[this.key].scale * (my + slope * (x - mx));
  }

  draw() {
    const { history, low, high } = this.view;
    if (!history) return;
    const [start, stop] = history.range(low - 1, high + 1);
    this.data = reduce(history, this.key, start, stop, this.size.width, this.trend(start, stop));
    this.findRange();
    this.plot.batch(() => {
      this.plot.setData([this.data.x, this.data.truth, this.data.y], false);
      this.plot.setScale("x", { min: low, max: Math.max(high, low + 1) });
    });
    this.drawn++;
    const empty = this.data.y.every((y) => y === null) ? "no valid pose in these cycles" : "";
    if (this.plotNode.dataset.empty !== empty) this.plotNode.dataset.empty = empty;
    this.readOut();
    if (this.legend) {
      const { aligned } = this.view;
      const text = `against motion cycle, band ±${BAND_SD} sd`
        + (aligned ? `; broad grey line: simulator's truth, aligned over cycles ${aligned.join(" to ")}` : "");
      if (this.legend.textContent !== text) this.legend.textContent = text;
    }
  }

  // From the values, widened where they would otherwise show nothing but noise.
  findRange() {
    let least = Infinity, most = -Infinity, widest = 0;
    const { y, low, high } = this.data;
    for (let i = 0; i < y.length; i++) {
      if (y[i] === null) continue;
      least = Math.min(least, y[i]);
      most = Math.max(most, y[i]);
      if (high[i] > low[i]) {
        least = Math.min(least, low[i]);
        most = Math.max(most, high[i]);
        widest = Math.max(widest, (high[i] - low[i]) / (2 * BAND_SD));
      }
    }
    if (least > most) [least, most] = [-1, 1];
    const target = this.target();
    if (target !== null) [least, most] = [Math.min(least, target), Math.max(most, target)];
    const room = Math.max((most - least) * 0.06, widest, 1e-9 * Math.abs(most) || 1e-9);
    this.yRange = [least - room, most + room];
  }

  // Where the controller goes, in the unit of this plot; null: nowhere, or not on this plot.
  target() {
    const { target } = this.view;
    return this.key !== "psi" || this.detrended || target === null ? null : target * QUANTITIES.psi.scale;
  }

  drawBackground(u) {
    if (!this.data) return;
    const { ctx, bbox } = u;
    const { x, low, high, status } = this.data;
    const px = (v) => u.valToPos(v, "x", true), py = (v) => u.valToPos(v, "y", true);
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    for (let i = 0; i < x.length; i++) {
      if (status[i] === 1) continue;
      let j = i;
      while (j + 1 < x.length && status[j + 1] === status[i]) j++;
      const left = px(x[i] - 0.5), right = px(j + 1 < x.length ? x[j + 1] - 0.5 : x[j] + 0.5);
      ctx.fillStyle = colour(status[i] === 3 ? "lost" : "degraded");
      ctx.fillRect(left, bbox.top, Math.max(right - left, devicePixelRatio), bbox.height);
      i = j;
    }
    ctx.fillStyle = colour(QUANTITIES[this.key].color);
    ctx.globalAlpha = 0.24;
    for (let i = 0; i < x.length; i++) {
      if (!(high[i] > low[i])) continue;
      let j = i;
      while (j + 1 < x.length && high[j + 1] > low[j + 1]) j++;
      ctx.beginPath();
      for (let k = i; k <= j; k++) ctx.lineTo(px(x[k]), py(high[k]));
      for (let k = j; k >= i; k--) ctx.lineTo(px(x[k]), py(low[k]));
      ctx.fill();
      i = j;
    }
    ctx.globalAlpha = 1;
    const rule = (y, name, dash) => {
      ctx.strokeStyle = colour(name);
      ctx.lineWidth = devicePixelRatio;
      ctx.setLineDash(dash.map((length) => length * devicePixelRatio));
      ctx.beginPath();
      ctx.moveTo(bbox.left, py(y));
      ctx.lineTo(bbox.left + bbox.width, py(y));
      ctx.stroke();
    };
    const limit = this.detrended ? null : this.view.limits.get(this.key);
    for (const bound of [limit?.low ?? null, limit?.high ?? null]) {
      if (bound !== null) rule(bound * QUANTITIES[this.key].scale, "alarm", [7, 5]);
    }
    const target = this.target();
    if (target !== null) rule(target, "text", [2, 3]);
    ctx.restore();
  }

  // The value under the cursor, else the newest one shown.
  readOut() {
    const { history, high } = this.view;
    if (!history?.length) return;
    const { left } = this.plot.cursor;
    const hovered = left >= 0;
    const target = hovered ? Math.round(this.plot.posToVal(left, "x")) : high;
    const row = Math.min(Math.max(history.find(target + 0.5) - 1, history.first), history.end - 1);
    const { value, sd } = uncertain(this.key, history.columns[this.key][row], history.columns[`sd_${this.key}`]?.[row]);
    const cycle = hovered ? `cycle ${history.cycle[row]}  ` : "";
    if (this.valueNode.textContent !== value) this.valueNode.textContent = value;
    const note = cycle + sd;
    if (this.noteNode.textContent !== note) this.noteNode.textContent = note;
  }
}
