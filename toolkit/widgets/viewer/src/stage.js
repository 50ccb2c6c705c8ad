import { Navigation } from "./navigation.js";
import { COLOURS, cameraAt, drawCameras } from "./overlay.js";

// Milliseconds of a flight to a camera.
const FLIGHT = 600;
// Radians for a drag across a pixel, and for a press of an arrow key.
const PER_PIXEL = 0.006, PER_KEY = 0.08;
// Pixels that a click may wander.
const STILL = 5;
// Pixels of the longer side of a picture from the server: more would take it too long.
const MOST = 1280;
const HELP =
  "Drag to turn, drag with the right button or with Shift to shift, scroll to come nearer. Keys: arrows turn, " +
  "Shift and arrows shift, plus and minus come nearer, W A S D Q E walk, comma and full stop go from camera to " +
  "camera, U levels the horizon, C hides the cameras, Home goes back.";

// The picture with cameras drawn over it, pointer, keys and buttons: all that does not depend on who paints.
//
// `surface` is the element that shows the splat; `paint(navigation, width, height)` is called, at most once a frame,
// when the view has changed.
export class Stage {
  constructor(el, model, surface, paint) {
    Object.assign(this, { model, surface, paint });
    this.navigation = null;
    this.scene = null;
    this.showsCameras = true;
    this.pointers = new Map();
    this.gone = new AbortController();
    this.build(el);
    this.listen();
    model.on("scene", () => this.open());
    model.on("camera", () => this.visit(model.camera));
    model.on("extras", () => this.label());
    model.on("msg:custom", (message) => message.kind === "where" && this.answer(message.number));
    model.on("status", () => this.repeat());
    model.on("lifecycle:remove", () => this.close());
    this.tell();
  }

  build(el) {
    const made = (tag, name, attributes = {}) => {
      const element = Object.assign(document.createElement(tag), attributes);
      element.className = name;
      return element;
    };
    this.root = made("div", "stage");
    this.overlay = made("canvas", "overlay", { tabIndex: 0, role: "application", ariaLabel: `Splat. ${HELP}` });
    this.message = made("div", "message", { role: "status" });
    this.words = made("span", "words");
    this.bar = made("progress", "bar", { max: 1 });
    this.bar.setAttribute("aria-label", "Loading");
    this.message.append(this.words, this.bar);
    this.tools = made("div", "tools");
    const button = (text, title, act) => {
      const one = made("button", "tool", { type: "button", textContent: text, title });
      one.addEventListener("click", act, { signal: this.gone.signal });
      this.tools.append(one);
      return one;
    };
    button("Reset view", "Back to where the view began (Home)", () => this.reset());
    button("Level", "Bring the horizon to lie level (U)", () => this.act(() => this.navigation.level()));
    this.toggle = button("Cameras", "Show or hide the cameras (C)", () => this.toggleCameras());
    this.toggle.setAttribute("aria-pressed", "true");
    this.legend = made("div", "legend");
    this.surface.classList.add("surface");
    this.root.append(this.surface, this.overlay, this.tools, this.legend, this.message);
    el.style.width = "100%";
    el.replaceChildren(this.root);
  }

  listen() {
    const signal = this.gone.signal, canvas = this.overlay;
    canvas.addEventListener("pointerdown", (event) => this.press(event), { signal });
    canvas.addEventListener("pointermove", (event) => this.drag(event), { signal });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.release(event), { signal });
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    canvas.addEventListener("wheel", (event) => this.scroll(event), { signal, passive: false });
    canvas.addEventListener("keydown", (event) => this.type(event), { signal });
    this.watching = new ResizeObserver(() => this.changed());
    this.watching.observe(this.root);
  }

  close() {
    this.gone.abort();
    this.watching.disconnect();
    cancelAnimationFrame(this.frame);
    cancelAnimationFrame(this.flight);
  }

  // Show the scene that Python put into the model.
  open() {
    const { scene, camera } = this.model;
    cancelAnimationFrame(this.flight);
    this.scene = scene.cameras ? scene : null;
    this.root.dataset.empty = String(!this.scene);
    if (this.scene) {
      this.navigation = new Navigation(scene.up, scene.radius, this.cameras[camera] ?? scene.home);
    } else {
      this.navigation = null;
    }
    this.label();
  }

  // The scene's cameras, and those that came after it was opened.
  get cameras() {
    return this.scene ? [...this.scene.cameras, ...this.model.extras] : [];
  }

  // Say which cameras there are.
  label() {
    const count = (use) => this.cameras.filter((one) => one.use === use).length;
    const names = { train: "training", test: "test", query: "query", start: "start" };
    this.legend.replaceChildren(
      ...Object.keys(names).filter(count).map((use) => {
        const item = document.createElement("span"), dot = document.createElement("i");
        dot.style.background = COLOURS[use];
        item.append(dot, `${count(use)} ${names[use]}`);
        return item;
      }),
    );
    this.changed();
  }

  // Tell Python where the viewer stands.
  answer(number) {
    if (this.navigation) this.model.send_msg({ kind: "where", number, ...this.standing() });
  }

  // The view as a picture that the server may draw.
  standing() {
    const share = Math.min(1, MOST / Math.max(...this.size)), size = this.size.map((side) => share * side);
    const { position, rotation } = this.navigation, { fx, fy, cx, cy } = this.navigation.projection(...size);
    return {
      position,
      rotation,
      focal: [fx, fy],
      principal: [cx, cy],
      size,
      background: this.background,
    };
  }

  // Say something over the picture, else what Python says; a share from 0 to 1 shows as a bar.
  tell(text = "", share = null) {
    [this.said, this.share] = [text, share];
    this.repeat();
  }

  repeat() {
    this.words.textContent = this.said || this.model.status;
    this.message.hidden = !this.words.textContent;
    // Without a share the bar only says that something goes on.
    if (this.share === null) this.bar.removeAttribute("value");
    else this.bar.value = this.share;
  }

  // What the browser draws behind the splat: the page's ground, as numbers from 0 to 1.
  get background() {
    const [red, green, blue] = getComputedStyle(this.root).backgroundColor.match(/[\d.]+/g) ?? [0, 0, 0];
    return [red / 255, green / 255, blue / 255];
  }

  get size() {
    return [this.root.clientWidth, this.root.clientHeight];
  }

  // The view has changed: paint it with the next frame.
  changed() {
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      const [width, height] = this.size, dense = Math.min(devicePixelRatio, 2);
      if (width < 16 || height < 16) return;
      this.overlay.width = Math.round(dense * width);
      this.overlay.height = Math.round(dense * height);
      if (!this.scene) return;
      this.paint(this.navigation, width, height);
      if (!this.showsCameras) return;
      const context = this.overlay.getContext("2d");
      context.scale(dense, dense);
      const scene = { ...this.scene, cameras: this.cameras };
      drawCameras(context, this.navigation, scene, this.model.camera, width, height);
    });
  }

  // Change the view by hand, which ends a flight.
  act(change) {
    if (!this.navigation) return;
    cancelAnimationFrame(this.flight);
    change();
    this.changed();
  }

  fly(view) {
    if (!this.navigation) return;
    cancelAnimationFrame(this.flight);
    const from = this.navigation.view, began = performance.now();
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const step = (now) => {
      const share = still ? 1 : Math.min(1, (now - began) / FLIGHT);
      if (share < 1) {
        this.navigation.standBetween(from, view, share * share * (3 - 2 * share));
        this.flight = requestAnimationFrame(step);
      } else {
        this.navigation.stand(view);
      }
      this.changed();
    };
    step(began);
  }

  visit(number) {
    const camera = this.cameras[number];
    if (camera) this.fly(camera);
    else this.changed();
  }

  // Choose a camera here: Python hears of it and shows its photo.
  choose(number) {
    if (number === this.model.camera) this.visit(number);
    else this.model.camera = number;
  }

  reset() {
    if (this.scene) this.fly(this.scene.home);
  }

  toggleCameras() {
    this.showsCameras = !this.showsCameras;
    this.toggle.setAttribute("aria-pressed", String(this.showsCameras));
    this.changed();
  }

  place(event) {
    const box = this.overlay.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  press(event) {
    this.overlay.focus({ preventScroll: true });
    this.overlay.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, this.place(event));
    this.began = this.place(event);
    this.clicks = this.pointers.size === 1 && event.button === 0;
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before || !this.navigation) return;
    const now = this.place(event), [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    if (Math.hypot(now[0] - this.began[0], now[1] - this.began[1]) > STILL) this.clicks = false;
    if (this.clicks) return;
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    this.pointers.set(event.pointerId, now);
    this.act(() => {
      if (others.length) {
        const apart = (place) => Math.max(1, Math.hypot(place[0] - others[0][0], place[1] - others[0][1]));
        this.navigation.approach(apart(before) / apart(now));
        this.shift(dx / 2, dy / 2);
      } else if (event.buttons !== 1 || event.shiftKey || event.ctrlKey) {
        this.shift(dx, dy);
      } else {
        this.navigation.orbit(-PER_PIXEL * dx, -PER_PIXEL * dy);
      }
    });
  }

  // The target follows the pointer.
  shift(dx, dy) {
    const { fx, fy } = this.navigation.projection(...this.size);
    this.navigation.pan(-dx / fx, -dy / fy);
  }

  release(event) {
    const place = this.pointers.get(event.pointerId);
    this.pointers.delete(event.pointerId);
    if (!place || !this.clicks || !this.scene || event.type !== "pointerup") return;
    this.clicks = false;
    if (!this.showsCameras) return;
    const scene = { ...this.scene, cameras: this.cameras };
    const number = cameraAt(place, this.navigation, scene, ...this.size);
    if (number >= 0) this.choose(number);
  }

  scroll(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
    this.act(() => this.navigation.approach(Math.exp(0.0015 * Math.max(-300, Math.min(300, pixels)))));
  }

  type(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || !this.navigation) return;
    const view = this.navigation, step = 0.03 * view.radius, shift = event.shiftKey;
    const arrow = (x, y) => (shift ? view.pan(0.05 * x, 0.05 * y) : view.orbit(PER_KEY * x, PER_KEY * y));
    const next = (by) => {
      const count = this.cameras.length;
      if (count) this.choose((Math.max(this.model.camera, by > 0 ? -1 : 0) + by + count) % count);
    };
    const keys = {
      arrowleft: () => arrow(-1, 0),
      arrowright: () => arrow(1, 0),
      arrowup: () => arrow(0, -1),
      arrowdown: () => arrow(0, 1),
      "+": () => view.approach(0.9),
      "=": () => view.approach(0.9),
      "-": () => view.approach(1.1),
      w: () => view.move(0, 0, step),
      s: () => view.move(0, 0, -step),
      a: () => view.move(-step, 0, 0),
      d: () => view.move(step, 0, 0),
      q: () => view.move(0, step, 0),
      e: () => view.move(0, -step, 0),
      u: () => view.level(),
      c: () => this.toggleCameras(),
      home: () => this.reset(),
      ",": () => next(-1),
      ".": () => next(1),
    };
    const key = event.key.toLowerCase();
    if (!(key in keys)) return;
    event.preventDefault();
    // A flight ends where another movement begins; the last three begin one.
    if (["home", ",", "."].includes(key)) keys[key]();
    else this.act(keys[key]);
  }
}
