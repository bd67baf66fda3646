// The path of two quantities against each other, to scale: the centre, or the axis.

import { QUANTITIES, colour, decimals, font, niceStep, number } from "./quantities.js";

const MAX_POINTS = 3000;

export class PathMap {
  // note(history, row): text beside the title
  constructor(root, title, keys, view, note) {
    this.keys = keys;
    this.view = view;
    this.note = note;
    root.innerHTML = `<h2>${title} <small></small></h2><div class="stage"><canvas></canvas></div>`;
    this.noteNode = root.querySelector("small");
    this.canvas = root.querySelector("canvas");
    new ResizeObserver(() => {
      // Kept, because to ask for it while drawing would lay out the page anew each time.
      this.size = [this.canvas.clientWidth, this.canvas.clientHeight];
      this.draw();
    }).observe(root.querySelector(".stage"));
  }

  draw() {
    const { history, low, high } = this.view;
    const ratio = devicePixelRatio, canvas = this.canvas;
    const [width, height] = this.size ?? [0, 0];
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const ctx = canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    if (!history?.length) return;
    const [start, stop] = history.range(low, high);
    if (start === stop) return;
    const [a, b] = this.keys.map((key) => QUANTITIES[key]);
    const [xs, ys] = this.keys.map((key) => history.columns[key]);
    const [sdx, sdy] = this.keys.map((key) => history.columns[`sd_${key}`]);

    let left = Infinity, right = -Infinity, top = Infinity, bottom = -Infinity, last = -1;
    for (let i = start; i < stop; i++) {
      if (Number.isNaN(xs[i])) continue;
      last = i;
      left = Math.min(left, xs[i]); right = Math.max(right, xs[i]);
      top = Math.min(top, ys[i]); bottom = Math.max(bottom, ys[i]);
    }
    if (last < 0) return;
    const note = this.note(history, last);
    if (this.noteNode.textContent !== note) this.noteNode.textContent = note;

    // Equal scales; y downwards, as in the micrograph.
    const box = { x: 46, y: 6, w: width - 54, h: height - 30 };
    const margin = 2.5 * Math.max(sdx[last], sdy[last], 1e-12);
    const cx = (left + right) / 2, cy = (top + bottom) / 2;
    const halfX = (right - left) / 2 + margin, halfY = (bottom - top) / 2 + margin;
    const wanted = 2.16 * Math.max(halfX * a.scale / box.w, halfY * b.scale / box.h);  // units per px
    // Zooms in steps, so that the map does not breathe with every cycle.
    if (!(wanted < this.unit && this.unit < 1.5 * wanted)) this.unit = wanted * 1.15;
    const px = (v) => box.x + box.w / 2 + (v - cx) * a.scale / this.unit;
    const py = (v) => box.y + box.h / 2 + (v - cy) * b.scale / this.unit;

    const step = niceStep(Math.min(box.w, box.h) * this.unit, 3.2);
    const digits = decimals(step);
    ctx.font = font();
    ctx.fillStyle = colour("muted");
    ctx.lineWidth = 1;
    const grid = (centre, half, scale, place) => {
      const first = Math.ceil((centre * scale - half * this.unit) / step);
      for (let k = first; k * step <= centre * scale + half * this.unit; k++) place(k * step / scale, k * step, k === 0);
    };
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    const labelWidth = ctx.measureText(`${a.label} / ${a.unit}`).width;
    grid(cx, box.w / 2, a.scale, (v, text, zero) => {
      ctx.strokeStyle = colour(zero ? "line" : "grid");
      line(ctx, px(v), box.y, px(v), box.y + box.h);
      if (px(v) < box.x + box.w - labelWidth - 24) ctx.fillText(number(text, digits), px(v), box.y + box.h + 6);
    });
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    grid(cy, box.h / 2, b.scale, (v, text, zero) => {
      ctx.strokeStyle = colour(zero ? "line" : "grid");
      line(ctx, box.x, py(v), box.x + box.w, py(v));
      if (py(v) > box.y + 20) ctx.fillText(number(text, digits), box.x - 6, py(v));
    });
    ctx.fillStyle = colour(a.color);
    ctx.textBaseline = "top";
    ctx.fillText(`${a.label} / ${a.unit}`, box.x + box.w + 4, box.y + box.h + 6);
    ctx.fillStyle = colour(b.color);
    ctx.textAlign = "left";
    ctx.fillText(`${b.label} / ${b.unit} ↓`, 2, box.y - 3);

    ctx.save();
    ctx.beginPath();
    ctx.rect(box.x, box.y, box.w, box.h);
    ctx.clip();
    const stride = Math.max(1, Math.ceil((last + 1 - start) / MAX_POINTS));
    const from = Math.ceil(history.cycle[start] / stride) * stride;
    const first = history.find(from);
    ctx.strokeStyle = colour("neutral");
    const pieces = 24, count = Math.max(last - first, 1);
    for (let p = 0; p < pieces; p++) {  // older is fainter
      ctx.globalAlpha = 0.06 + 0.34 * ((p + 1) / pieces) ** 2;
      ctx.beginPath();
      let down = false;
      const end = first + Math.ceil((p + 1) * count / pieces);
      for (let i = first + Math.floor(p * count / pieces); i <= Math.min(end, last); i += stride) {
        if (Number.isNaN(xs[i])) { down = false; continue; }
        if (down) ctx.lineTo(px(xs[i]), py(ys[i])); else ctx.moveTo(px(xs[i]), py(ys[i]));
        down = true;
      }
      ctx.stroke();
    }
    ctx.globalAlpha = 0.75;
    ctx.fillStyle = colour("neutral");
    const dot = count / stride > 600 ? 1.1 : 1.8;
    for (let i = first; i <= last; i += stride) {
      if (!Number.isNaN(xs[i])) ctx.fillRect(px(xs[i]) - dot / 2, py(ys[i]) - dot / 2, dot, dot);
    }
    ctx.globalAlpha = 0.28;
    ctx.fillStyle = colour("mark");
    ctx.beginPath();
    ctx.ellipse(px(xs[last]), py(ys[last]), Math.max(2 * sdx[last] * a.scale / this.unit, 1),
      Math.max(2 * sdy[last] * b.scale / this.unit, 1), 0, 0, 2 * Math.PI);
    ctx.fill();
    ctx.globalAlpha = 1;
    ctx.fillStyle = colour("mark");
    ctx.strokeStyle = colour("panel");
    ctx.lineWidth = 1.5;
    ctx.beginPath();
    ctx.arc(px(xs[last]), py(ys[last]), 4.5, 0, 2 * Math.PI);
    ctx.fill();
    ctx.stroke();
    ctx.restore();
  }
}

function line(ctx, x0, y0, x1, y1) {
  ctx.beginPath();
  ctx.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
  ctx.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
  ctx.stroke();
}
