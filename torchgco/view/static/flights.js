// The trajectories of a layout: tubes, marks where something is violated, and the vehicles that fly along.
import * as THREE from "./three.module.min.js";
import { between, point } from "./data.js";
import { vehicle } from "./vehicle.js";

const AROUND = 6; // corners of a tube's section
const BAD = 0xd02020;

/** Straight pieces between points, as three.js wants them for tubes. */
class Polyline extends THREE.Curve {
  constructor(points) {
    super();
    this.points = points;
  }

  getPoint(share, out = new THREE.Vector3()) {
    const at = share * (this.points.length - 1);
    const k = Math.min(Math.floor(at), this.points.length - 2);
    return out.copy(this.points[k]).lerp(this.points[k + 1], at - k);
  }

  getPointAt(share, out) {
    return this.getPoint(share, out);
  }

  getTangentAt(share, out = new THREE.Vector3()) {
    const step = 0.5 / (this.points.length - 1);
    const [a, b] = [Math.max(0, share - step), Math.min(1, share + step)];
    return out.copy(this.getPoint(b)).sub(this.getPoint(a)).normalize();
  }
}

/** A tube through points; null where they don't leave their place. Each piece has the same number of corners. */
export function tube(points, radius, material) {
  const moved = points.filter((place, k) => k === 0 || place.distanceTo(points[k - 1]) > 1e-9);
  if (moved.length < 2) return null;
  // Points that coincide would have no direction: the same number of pieces, spread a little.
  const spread = moved.length === points.length ? points : spreadOut(points);
  return new THREE.Mesh(new THREE.TubeGeometry(new Polyline(spread), spread.length - 1, radius, AROUND), material);
}

function spreadOut(points) {
  const tiny = 1e-7 * (1 + points[0].length());
  return points.map((place, k) => place.clone().addScalar(tiny * k));
}

/** All flights of a layout, in the colours of their solvers. */
export class Flights {
  constructor(layout, head, space) {
    this.group = new THREE.Group();
    this.head = head;
    this.space = space;
    this.thick = 0.0035 * space.size;
    this.all = layout.flights.filter((flight) => flight.path.rows > 0).map((flight) => this.built(flight));
    this.knots = Math.max(1, ...this.all.map((one) => one.flight.path.rows - 1));
  }

  /** Seconds from the first knot to the last of the longest flight. */
  get duration() {
    return this.knots * this.head.dt;
  }

  place(x, y, z) {
    return new THREE.Vector3(x, y, this.space.flat ? 0.5 * this.space.height : z);
  }

  points(path) {
    return Array.from({ length: path.rows }, (_, k) => this.place(...point(path, k)));
  }

  built(flight) {
    const { name, colour } = this.head.solvers[flight.solver];
    const group = new THREE.Group();
    const points = this.points(flight.path);
    const paint = new THREE.MeshLambertMaterial({ color: colour });
    const line = tube(points, this.thick, paint);
    if (line) {
      // Seen through whatever stands before it.
      const ghost = new THREE.Mesh(
        line.geometry,
        new THREE.MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.28, depthTest: false, depthWrite: false }),
      );
      ghost.renderOrder = 5;
      line.castShadow = true;
      group.add(line, ghost);
    }
    const body = vehicle(this.head.body, this.head.radius || 0.012 * this.space.size, colour, this.space.flat);
    body.add(dot(colour));
    group.add(body, ...this.marks(flight, points));
    const plan = flight.plan ? this.planned(flight, colour) : null;
    if (plan) group.add(plan);
    this.group.add(group);
    return { flight, name, colour, group, points, line, body, plan };
  }

  /** Red where a constraint is violated, and a red mark at each contact. */
  marks(flight, points) {
    const found = [];
    const paint = new THREE.MeshLambertMaterial({ color: BAD });
    for (const [first, last] of runs(flight.violated.map(([k]) => k))) {
      const piece = points.slice(Math.max(0, first - 1), last + 2);
      const red = piece.length > 1 ? tube(piece, 1.5 * this.thick, paint) : null;
      if (red) found.push(red);
    }
    if (flight.contacts.length) {
      const size = 3.2 * this.thick;
      const shapes = new THREE.InstancedMesh(new THREE.OctahedronGeometry(size), paint, flight.contacts.length);
      const at = new THREE.Matrix4();
      flight.contacts.forEach((place, i) => {
        const { x, y, z } = this.place(...place);
        shapes.setMatrixAt(i, at.makeTranslation(x, y, z));
      });
      shapes.frustumCulled = false;
      found.push(shapes);
    }
    return found;
  }

  /** The plan of a mission at one instant, as dots on a line. */
  planned(flight, colour) {
    const geometry = new THREE.BufferGeometry();
    const positions = new THREE.BufferAttribute(new Float32Array(3 * flight.plan.shape[1]), 3);
    geometry.setAttribute("position", positions);
    const group = new THREE.Group();
    group.add(new THREE.Points(geometry, new THREE.PointsMaterial({ color: colour, size: 4, sizeAttenuation: false })));
    group.add(new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: colour })));
    group.children.forEach((one) => (one.frustumCulled = false));
    group.userData.positions = positions;
    return group;
  }

  /** Move all vehicles to a time, s. */
  setTime(t) {
    const knots = t / this.head.dt;
    for (const { flight, body, line, plan } of this.all) {
      const place = this.place(...between(flight.path, knots));
      body.position.copy(place);
      if (flight.attitude) body.quaternion.copy(attitude(flight.attitude, knots));
      const k = Math.min(Math.floor(knots), flight.path.rows - 1);
      if (plan) this.showPlan(flight, plan, k);
      if (this.head.mission && line) line.geometry.setDrawRange(0, Math.max(1, k) * AROUND * 6);
    }
  }

  showPlan(flight, plan, k) {
    const [, count, width] = flight.plan.shape;
    const row = Math.min(k, flight.plan.rows - 1) * count * width;
    const { positions } = plan.userData;
    for (let i = 0; i < count; i++) positions.setXYZ(i, ...flight.plan.data.subarray(row + i * width, row + i * width + 3));
    positions.needsUpdate = true;
  }

  setVisible(names) {
    this.all.forEach((one) => (one.group.visible = names.has(one.name)));
  }

  dispose() {
    this.group.traverse((one) => {
      if (one.geometry) one.geometry.dispose();
      if (one.material) one.material.dispose();
    });
  }
}

/** A dot that shows where a vehicle is behind obstacles, too. */
function dot(colour) {
  const look = { color: colour, size: 7, sizeAttenuation: false, transparent: true, opacity: 0.75, depthTest: false };
  const made = new THREE.Points(new THREE.BufferGeometry().setFromPoints([new THREE.Vector3()]), new THREE.PointsMaterial(look));
  made.renderOrder = 7;
  return made;
}

/** The quaternion between two knots: the shorter way, as both signs mean the same. */
function attitude(array, knots) {
  const last = array.rows - 1;
  const at = Math.min(Math.max(knots, 0), last);
  const k = Math.floor(at);
  const read = (row) => {
    const [w, x, y, z] = array.data.subarray(4 * row, 4 * row + 4);
    return new THREE.Quaternion(x, y, z, w).normalize();
  };
  return read(k).slerp(read(Math.min(k + 1, last)), at - k);
}

/** First and last of each run of whole numbers that follow each other. */
export function runs(numbers) {
  const found = [];
  for (const number of numbers) {
    const last = found[found.length - 1];
    if (last && number === last[1] + 1) last[1] = number;
    else found.push([number, number]);
  }
  return found;
}
