// Tubes along polylines.
import * as THREE from "./three.module.min.js";

export const AROUND = 6; // corners of a tube's section

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
export function tube(points, radius, material, around = AROUND) {
  const moved = points.filter((place, k) => k === 0 || place.distanceTo(points[k - 1]) > 1e-9);
  if (moved.length < 2) return null;
  // Points that coincide would have no direction: the same number of pieces, spread a little.
  const spread = moved.length === points.length ? points : spreadOut(points);
  return new THREE.Mesh(new THREE.TubeGeometry(new Polyline(spread), spread.length - 1, radius, around), material);
}

function spreadOut(points) {
  const tiny = 1e-7 * (1 + points[0].length());
  return points.map((place, k) => place.clone().addScalar(tiny * k));
}

/** Take out every other piece of a tube, of a length, where it runs within `near` of one of other courses. */
export function dashWhereShared(geometry, points, others, near, length) {
  let passed = 0;
  for (let k = 0; k + 1 < points.length; k++) {
    passed += points[k].distanceTo(points[k + 1]);
    if (Math.floor(passed / length) % 2 === 0) continue;
    const middle = points[k].clone().lerp(points[k + 1], 0.5);
    if (!others.some((other) => isNear(middle, other, near))) continue;
    const block = geometry.index.count / (points.length - 1);
    for (let i = k * block; i < (k + 1) * block; i++) geometry.index.setX(i, 0);
  }
}

function isNear(place, points, near) {
  const closest = new THREE.Vector3();
  const piece = new THREE.Line3();
  return points.some((start, k) => {
    const end = points[Math.min(k + 1, points.length - 1)];
    return piece.set(start, end).closestPointToPoint(place, true, closest).distanceTo(place) < near;
  });
}
