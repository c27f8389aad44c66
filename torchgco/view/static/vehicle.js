// The body of a vehicle, and the ball or disc of its radius.
import * as THREE from "./three.module.min.js";

/** A vehicle of a radius, m, nose along x, z up; `kind` is "ball", "car", "quadrotor" or "dart". One with a body has its shape. */
export function vehicle(kind, radius, colour, flat, shape) {
  const group = new THREE.Group();
  const paint = new THREE.MeshLambertMaterial({ color: colour });
  const dark = new THREE.MeshLambertMaterial({ color: 0x30343a });
  if (shape) {
    group.add(...solids(shape, paint, dark, flat), ...shape.balls.map((ball) => reach(ball[3], colour, flat, ball)));
    return group;
  }
  const built = { ball, car, quadrotor, dart }[kind](radius, paint, dark, flat);
  built.forEach((mesh) => (mesh.castShadow = true));
  group.add(...built);
  if (kind !== "ball") group.add(reach(radius, colour, flat));
  return group;
}

/** The box that a body's balls cover, with a dark mark ahead; without one the balls are all there is. */
function solids({ balls, box }, paint, dark, flat) {
  if (!box) return balls.map(([x, y, z, radius]) => placed(ball(0.98 * radius, paint, dark, flat)[0], x, y, z));
  const [low, high] = box;
  const [long, wide] = [high[0] - low[0], high[1] - low[1]];
  const tall = flat ? 0.3 * wide : high[2] - low[2];
  const middle = [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), flat ? 0 : 0.5 * (low[2] + high[2])];
  const mark = [low[0] + 0.72 * long, middle[1], middle[2] + 0.03 * tall];
  const made = [mesh(new THREE.BoxGeometry(long, wide, tall), paint, middle)];
  made.push(mesh(new THREE.BoxGeometry(0.12 * long, 0.8 * wide, tall), dark, mark));
  made.forEach((one) => (one.castShadow = true));
  return made;
}

function placed(one, x, y, z) {
  one.position.set(x, y, z);
  one.castShadow = true;
  return one;
}

function mesh(geometry, material, place = [0, 0, 0]) {
  const made = new THREE.Mesh(geometry, material);
  made.position.set(...place);
  return made;
}

function ball(radius, paint, dark, flat) {
  if (!flat) return [mesh(new THREE.SphereGeometry(radius, 24, 16), paint)];
  const disc = mesh(new THREE.CylinderGeometry(radius, radius, 0.6 * radius, 32), paint);
  disc.rotation.x = 0.5 * Math.PI;
  return [disc];
}

function car(radius, paint, dark) {
  const body = mesh(new THREE.BoxGeometry(1.5 * radius, 0.8 * radius, 0.4 * radius), paint, [0, 0, 0.1 * radius]);
  const cabin = mesh(new THREE.BoxGeometry(0.6 * radius, 0.66 * radius, 0.3 * radius), dark, [-0.15 * radius, 0, 0.42 * radius]);
  const wheels = [-1, 1].flatMap((x) =>
    [-1, 1].map((y) =>
      mesh(new THREE.CylinderGeometry(0.22 * radius, 0.22 * radius, 0.16 * radius, 14), dark, [
        0.46 * x * radius, 0.42 * y * radius, -0.08 * radius,
      ]),
    ),
  );
  return [body, cabin, ...wheels];
}

/** A pointed body with a fin: which way is ahead and which is up is all that it tells. */
function dart(radius, paint, dark) {
  const body = mesh(new THREE.ConeGeometry(0.45 * radius, 1.5 * radius, 24), paint, [0.1 * radius, 0, 0]);
  body.rotation.z = -0.5 * Math.PI;
  body.scale.z = 0.5;
  const fin = mesh(new THREE.BoxGeometry(0.4 * radius, 0.06 * radius, 0.45 * radius), dark, [-0.43 * radius, 0, 0.2 * radius]);
  return [body, fin];
}

function quadrotor(radius, paint, dark) {
  const arm = 0.66 * radius; // from the centre to a rotor's axis; with the rotor it ends at the vehicle's radius
  const meshes = [mesh(new THREE.BoxGeometry(0.5 * radius, 0.34 * radius, 0.2 * radius), paint)];
  meshes.push(mesh(new THREE.ConeGeometry(0.1 * radius, 0.3 * radius, 12), paint, [0.38 * radius, 0, 0]));
  meshes[1].rotation.z = -0.5 * Math.PI; // the nose
  for (const angle of [0.25, 0.75, 1.25, 1.75].map((turn) => turn * Math.PI)) {
    const rod = mesh(new THREE.BoxGeometry(arm, 0.08 * radius, 0.06 * radius), dark);
    rod.position.set(0.5 * arm * Math.cos(angle), 0.5 * arm * Math.sin(angle), 0);
    rod.rotation.z = angle;
    const rotor = mesh(new THREE.CylinderGeometry(0.33 * radius, 0.33 * radius, 0.03 * radius, 20), paint);
    rotor.position.set(arm * Math.cos(angle), arm * Math.sin(angle), 0.1 * radius);
    rotor.rotation.x = 0.5 * Math.PI;
    meshes.push(rod, rotor);
  }
  return meshes;
}

/** What obstacles count: a ball, in the plane a disc. */
function reach(radius, colour, flat, place = [0, 0, 0]) {
  const look = { color: colour, transparent: true, opacity: 0.16, depthWrite: false };
  const shape = flat ? new THREE.CircleGeometry(radius, 40) : new THREE.SphereGeometry(radius, 24, 16);
  return mesh(shape, new THREE.MeshLambertMaterial(look), place.slice(0, 3));
}
