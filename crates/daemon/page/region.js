// The region of interest: shown over the picture, drawn with a finger, a mouse or the keyboard, and stored.

import { attempt } from "./api.js";
import { byId, draw, fixed, say, toast } from "./dom.js";
import { closedPath } from "./picture.js";

const CORNER_PX = 13;
const MOST_CORNERS = 100;

export class RegionEditor {
  #picture;
  #stored = null;
  #points = null;
  /** Size of the frame that is drawn on. */
  #size = null;

  constructor(picture) {
    this.#picture = picture;
    byId("region-draw").addEventListener("click", () => this.#begin());
    byId("region-clear").addEventListener("click", () => this.#store(null));
    byId("region-store").addEventListener("click", () => this.#store(this.#points));
    byId("region-cancel").addEventListener("click", () => this.#end());
    picture.onDrawn(() => this.redraw());
  }

  /** Takes what is stored. */
  set(region) {
    this.#stored = region;
    const text = region
      ? `Parts are picked inside ${region.points_px.length} corners.`
      : "Parts are picked on the whole picture.";
    say(byId("region-state"), text);
    byId("region-clear").disabled = !region;
    this.redraw();
  }

  redraw() {
    const scene = this.#picture.scene;
    if (!scene) return;
    const shown = byId("region-of-interest");
    const region = this.#points ? null : this.#stored;
    if (!region) shown.replaceChildren();
    else {
      const { width_px: w, height_px: h } = scene;
      const isOther = region.width_px !== w || region.height_px !== h;
      const inner = isOther ? [] : [region.points_px];
      const frame = [[-1, -1], [w, -1], [w, h], [-1, h]];
      shown.replaceChildren(
        draw("path", { class: "region-outside", d: closedPath([frame, ...inner]) }),
        draw("path", { class: "region-line", d: closedPath(inner) }),
      );
      if (isOther) say(byId("region-state"), "The region was drawn on frames of another size: nothing is picked until it is drawn anew.");
    }
  }

  #begin() {
    const scene = this.#picture.scene;
    if (!scene) return toast("There is no frame to draw on.", true);
    const { width_px: w, height_px: h } = scene;
    this.#size = [w, h];
    const isFitting = this.#stored && this.#stored.width_px === w && this.#stored.height_px === h;
    const [l, t, r, b] = [w * 0.1, h * 0.1, w * 0.9, h * 0.9].map(Math.round);
    this.#points = isFitting ? this.#stored.points_px.map((point) => [...point]) : [[l, t], [r, t], [r, b], [l, b]];
    byId("region-idle").hidden = true;
    byId("region-busy").hidden = false;
    this.redraw();
    this.#drawEditor();
    byId("region-editor").querySelector(".corner").focus();
    byId("picture").scrollIntoView({ block: "nearest" });
  }

  #end() {
    this.#points = null;
    byId("region-idle").hidden = false;
    byId("region-busy").hidden = true;
    byId("region-editor").replaceChildren();
    this.redraw();
  }

  async #store(points) {
    const scene = this.#picture.scene;
    const region = points && { width_px: this.#size[0], height_px: this.#size[1], points_px: points };
    const stored = await attempt(region ? "PUT" : "DELETE", "/region", region ?? undefined);
    if (stored === undefined || (!scene && points)) return;
    this.#end();
    this.set(stored.region_of_interest);
    toast(points ? "The region is stored." : "Parts are picked on the whole picture.");
  }

  #move(index, [x, y]) {
    const [w, h] = this.#size;
    const within = (value, most) => Math.round(Math.min(Math.max(value, 0), most - 1) * 10) / 10;
    this.#points[index] = [within(x, w), within(y, h)];
    this.#update();
  }

  #insert(index, point) {
    if (this.#points.length >= MOST_CORNERS) return;
    this.#points.splice(index, 0, point);
    this.#drawEditor();
  }

  #remove(index) {
    if (this.#points.length <= 3) return toast("A region has at least three corners.", true);
    this.#points.splice(index, 1);
    this.#drawEditor();
    this.#focus(index % this.#points.length);
  }

  #focus(index) {
    byId("region-editor").querySelectorAll(".corner")[index]?.focus();
  }

  #between(index) {
    const [a, b] = [this.#points[index], this.#points[(index + 1) % this.#points.length]];
    return [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
  }

  #drawEditor() {
    const radius = CORNER_PX * this.#picture.scale();
    const shape = draw("path", { class: "region-edit" });
    const between = this.#points.map((_, i) =>
      draw("circle", { class: "between", r: radius * 0.6, on: { pointerdown: (event) => this.#addAt(event, i) } }),
    );
    const corners = this.#points.map((_, i) =>
      draw("circle", {
        class: "corner",
        r: radius,
        tabindex: 0,
        role: "button",
        on: { pointerdown: (event) => this.#drag(event, i), keydown: (event) => this.#key(event, i) },
      }),
    );
    byId("region-editor").replaceChildren(shape, ...between, ...corners);
    this.#update();
  }

  #update() {
    const editor = byId("region-editor");
    editor.querySelector(".region-edit").setAttribute("d", closedPath([this.#points]));
    editor.querySelectorAll(".corner").forEach((circle, i) => {
      const [x, y] = this.#points[i];
      circle.setAttribute("cx", x);
      circle.setAttribute("cy", y);
      circle.setAttribute("aria-label", `corner ${i + 1} of ${this.#points.length}, at ${fixed(x)}, ${fixed(y)}`);
    });
    editor.querySelectorAll(".between").forEach((circle, i) => {
      const [x, y] = this.#between(i);
      circle.setAttribute("cx", x);
      circle.setAttribute("cy", y);
    });
  }

  #addAt(event, index) {
    event.preventDefault();
    this.#insert(index + 1, this.#between(index));
    this.#drag(event, index + 1);
  }

  #drag(event, index) {
    event.preventDefault();
    this.#focus(index);
    const move = (moved) => this.#move(index, this.#picture.pointAt(moved));
    const end = () => {
      removeEventListener("pointermove", move);
      removeEventListener("pointerup", end);
      removeEventListener("pointercancel", end);
    };
    addEventListener("pointermove", move);
    addEventListener("pointerup", end);
    addEventListener("pointercancel", end);
  }

  #key(event, index) {
    const step = event.shiftKey ? 10 : 1;
    const [x, y] = this.#points[index];
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (moves[event.key]) this.#move(index, [x + moves[event.key][0], y + moves[event.key][1]]);
    else if (event.key === "Insert") {
      this.#insert(index + 1, this.#between(index));
      this.#focus(index + 1);
    } else if (event.key === "Delete") this.#remove(index);
    else if (event.key === "Escape") this.#end();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}
