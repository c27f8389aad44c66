// The numbers of the page: base64, deflated, half precision. The other side is torchgco/view/packing.py.

const KEY = "$";

/** Inflate a part of the page: its text, in which every reference to an array has become {data, shape}. */
export async function part(name) {
  const element = document.getElementById(name);
  if (!element) throw new Error(`the page has no ${name}`);
  const letters = atob(element.textContent);
  const packed = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) packed[i] = letters.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const whole = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(whole.buffer).getUint32(0, true);
  const text = JSON.parse(new TextDecoder().decode(whole.subarray(4, 4 + length)));
  return resolved(text, whole.subarray(4 + length));
}

function resolved(value, bytes) {
  if (Array.isArray(value)) return value.map((one) => resolved(one, bytes));
  if (value === null || typeof value !== "object") return value;
  if (KEY in value) return array(value, bytes);
  return Object.fromEntries(Object.entries(value).map(([name, one]) => [name, resolved(one, bytes)]));
}

/** An array from its planes of bytes: lowest ones first, two for half precision, four for whole numbers. */
function array({ [KEY]: place, shape, steps, whole }, bytes) {
  if (whole) return wholes(place, shape, bytes);
  const count = shape.reduce((product, size) => product * size, 1);
  const width = count / Math.max(1, shape[0]);
  const data = new Float32Array(count);
  const sums = new Float64Array(width);
  for (let i = 0; i < count; i++) {
    const number = half(bytes[place + i] | (bytes[place + count + i] << 8));
    data[i] = steps ? (sums[i % width] += number) : number;
  }
  return { data, shape, rows: shape[0], width };
}

/** Whole numbers from their differences, modulo 2^32. */
function wholes(place, shape, bytes) {
  const [count] = shape;
  const data = new Uint32Array(count);
  let sum = 0;
  for (let i = 0; i < count; i++) {
    for (let plane = 0; plane < 4; plane++) sum += bytes[place + plane * count + i] * 2 ** (8 * plane);
    data[i] = sum %= 2 ** 32;
  }
  return { data, shape, rows: count, width: 1 };
}

/** The number that 16 bits stand for in half precision. */
export function half(bits) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 0x1f;
  const fraction = bits & 0x3ff;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

/** Row k of an array as [x, y, z]; z is 0 in the plane. */
export function point(points, k) {
  const at = k * points.width;
  return [points.data[at], points.data[at + 1], points.width > 2 ? points.data[at + 2] : 0];
}

/** The point between rows of an array at a time that is no whole number of knots. */
export function between(points, knots) {
  const last = points.rows - 1;
  const k = Math.min(Math.max(knots, 0), last);
  const low = Math.floor(k);
  const share = k - low;
  const a = point(points, low);
  const b = point(points, Math.min(low + 1, last));
  return a.map((value, i) => value + share * (b[i] - value));
}
