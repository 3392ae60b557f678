// The picture: frame, layers, and what was seen in it. All three are of the same frame and change in the same moment.

import { byId, draw, fixed } from "./dom.js";

const LABEL_PX = 16;

/** Shows scenes; when they come faster than pictures do, only the newest. */
export class Picture {
  scene = null;
  layers = new Set();
  isDrawn = true;
  #next = null;
  #busy = false;
  #svg = byId("drawing");
  #listeners = [];

  constructor() {
    new ResizeObserver(() => this.redraw()).observe(byId("picture"));
  }

  /** Calls `listener` with each scene that has been drawn. */
  onDrawn(listener) {
    this.#listeners.push(listener);
  }

  async show(scene) {
    this.#next = scene;
    if (this.#busy) return;
    this.#busy = true;
    try {
      while (this.#next) {
        const now = this.#next;
        this.#next = null;
        await this.#show(now);
      }
    } finally {
      this.#busy = false;
    }
  }

  async #show(scene) {
    const layers = [...this.layers];
    const [frame, ...pictures] = await Promise.all([
      bitmap(`frame.jpg?frame=${scene.frame}`),
      ...layers.map((layer) => bitmap(`layers/${layer}.png?frame=${scene.frame}`)),
    ]);
    // Overtaken by a newer one: that is shown next.
    if (!frame) return;
    this.scene = scene;
    paint(byId("frame"), frame);
    layers.forEach((layer, i) => {
      const canvas = byId(`layer-${layer}`);
      canvas.hidden = !pictures[i] || !this.layers.has(layer);
      if (pictures[i]) paint(canvas, pictures[i]);
    });
    byId("empty").hidden = true;
    byId("picture").style.setProperty("--aspect", `${scene.width_px} / ${scene.height_px}`);
    this.redraw();
    this.#svg.dataset.drawnUnixMs = Date.now();
    this.#listeners.forEach((listener) => listener(scene));
  }

  /** Switches a layer. */
  setLayer(layer, isOn) {
    if (isOn) this.layers.add(layer);
    else this.layers.delete(layer);
    if (!isOn) byId(`layer-${layer}`).hidden = true;
  }

  /** Pixels of the frame that are one of the screen. */
  scale() {
    const { width_px, height_px } = this.scene ?? { width_px: 4, height_px: 3 };
    const { clientWidth, clientHeight } = this.#svg;
    return Math.max(width_px / (clientWidth || 1), height_px / (clientHeight || 1));
  }

  /** A point of the frame, px, under a pointer; pixel centres are at integers. */
  pointAt(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.#svg.getScreenCTM().inverse());
    return [point.x, point.y];
  }

  redraw() {
    const scene = this.scene;
    if (!scene) return;
    const svg = this.#svg;
    // Pixel centres are at integers: the picture begins half a pixel before.
    svg.setAttribute("viewBox", `-0.5 -0.5 ${scene.width_px} ${scene.height_px}`);
    Object.assign(svg.dataset, { frame: scene.frame, sequence: scene.sequence, timestampMs: scene.timestamp_ns / 1e6 });
    const parts = byId("parts");
    parts.replaceChildren(...(this.isDrawn ? drawParts(scene, this.scale()) : []));
  }
}

async function bitmap(path) {
  try {
    const answer = await fetch(`/api/v1/${path}`);
    return answer.ok ? await createImageBitmap(await answer.blob()) : null;
  } catch {
    return null;
  }
}

function paint(canvas, picture) {
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    canvas.width = picture.width;
    canvas.height = picture.height;
  }
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.drawImage(picture, 0, 0);
  picture.close();
}

/** A closed path through points. */
export const closedPath = (outlines) => outlines.map((points) => `M${points.map(([x, y]) => `${x} ${y}`).join("L")}Z`).join("");

function drawParts(scene, scale) {
  const named = new Set(scene.detections.flatMap((detection) => detection.objects));
  const labels = new Labels(scene, scale);
  const objects = scene.drawing.objects.filter(({ id }) => !named.has(id)).map((drawn) => {
    const object = scene.objects[drawn.id];
    const place = object.base ?? object.world;
    const [x, y] = object.centroid_px;
    const size = object.size_mm && `${fixed(object.size_mm[0])} × ${fixed(object.size_mm[1])} mm`;
    const data = { kind: "object", id: object.id, x, y, angle: object.box.angle_deg, next: scene.best_object === object.id };
    return one(drawn, data, place, size ?? "object", place && placeText(place), [], labels);
  });
  const detections = scene.drawing.detections.map((drawn) => {
    const detection = scene.detections[drawn.id];
    const place = detection.base ?? detection.world;
    const [x, y] = detection.image.origin_px;
    const angle = detection.image.angle_deg;
    const title = detection.name ? `${detection.name} ${fixed(angle)}°` : "unknown";
    const next = scene.best_detection === detection.id;
    const data = { kind: "detection", id: detection.id, name: detection.name ?? "", score: detection.score, x, y, angle, next };
    return one(drawn, data, place, title, detection.name && place && placeText(place), drawn.arrow_px, labels);
  });
  const all = [...objects, ...detections];
  // Labels last, so that no outline crosses one.
  return [...all.map(({ shape }) => shape), ...all.map(({ label }) => label)];
}

const placeText = ({ x_mm, y_mm }) => `${fixed(x_mm, 1)}, ${fixed(y_mm, 1)} mm`;

function one(drawn, data, place, title, second, arrow, labels) {
  const path = closedPath(drawn.outlines_px);
  const shape = draw(
    "g",
    {
      class: "part",
      data: { ...data, inside: drawn.inside, ...(place && { xMm: place.x_mm, yMm: place.y_mm, yawDeg: place.yaw_deg }) },
    },
    draw("path", { class: "casing", d: path }),
    draw("path", { d: path, stroke: drawn.colour }),
    ...arrow.map(([[x1, y1], [x2, y2]]) => draw("line", { x1, y1, x2, y2, stroke: drawn.colour })),
  );
  return { shape, label: labels.make(drawn.outlines_px, title, second, drawn.inside) };
}

/** Places texts above what they name, none over another while there is room. */
class Labels {
  #taken = [];

  constructor(scene, scale) {
    [this.width, this.height, this.size] = [scene.width_px, scene.height_px, LABEL_PX * scale];
  }

  make(outlines, title, second, inside) {
    const points = outlines.flat();
    const [left, right] = [Math.min(...points.map(([x]) => x)), Math.max(...points.map(([x]) => x))];
    const [top, bottom] = [Math.min(...points.map(([, y]) => y)), Math.max(...points.map(([, y]) => y))];
    const size = this.size;
    const width = Math.max(title.length, (second ?? "").length * 0.85) * size * 0.58;
    const height = size * (second ? 2.25 : 1.25);
    const x = Math.min(Math.max((left + right) / 2, width / 2), Math.max(this.width - width / 2, width / 2));
    const candidates = [top - height - size * 0.2, bottom + size * 0.2, (top + bottom - height) / 2];
    for (let k = 1; k < 12; k += 1) candidates.push(top - height - k * size * 0.6, bottom + k * size * 0.6);
    const field = (y) => [x - width / 2, y, x + width / 2, y + height];
    const isFree = (y) => {
      const [l, t, r, b] = field(y);
      const isOn = t >= 0 && b <= this.height;
      return isOn && !this.#taken.some(([l2, t2, r2, b2]) => l < r2 && l2 < r && t < b2 && t2 < b);
    };
    const y = candidates.find(isFree) ?? Math.max(0, candidates[0]);
    this.#taken.push(field(y));
    const lines = [draw("text", { x, y: y + size, "font-size": size }, title)];
    if (second) lines.push(draw("text", { class: "place", x, y: y + size * 2, "font-size": size * 0.85 }, second));
    return draw("g", { class: "part", data: { inside } }, ...lines);
  }
}
