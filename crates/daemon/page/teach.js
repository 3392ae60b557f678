// Teaching a part, step by step.

import { change } from "./api.js";
import { byId, count, draw, fixed, say } from "./dom.js";
import { closedPath } from "./picture.js";

let looked = null;

export function setUpTeaching() {
  byId("teach-look").addEventListener("click", look);
  byId("teach-again").addEventListener("click", look);
  byId("teach-right").addEventListener("click", () => {
    step(3);
    byId("teach-form").elements.name.focus();
  });
  byId("teach-cancel").addEventListener("click", () => {
    reset();
    tell("");
  });
  byId("teach-form").addEventListener("submit", store);
}

function step(now) {
  for (const number of [1, 2, 3]) {
    const item = byId(`teach-${number}`);
    item.classList.toggle("done", number < now);
    if (number === now) item.setAttribute("aria-current", "step");
    else item.removeAttribute("aria-current");
  }
  byId("teach-2").querySelector(".row").hidden = now !== 2;
  byId("teach-form").hidden = now !== 3;
}

function tell(text, isBad = false) {
  say(byId("teach-result"), text);
  byId("teach-result").classList.toggle("bad", isBad);
}

function reset() {
  looked = null;
  byId("extra").replaceChildren();
  byId("teach-form").reset();
  say(byId("teach-found"), "Check that the outline on the picture is that of the part.");
  step(1);
}

async function look() {
  tell("Looking …");
  try {
    looked = await change("POST", "/teach/look");
  } catch (error) {
    reset();
    if (error) tell(error.message, true);
    return;
  }
  tell("");
  byId("extra").replaceChildren(draw("path", { class: "taught", d: closedPath(looked.outlines_px) }));
  const { frame, area_px, width_px, height_px } = looked;
  say(
    byId("teach-found"),
    `Check that the outline on the picture is that of the part: frame ${frame}, ${count(area_px)} px, ${width_px} × ${height_px} px.`,
  );
  step(2);
  byId("teach-right").focus();
}

async function store(event) {
  event.preventDefault();
  const { name, height, grasp, replace } = byId("teach-form").elements;
  const lesson = { frame: looked.frame, name: name.value, height_mm: Number(height.value), replace: replace.checked };
  if (grasp.value !== "") lesson.grasp_width_mm = Number(grasp.value);
  try {
    const taught = await change("POST", "/teach", lesson);
    reset();
    tell(
      `${taught.name} is stored: ${fixed(taught.height_mm, 1)} mm high, gripped ${fixed(taught.grasp_width_mm, 1)} mm wide at ` +
        `${fixed(taught.grasp_angle_deg)}°, ${taught.symmetry}. It is recognised ${taught.in_force}.`,
    );
  } catch (error) {
    if (error) tell(error.message, true);
  }
}
