// The micrograph with what was found on it: particles, identities, residuals, to zoom into.

import { font, niceStep, number } from "./quantities.js";

const FLAGS = ["fit failed", "window cut", "saturated", "neighbour", "poor fit", "z ambiguous", "z out of range",
  "out of field", "out of brightness", "no z"];
// On a picture that is dark in both themes.
const USED = "#35d0ff", UNUSED = "#ffab4a", RESIDUAL = "#ffe14d", INK = "#eaf2f8";

export class Micrograph {
  constructor(canvas, tooltip, caption) {
    Object.assign(this, { canvas, tooltip, caption });
    this.show = { particles: true, identities: true, residuals: true };
    this.overlay = null;
    this.bitmap = null;
    this.body = 0;
    this.zoom = 1;
    this.centre = [0.5, 0.5];  // of the view, as fractions of the image
    this.pointer = null;
    this.drawn = 0;
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("wheel", (e) => this.onWheel(e), { passive: false });
    canvas.addEventListener("pointerdown", (e) => { this.grab = [e.offsetX, e.offsetY]; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener("pointerup", () => { this.grab = null; });
    canvas.addEventListener("pointermove", (e) => this.onMove(e));
    canvas.addEventListener("pointerleave", () => { this.pointer = null; this.point(); });
    canvas.addEventListener("dblclick", () => { this.zoom = 1; this.centre = [0.5, 0.5]; this.draw(); });
  }

  async setPicture(overlay, jpeg) {
    const bitmap = jpeg.length ? await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" })) : null;
    this.bitmap?.close();
    this.bitmap = bitmap;
    // Without an image its size is unknown: the last one's, or the usual sensor's.
    overlay.width ??= this.overlay?.width ?? 2048;
    overlay.height ??= this.overlay?.height ?? 2048;
    overlay.pixel_size ??= this.overlay?.pixel_size;
    this.overlay = overlay;
    const grey = overlay.grey ? `, grey ${overlay.grey.map((g) => Math.round(g)).join(" to ")} ADU` : ", no image received";
    this.caption.textContent = `cycle ${overlay.cycle}${grey}`;
    this.caption.title = this.caption.textContent;
    this.draw();
    this.point();
  }

  geometry() {
    const { width, height } = this.overlay;
    const w = this.canvas.clientWidth, h = this.canvas.clientHeight;
    const scale = Math.min(w / width, h / height) * this.zoom;  // screen px per image px
    return { scale, left: w / 2 - this.centre[0] * width * scale, top: h / 2 - this.centre[1] * height * scale, w, h };
  }

  onWheel(event) {
    event.preventDefault();
    if (!this.overlay) return;
    const { scale, left, top } = this.geometry();
    const { width, height } = this.overlay;
    const at = [(event.offsetX - left) / (scale * width), (event.offsetY - top) / (scale * height)];
    const zoom = Math.min(Math.max(this.zoom * 1.0015 ** -event.deltaY, 1), 40);
    this.centre = this.centre.map((c, i) => at[i] + (c - at[i]) * this.zoom / zoom);
    this.zoom = zoom;
    this.keepInside();
    this.draw();
  }

  keepInside() {
    const half = 0.5 / this.zoom;
    this.centre = this.centre.map((c) => Math.min(Math.max(c, half), 1 - half));
  }

  onMove(event) {
    this.pointer = [event.offsetX, event.offsetY];
    if (this.grab && this.overlay) {
      const { scale } = this.geometry();
      this.centre[0] -= (event.offsetX - this.grab[0]) / (scale * this.overlay.width);
      this.centre[1] -= (event.offsetY - this.grab[1]) / (scale * this.overlay.height);
      this.grab = [event.offsetX, event.offsetY];
      this.keepInside();
      this.draw();
    }
    this.point();
  }

  of() { return this.overlay?.bodies?.find((b) => b.body === this.body); }

  draw() {
    const ratio = devicePixelRatio, { canvas, overlay } = this;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const ctx = canvas.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.fillStyle = "#05070a";
    ctx.fillRect(0, 0, width, height);
    if (!overlay) {
      this.say(ctx, "Waiting for frames", "shown while the instrument measures");
      return;
    }
    const { scale, left, top } = this.geometry();
    if (this.bitmap) {
      ctx.imageSmoothingEnabled = scale * overlay.width / this.bitmap.width < 4;
      ctx.drawImage(this.bitmap, left, top, overlay.width * scale, overlay.height * scale);
    } else {
      ctx.strokeStyle = "#2a3440";
      ctx.strokeRect(left, top, overlay.width * scale, overlay.height * scale);
    }
    this.drawScales(ctx, this.drawParticles(ctx));
    if (overlay.x_px?.length === 0) this.say(ctx, "No particle found", `in cycle ${overlay.cycle}`);
    this.drawn++;
  }

  // Words in the middle, where there is nothing else to see.
  say(ctx, headline, detail) {
    const x = this.canvas.clientWidth / 2, y = this.canvas.clientHeight / 2;
    ctx.textAlign = "center";
    ctx.textBaseline = "middle";
    ctx.fillStyle = INK;
    ctx.font = font(1.15, 600);
    ctx.fillText(headline, x, y - 12);
    ctx.fillStyle = "#93a0af";
    ctx.font = font(0.9);
    ctx.fillText(detail, x, y + 12);
    ctx.textAlign = "left";
  }

  // Returns the length of a residual on the screen, px per m.
  drawParticles(ctx) {
    const { overlay, show } = this;
    if (!overlay.x_px) return 0;
    const { scale, left, top, w, h } = this.geometry();
    const pose = this.of();
    // Pixel centres are integers, the corner of the image is at -1/2.
    const at = (i) => [left + (overlay.x_px[i] + 0.5) * scale, top + (overlay.y_px[i] + 0.5) * scale];
    const radius = Math.min(Math.max(16 * scale, 5.5), 60);
    const used = (i) => (pose?.particle_id[i] ?? -1) >= 0;
    const lengths = [];
    if (pose) {
      for (let i = 0; i < pose.residual_x.length; i++) {
        if (pose.residual_x[i] !== null) lengths.push(Math.hypot(pose.residual_x[i], pose.residual_y[i]));
      }
    }
    const gain = this.residualGain(lengths);
    ctx.font = font(0.76, 500);
    ctx.textBaseline = "middle";
    ctx.lineJoin = "round";
    for (let i = 0; i < overlay.x_px.length; i++) {
      if (overlay.x_px[i] === null) continue;
      const [x, y] = at(i);
      if (x < -20 || y < -20 || x > w + 20 || y > h + 20) continue;
      if (show.particles) {
        ctx.strokeStyle = used(i) ? USED : UNUSED;
        ctx.lineWidth = 1.4;
        ctx.setLineDash(used(i) ? [] : [3, 3]);
        ctx.beginPath();
        ctx.arc(x, y, radius, 0, 2 * Math.PI);
        ctx.stroke();
      }
      if (show.residuals && gain && pose.residual_x[i] !== null) {
        arrow(ctx, x, y, x + pose.residual_x[i] * gain, y + pose.residual_y[i] * gain);
      }
      if (show.identities && used(i)) {
        ctx.setLineDash([]);
        ctx.strokeStyle = "rgba(0, 0, 0, .75)";
        ctx.lineWidth = 2.5;
        ctx.strokeText(pose.particle_id[i], x + radius * 0.75 + 2, y - radius * 0.75 - 2);
        ctx.fillStyle = INK;
        ctx.fillText(pose.particle_id[i], x + radius * 0.75 + 2, y - radius * 0.75 - 2);
      }
    }
    ctx.setLineDash([]);
    return show.residuals ? gain : 0;
  }

  // A typical residual is about 16 px long; kept until far off, so that lengths compare over time.
  residualGain(lengths) {
    if (lengths.length) {
      const typical = lengths.sort((p, q) => p - q)[lengths.length >> 1] || 1e-9;
      const wanted = 16 / typical;
      if (!(this.gain > wanted / 1.8 && this.gain < wanted * 1.8)) this.gain = wanted;
      return this.gain;
    }
    return 0;
  }

  drawScales(ctx, gain) {
    const { overlay } = this;
    const { scale, w, h } = this.geometry();
    ctx.font = font(0.82, 500);
    ctx.textBaseline = "bottom";
    ctx.textAlign = "left";
    const label = (text, x, y) => {
      ctx.strokeStyle = "rgba(0, 0, 0, .8)";
      ctx.lineWidth = 3;
      ctx.strokeText(text, x, y);
      ctx.fillStyle = INK;
      ctx.fillText(text, x, y);
    };
    const bar = (x, length, colour) => {
      for (const [width, style] of [[5, "rgba(0, 0, 0, .7)"], [3, colour]]) {
        ctx.strokeStyle = style;
        ctx.lineWidth = width;
        ctx.beginPath();
        ctx.moveTo(x, h - 12);
        ctx.lineTo(x + length, h - 12);
        ctx.stroke();
      }
    };
    const shade = (x, width) => {
      ctx.fillStyle = "rgba(5, 7, 10, .72)";
      ctx.beginPath();
      ctx.roundRect(x - 7, h - 38, width + 14, 33, 5);
      ctx.fill();
    };
    if (overlay.pixel_size) {
      const micrometres = niceStep(w / scale * overlay.pixel_size * 1e6, 6);
      const length = micrometres * 1e-6 / overlay.pixel_size * scale;
      shade(14, length);
      bar(14, length, INK);
      label(`${micrometres} µm`, 14, h - 18);
    }
    if (gain) {
      const nanometres = niceStep(48 / gain * 1e9, 1);
      const length = nanometres * 1e-9 * gain;
      const text = `residual ${number(nanometres, nanometres < 1 ? 1 : 0)} nm`;
      const width = Math.max(length, ctx.measureText(text).width);
      shade(w - 14 - width, width);
      bar(w - 14 - length, length, RESIDUAL);
      ctx.textAlign = "right";
      label(text, w - 14, h - 18);
    }
    ctx.textAlign = "left";
    ctx.textBaseline = "middle";
    for (const [dx, dy, text] of [[26, 0, "x"], [0, 26, "y"]]) {
      ctx.setLineDash([]);
      arrow(ctx, 14, 14, 14 + dx, 14 + dy, INK);
      label(text, 18 + dx, 14 + dy * 1.05);
    }
  }

  // Says what is known of the particle under the pointer.
  point() {
    const { overlay, pointer, tooltip } = this;
    tooltip.hidden = true;
    if (!overlay?.x_px || !pointer) return;
    const { scale, left, top, w, h } = this.geometry();
    let nearest = -1, least = 18;
    for (let i = 0; i < overlay.x_px.length; i++) {
      if (overlay.x_px[i] === null) continue;
      const d = Math.hypot(left + (overlay.x_px[i] + 0.5) * scale - pointer[0], top + (overlay.y_px[i] + 0.5) * scale - pointer[1]);
      if (d < least) [least, nearest] = [d, i];
    }
    if (nearest < 0) return;
    const i = nearest, pose = this.of(), id = pose?.particle_id[i] ?? -1;
    const um = (v) => number((v ?? NaN) * 1e6, 3), nm = (v) => number((v ?? NaN) * 1e9, 1);
    const flags = FLAGS.filter((_, bit) => overlay.flags[i] & (1 << bit));
    tooltip.textContent = [
      id >= 0 ? `particle ${id}` : "not used for the pose",
      `x, y, z  ${um(overlay.x[i])}, ${um(overlay.y[i])}, ${um(overlay.z[i])} µm`,
      ...(id >= 0 ? [`residual  ${nm(pose.residual_x[i])}, ${nm(pose.residual_y[i])}, ${nm(pose.residual_z[i])} nm`] : []),
      `${Math.round(overlay.flux[i] ?? NaN).toLocaleString("en")} electrons`,
      ...(flags.length ? [flags.join(", ")] : []),
    ].join("\n");
    tooltip.hidden = false;
    const place = (p, size, room) => `${p + 16 + size > room ? Math.max(p - 12 - size, 0) : p + 16}px`;
    tooltip.style.left = place(pointer[0], tooltip.offsetWidth, w);
    tooltip.style.top = place(pointer[1], tooltip.offsetHeight, h);
  }
}

function arrow(ctx, x0, y0, x1, y1, colour = RESIDUAL) {
  const length = Math.hypot(x1 - x0, y1 - y0);
  const head = Math.min(5, length * 0.5), angle = Math.atan2(y1 - y0, x1 - x0);
  ctx.setLineDash([]);
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  for (const turn of [2.6, -2.6]) {
    ctx.moveTo(x1, y1);
    ctx.lineTo(x1 + head * Math.cos(angle + turn), y1 + head * Math.sin(angle + turn));
  }
  ctx.strokeStyle = "rgba(0, 0, 0, .6)";
  ctx.lineWidth = 3;
  ctx.stroke();
  ctx.strokeStyle = colour;
  ctx.lineWidth = 1.6;
  ctx.stroke();
}
