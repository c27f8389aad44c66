// What a mission planned, saw and sought in a control period.
import * as THREE from "./three.module.min.js";
import { point } from "./data.js";
import { NONE, SUN } from "./shapes.js";
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

  /** Show no cells above a height, m. */
  setCeiling(z) {
    if (this.seen) this.seen.boxes.ceiling.value = z ?? NONE;
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
    this.occupied = new Set();
    this.boxes = new Boxes(corner, shape, resolution);
    this.sheet = this.sheetOf(shape[0], shape[1]);
    this.group = new THREE.Group();
    this.group.add(this.boxes.mesh, this.sheet);
    this.reset();
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
    this.occupied.clear();
  }

  /** Bring the map to period k. */
  show(k) {
    if (k < this.step) this.reset();
    const cells = this.state.length;
    for (let i = this.starts[this.step + 1]; i < this.starts[k + 1]; i++) {
      const cell = this.changes[i] % cells;
      const state = Math.floor(this.changes[i] / cells);
      if (state === OCCUPIED_STATE) this.occupied.add(cell);
      else this.occupied.delete(cell);
      this.state[cell] = state;
    }
    this.step = k;
    this.boxes.fill(this.occupied);
    this.paint();
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

/** Boxes that fill some cells, in one draw call; each costs as much as a cell would. */
class Boxes {
  constructor(corner, shape, resolution) {
    Object.assign(this, { corner, shape, resolution });
    this.geometry = new THREE.InstancedBufferGeometry();
    this.geometry.setIndex([0, 1, 2, 0, 2, 3, 4, 5, 6, 4, 6, 7, 8, 9, 10, 8, 10, 11]);
    for (const [name, values] of Object.entries(threeSides())) {
      this.geometry.setAttribute(name, new THREE.Float32BufferAttribute(values, 3));
    }
    this.ceiling = { value: NONE };
    this.mesh = new THREE.Mesh(this.geometry, new THREE.ShaderMaterial(shader(this.ceiling)));
    this.mesh.frustumCulled = false;
    this.grow(64);
  }

  grow(count) {
    this.most = 2 * count;
    this.geometry.dispose(); // its buffers have another size from now on
    for (const name of ["middle", "sides"]) {
      const attribute = new THREE.InstancedBufferAttribute(new Float32Array(3 * this.most), 3);
      this.geometry.setAttribute(name, attribute.setUsage(THREE.DynamicDrawUsage));
    }
  }

  /** Fill cells, given by their numbers in a set. */
  fill(cells) {
    this.boxes = merged(Uint32Array.from(cells).sort(), this.shape);
    if (this.boxes.length > this.most) this.grow(this.boxes.length);
    const { middle, sides } = this.geometry.attributes;
    const half = 0.5 * this.resolution;
    this.boxes.forEach(([low, high], i) => {
      middle.setXYZ(i, ...low.map((first, axis) => this.corner[axis] + half * (first + high[axis])));
      sides.setXYZ(i, ...low.map((first, axis) => half * (high[axis] - first)));
    });
    middle.needsUpdate = sides.needsUpdate = true;
    this.geometry.instanceCount = this.boxes.length;
    this.mesh.visible = this.boxes.length > 0;
  }
}

/** Few boxes [first cell, the one after the last] that fill cells, given by their numbers in order: runs along z become
 * bars, bars of equal ends side by side plates, and so on. */
function merged(cells, [, width, height]) {
  const boxes = [];
  for (let i = 0; i < cells.length; i++) {
    const z = cells[i] % height;
    const column = (cells[i] - z) / height;
    const last = boxes[boxes.length - 1];
    if (last && z > 0 && cells[i] === cells[i - 1] + 1) last[1][2] += 1;
    else boxes.push([[Math.floor(column / width), column % width, z], [Math.floor(column / width) + 1, (column % width) + 1, z + 1]]);
  }
  return [1, 0].reduce(joined, boxes);
}

/** Boxes in order, those joined that touch along an axis and end alike along the others. */
function joined(boxes, axis) {
  const open = new Map();
  return boxes.filter(([low, high]) => {
    const key = [0, 1, 2].filter((other) => other !== axis).map((other) => `${low[other]} ${high[other]}`).join(" ");
    const before = open.get(key);
    const joins = before !== undefined && before[1][axis] === low[axis];
    if (joins) before[1][axis] = high[axis];
    else open.set(key, [low, high]);
    return !joins;
  });
}

/** Of a box no more than three sides face the camera: those at the higher ends, which the shader mirrors where need be. */
function threeSides() {
  const found = { position: [], normal: [] };
  for (const axis of [0, 1, 2]) {
    for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
      const corner = [a, b];
      found.position.push(...[0, 1, 2].map((other) => (other === axis ? 1 : corner.shift())));
      found.normal.push(...[0, 1, 2].map((other) => (other === axis ? 1 : 0)));
    }
  }
  return found;
}

function shader(ceiling) {
  return {
    side: THREE.DoubleSide,
    uniforms: { colour: { value: new THREE.Color(OCCUPIED) }, sun: { value: SUN }, ceiling },
    vertexShader: `attribute vec3 middle; attribute vec3 sides; uniform float ceiling; uniform vec3 colour;
      uniform vec3 sun; varying vec3 shade;
      void main() {
        vec3 facing = vec3(greaterThan(cameraPosition, middle)) * 2.0 - 1.0;
        vec3 n = facing * normal;
        vec3 light = mix(vec3(0.42, 0.40, 0.38), vec3(0.66, 0.67, 0.69), 0.5 + 0.5 * n.z) + 0.5 * max(0.0, dot(n, sun));
        shade = pow(colour * light, vec3(1.0 / 2.2));
        vec3 p = middle + sides * facing * position;
        p = middle.z - sides.z > ceiling ? middle : vec3(p.xy, min(p.z, ceiling));
        gl_Position = projectionMatrix * viewMatrix * vec4(p, 1.0);
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
