// Times of the stages: a line of the last frames, and a bar for each stage of the newest.

import { byId, draw, fixed, make, replaceIfChanged, say } from "./dom.js";

const LENGTH = 150;
const STAGES = ["segment", "saliency", "regions", "shadow", "recognize"];
const totals = [];

/** Takes the times of a scene. */
export function addTimes(scene) {
  totals.push(scene.total_ms);
  if (totals.length > LENGTH) totals.shift();
}

/** Draws them; called when they can be seen. */
export function drawTimes(scene) {
  if (!scene) return;
  const most = niceAbove(Math.max(...totals, 1));
  const points = totals.map((ms, i) => `${(300 * i) / (LENGTH - 1)},${90 - (86 * ms) / most}`).join(" ");
  const lines = [0.5, 1].map((share) => draw("line", { x1: 0, x2: 300, y1: 90 - 86 * share, y2: 90 - 86 * share }));
  byId("chart").replaceChildren(...lines, draw("polyline", { points }));
  const sorted = [...totals].sort((a, b) => a - b);
  const median = sorted[Math.floor(sorted.length / 2)];
  say(byId("total-ms"), `${fixed(scene.total_ms)} ms, half below ${fixed(median)}, up to ${fixed(most)}`);
  const times = STAGES.map((stage) => scene.times_ms[stage]);
  const longest = Math.max(...times, 0.001);
  replaceIfChanged(byId("stages"), `${scene.frame}`, () =>
    STAGES.flatMap((stage, i) => [
      make("span", {}, stage),
      draw("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none" }, draw("rect", { width: (100 * times[i]) / longest, height: 10 })),
      make("span", { class: "n" }, `${fixed(times[i], 1)} ms`),
    ]),
  );
}

/** The next 1, 2 or 5 times a power of ten. */
function niceAbove(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((step) => step * power).find((nice) => nice >= value) ?? value;
}
