// The trajectories of a layout: tubes, marks where something is violated, and the vehicles that fly along.
import * as THREE from "./three.module.min.js";
import { between, point } from "./data.js";
import { MissionParts } from "./missions.js";
import { AROUND, dashWhereShared, tube } from "./tubes.js";
import { vehicle } from "./vehicle.js";

const BAD = 0xd02020;

/** All flights of a layout, in the colours of their solvers. */
export class Flights {
  constructor(layout, head, space) {
    this.group = new THREE.Group();
    this.head = head;
    this.space = space;
    this.thick = 0.0035 * space.size;
    this.all = layout.flights.filter((flight) => flight.path.rows > 0).map((flight) => this.built(flight));
    this.all.forEach(({ line, drawn: points }, i) => {
      const before = this.all.slice(0, i).map((one) => one.drawn);
      if (line) dashWhereShared(line.geometry, points, before, 1.5 * this.thick, 6 * this.thick);
    });
    this.free = layout.free;
    this.times = layout.times ? layout.times.data : null; // of the knots of all flights
    this.phases = layout.flights.map(({ phase }) => phase).filter(Boolean);
    const longest = Math.max(1, ...this.all.map((one) => one.flight.path.rows - 1));
    this.knots = this.phases.length ? this.times.length - 1 : longest; // phases follow each other
  }

  /** When obstacles are at a time, s: unless it is free they count in steps of equal length, of each phase from its start. */
  clocks(t) {
    const knots = this.knotsAt(t);
    if (!this.phases.length) return { times: [this.free ? t : knots * this.head.dt], present: 0 };
    const times = this.phases.map(({ first, stages, dt }) => Math.min(Math.max(knots - first, 0), stages) * dt);
    return { times, present: this.present(knots) };
  }

  /** Which phase a knot is of, or what lies behind it: at a jump the later one. */
  present(knots) {
    return Math.max(0, this.phases.findLastIndex(({ first }) => first <= knots));
  }

  /** Seconds from the first knot to the last of the flight that takes longest. */
  get duration() {
    return Math.max(this.timeOf(this.knots), ...this.all.map(({ flight }) => (flight.times ? flight.times.data.at(-1) : 0)));
  }

  /** The times of the knots of a flight, by default of the first one, s; null: steps of equal length. */
  timesOf(flight = this.all[0]?.flight) {
    return this.times ?? flight?.times?.data ?? null;
  }

  /** The time of a knot of a flight, s. */
  timeOf(k, flight) {
    const times = this.timesOf(flight);
    return times ? times[Math.min(k, times.length - 1)] : k * this.head.dt;
  }

  /** How many knots of a flight have passed at a time, s; between two knots it is no whole number. */
  knotsAt(t, flight) {
    const times = this.timesOf(flight);
    if (!times) return t / this.head.dt;
    const next = times.findIndex((time) => time > t);
    if (next <= 0) return next === 0 ? 0 : times.length - 1;
    return next - 1 + (t - times[next - 1]) / (times[next] - times[next - 1]);
  }

  place(x, y, z) {
    return new THREE.Vector3(x, y, this.space.flat ? 0.5 * this.space.height : z);
  }

  points(path) {
    return Array.from({ length: path.rows }, (_, k) => this.place(...point(path, k)));
  }

  built(flight) {
    const { name, seen: colour } = this.head.solvers[flight.solver];
    const group = new THREE.Group();
    const points = this.points(flight.path);
    const drawn = flight.way ? this.points(flight.way) : points; // along the path between the knots
    const paint = new THREE.MeshLambertMaterial({ color: colour });
    const line = tube(drawn, (flight.solver === 0 ? 1 : 1.2) * this.thick, paint);
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
    const { radius, shape, body: kind } = flight.phase ?? this.head;
    const body = vehicle(kind, radius || 0.012 * this.space.size, colour, this.space.flat, shape);
    body.add(dot(colour));
    group.add(body, ...this.marks(flight, drawn, colour));
    const parts = flight.plan ? new MissionParts(flight, colour, this.space) : null;
    if (parts) group.add(parts.group);
    this.group.add(group);
    return { flight, name, colour, group, points, drawn, line, body, parts };
  }

  /** Red where a constraint is violated, a red mark at each contact, and one in the flight's colour where it passes a gate. */
  marks(flight, points, colour) {
    const found = [];
    const pieces = flight.pieces ?? 1;
    const paint = new THREE.MeshLambertMaterial({ color: BAD });
    for (const [first, last] of runs(flight.violated.map(([k]) => k))) {
      const piece = points.slice(pieces * Math.max(0, first - 1), pieces * (last + 1) + 1);
      const red = piece.length > 1 ? tube(piece, 1.8 * this.thick, paint) : null;
      if (red) found.push(red);
    }
    // They lie within what is touched: seen through it.
    const through = new THREE.MeshBasicMaterial({ color: BAD, transparent: true, opacity: 0.6, depthTest: false, depthWrite: false });
    const solid = new THREE.OctahedronGeometry(3.2 * this.thick);
    found.push(...this.placed(flight.contacts, solid, paint, 0), ...this.placed(flight.contacts, solid, through, 6));
    const disc = new THREE.SphereGeometry(2.4 * this.thick);
    return [...found, ...this.placed(flight.crossings, disc, new THREE.MeshLambertMaterial({ color: colour }), 0)];
  }

  /** A shape at each of some places. */
  placed(places, shape, look, order) {
    const shapes = new THREE.InstancedMesh(shape, look, places.length);
    const at = new THREE.Matrix4();
    places.forEach((place, i) => {
      const { x, y, z } = this.place(...place);
      shapes.setMatrixAt(i, at.makeTranslation(x, y, z));
    });
    shapes.frustumCulled = false;
    shapes.renderOrder = order;
    return places.length ? [shapes] : [];
  }

  /** Move all vehicles to a time, s. */
  setTime(t) {
    const now = this.phases[this.present(this.knotsAt(t))];
    for (const { flight, body, line, parts } of this.all) {
      const knots = Math.max(0, this.knotsAt(t, flight) - (flight.phase?.first ?? 0));
      body.visible = flight.phase === now;
      const place = this.place(...between(flight.way ?? flight.path, knots * (flight.pieces ?? 1)));
      body.position.copy(place);
      if (flight.attitude) body.quaternion.copy(attitude(flight.attitude, knots));
      const k = Math.min(Math.floor(knots), flight.path.rows - 1);
      if (parts) parts.show(k, place);
      if (this.head.mission && line) line.geometry.setDrawRange(0, Math.max(1, k) * AROUND * 6);
    }
  }

  setVisible(names) {
    this.all.forEach((one) => (one.group.visible = names.has(one.name)));
  }

  /** Which of a mission's parts can be shown in this layout. */
  get partNames() {
    return new Set(this.all.flatMap(({ parts }) => (parts ? Object.keys(parts.layers) : [])));
  }

  setPart(name, on) {
    for (const { parts } of this.all) if (parts && name in parts.layers) parts.layers[name].visible = on;
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
