// The controller: where it is sent, what it does, why it stopped, and within which limits.

import { $, text } from "./panels.js";
import { number } from "./quantities.js";

const LEVELS = { idle: "info", moving: "good", arrived: "good", stopped: "alarm" };
const LIMITS = [
  ["max_play", "play", 1e6, 3, "µm"],
  ["max_tilt", "tilt", 1e3, 3, "mrad"],
  ["max_sd_psi", "sd of ψ", 1e6, 0, "µrad"],
  ["max_pose_age", "age of a pose", 1, 2, "s"],
  ["move_timeout", "time", 1, 0, "s"],
];

// call(service, value): a promise of the answer
export function setUpController(call) {
  const target = $("controller-target");
  target.oninput = () => target.setCustomValidity("");
  $("controller").onsubmit = (event) => {
    event.preventDefault();
    const words = target.value.trim().replace(",", ".").replace("\u2212", "-");
    const radians = words === "" ? NaN : Number(words) * Number($("controller-unit").value);
    target.setCustomValidity(Number.isFinite(radians) ? "" : "an angle, for example 0.5");
    if (event.target.reportValidity()) call("controller/go", radians);
  };
  $("controller-stop").onclick = () => call("controller/stop");
}

export function showController(controller, services) {
  const form = $("controller");
  form.hidden = !controller;
  if (!controller) return;
  const here = Boolean(services?.["controller/stop"]);
  const { state, target, error, cycles, reason, limits } = controller;
  form.dataset.level = here ? LEVELS[state] ?? "idle" : "alarm";
  text($("controller-state"), here ? state.toUpperCase() : "NOT THERE");
  for (const id of ["controller-go", "controller-stop"]) $(id).disabled = !here;
  text($("controller-asked"), target === null ? "–" : `${number(target, 5)} rad`);
  text($("controller-error"), error === null ? "–" : `${number(error * 1e3, 3)} mrad`);
  text($("controller-cycles"), cycles === null ? "–" : String(cycles));
  text($("controller-reason"), here ? reason : "it has gone; the drive stands still without commands");
  const known = LIMITS.filter(([name]) => limits?.[name] !== undefined);
  const words = known.map(([name, label, scale, digits, unit]) =>
    `${label} ${number(limits[name] * scale, digits).replace(/(\.\d*?)0+$/, "$1").replace(/\.$/, "")} ${unit}`);
  text($("controller-limits"), words.length ? `stops beyond ${words.join(", ")}` : "");
  $("controller-limits").title = $("controller-limits").textContent;
}
