// The page: puts together what is pushed, what is drawn and what is asked for.

import { attempt, change, hasToken, lock, showLock, unlock } from "./api.js";
import { setUpCalibration } from "./calibration.js";
import { addTimes, drawTimes } from "./chart.js";
import { byId, bytes, count, duration, fixed, make, replaceIfChanged, say, toast } from "./dom.js";
import { Picture } from "./picture.js";
import { RegionEditor } from "./region.js";
import { Connection } from "./state.js";
import { setUpTeaching } from "./teach.js";

/** Time without a scene after which the picture is told to be old. */
const OLD_MS = 2500;
const RATE_OVER = 20;

const connection = new Connection();
const picture = new Picture();
const region = new RegionEditor(picture);
const arrivals = [];

// What is pushed.

connection.addEventListener("scene", () => {
  const scene = connection.scene;
  arrivals.push(connection.sceneAt);
  if (arrivals.length > RATE_OVER) arrivals.shift();
  addTimes(scene);
  picture.show(scene);
});

picture.onDrawn((scene) => {
  say(byId("frame-number"), count(scene.sequence));
  showSeen(scene);
  if (!byId("panel-numbers").hidden) drawTimes(scene);
});

connection.addEventListener("status", () => {
  const status = connection.status;
  document.title = `${status.cell}: samsod`;
  say(byId("cell"), status.cell);
  const isFine = status.status === "ok";
  byId("health").dataset.grade = isFine ? "fine" : "bad";
  say(byId("health"), isFine ? "all is well" : status.status);
  const { robot } = status;
  picture.setWork(robot?.jig.length ? { part: robot.step?.part ?? null } : null);
  showRobot(status);
  showJig(status);
  showPicks(status);
  showNumbers(status);
  region.set(status.region_of_interest);
});

// How old what is shown is.

setInterval(showAge, 250);
connection.addEventListener("link", showAge);
function showAge() {
  const now = performance.now();
  const age = connection.sceneAt === null ? null : now - connection.sceneAt;
  const isOld = !connection.isOpen || age === null || age > OLD_MS;
  byId("picture").classList.toggle("stale", isOld && picture.scene !== null);
  say(byId("frame-age"), age === null ? "none yet" : age > 1000 ? `${duration(age)} ago` : "live");
  const span = arrivals.length > 1 ? arrivals.at(-1) - arrivals[0] : 0;
  say(byId("frame-rate"), span > 0 && !isOld ? fixed(((arrivals.length - 1) * 1000) / span, 1) : "–");
  const banner = byId("banner");
  const since = connection.aliveAt === null ? "" : ` for ${duration(now - connection.aliveAt)}`;
  const frame = age === null ? "" : ` The last frame is ${duration(age)} old.`;
  if (!connection.isOpen) {
    banner.dataset.kind = "lost";
    say(banner, `No connection to samsodd${since}. What is shown is not what is.${frame}`);
    byId("health").dataset.grade = "bad";
    say(byId("health"), "not connected");
  } else if (isOld && age !== null) {
    banner.dataset.kind = "warn";
    say(banner, `No frame for ${duration(age)}. The picture is old.`);
  } else say(banner, "");
  banner.hidden = banner.textContent === "";
}

// The robot and its work.

function robotState({ robot, parts }) {
  if (!robot) return ["none", "No robot is commanded", "", parts.robot.detail ?? ""];
  const step = robot.step ? `${robot.step.name}${robot.step.part ? `: ${robot.step.part}` : ""}` : "";
  const state = robot.sequence?.state;
  if (robot.latched) return ["stands", "Stands until resumed", "", robot.reason ?? ""];
  if (!robot.connected) return ["lost", "Not connected", "", robot.reason ?? ""];
  if (robot.step) return ["moving", "At work", step, ""];
  if (robot.moving) return ["moving", "Moves", "", ""];
  if (robot.reason) return ["waits", "Waits", robot.reason, ""];
  if (state === "complete") return ["full", "The jig is full", "", ""];
  if (state === "stopped") return ["stands", "Has stopped", "", "it gets no more commands until samsodd is started anew"];
  if (state === "from_home") return ["waits", "Goes home first", "", ""];
  return ["ready", "Ready", "waits for a part that it can pick", ""];
}

function showRobot(status) {
  const { robot } = status;
  const [kind, text, step, reason] = robotState(status);
  byId("robot").dataset.state = kind;
  say(byId("robot-state"), robot?.simulated ? `${text} (simulated)` : text);
  say(byId("robot-step"), step || (robot?.position ? positionText(robot.position) : ""));
  say(byId("robot-reason"), kind === "none" ? "" : reason);
  if (kind === "none") say(byId("robot-step"), reason);
  byId("hold").disabled = !robot;
  byId("resume").disabled = !robot?.latched;
  byId("new-jig").hidden = robot?.sequence?.state !== "complete";
}

const positionText = (p) => `at ${fixed(p.x_mm)}, ${fixed(p.y_mm)}, ${fixed(p.z_mm)} mm`;

function showJig({ robot }) {
  const jig = robot?.jig ?? [];
  say(byId("jig-count"), jig.length ? `${jig.filter((slot) => slot.filled).length} of ${jig.length} placed` : "");
  const at = robot?.step?.part;
  const current = jig.findIndex((slot) => !slot.filled && slot.part === at);
  replaceIfChanged(byId("jig"), JSON.stringify([jig, current]), () =>
    jig.length
      ? jig.map((slot, i) => {
          const [kind, mark] = slot.filled ? ["filled", "✓ placed"] : i === current ? ["next", "being picked"] : ["open", slot.passed_over ? "passed over" : "waits"];
          return make(
            "li",
            { class: kind, data: { part: slot.part, slot: i + 1, state: kind } },
            make("span", { class: "number" }, `${i + 1}`),
            make("span", {}, slot.part),
            make("span", { class: "mark" }, mark),
            !slot.filled && i !== current && slot.passed_over ? make("span", { class: "why" }, slot.passed_over) : null,
          );
        })
      : [make("li", { class: "nothing" }, "There is no assembly list.")],
  );
}

function showSeen(scene) {
  const lines = [
    ...scene.detections.map((detection) => ({
      drawn: scene.drawing.detections[detection.id],
      name: detection.name ?? "unknown",
      place: detection.base ?? detection.world,
      score: detection.score,
      isNext: picture.isNext("detection", detection),
    })),
    // Beside recognised parts, crumbs are only drawn.
    ...(scene.detections.length ? [] : scene.objects).map((object) => ({
      drawn: scene.drawing.objects[object.id],
      name: "object",
      place: object.base ?? object.world,
      score: NaN,
      isNext: picture.isNext("object", object),
    })),
  ];
  say(byId("seen-count"), lines.length ? `${lines.length}` : "");
  const rows = lines.map(({ drawn, name, place, score, isNext }) => {
    const swatch = make("span", { class: "swatch" });
    swatch.style.background = drawn.colour;
    const asides = [!drawn.inside && "outside the region", isNext && "next"].filter(Boolean).join(", ");
    return make(
      "tr",
      { data: { name } },
      make("td", {}, swatch, name, asides ? make("span", { class: "aside" }, asides) : null),
      make("td", { class: "n" }, fixed(place?.x_mm, 1)),
      make("td", { class: "n" }, fixed(place?.y_mm, 1)),
      make("td", { class: "n" }, place ? `${fixed(place.yaw_deg)}°` : "–"),
      make("td", { class: "n" }, fixed(score, 2)),
    );
  });
  const nothing = () => [make("tr", {}, make("td", { class: "nothing", colspan: 5 }, "Nothing stands out."))];
  byId("seen").replaceChildren(...(rows.length ? rows : nothing()));
}

const RESULTS = { placed: "placed", missed: "missed", not_reached: "not reached" };

function showPicks({ robot }) {
  const picks = (robot?.picks ?? []).slice(-8).reverse();
  replaceIfChanged(byId("picks"), JSON.stringify(picks), () =>
    picks.length
      ? picks.map((pick) =>
          make(
            "li",
            {},
            make("span", {}, pick.part, " ", make("span", { class: pick.result, title: pick.reason ?? "" }, RESULTS[pick.result] ?? pick.result)),
            make("span", {}, `frame ${count(pick.frame)}, ${fixed(pick.took_ms / 1000, 1)} s`),
          ),
        )
      : [make("li", { class: "nothing" }, "None yet.")],
  );
}

function showNumbers(status) {
  if (byId("panel-numbers").hidden) return;
  const { frames, objects, recorder, robot, parts } = status;
  const list = (id, lines) =>
    byId(id).replaceChildren(...lines.flatMap(([name, value, kind = ""]) => [make("dt", {}, name), make("dd", { class: kind }, value)]));
  const some = (value, kind) => (value > 0 ? kind : "");
  list("counts", [
    ["frames processed", count(frames.processed)],
    ["passed over for a newer one", count(frames.dropped), some(frames.dropped, "warn")],
    ["refused", count(frames.rejected), some(frames.rejected, "warn")],
    ["failed", count(frames.failed), some(frames.failed, "bad")],
    ["objects", count(objects.found)],
    ["recognised", count(objects.recognized)],
    ["unknown", count(objects.unknown)],
    ...(robot
      ? [
          ["picks placed", count(robot.placed)],
          ["missed", count(robot.missed), some(robot.missed, "warn")],
          ["not reached", count(robot.not_reached), some(robot.not_reached, "warn")],
          ["commands", count(robot.commands.sent)],
        ]
      : []),
  ]);
  list("recorder", [
    ["frames written", count(recorder.written)],
    ["frames lost", count(recorder.dropped + recorder.not_written), some(recorder.dropped + recorder.not_written, "bad")],
    ["size", bytes(recorder.bytes)],
    ["free on the disk", bytes(recorder.disk_free_bytes ?? NaN)],
    ["file", recorder.file.split("/").at(-1)],
  ]);
  const bad = new Set(status.status === "ok" ? [] : status.status.split(", ").map((text) => text.split(" ")[0]));
  list("health-parts", [
    ...Object.entries(parts).map(([name, part]) => [name, part.state, bad.has(name) ? "bad" : ""]),
    ["up for", duration(status.uptime_s * 1000)],
    ["version", status.version],
  ]);
}

// What is asked for.

async function hold() {
  const status = await attempt("POST", "/hold");
  if (status) toast("The robot stands.");
}

function resume() {
  const { robot } = connection.status ?? {};
  if (!robot?.latched) return;
  const part = robot.gripper_may_hold;
  say(byId("resume-reason"), robot.reason ?? "");
  byId("resume-empty").hidden = !part;
  say(byId("resume-gripper"), part ? `I have taken the ${part} out: the gripper is empty` : "The gripper is empty");
  byId("resume-form").reset();
  say(byId("resume-error"), "");
  byId("resume-dialog").showModal();
}

byId("resume-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const isEmpty = byId("resume-form").elements.empty.checked;
  try {
    await change("POST", "/resume", { gripper_is_empty: isEmpty });
    byId("resume-dialog").close();
    toast("Resumed.");
  } catch (error) {
    if (error) say(byId("resume-error"), error.message);
  }
});

async function inspect() {
  const scene = await attempt("POST", "/inspect");
  if (!scene) return;
  picture.show(scene);
  const known = scene.detections.filter((detection) => detection.name).length;
  const text = scene.detections.length ? `${known} parts, ${scene.detections.length - known} unknown` : `${scene.objects.length} objects`;
  toast(`Frame ${count(scene.sequence)}: ${text}.`);
}

function toggleLayer(layer) {
  const button = document.querySelector(`[data-layer="${layer}"]`);
  const isOn = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", isOn);
  picture.setLayer(layer, isOn);
  connection.setLayers(picture.layers);
}

function toggleDrawing() {
  picture.isDrawn = !picture.isDrawn;
  byId("show-drawing").setAttribute("aria-pressed", picture.isDrawn);
  picture.redraw();
}

byId("hold").addEventListener("click", hold);
byId("resume").addEventListener("click", resume);
byId("inspect").addEventListener("click", inspect);
byId("show-drawing").addEventListener("click", toggleDrawing);
byId("new-jig").addEventListener("click", async () => {
  if (await attempt("POST", "/new-jig")) toast("The new jig is filled from its first slot on.");
});
byId("unlock").addEventListener("click", () => (hasToken() ? lock() : unlock()));
for (const button of document.querySelectorAll("[data-layer]")) {
  button.addEventListener("click", () => toggleLayer(button.dataset.layer));
}
for (const button of document.querySelectorAll("[data-close]")) {
  button.addEventListener("click", () => button.closest("dialog").close());
}
byId("opacity").addEventListener("input", (event) => {
  for (const layer of document.querySelectorAll(".layer")) layer.style.opacity = event.target.value / 100;
});

// Tabs: arrow keys go from one to the next.

const tabs = [...document.querySelectorAll('[role="tab"]')];
function selectTab(selected) {
  for (const tab of tabs) {
    tab.setAttribute("aria-selected", tab === selected);
    tab.tabIndex = tab === selected ? 0 : -1;
    byId(tab.getAttribute("aria-controls")).hidden = tab !== selected;
  }
  if (connection.status) showNumbers(connection.status);
  if (!byId("panel-numbers").hidden) drawTimes(picture.scene);
}
tabs.forEach((tab, i) => {
  tab.addEventListener("click", () => selectTab(tab));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const next = tabs[(i + step + tabs.length) % tabs.length];
    selectTab(next);
    next.focus();
  });
});

const SHORTCUTS = {
  h: hold,
  r: resume,
  i: inspect,
  p: toggleDrawing,
  1: () => toggleLayer("partition"),
  2: () => toggleLayer("saliency"),
  3: () => toggleLayer("shadow"),
};
addEventListener("keydown", (event) => {
  const isTyping = event.target.closest?.("input, dialog");
  if (isTyping || event.repeat || event.ctrlKey || event.altKey || event.metaKey) return;
  const shortcut = SHORTCUTS[event.key.toLowerCase()];
  if (!shortcut) return;
  event.preventDefault();
  if (event.key.toLowerCase() !== "h" || !byId("hold").disabled) shortcut();
});

setUpTeaching();
setUpCalibration(picture);
showLock();
