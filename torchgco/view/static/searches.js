// The search for ways around obstacles, on demand: paths of the roadmap, candidates, guide regions.
import * as THREE from "./three.module.min.js";
import { point } from "./data.js";

// Colours of homotopy classes, and how candidates of each fate are drawn.
const CLASSES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#999933"];
const FATES = { proposed: 1, refined: 0.85, relaxed: 0.55, tracked: 0.35, failed: 0.4, unsound: 0.4 };
export const LAYERS = { path: "paths", caught: "caught trajectory", tracked: "tracked", relaxed: "relaxed", refined: "refined" };

export const classColour = (group) => CLASSES[((group % CLASSES.length) + CLASSES.length) % CLASSES.length];

/** The lines of one comparison of candidates, and the guide regions of one outer iteration. */
export class Search {
  constructor(search, space) {
    this.search = search;
    this.space = space;
    this.group = new THREE.Group();
  }

  show(round, guide, layers) {
    this.clear();
    const { rounds, guides } = this.search;
    for (const line of rounds[round]?.lines ?? []) if (layers.has(line.kind)) this.group.add(this.line(line));
    if (guides[guide]) this.group.add(...this.guided(guides[guide]));
  }

  at(points, k) {
    const [x, y, z] = point(points, k);
    return new THREE.Vector3(x, y, this.space.flat ? 0.5 * this.space.height : z);
  }

  line({ points, kind, group, fate }) {
    const places = Array.from({ length: points.rows }, (_, k) => this.at(points, k));
    const colour = kind === "caught" ? "#777777" : classColour(group);
    const dashed = kind === "path" || fate === "failed" || fate === "unsound";
    const size = this.space.size;
    const look = { color: colour, transparent: true, opacity: FATES[fate] ?? 1, depthTest: false };
    const material = dashed
      ? new THREE.LineDashedMaterial({ ...look, dashSize: 0.012 * size, gapSize: 0.008 * size })
      : new THREE.LineBasicMaterial(look);
    const made = new THREE.Line(new THREE.BufferGeometry().setFromPoints(places), material);
    if (dashed) made.computeLineDistances();
    made.renderOrder = 6;
    return made;
  }

  /** Balls that attract knots, and the sampled trajectory that they lie around. */
  guided({ balls, sample }) {
    const found = [];
    const shape = new THREE.SphereGeometry(1, 16, 12);
    const paint = new THREE.MeshLambertMaterial({ color: 0xcc79a7, transparent: true, opacity: 0.45, depthWrite: false });
    const meshes = new THREE.InstancedMesh(shape, paint, balls.rows);
    const matrix = new THREE.Matrix4();
    for (let k = 0; k < balls.rows; k++) {
      const radius = balls.data[(k + 1) * balls.width - 1];
      const place = this.at({ ...balls, width: balls.width, data: withoutRadius(balls) }, k);
      matrix.makeScale(radius, radius, radius).setPosition(place);
      meshes.setMatrixAt(k, matrix);
    }
    meshes.frustumCulled = false;
    found.push(meshes);
    if (sample.rows > 1) found.push(this.line({ points: sample, kind: "path", group: 3, fate: "" }));
    return found;
  }

  clear() {
    for (const child of [...this.group.children]) {
      child.geometry.dispose();
      child.material.dispose();
      this.group.remove(child);
    }
  }
}

/** Centres of balls in the form of points; in the plane the third number is the radius, which isn't a height. */
function withoutRadius(balls) {
  if (balls.width > 3) return balls.data;
  const data = balls.data.slice();
  for (let k = 0; k < balls.rows; k++) data[(k + 1) * balls.width - 1] = 0;
  return data;
}
