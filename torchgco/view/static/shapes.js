// All obstacles of a layout in one draw call: rounded boxes. A sphere has no sides, a capsule one, a sharp box no radius.
// A kind of obstacles that isn't made of rounded boxes gets its own mesh here.
import * as THREE from "./three.module.min.js";

const MANY = 60; // shapes from which on each has fewer corners
export const NONE = 1e9; // m: so high that there is no ceiling
const LONG = 0.35; // half sides longer than this share of the scene are cut where the scene ends
export const SUN = new THREE.Vector3(-0.25, -0.4, 0.88).normalize();

/** The rounded box with half sides `corner` and radius 1 of `offset`: every vertex is half * corner + radius * offset.
 *
 * With a single side, along z, as of trunks and spheres, the corners around z are one: fewer points do.
 */
function solid(steps, rings, single) {
  const corners = [];
  const offsets = [];
  const index = [];
  const ring = single ? circle(3 * steps + 1) : quarterTurns(4, steps);
  const levels = [];
  for (const up of [-1, 1]) {
    for (let i = 0; i <= rings; i++) levels.push({ up, angle: ((up < 0 ? i - rings : i) / rings) * 0.5 * Math.PI });
  }
  for (const { up, angle } of levels) {
    for (const { x, y, sx, sy } of ring) {
      corners.push(sx, sy, up);
      offsets.push(Math.cos(angle) * x, Math.cos(angle) * y, Math.sin(angle));
    }
  }
  const count = ring.length;
  for (let level = 0; level + 1 < levels.length; level++) {
    for (let i = 0; i < count; i++) {
      const a = level * count + i;
      const b = level * count + ((i + 1) % count);
      index.push(a, b, b + count, a, b + count, a + count);
    }
  }
  if (single) return { corners, offsets, normals: offsets, index };
  const quarter = steps + 1; // the first corner of each quarter
  const top = (levels.length - 1) * count;
  index.push(top, top + quarter, top + 2 * quarter, top, top + 2 * quarter, top + 3 * quarter);
  index.push(0, 2 * quarter, quarter, 0, 3 * quarter, 2 * quarter);
  return { corners, offsets, normals: offsets, index };
}

/** The same for the plane, and for trunks that are cut: a prism, rounded in the plane alone, with a lid. */
function prism(steps, single) {
  const corners = [];
  const offsets = [];
  const normals = [];
  const index = [];
  const ring = single ? circle(3 * steps + 1) : quarterTurns(4, steps);
  for (const up of [-1, 1]) {
    for (const { x, y, sx, sy } of ring) {
      corners.push(sx, sy, up);
      offsets.push(x, y, 0);
      normals.push(x, y, 0);
    }
  }
  const count = ring.length;
  for (let i = 0; i < count; i++) {
    const next = (i + 1) % count;
    index.push(i, next, count + next, i, count + next, count + i);
    corners.push(ring[i].sx, ring[i].sy, 1);
    offsets.push(ring[i].x, ring[i].y, 0);
    normals.push(0, 0, 1);
    if (i > 1) index.push(2 * count, 2 * count + i - 1, 2 * count + i);
  }
  return { corners, offsets, normals, index };
}

/** Directions around z. */
function circle(count) {
  const angles = Array.from({ length: count }, (_, i) => (2 * Math.PI * i) / count);
  return angles.map((angle) => ({ x: Math.cos(angle), y: Math.sin(angle), sx: 0, sy: 0 }));
}

/** Directions around z with both ends of each quarter, and the signs of its corner. */
function quarterTurns(quarters, steps) {
  const found = [];
  for (let quarter = 0; quarter < quarters; quarter++) {
    const middle = (quarter + 0.5) * 0.5 * Math.PI;
    for (let i = 0; i <= steps; i++) {
      const angle = (quarter + i / steps) * 0.5 * Math.PI;
      const signs = { sx: Math.sign(Math.cos(middle)), sy: Math.sign(Math.sin(middle)) };
      found.push({ x: Math.cos(angle), y: Math.sin(angle), ...signs });
    }
  }
  return found;
}

// Long shapes end where the scene does: their corners are moved there, which leaves a flat end. Above a ceiling nothing
// is shown; `rise` holds half the height of a shape, and 1 where that can be cut, as its sides are straight.
const SHAPE = `
attribute vec3 corner; attribute vec3 middle; attribute vec3 sides; attribute float radius;
attribute vec4 turn; attribute vec3 velocity; attribute vec3 cut; attribute vec2 rise;
uniform float time; uniform float grown; uniform float ceiling; uniform vec3 low; uniform vec3 high;
#ifdef STRAIGHT
#define turned(q, v) (v)
#else
vec3 turned(vec4 q, vec3 v) { return v + 2.0 * cross(q.yzw, cross(q.yzw, v) + q.x * v); }
#endif
vec3 whole() { return middle + time * velocity + turned(turn, corner * sides + (radius + grown) * position); }
vec3 placed(vec3 p) {
  if (middle.z + time * velocity.z - rise.x > ceiling) return middle;
  vec3 q = mix(p, clamp(p, low, high), cut);
  return vec3(q.xy, rise.y > 0.5 ? min(q.z, ceiling) : q.z);
}
vec3 faced(vec3 p) {
  vec3 n = turned(turn, normal);
  vec3 over = cut * (step(high, p) - step(p, low));
  return dot(over, n) > 0.001 ? normalize(over) : n;
}
`;
// Light is computed at the corners alone: without a graphics card every pixel counts.
const PLAIN = {
  vertexShader: `${SHAPE}
    uniform vec3 colour; uniform vec3 sun; varying vec3 shade;
    void main() {
      vec3 p = whole();
      vec3 n = faced(p);
      vec3 light = mix(vec3(0.42, 0.40, 0.38), vec3(0.66, 0.67, 0.69), 0.5 + 0.5 * n.z) + 0.5 * max(0.0, dot(n, sun));
      shade = pow(colour * light, vec3(1.0 / 2.2));
      gl_Position = projectionMatrix * viewMatrix * vec4(placed(p), 1.0);
    }`,
  fragmentShader: "uniform float opacity; varying vec3 shade; void main() { gl_FragColor = vec4(shade, opacity); }",
};

function plain(colour, opacity, uniforms, straight) {
  const own = { colour: { value: colour }, opacity: { value: opacity }, sun: { value: SUN } };
  const made = new THREE.ShaderMaterial({ ...PLAIN, uniforms: { ...uniforms, ...own } });
  if (straight) made.defines.STRAIGHT = true;
  made.transparent = opacity < 1;
  made.depthWrite = opacity === 1;
  return made;
}

/** A material of three.js for the shapes, with shadows, for pictures that stand still. */
function shaded(kind, options, uniforms) {
  const made = new THREE[kind](options);
  made.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, uniforms);
    shader.vertexShader = (SHAPE + shader.vertexShader)
      .replace("#include <beginnormal_vertex>", "vec3 objectNormal = faced(whole());")
      .replace("#include <begin_vertex>", "vec3 transformed = placed(whole());");
  };
  return made;
}

/** The obstacles of a layout, of which those of a phase are there while it lasts. */
export function obstacles(parts, phases, space, colours, still) {
  const sets = phases.length
    ? phases.map(({ radius }, i) => obstaclesOf(parts.filter((one) => one.phase === i), { ...space, radius }, colours, still))
    : [obstaclesOf(parts, space, colours, still)];
  const group = new THREE.Group();
  group.add(...sets.map((set) => set.group));
  const each = (name) => [name, (value) => sets.forEach((set) => set[name](value))];
  return {
    group,
    unknown: sets.find((set) => set.unknown)?.unknown ?? null,
    ...Object.fromEntries(["setCeiling", "setGrown", "setUnknown", "setSeeThrough", "dispose"].map(each)),
    setClocks: ({ times, present }) =>
      sets.forEach((set, i) => {
        set.group.visible = i === present;
        set.setTime(times[i]);
      }),
  };
}

/** Obstacles as meshes, and the numbers that the scene changes later. */
function obstaclesOf(parts, space, colours, still) {
  const group = new THREE.Group();
  const uniforms = Object.fromEntries(
    Object.entries({ time: 0, low: space.low, high: space.high, grown: 0, ceiling: NONE }).map(([name, value]) => [name, { value }]),
  );
  const colour = new THREE.Color(colours.obstacle);
  const straight = parts.every((part) => !part.turn);
  const unknown = plain(new THREE.Color(colours.unknown), 0.45, uniforms, straight);
  const solids = still ? shaded("MeshLambertMaterial", { color: colour }, uniforms) : plain(colour, 1, uniforms, straight);
  const clear = plain(colour, 0.3, uniforms, straight);
  const hull = plain(colour, 0.18, { ...uniforms, grown: { value: space.radius } }, straight);
  const shadow = shaded("MeshDepthMaterial", { depthPacking: THREE.RGBADepthPacking }, uniforms);
  const meshes = [];
  const shells = [];
  const unseen = parts.filter((part) => part.unknown).map((part) => new THREE.Mesh(geometryOf(part, space, still), unknown));
  for (const part of parts.filter((one) => !one.unknown)) {
    const geometry = geometryOf(part, space, still);
    const mesh = new THREE.Mesh(geometry, solids);
    mesh.castShadow = mesh.receiveShadow = true;
    mesh.customDepthMaterial = shadow;
    meshes.push(mesh);
  }
  const add = (...more) => {
    more.forEach((one) => (one.frustumCulled = false));
    if (more.length) group.add(...more);
  };
  add(...meshes, ...unseen);
  const until = Math.min(...parts.map((part) => part.until ?? Infinity), Infinity);
  return {
    group,
    setCeiling: (z) => (uniforms.ceiling.value = z ?? NONE),
    setTime: (t) => {
      uniforms.time.value = Math.min(t, until);
      [...meshes, ...shells].forEach((mesh) => mesh.geometry.follow?.(uniforms.time.value));
    },
    setGrown: (on) => {
      if (on && !shells.length) {
        const counted = parts.filter((part) => part.unknown !== "free");
        shells.push(...counted.map((part) => new THREE.Mesh(geometryOf(part, space, still, true), hull)));
        shells.forEach((mesh) => mesh.geometry.follow?.(uniforms.time.value));
        add(...shells);
      }
      shells.forEach((shell) => (shell.visible = on));
    },
    unknown: parts.find((part) => part.unknown)?.unknown ?? null,
    setUnknown: (on) => unseen.forEach((mesh) => (mesh.visible = on)),
    setSeeThrough: (on) => meshes.forEach((mesh) => (mesh.material = on ? clear : solids)),
    dispose: () => {
      [solids, clear, hull, shadow, unknown].forEach((one) => one.dispose());
      [...meshes, ...shells, ...unseen].forEach((mesh) => mesh.geometry.dispose());
    },
  };
}

/** The six sides of sharp boxes, such as the cells of a map. */
function sharp() {
  const box = new THREE.BoxGeometry(2, 2, 2);
  const corners = [...box.attributes.position.array];
  return { corners, offsets: corners.map(() => 0), normals: [...box.attributes.normal.array], index: [...box.index.array] };
}

/** The simplest solid that all shapes of a part can be made of. */
function templateOf(part, { sides, cut }, flat, still, grown) {
  const [steps, rings] = still ? [10, 8] : part.count > MANY ? [3, 2] : [6, 5];
  if (!grown && part.radius.data.every((radius) => radius === 0)) return sharp();
  if (flat) return prism(2 * steps);
  const single = sides.every((half, i) => i % 3 === 2 || half === 0);
  const flatEnds = single && cut.every((long, i) => i % 3 !== 2 || long === 1);
  return flatEnds && !grown ? prism(steps, true) : solid(steps, rings, single);
}

function geometryOf(part, space, still, grown) {
  const rows = instances(part, space);
  const template = templateOf(part, rows, space.flat, still, grown);
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.instanceCount = part.count;
  geometry.setIndex(template.index);
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(template.offsets, 3));
  geometry.setAttribute("normal", new THREE.Float32BufferAttribute(template.normals, 3));
  geometry.setAttribute("corner", new THREE.Float32BufferAttribute(template.corners, 3));
  for (const [name, size] of Object.entries({ middle: 3, sides: 3, radius: 1, turn: 4, velocity: 3, cut: 3, rise: 2 })) {
    geometry.setAttribute(name, new THREE.InstancedBufferAttribute(rows[name], size));
  }
  if (part.track) geometry.follow = (t) => follow(geometry.attributes.middle, part, space.flat ? 2 : 3, t);
  return geometry;
}

/** Moves shapes along their track to where they are at time t. */
export function follow(middle, part, dimension, t) {
  const at = Math.min(Math.max(t / part.step, 0), part.knots - 1);
  const before = Math.min(Math.floor(at), part.knots - 2);
  for (let k = 0; k < part.count; k++) {
    for (let i = 0; i < dimension; i++) {
      const [from, to] = [before, before + 1].map((knot) => part.track.data[(knot * part.count + k) * part.track.width + i]);
      middle.array[3 * k + i] = from + (at - before) * (to - from) + part.middle[i];
    }
  }
  middle.needsUpdate = true;
}

/** Numbers per shape, in space also where they are given in the plane. */
export function instances(part, space) {
  const row = (array, k) => (array ? Math.min(k, array.rows - 1) * array.width : 0);
  const sizes = { middle: 3, sides: 3, radius: 1, turn: 4, velocity: 3, cut: 3, rise: 2 };
  const found = Object.fromEntries(
    Object.entries(sizes).map(([name, size]) => [name, new Float32Array(size * part.count)]),
  );
  for (let k = 0; k < part.count; k++) {
    for (let i = 0; i < (space.flat ? 2 : 3); i++) {
      found.middle[3 * k + i] = part.center.data[row(part.center, k) + i] + part.middle[i];
      found.sides[3 * k + i] = part.half.data[row(part.half, k) + i];
      if (part.velocity) found.velocity[3 * k + i] = part.velocity.data[row(part.velocity, k) + i];
    }
    if (space.flat) found.middle[3 * k + 2] = found.sides[3 * k + 2] = 0.5 * space.height;
    found.radius[k] = part.radius.data[row(part.radius, k)];
    found.turn.set(turnOf(part.turn, row(part.turn, k)), 4 * k);
    if (space.flat) continue;
    found.cut.set(cuts(found, k, space), 3 * k);
    found.rise.set(riseOf(found, k), 2 * k);
  }
  return found;
}

/** 1 for the axes along which shape k is long and straight, else 0: only then does a moved corner leave it straight. */
function cuts({ sides, radius, turn }, k, space) {
  const [w, x, y, z] = turn.subarray(4 * k, 4 * k + 4);
  const quaternion = new THREE.Quaternion(x, y, z, w);
  const found = [0, 0, 0];
  for (let i = 0; i < 3; i++) {
    const half = sides[3 * k + i];
    if (half + radius[k] <= LONG * space.size) continue;
    const along = new THREE.Vector3().setComponent(i, 1).applyQuaternion(quaternion).toArray().map(Math.abs);
    const axis = along.indexOf(Math.max(...along));
    if (along[axis] > 0.99999 && half > 0) found[axis] = 1;
  }
  return found;
}

/** Half the height of shape k, and whether it is a sharp box that stands upright. */
function riseOf({ sides, radius, turn }, k) {
  const [w, x, y, z] = turn.subarray(4 * k, 4 * k + 4);
  const quaternion = new THREE.Quaternion(x, y, z, w);
  const along = [0, 1, 2].map((i) => Math.abs(new THREE.Vector3().setComponent(i, 1).applyQuaternion(quaternion).z));
  const half = along.reduce((sum, share, i) => sum + share * sides[3 * k + i], radius[k]);
  return [half, radius[k] === 0 && along[2] > 0.99999 ? 1 : 0];
}

function turnOf(turn, at) {
  if (!turn) return [1, 0, 0, 0];
  if (turn.width === 4) return turn.data.subarray(at, at + 4);
  const half = 0.5 * turn.data[at];
  return [Math.cos(half), 0, 0, Math.sin(half)];
}
