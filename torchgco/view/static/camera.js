// A camera that turns around a point, by mouse, touch and keys. z is up.
import * as THREE from "./three.module.min.js";

const STEEPEST = 0.499 * Math.PI;
const TURN = 0.006; // rad per pixel
const MARGIN = 1.05; // of the distance from which a box fits into the picture
const ZOOM = 1.0015; // per unit of the wheel
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export class Orbit {
  constructor(element, changed) {
    this.camera = new THREE.PerspectiveCamera(42, 1, 0.05, 1000);
    this.camera.up.set(0, 0, 1);
    this.target = new THREE.Vector3();
    this.azimuth = 0;
    this.elevation = 0.5;
    this.distance = 10;
    this.changed = changed;
    this.pointers = new Map();
    element.addEventListener("pointerdown", (event) => this.press(event, element));
    element.addEventListener("pointermove", (event) => this.move(event, element));
    for (const name of ["pointerup", "pointercancel"]) {
      element.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    element.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    element.addEventListener("keydown", (event) => this.key(event));
    element.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  get held() {
    return this.pointers.size > 0;
  }

  press(event, element) {
    element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  move(event, element) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
    if (this.pointers.size === 2) this.pinch(event, dx, dy, element);
    else if (event.buttons & 2 || event.shiftKey) this.pan(dx, dy, element);
    else this.turn(-dx * TURN, dy * TURN);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  /** Two fingers: their distance zooms, their middle pans. */
  pinch(event, dx, dy, element) {
    const [other] = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    const before = this.pointers.get(event.pointerId);
    const apart = (x, y) => Math.max(1, Math.hypot(x - other[0], y - other[1]));
    this.zoom(apart(...before) / apart(event.clientX, event.clientY));
    this.pan(0.5 * dx, 0.5 * dy, element);
  }

  wheel(event) {
    event.preventDefault();
    this.zoom(ZOOM ** event.deltaY);
  }

  key(event) {
    if (event.key in KEYS && !event.ctrlKey && !event.metaKey && !event.altKey) {
      const [x, y] = KEYS[event.key];
      if (event.shiftKey) this.pan(-30 * x, 30 * y, event.currentTarget);
      else this.turn(0.08 * x, 0.06 * y);
    } else if (event.key === "+" || event.key === "=") this.zoom(0.85);
    else if (event.key === "-") this.zoom(1 / 0.85);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  turn(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = Math.min(STEEPEST, Math.max(-STEEPEST, this.elevation + elevation));
    this.place();
  }

  zoom(factor) {
    this.distance = Math.min(1e5, Math.max(1e-3, this.distance * factor));
    this.place();
  }

  pan(dx, dy, element) {
    const scale = (2 * this.distance * Math.tan((this.camera.fov * Math.PI) / 360)) / element.clientHeight;
    const { elements } = this.camera.matrix;
    this.target.addScaledVector(new THREE.Vector3(elements[0], elements[1], elements[2]), -dx * scale);
    this.target.addScaledVector(new THREE.Vector3(elements[4], elements[5], elements[6]), dy * scale);
    this.place();
  }

  /** Look at the middle of a box from an azimuth and an elevation, rad, so far away that the box just fits in. */
  look(box, azimuth, elevation) {
    box.getCenter(this.target);
    this.azimuth = azimuth;
    this.elevation = Math.min(STEEPEST, Math.max(-STEEPEST, elevation));
    this.distance = 1;
    this.place();
    const tall = Math.tan((this.camera.fov * Math.PI) / 360);
    const inverse = this.camera.matrixWorldInverse.copy(this.camera.matrixWorld).invert();
    const corner = new THREE.Vector3();
    const far = Array.from({ length: 8 }, (_, i) => {
      corner.set(...["x", "y", "z"].map((axis, bit) => (i & (1 << bit) ? box.max : box.min)[axis])).applyMatrix4(inverse);
      return corner.z + 1 + Math.max(Math.abs(corner.x) / (tall * this.camera.aspect), Math.abs(corner.y) / tall);
    });
    this.distance = Math.max(...far, 1e-3) * MARGIN;
    this.place();
  }

  place() {
    const flat = Math.cos(this.elevation);
    const out = [Math.cos(this.azimuth) * flat, Math.sin(this.azimuth) * flat, Math.sin(this.elevation)];
    this.camera.position.copy(this.target).addScaledVector(new THREE.Vector3(...out), this.distance);
    this.camera.near = this.distance / 200;
    this.camera.far = this.distance * 20;
    this.camera.lookAt(this.target);
    this.camera.updateMatrix();
    this.camera.updateMatrixWorld();
    this.camera.updateProjectionMatrix();
    this.changed();
  }
}
