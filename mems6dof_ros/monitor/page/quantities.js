// What the page shows, in the units that a person reads: value shown = SI value x scale.

const quantity = (label, name, unit, scale, digits, color = "neutral") =>
  ({ label, name, unit, scale, digits, color });

export const QUANTITIES = {
  dx: quantity("dx", "displacement along columns", "nm", 1e9, 2, "x"),
  dy: quantity("dy", "displacement along rows", "nm", 1e9, 2, "y"),
  dz: quantity("dz", "displacement along the optical axis", "nm", 1e9, 1, "z"),
  tilt_x: quantity("tilt x", "tilt about x", "mrad", 1e3, 3, "x"),
  tilt_y: quantity("tilt y", "tilt about y", "mrad", 1e3, 3, "y"),
  psi: quantity("ψ", "intrinsic rotation", "rad", 1, 6, "psi"),
  rotation_per_cycle: quantity("Δψ", "rotation per cycle", "mrad", 1e3, 4, "psi"),
  beta: quantity("β", "nutation", "mrad", 1e3, 3),
  alpha: quantity("α", "precession", "°", 180 / Math.PI, 1),
  residual_rms_xy: quantity("residual xy", "rms residual in x and y", "nm", 1e9, 2),
  residual_rms_z: quantity("residual z", "rms residual in z", "nm", 1e9, 1),
  chi_square: quantity("χ² / dof", "reduced chi-square", "", 1, 2),
  particles_used: quantity("particles used", "particles in the solution", "", 1, 0),
  latency_total: quantity("latency", "frame published to pose published", "ms", 1e3, 1),
};

export const STATUS = [
  { name: "INITIALIZING", level: "warning" },
  { name: "TRACKING", level: "good" },
  { name: "DEGRADED", level: "warning" },
  { name: "LOST", level: "alarm" },
];

const MINUS = "\u2212";

export function number(value, digits) {
  return Number.isFinite(value) ? value.toFixed(digits).replace("-", MINUS) : "–";
}

// A value with its standard deviation, to the digits that the latter justifies.
export function uncertain(key, value, sd) {
  const { unit, scale, digits } = QUANTITIES[key];
  if (!Number.isFinite(value)) return { value: "–", sd: "" };
  const d = sd > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(sd * scale)), 0), 8) : digits;
  const text = `${number(value * scale, d)} ${unit}`;
  if (!(sd > 0)) return { value: text, sd: "" };
  const [sdScale, sdUnit] = unit === "rad" || unit === "mrad" ? [1e6, "µrad"] : [scale, unit];
  const sdDigits = Math.max(1 - Math.floor(Math.log10(sd * sdScale)), 0);
  return { value: text, sd: `± ${number(sd * sdScale, sdDigits)} ${sdUnit}` };
}

// A step of 1, 2 or 5 times a power of ten, at least `span / count`.
export function niceStep(span, count) {
  const raw = span / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  return [1, 2, 5, 10].find((f) => f * power >= raw * 0.999) * power;
}

// Decimals that tell multiples of `step` apart and exactly.
export function decimals(step) {
  let digits = 0;
  while (digits < 9 && Math.abs(Math.round(step * 10 ** digits) - step * 10 ** digits) > 1e-6 * step * 10 ** digits) digits++;
  return digits;
}

let colours = {};
export function readColours() {
  const style = getComputedStyle(document.documentElement);
  const names = ["bg", "panel", "line", "grid", "text", "muted", "x", "y", "z", "psi", "neutral", "mark", "alarm",
    "warning", "lost", "degraded", "truth"];
  colours = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  colours.font = style.fontFamily;
  colours.size = parseFloat(style.fontSize);
}
export const colour = (name) => colours[name];
export const font = (scale = 0.8, weight = 400) => `${weight} ${Math.round(colours.size * scale)}px ${colours.font}`;
