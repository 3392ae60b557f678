// What samsodd pushes: the connection, the newest scene and status, and since when nothing has come.

const SILENCE_MS = 4000;
const RETRY_MS = 1000;

/** Tells its listeners `scene`, `status` and `link` events. */
export class Connection extends EventTarget {
  scene = null;
  status = null;
  /** When the last scene and the last sign of life came, by the clock of this page. */
  sceneAt = null;
  aliveAt = null;
  isOpen = false;
  #source = null;
  #layers = "";
  #retry = null;

  constructor() {
    super();
    setInterval(() => this.#look(), 500);
    // A tab that nobody sees costs samsodd nothing.
    document.addEventListener("visibilitychange", () => (document.hidden ? this.#close() : this.#open()));
    this.#open();
  }

  /** The layers whose pictures come with every scene. */
  setLayers(layers) {
    const wanted = [...layers].sort().join(",");
    if (wanted === this.#layers) return;
    this.#layers = wanted;
    this.#open();
  }

  #open() {
    this.#close();
    if (document.hidden) return;
    const source = new EventSource(`/api/v1/events${this.#layers ? `?layers=${this.#layers}` : ""}`);
    this.#source = source;
    const listen = (name, take) =>
      source.addEventListener(name, (event) => {
        this.aliveAt = performance.now();
        this.#setOpen(true);
        take(event);
      });
    listen("scene", (event) => {
      this.scene = JSON.parse(event.data);
      this.sceneAt = this.aliveAt;
      this.#tell("scene");
    });
    listen("status", (event) => {
      this.status = JSON.parse(event.data);
      this.#tell("status");
    });
    listen("heartbeat", () => {});
    source.onerror = () => {
      this.#setOpen(false);
      this.#close();
      this.#retry = setTimeout(() => this.#open(), RETRY_MS);
    };
  }

  #close() {
    clearTimeout(this.#retry);
    this.#source?.close();
    this.#source = null;
  }

  #setOpen(isOpen) {
    if (this.isOpen === isOpen) return;
    this.isOpen = isOpen;
    this.#tell("link");
  }

  #look() {
    if (this.#source && this.isOpen && performance.now() - this.aliveAt > SILENCE_MS) {
      this.#setOpen(false);
      this.#open();
    }
  }

  #tell(name) {
    this.dispatchEvent(new Event(name));
  }
}
