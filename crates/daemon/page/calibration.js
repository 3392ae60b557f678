// Verifying the calibration: the error of a board on the table, in millimetres.

import { change } from "./api.js";
import { byId, draw, fixed, make } from "./dom.js";

const FLAT_DEG = 2;

export function setUpCalibration(picture) {
  byId("calibration-form").addEventListener("submit", (event) => measure(event, picture));
  byId("calibration-clear").addEventListener("click", () => {
    byId("extra").replaceChildren();
    byId("calibration-result").replaceChildren();
    byId("calibration-clear").hidden = true;
  });
}

async function measure(event, picture) {
  event.preventDefault();
  const { columns, rows, square, thickness } = byId("calibration-form").elements;
  const board = {
    columns: Number(columns.value),
    rows: Number(rows.value),
    square_mm: Number(square.value),
    board_thickness_mm: Number(thickness.value),
  };
  const result = byId("calibration-result");
  const button = byId("calibration-form").querySelector(".primary");
  button.disabled = true;
  result.classList.remove("bad");
  result.replaceChildren("Measuring …");
  try {
    const seen = await change("POST", "/calibration/verify", board);
    const radius = 6 * picture.scale();
    byId("extra").replaceChildren(
      ...seen.corners_px.map(([cx, cy]) => draw("circle", { class: "board-corner", cx, cy, r: radius })),
    );
    result.replaceChildren(table(seen));
    byId("calibration-clear").hidden = false;
  } catch (error) {
    result.classList.add("bad");
    result.replaceChildren(error?.message ?? "");
  } finally {
    button.disabled = false;
  }
}

function table(seen) {
  const line = (name, spread, unit, isBig) => [
    make("span", {}, name),
    make("span", { class: isBig ? "n big" : "n" }, `${fixed(spread.mean, 2)} ${unit}`),
    make("span", { class: "n soft" }, `max ${fixed(spread.max, 2)}`),
  ];
  const notes = [`${seen.corners} corners, lengths come out ${fixed(seen.scale_error_percent, 3)} % long`];
  if (seen.tilt_deg > FLAT_DEG) notes.push(`the board seems tilted by ${fixed(seen.tilt_deg, 1)}°: does it lie flat?`);
  return make(
    "div",
    {},
    make(
      "div",
      { class: "measure", data: { meanMm: seen.position_mm.mean, maxMm: seen.position_mm.max } },
      ...line("error of places", seen.position_mm, "mm", true),
      ...line("error of distances", seen.distance_mm, "mm"),
      ...line("reprojection", seen.reprojection_px, "px"),
    ),
    ...notes.map((note) => make("p", { class: "note" }, note)),
  );
}
