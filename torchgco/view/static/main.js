// The page: what is chosen, and the loop that draws it.
import * as THREE from "./three.module.min.js";
import { half, part } from "./data.js";
import { obstacles } from "./shapes.js";
import { Orbit } from "./camera.js";
import { DARK, LIGHT, against, aim, lights, spaceOf, surroundings } from "./scenery.js";
import { PARTS } from "./missions.js";
import { Flights } from "./flights.js";
import { Search } from "./searches.js";
import { linesOf, pick, showHover } from "./hover.js";
import { build, by, showLayout, showParts, showSearch, showTime, showUnknown } from "./panel.js";

const SLOW = 1 / 31; // s a frame, above which the picture gets coarser while it moves
const TOLD = 100; // ms between two updates of the text while playing
const COARSEST = 0.4; // pixels of the picture per pixel of the screen

/** Whether pictures are computed without a graphics card: smooth edges would cost half of the time. */
function software() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (!context) throw new Error("the browser offers no WebGL 2");
  const names = context.getExtension("WEBGL_debug_renderer_info");
  const name = names ? context.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

class Page {
  constructor(head) {
    this.head = head;
    this.canvas = by("picture");
    const asked = new URLSearchParams(location.hash.slice(1));
    this.asked = asked;
    this.still = asked.has("picture"); // nothing but the picture, as fine as can be
    document.body.classList.toggle("picture", this.still);
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: !software() });
    this.renderer.shadowMap.enabled = this.still;
    this.scene = new THREE.Scene();
    this.sun = lights(this.scene);
    this.orbit = new Orbit(this.canvas, () => this.redraw());
    this.visible = new Set(head.solvers.map(({ name }) => name));
    this.layers = new Set(["path", "caught", "refined"]);
    const parts = Object.fromEntries(PARTS.map((name) => [name, true]));
    // In space unknown cells would hide all the rest.
    this.shown = { follow: false, through: false, unknown: head.dimension === 2, grown: false, searched: false, ...parts };
    this.time = 0;
    this.speed = 1;
    this.playing = false;
    this.ratio = this.finest;
    this.frames = 0;
    this.spent = [];
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.addEventListener("change", () => this.rebuild());
  }

  get finest() {
    return Math.min(2, window.devicePixelRatio || 1);
  }

  get colours() {
    return this.dark.matches ? DARK : LIGHT;
  }

  async start() {
    build(this.head, this.actions());
    window.addEventListener("resize", () => this.resize());
    window.addEventListener("keydown", (event) => this.key(event));
    this.canvas.addEventListener("pointermove", (event) => this.hover(event));
    this.canvas.addEventListener("click", (event) => this.hover(event)); // a finger doesn't hover
    this.canvas.addEventListener("pointerleave", () => showHover(by("hover"), null));
    this.resize();
    await this.choose(this.firstLayout());
    this.setTime(Number(this.asked.get("time") ?? 0));
    if (this.asked.has("cut")) by("cut").value = this.asked.get("cut");
    this.cut(Number(by("cut").value));
    if (this.asked.has("camera")) this.placeCamera(this.asked.get("camera").split(",").map(Number));
    this.draw();
    this.canvas.dataset.first = Math.round(performance.now());
    this.canvas.dataset.ready = "true";
    requestAnimationFrame((now) => this.loop(now));
  }

  firstLayout() {
    const asked = Number(this.asked.get("layout") ?? 0);
    return Number.isInteger(asked) && asked >= 0 && asked < this.head.layouts.length ? asked : 0;
  }

  actions() {
    return {
      choose: (number) => this.choose(number),
      step: (change) => this.choose((this.number + change + this.head.layouts.length) % this.head.layouts.length),
      view: (name) => this.view(name),
      cut: (share) => this.cut(share),
      toggle: (name, on) => this.toggle(name, on),
      solver: (name, on) => this.setSolver(name, on),
      play: () => this.play(!this.playing),
      time: (t) => this.setTime(t),
      speed: (speed) => (this.speed = speed),
      resize: () => this.resize(),
      round: (number) => this.setSearch({ round: number }),
      guide: (number) => this.setSearch({ guide: number }),
      layer: (kind, on) => {
        if (on) this.layers.add(kind);
        else this.layers.delete(kind);
        this.setSearch({});
      },
    };
  }

  /** Show another layout. A slow one that comes after a later choice is dropped. */
  async choose(number) {
    this.number = number;
    const layout = await part(`part-${number}`);
    layout.obstacles = await Promise.all(
      layout.obstacles.map(async (one) => ("shared" in one ? { ...(await part(`map-${one.shared}`)), phase: one.phase } : one)),
    );
    if (number !== this.number) return;
    this.layout = layout;
    // Maps may have a ceiling: it is cut off at first.
    if (!this.placed && this.head.dimension === 3 && layout.obstacles.some((one) => one.cells)) by("cut").value = 0.99;
    this.rebuild();
    if (!this.placed) this.view("perspective");
    if (!this.placed && this.flights.partNames.has("sensed")) this.toggle("through", true); // the map is inside them
    this.placed = true; // from here on the camera is the user's
    this.setTime(Math.min(this.time, this.flights.duration));
  }

  rebuild() {
    this.clear();
    const { scene, layout, colours } = this;
    scene.background = new THREE.Color(colours.sky);
    for (const solver of this.head.solvers) solver.seen = against(colours, solver.colour);
    showLayout(layout, this.number, this.head, this.visible, this.actions());
    this.space = spaceOf(layout, this.head);
    if (this.still) scene.fog = new THREE.Fog(colours.sky, 0.7 * this.space.size, 2.2 * this.space.size);
    this.flights = new Flights(layout, this.head, this.space);
    this.obstacles = obstacles(layout.obstacles, this.flights.phases, this.space, colours, this.still);
    this.search = layout.search ? new Search(layout.search, this.space) : null;
    this.around = surroundings(layout, this.space, colours, this.still);
    aim(this.sun, this.space);
    scene.add(this.obstacles.group, this.flights.group, this.around);
    if (this.search) scene.add(this.search.group);
    showSearch(layout.search, this.layers, this.actions());
    this.chosen = { round: 0, guide: 0 };
    this.cut(Number(by("cut").value));
    this.flights.setVisible(this.visible);
    showParts(this.flights.partNames);
    showUnknown(this.obstacles.unknown);
    for (const [name, on] of Object.entries(this.shown)) this.toggle(name, on);
    this.setTime(this.time);
  }

  clear() {
    if (!this.flights) return;
    this.scene.remove(this.obstacles.group, this.flights.group, this.around);
    this.around.traverse((one) => one.geometry && (one.geometry.dispose(), one.material.dispose()));
    this.obstacles.dispose();
    this.flights.dispose();
    if (this.search) {
      this.search.clear();
      this.scene.remove(this.search.group);
    }
  }

  view(name) {
    const { start, goal } = this.layout;
    const ahead = start && goal ? Math.atan2(goal[1] - start[1], goal[0] - start[0]) : 0;
    const views = {
      perspective: [ahead - 0.5 * Math.PI - 0.45, this.space.flat ? 1.0 : 0.5],
      above: [-0.5 * Math.PI, 1.57],
      side: [ahead - 0.5 * Math.PI, 0.02],
      behind: [ahead + Math.PI, 0.3],
    };
    this.orbit.look(this.space.near, ...views[name]);
  }

  /** Azimuth and elevation in degrees, the distance as a share of the scene's size, and where the camera looks. */
  placeCamera([azimuth, elevation, share, ...target]) {
    if (target.length === 3) this.orbit.target.set(...target);
    this.orbit.azimuth = (azimuth * Math.PI) / 180;
    this.orbit.elevation = (elevation * Math.PI) / 180;
    this.orbit.distance = share * this.space.size;
    this.orbit.place();
  }

  cut(share) {
    const { low, high, top } = this.space;
    high.z = low.z + share * (top - low.z);
    const ceiling = share < 1 ? high.z : null;
    this.obstacles.setCeiling(ceiling);
    this.flights.all.forEach(({ parts }) => parts?.setCeiling(ceiling));
    this.redraw();
  }

  toggle(name, on) {
    this.shown[name] = on;
    by(name).checked = on;
    if (name === "grown") this.obstacles.setGrown(on);
    if (name === "unknown") this.obstacles.setUnknown(on);
    if (name === "through") this.obstacles.setSeeThrough(on);
    if (PARTS.includes(name)) this.flights.setPart(name, on);
    if (name === "searched") this.setSearch({});
    if (name === "follow" && on) this.follow();
    this.redraw();
  }

  setSolver(name, on) {
    if (on) this.visible.add(name);
    else this.visible.delete(name);
    this.flights.setVisible(this.visible);
    this.redraw();
  }

  setSearch(change) {
    Object.assign(this.chosen, change);
    if (!this.search) return;
    by("search-more").hidden = !this.shown.searched;
    this.search.show(this.shown.searched ? this.chosen.round : -1, this.shown.searched ? this.chosen.guide : -1, this.layers);
    this.redraw();
  }

  play(on) {
    if (on && this.time >= this.flights.duration) this.setTime(0);
    this.playing = on;
    this.spent = [];
    if (!on) this.setRatio(this.finest);
    this.tell();
    this.redraw();
  }

  setTime(t) {
    this.time = Math.min(Math.max(0, t), this.flights.duration);
    this.obstacles.setClocks(this.flights.clocks(this.time));
    this.flights.setTime(this.time);
    if (this.shown.follow) this.follow();
    this.redraw();
    const now = performance.now();
    if (this.playing && now - (this.told ?? 0) < TOLD) return; // text costs more than the picture
    this.told = now;
    this.tell();
  }

  tell() {
    const first = this.flights.all.find(({ body }) => body.visible);
    if (first) this.canvas.dataset.vehicle = first.body.position.toArray().map((value) => value.toFixed(3)).join(" ");
    this.canvas.dataset.frames = this.frames;
    showTime(this.time, this.flights.duration, this.playing);
  }

  follow() {
    const led = this.flights.all.find(({ group, body }) => group.visible && body.visible);
    if (!led) return;
    this.orbit.target.copy(led.body.position);
    this.orbit.place();
  }

  key(event) {
    const typing = ["SELECT", "INPUT", "TEXTAREA", "BUTTON"].includes(event.target.tagName);
    if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
    const steps = { ",": -1, ".": 1 };
    const layouts = { n: 1, p: -1 };
    if (event.key === " ") this.play(!this.playing);
    else if (event.key in steps) this.stepKnot(steps[event.key]);
    else if (event.key in layouts) this.actions().step(layouts[event.key]);
    else return;
    event.preventDefault();
  }

  /** To the next knot, or the one before. */
  stepKnot(change) {
    const at = this.flights.knotsAt(this.time);
    const near = Math.round(at);
    const from = Math.abs(at - near) < 1e-3 ? near : change > 0 ? Math.floor(at) : Math.ceil(at);
    this.setTime(this.flights.timeOf(Math.min(this.flights.knots, Math.max(0, from + change))));
  }

  hover(event) {
    if (this.orbit.held || !this.flights) return;
    const { clientWidth, clientHeight } = this.canvas;
    const found = pick(this.flights, this.orbit.camera, event.offsetX, event.offsetY, clientWidth, clientHeight);
    const { label } = this.head.layouts[this.number];
    showHover(by("hover"), found && linesOf(label, found, this.flights), event.offsetX, event.offsetY, clientWidth);
  }

  resize() {
    this.setRatio(this.ratio);
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.orbit.camera.aspect = clientWidth / Math.max(1, clientHeight);
    this.orbit.place();
  }

  setRatio(ratio) {
    if (ratio === this.renderer.getPixelRatio()) return;
    this.ratio = ratio;
    this.renderer.setPixelRatio(ratio);
    this.redraw();
  }

  redraw() {
    this.stale = true;
  }

  loop(now) {
    const passed = this.last === undefined ? 0 : (now - this.last) / 1000;
    this.last = now;
    if (this.playing) {
      this.pace(passed);
      this.setTime(this.time + this.speed * passed);
      if (this.time >= this.flights.duration) this.play(false);
    }
    if (this.stale) this.draw();
    requestAnimationFrame((next) => this.loop(next));
  }

  /** Fewer pixels where frames come slower than 30 a second, as without a graphics card. */
  pace(passed) {
    this.spent.push(passed);
    if (this.spent.length < 8) return;
    const median = this.spent.sort((a, b) => a - b)[4];
    this.spent = [];
    if (median > SLOW && this.ratio > COARSEST) this.setRatio(Math.max(COARSEST, this.ratio * Math.max(0.6, Math.sqrt(SLOW / median))));
  }

  draw() {
    this.stale = false;
    this.renderer.render(this.scene, this.orbit.camera);
    this.frames += 1;
  }
}

export async function start() {
  const page = new Page(await part("head"));
  await page.start();
  window.torchgcoView = page; // for scripts, such as those that take pictures
  page.half = half;
}
