// What a mission planned, saw and sought in a control period.
import * as THREE from "./three.module.min.js";
import { point } from "./data.js";
import { SUN } from "./shapes.js";
import { tube } from "./tubes.js";

export const PARTS = ["plan", "safe", "sought", "sensed"];
const SAFE = 0x2e8b57;
const FREE = [86, 180, 233, 84]; // red, green, blue and opacity of what is known to be free
const OCCUPIED = 0x6a4c93;
const [FREE_STATE, OCCUPIED_STATE] = [1, 2];

/** Plan, safe plan, path sought and sensed map of a flight, each in a layer that can be hidden. */
export class MissionParts {
  constructor(flight, colour, space) {
    this.flight = flight;
    this.group = new THREE.Group();
    this.plan = dotted(flight.plan.shape[1], colour);
    this.layers = { plan: this.plan };
    if (flight.sensed) {
      this.safe = new Swept(space.radius);
      this.sought = new Sought(flight.sensed, space);
      this.seen = new SeenMap(flight.sensed);
      Object.assign(this.layers, { safe: this.safe.group, sought: this.sought.line, sensed: this.seen.group });
    }
    this.group.add(...Object.values(this.layers));
  }

  /** Show period k, with the vehicle at a place. */
  show(k, place) {
    if (this.seen) this.seen.setLevel(place.z);
    if (k === this.k) return;
    this.k = k;
    const { plan, sensed } = this.flight;
    const row = Math.min(k, plan.rows - 1);
    const points = Array.from({ length: plan.shape[1] }, (_, i) => {
      const at = row * plan.width + 3 * i;
      return new THREE.Vector3(plan.data[at], plan.data[at + 1], plan.data[at + 2]);
    });
    const { position } = this.plan.children[0].geometry.attributes;
    points.forEach(({ x, y, z }, i) => position.setXYZ(i, x, y, z));
    position.needsUpdate = true;
    if (!sensed) return;
    this.safe.show(sensed.safe[row] ? points : null);
    this.sought.show(row);
    this.seen.show(row);
  }
}

/** A line of `count` points with a dot at each. */
function dotted(count, colour) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
  const group = new THREE.Group();
  group.add(new THREE.Points(geometry, new THREE.PointsMaterial({ color: colour, size: 4, sizeAttenuation: false })));
  group.add(new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: colour })));
  const ghost = { color: colour, transparent: true, opacity: 0.35, depthTest: false, depthWrite: false };
  group.add(new THREE.Line(geometry, new THREE.LineBasicMaterial(ghost))); // seen through whatever stands before it
  group.children.forEach((one) => (one.frustumCulled = false));
  return group;
}

/** The space that a vehicle sweeps until it rests: a tube of its radius that ends in a ball. */
class Swept {
  constructor(radius) {
    this.radius = radius;
    this.group = new THREE.Group();
    this.paint = new THREE.MeshLambertMaterial({ color: SAFE, transparent: true, opacity: 0.25, depthWrite: false });
    this.ball = new THREE.Mesh(new THREE.SphereGeometry(radius, 16, 12), this.paint);
    this.group.add(this.ball);
  }

  show(points) {
    if (this.body) {
      this.group.remove(this.body);
      this.body.geometry.dispose();
    }
    this.body = points && tube(points, this.radius, this.paint, 12);
    this.ball.visible = Boolean(points);
    if (points) this.ball.position.copy(points[points.length - 1]);
    if (this.body) this.group.add(this.body);
  }
}

/** The path to the goal over cells that aren't known to be occupied: dashed, as it may lead through unknown space. */
class Sought {
  constructor({ paths, corners }, space) {
    this.paths = paths;
    this.starts = sums(corners.data);
    const look = { color: 0xb3417a, dashSize: 0.016 * space.size, gapSize: 0.008 * space.size };
    this.line = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineDashedMaterial(look));
    this.line.frustumCulled = false;
  }

  show(k) {
    const places = [];
    for (let i = this.starts[k]; i < this.starts[k + 1]; i++) places.push(new THREE.Vector3(...point(this.paths, i)));
    this.line.geometry.dispose();
    this.line.geometry = new THREE.BufferGeometry().setFromPoints(places);
    this.line.computeLineDistances();
  }
}

/** The cells that are known to be occupied, and at the vehicle's height those that are known to be free. */
class SeenMap {
  constructor({ corner, shape, resolution, changes, counts }) {
    Object.assign(this, { corner, shape, resolution, changes: changes.data });
    this.starts = sums(counts.data);
    this.state = new Uint8Array(shape[0] * shape[1] * shape[2]);
    this.boxes = new Boxes(resolution, Math.max(64, this.mostOccupied()));
    this.sheet = this.sheetOf(shape[0], shape[1]);
    this.group = new THREE.Group();
    this.group.add(this.boxes.mesh, this.sheet);
    this.reset();
  }

  /** No more cells than ever become occupied. */
  mostOccupied() {
    return this.changes.filter((change) => Math.floor(change / this.state.length) === OCCUPIED_STATE).length;
  }

  sheetOf(width, height) {
    this.texture = new THREE.DataTexture(new Uint8Array(4 * width * height), width, height);
    this.texture.magFilter = THREE.NearestFilter;
    const look = { map: this.texture, transparent: true, depthWrite: false, side: THREE.DoubleSide };
    const geometry = new THREE.PlaneGeometry(width * this.resolution, height * this.resolution);
    const made = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial(look));
    made.position.set(this.corner[0] + 0.5 * width * this.resolution, this.corner[1] + 0.5 * height * this.resolution, 0);
    return made;
  }

  reset() {
    this.step = -1;
    this.state.fill(0);
    this.boxes.clear();
  }

  /** Bring the map to period k. */
  show(k) {
    if (k < this.step) this.reset();
    const cells = this.state.length;
    for (let i = this.starts[this.step + 1]; i < this.starts[k + 1]; i++) {
      const cell = this.changes[i] % cells;
      const state = Math.floor(this.changes[i] / cells);
      if (state === OCCUPIED_STATE) this.boxes.add(cell, this.centerOf(cell));
      else if (this.state[cell] === OCCUPIED_STATE) this.boxes.remove(cell);
      this.state[cell] = state;
    }
    this.step = k;
    this.boxes.update();
    this.paint();
  }

  centerOf(cell) {
    const [, width, height] = this.shape;
    const z = cell % height;
    const y = Math.floor(cell / height) % width;
    const x = Math.floor(cell / (height * width));
    return [x, y, z].map((at, i) => this.corner[i] + (at + 0.5) * this.resolution);
  }

  /** Move the sheet to the cells in which a height, m, lies. */
  setLevel(z) {
    const level = Math.floor((z - this.corner[2]) / this.resolution);
    const kept = Math.min(Math.max(level, 0), this.shape[2] - 1);
    if (kept === this.level) return;
    this.level = kept;
    this.sheet.position.z = this.corner[2] + (kept + 0.5) * this.resolution;
    if (this.step >= 0) this.paint();
  }

  paint() {
    const [width, height, levels] = this.shape;
    const { data } = this.texture.image;
    data.fill(0);
    for (let x = 0; x < width; x++) {
      for (let y = 0; y < height; y++) {
        if (this.state[(x * height + y) * levels + this.level] === FREE_STATE) data.set(FREE, 4 * (y * width + x));
      }
    }
    this.texture.needsUpdate = true;
  }
}

/** Equal cubes that come and go, in one draw call. */
class Boxes {
  constructor(size, most) {
    this.places = new Float32Array(3 * most);
    this.cells = new Uint32Array(most);
    this.slots = new Map(); // of each cell
    const box = new THREE.BoxGeometry(size, size, size);
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setIndex(box.index);
    for (const name of ["position", "normal"]) geometry.setAttribute(name, box.attributes[name]);
    this.attribute = new THREE.InstancedBufferAttribute(this.places, 3).setUsage(THREE.DynamicDrawUsage);
    geometry.setAttribute("middle", this.attribute);
    this.mesh = new THREE.Mesh(geometry, new THREE.ShaderMaterial(shader()));
    this.mesh.frustumCulled = false;
  }

  clear() {
    this.slots.clear();
    this.update();
  }

  add(cell, place) {
    if (this.slots.has(cell)) return;
    const slot = this.slots.size;
    this.slots.set(cell, slot);
    this.cells[slot] = cell;
    this.places.set(place, 3 * slot);
  }

  /** The last one takes the place of the one that goes. */
  remove(cell) {
    const slot = this.slots.get(cell);
    const last = this.slots.size - 1;
    this.slots.delete(cell);
    if (slot === last) return;
    this.cells[slot] = this.cells[last];
    this.slots.set(this.cells[slot], slot);
    this.places.copyWithin(3 * slot, 3 * last, 3 * last + 3);
  }

  update() {
    this.mesh.geometry.instanceCount = this.slots.size;
    this.mesh.visible = this.slots.size > 0;
    this.attribute.needsUpdate = true;
  }
}

function shader() {
  return {
    uniforms: { colour: { value: new THREE.Color(OCCUPIED) }, sun: { value: SUN } },
    vertexShader: `attribute vec3 middle; uniform vec3 colour; uniform vec3 sun; varying vec3 shade;
      void main() {
        vec3 light = mix(vec3(0.42, 0.40, 0.38), vec3(0.66, 0.67, 0.69), 0.5 + 0.5 * normal.z) + 0.5 * max(0.0, dot(normal, sun));
        shade = pow(colour * light, vec3(1.0 / 2.2));
        gl_Position = projectionMatrix * viewMatrix * vec4(middle + position, 1.0);
      }`,
    fragmentShader: "varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }",
  };
}

/** Where each run begins of those with these lengths, and where the last one ends. */
function sums(lengths) {
  const found = new Uint32Array(lengths.length + 1);
  lengths.forEach((length, i) => (found[i + 1] = found[i] + length));
  return found;
}
