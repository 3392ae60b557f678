// The picture: frame, layers, and what was seen in it. All three are of the same frame and change in the same moment.

import { byId, draw, fixed } from "./dom.js";

const LABEL_PX = 16;

/** Shows scenes; when they come faster than pictures do, only the newest. */
export class Picture {
  scene = null;
  layers = new Set();
  isDrawn = true;
  #work = null;
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

  /** The part that is being picked by an assembly list; without a list (null) the best is next. */
  setWork(work) {
    if (work?.part === this.#work?.part && !work === !this.#work) return;
    this.#work = work;
    this.redraw();
  }

  /** Whether a detection or an object is what the robot goes to. */
  isNext(kind, found) {
    if (this.#work) return this.#work.part !== null && kind === "detection" && found.name === this.#work.part;
    return found.id === (kind === "detection" ? this.scene.best_detection : this.scene.best_object);
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
    parts.replaceChildren(...(this.isDrawn ? drawParts(scene, this.scale(), this) : []));
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

function drawParts(scene, scale, picture) {
  const named = new Set(scene.detections.flatMap((detection) => detection.objects));
  const boxes = [...scene.drawing.objects, ...scene.drawing.detections].map(({ outlines_px }) => boxOf(outlines_px));
  const labels = new Labels(scene, scale, boxes);
  const objects = scene.drawing.objects.filter(({ id }) => !named.has(id)).map((drawn) => {
    const object = scene.objects[drawn.id];
    const isCrumb = scene.detections.length > 0;
    const place = object.base ?? object.world;
    const [x, y] = object.centroid_px;
    const size = object.size_mm && `${fixed(object.size_mm[0])} × ${fixed(object.size_mm[1])} mm`;
    const data = { kind: isCrumb ? "crumb" : "object", id: object.id, x, y, angle: object.box.angle_deg };
    data.next = picture.isNext("object", object);
    return one(drawn, data, place, isCrumb ? null : (size ?? "object"), place && placeText(place), [], labels);
  });
  const detections = scene.drawing.detections.map((drawn) => {
    const detection = scene.detections[drawn.id];
    const place = detection.base ?? detection.world;
    const [x, y] = detection.image.origin_px;
    const angle = detection.image.angle_deg;
    const title = detection.name ? `${detection.name} ${fixed(angle)}°` : "unknown";
    const next = picture.isNext("detection", detection);
    const data = { kind: "detection", id: detection.id, name: detection.name ?? "", score: detection.score, x, y, angle, next };
    return one(drawn, data, place, title, detection.name && place && placeText(place), drawn.arrow_px, labels);
  });
  const all = [...objects, ...detections];
  // Labels last, so that no outline crosses one.
  return [...all.map(({ shape }) => shape), ...all.flatMap(({ label }) => label ?? [])];
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
  return { shape, label: title && labels.make(drawn.outlines_px, title, second, drawn.inside) };
}

/** Left, top, right and bottom end of outlines. */
function boxOf(outlines) {
  const points = outlines.flat();
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

/** Area that two boxes share. */
function shared([l, t, r, b], [l2, t2, r2, b2]) {
  return Math.max(0, Math.min(r, r2) - Math.max(l, l2)) * Math.max(0, Math.min(b, b2) - Math.max(t, t2));
}

/** Places texts beside what they name: none over another, and as little as may be over what others name. */
class Labels {
  #taken = [];

  constructor(scene, scale, boxes) {
    [this.width, this.height, this.size, this.boxes] = [scene.width_px, scene.height_px, LABEL_PX * scale, boxes];
  }

  make(outlines, title, second, inside) {
    const own = boxOf(outlines);
    const [left, top, right, bottom] = own;
    const size = this.size;
    const width = Math.max(title.length, (second ?? "").length * 0.85) * size * 0.64;
    const height = size * (second ? 2.2 : 1.25);
    const [middleX, middleY, gap] = [(left + right) / 2, (top + bottom) / 2, size * 0.25];
    const within = (value, least, most) => Math.min(Math.max(value, least), Math.max(most, least));
    const field = ([x, y]) => {
      const [l, t] = [within(x - width / 2, 0, this.width - width), within(y - height / 2, 0, this.height - height)];
      return [l, t, l + width, t + height];
    };
    // Above, below, beside; then farther and farther away, all round.
    const candidates = [
      [middleX, top - gap - height / 2],
      [middleX, bottom + gap + height / 2],
      [right + gap + width / 2, middleY],
      [left - gap - width / 2, middleY],
    ];
    for (let k = 1; k < 9; k += 1) {
      for (let turn = 0; turn < 12; turn += 1) {
        const angle = (turn * Math.PI) / 6 - Math.PI / 2;
        const [rx, ry] = [(right - left + width) / 2 + k * size * 0.7, (bottom - top + height) / 2 + k * size * 0.7];
        candidates.push([middleX + rx * Math.cos(angle), middleY + ry * Math.sin(angle)]);
      }
    }
    const isFree = (box) => !this.#taken.some((other) => shared(box, other) > 0);
    const fields = candidates.map(field);
    // What is covered, as a share of the text, and how far down the list.
    const others = this.boxes.filter((box) => shared(box, own) < 0.5 * shared(box, box));
    const costs = fields.map((box, i) =>
      isFree(box) ? others.reduce((sum, other) => sum + shared(box, other), 0) / (width * height) + i * 0.02 : Infinity,
    );
    const least = costs.indexOf(Math.min(...costs));
    const found = fields[least];
    this.#taken.push(found);
    const [x, y] = [(found[0] + found[2]) / 2, found[1]];
    const isFar = least > 3;
    const leader = isFar ? [draw("line", { class: "leader", x1: middleX, y1: middleY, x2: x, y2: within(middleY, found[1], found[3]) })] : [];
    const lines = [draw("text", { x, y: y + size, "font-size": size }, title)];
    if (second) lines.push(draw("text", { class: "place", x, y: y + size * 2, "font-size": size * 0.85 }, second));
    return draw("g", { class: "part", data: { inside } }, ...leader, ...lines);
  }
}
