// What is shown, to take away: numbers as CSV, the page as PNG.

import { colour, font } from "./quantities.js";

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const fileName = (body, view, ending) => `mems6dof-${body}-cycles-${Math.round(view.low)}-${Math.round(view.high)}.${ending}`;

// Every row of the range shown, all columns, SI units.
export function exportCsv(view, units, body) {
  const { history, low, high } = view;
  const [start, stop] = history.range(low, high);
  const lines = [
    "# mems6dof monitor export, format 1",
    `# body: ${body}`,
    `# exported: ${new Date().toISOString()}`,
    `# units: ${history.names.map((name) => `${name} ${units[name] || "-"}`).join(", ")}`,
    "# status: 0 initializing, 1 tracking, 2 degraded, 3 lost; sd_: standard deviation; true_: simulator's truth, "
      + "aligned to one measured cycle; empty: unknown",
    history.names.join(","),
  ];
  const columns = history.names.map((name) => history.columns[name]);
  for (let row = start; row < stop; row++) {
    lines.push(columns.map((column) => (Number.isNaN(column[row]) ? "" : column[row])).join(","));
  }
  save(new Blob([lines.join("\n"), "\n"], { type: "text/csv" }), fileName(body, view, "csv"));
}

// All pictures of the page where they stand, with their titles.
export function exportPng(view, body, status) {
  const main = document.querySelector("main"), origin = main.getBoundingClientRect();
  const ratio = devicePixelRatio, margin = 16, head = 44;
  const panels = [...main.querySelectorAll(".panel")].filter((panel) => panel.querySelector("canvas"));
  const bottom = Math.max(...panels.map((panel) => panel.getBoundingClientRect().bottom));
  const canvas = document.createElement("canvas");
  canvas.width = origin.width * ratio;
  canvas.height = (bottom - origin.top + head + margin) * ratio;
  const ctx = canvas.getContext("2d");
  ctx.scale(ratio, ratio);
  ctx.fillStyle = colour("bg");
  ctx.fillRect(0, 0, canvas.width, canvas.height);
  ctx.textBaseline = "middle";
  ctx.fillStyle = colour("text");
  ctx.font = font(1.1, 650);
  ctx.fillText(`mems6dof   ${body}   ${status}   cycles ${Math.round(view.low)} to ${Math.round(view.high)}   `
    + new Date().toISOString().slice(0, 19).replace("T", " ") + " UTC", margin, head / 2);
  ctx.translate(-origin.left, head - origin.top);
  for (const panel of panels) {
    const box = panel.getBoundingClientRect();
    ctx.fillStyle = colour("panel");
    ctx.beginPath();
    ctx.roundRect(box.left, box.top, box.width, box.height, 10);
    ctx.fill();
    for (const source of panel.querySelectorAll("canvas")) {
      const place = source.getBoundingClientRect();
      ctx.drawImage(source, place.left, place.top, place.width, place.height);
    }
    for (const node of panel.querySelectorAll(".head span, h2, h2 small")) {
      const place = node.getBoundingClientRect(), style = getComputedStyle(node);
      ctx.font = `${style.fontWeight} ${style.fontSize} ${style.fontFamily}`;
      ctx.fillStyle = style.color;
      const words = node.tagName === "H2" ? node.firstChild.textContent : node.textContent;
      ctx.fillText(words.trim(), place.left, place.top + place.height / 2);
    }
  }
  canvas.toBlob((blob) => save(blob, fileName(body, view, "png")), "image/png");
}
