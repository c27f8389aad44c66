// What is said about the trajectory under the pointer.
import * as THREE from "./three.module.min.js";

const NEAR = 12; // pixels

/** The nearest knot of the visible flights to a place on the screen; null where none is near. */
export function pick(flights, camera, x, y, width, height) {
  let best = null;
  const seen = new THREE.Vector3();
  for (const one of flights.all) {
    if (!one.group.visible) continue;
    one.points.forEach((place, k) => {
      seen.copy(place).project(camera);
      if (seen.z > 1) return;
      const apart = Math.hypot((0.5 + 0.5 * seen.x) * width - x, (0.5 - 0.5 * seen.y) * height - y);
      if (apart <= NEAR && (!best || apart < best.apart)) best = { ...one, k, apart };
    });
  }
  return best;
}

/** The lines of the hover: layout, solver and result, time, what the table says, and what is violated at this knot. */
export function linesOf(label, { name, flight, points, k }, flights) {
  const { head } = flights;
  const place = points[k].toArray().slice(0, head.dimension);
  const lines = [`${label}, ${name}: ${flight.result}`];
  lines.push(`knot ${k}, t = ${flights.timeOf(k + (flight.phase?.first ?? 0), flight).toFixed(2)} s`);
  lines.push(`at (${place.map((value) => value.toFixed(2)).join(", ")}) m`);
  lines.push(...flight.rows.map(([label, text]) => `${label}: ${text}`));
  const here = flight.violated.find(([knot]) => knot === k);
  if (here) lines.push(`here violated: ${head.constraints[here[2]] ?? "a constraint"} by ${here[1]}`);
  if (flight.notes[k]) lines.push(flight.notes[k]);
  return lines;
}

export function showHover(element, lines, x, y, width) {
  element.hidden = !lines;
  if (!lines) return;
  element.replaceChildren(
    ...lines.map((text, i) => {
      const line = document.createElement(i === 0 ? "strong" : "span");
      line.textContent = text;
      return line;
    }),
  );
  element.style.left = `${Math.min(x + 14, width - element.offsetWidth - 8)}px`;
  element.style.top = `${Math.max(8, y - element.offsetHeight - 10)}px`;
}
