// Light, ground, start and goal of a layout, and how large it is.
import * as THREE from "./three.module.min.js";
import { point } from "./data.js";
import { SUN } from "./shapes.js";
import { tube } from "./tubes.js";

const SIDEWAYS = 0.25; // shares of the scene's size that are kept around the trajectories
const UPWARDS = 0.1;
const AROUND = 0.06; // that are in view around them at first

const STRAY = 1; // share of the size by which a path that ends badly may widen the scene, on each side

// Solvers have the colours of figures, which are made for paper; in the dark they get the least contrast to what is
// behind them that WCAG 2.2 asks of graphics (1.4.11).
export const LIGHT = { sky: 0xf7f8f9, obstacle: 0xcfc3ae, unknown: 0x7fa8d9, ground: 0xe9ebee, line: 0xc9ced6, contrast: 1 };
export const DARK = { sky: 0x16191d, obstacle: 0x8d8676, unknown: 0x5f86b8, ground: 0x20242a, line: 0x3a414b, contrast: 3 };

/** A colour, mixed with white until it has the contrast to the ground. */
export function against({ ground, contrast }, colour) {
  const light = ({ r, g, b }) => 0.2126 * r + 0.7152 * g + 0.0722 * b + 0.05; // they are linear
  const [seen, white] = [new THREE.Color(colour), new THREE.Color(0xffffff)];
  const least = contrast > 1 ? contrast * light(new THREE.Color(ground)) : 0;
  if (light(seen) < least) seen.lerp(white, (least - light(seen)) / (light(white) - light(seen)));
  return `#${seen.getHexString()}`;
}

/** The longest side of a box, at least as long as the vehicle is. */
function longest(box, head) {
  const { x, y, z } = box.getSize(new THREE.Vector3());
  return Math.max(x, y, z, 4 * head.radius, 1e-6);
}

/** The box around start, goal and trajectories, far ones that end badly left out; what is in view at first; where long obstacles end. */
export function spaceOf(layout, head) {
  const flat = head.dimension === 2;
  const box = new THREE.Box3();
  const add = (place) => place && box.expandByPoint(new THREE.Vector3(place[0], place[1], place[2] ?? 0));
  add(layout.start);
  add(layout.goal);
  const good = layout.flights.filter((flight) => flight.result !== "failed");
  const shown = layout.goal || good.length ? good : layout.flights;
  for (const { path } of shown) for (let k = 0; k < path.rows; k++) add(point(path, k));
  const rest = layout.flights.filter((flight) => !shown.includes(flight));
  const widest = box.clone().expandByScalar(STRAY * longest(box, head));
  if (layout.map) for (const [x, y, z] of layout.map) widest.expandByPoint(new THREE.Vector3(x, y, z ?? 0));
  for (const { path } of rest) {
    const places = Array.from({ length: path.rows }, (_, k) => point(path, k));
    if (places.every(([x, y, z]) => widest.containsPoint(new THREE.Vector3(x, y, z ?? 0)))) places.forEach(add);
  }
  if (layout.goal && layout.goal_radius) box.expandByScalar(0.2 * layout.goal_radius);
  const size = longest(box, head);
  const margin = new THREE.Vector3(SIDEWAYS, SIDEWAYS, UPWARDS).multiplyScalar(size).addScalar(head.radius);
  const low = box.min.clone().sub(margin);
  const high = box.max.clone().add(margin);
  const near = box.clone().expandByScalar(AROUND * size + head.radius);
  return { flat, box, near, size, low, high, radius: head.radius, height: 0.05 * size, top: high.z };
}

export function lights(scene) {
  scene.add(new THREE.HemisphereLight(0xffffff, 0x8a8578, 2.1));
  const sun = new THREE.DirectionalLight(0xffffff, 1.7);
  sun.castShadow = true;
  sun.shadow.mapSize.set(4096, 4096);
  sun.shadow.bias = -0.0006;
  sun.shadow.normalBias = 0.02;
  scene.add(sun, sun.target);
  return sun;
}

/** Put the sun where its shadows cover the layout. */
export function aim(sun, space) {
  const middle = space.low.clone().add(space.high).multiplyScalar(0.5);
  sun.target.position.copy(middle);
  sun.position.copy(middle).add(SUN.clone().multiplyScalar(2 * space.size));
  const reach = 0.9 * space.size;
  Object.assign(sun.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: 0.1, far: 5 * space.size });
  sun.shadow.camera.updateProjectionMatrix();
}

/** Ground with lines at round distances, start and goal. */
export function surroundings(layout, space, colours, still) {
  const group = new THREE.Group();
  const floor = space.flat ? 0 : space.low.z;
  group.add(...ground(space, floor, colours, still));
  if (layout.start) group.add(mark(layout.start, space, new THREE.BoxGeometry(1, 1, 1), colours));
  if (layout.goal) {
    group.add(mark(layout.goal, space, new THREE.OctahedronGeometry(0.8), colours));
    if (layout.goal_radius) group.add(target(layout.goal, layout.goal_radius, space));
  }
  for (const corners of layout.gates) group.add(gate(corners, space));
  return group;
}

function ground(space, floor, colours, still) {
  const step = 10 ** Math.floor(Math.log10(space.size / 4));
  const width = step * Math.ceil((1.6 * space.size) / step);
  const middle = space.box.getCenter(new THREE.Vector3());
  const at = [step * Math.round(middle.x / step), step * Math.round(middle.y / step)];
  const look = { color: colours.ground, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: 2 };
  const paint = still ? new THREE.MeshLambertMaterial(look) : new THREE.MeshBasicMaterial(look);
  const plane = new THREE.Mesh(new THREE.PlaneGeometry(2 * width, 2 * width), paint);
  plane.receiveShadow = true;
  plane.position.set(at[0], at[1], floor - 0.002 * space.size);
  const lines = new THREE.GridHelper(2 * width, Math.round((2 * width) / step), colours.line, colours.line);
  lines.rotation.x = 0.5 * Math.PI;
  lines.position.set(at[0], at[1], floor - 0.001 * space.size);
  return [plane, lines];
}

function mark(place, space, geometry, colours) {
  const made = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color: colours === DARK ? 0xe8eaed : 0x333333 }));
  made.scale.setScalar(0.012 * space.size);
  made.position.set(place[0], place[1], space.flat ? 0.5 * space.height : place[2]);
  return made;
}

/** A closed line through corners. */
function gate(corners, space) {
  const places = [...corners, corners[0]].map(([x, y, z]) => new THREE.Vector3(x, y, z ?? 0.5 * space.height));
  return tube(places, 0.003 * space.size, new THREE.MeshLambertMaterial({ color: 0xd55e00 }));
}

function target(place, radius, space) {
  const look = { color: 0x2e8b57, transparent: true, opacity: 0.14, depthWrite: false, side: THREE.DoubleSide };
  const geometry = space.flat ? new THREE.CircleGeometry(radius, 64) : new THREE.SphereGeometry(radius, 40, 24);
  const made = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial(look));
  made.position.set(place[0], place[1], space.flat ? 0.03 * space.height : place[2]);
  return made;
}
