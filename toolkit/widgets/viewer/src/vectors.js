// Vectors are arrays of three numbers, rotations unit quaternions [w, x, y, z].

export const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const times = (factor, a) => a.map((value) => factor * value);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export const norm = (a) => Math.hypot(...a);
export const unit = (a) => times(1 / norm(a), a);
export const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

// The rotation by an angle (radians) about a unit vector.
export function turn(axis, angle) {
  return [Math.cos(angle / 2), ...times(Math.sin(angle / 2), axis)];
}

// First q, then p.
export function after(p, q) {
  const [a, b, c, d] = p, [w, x, y, z] = q;
  return unit([
    a * w - b * x - c * y - d * z,
    a * x + b * w + c * z - d * y,
    a * y - b * z + c * w + d * x,
    a * z + b * y - c * x + d * w,
  ]);
}

export function rotated(q, v) {
  const axis = [q[1], q[2], q[3]], twice = times(2, cross(axis, v));
  return plus(plus(v, times(q[0], twice)), cross(axis, twice));
}

export const reversed = (q) => [q[0], -q[1], -q[2], -q[3]];

// From p (share 0) to q (share 1) along the shorter way (Shoemake 1985).
export function between(p, q, share) {
  let cosine = p.reduce((sum, value, i) => sum + value * q[i], 0);
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(1, Math.abs(cosine));
  const angle = Math.acos(cosine);
  if (angle < 1e-6) return q;
  const a = Math.sin((1 - share) * angle) / Math.sin(angle);
  const b = (sign * Math.sin(share * angle)) / Math.sin(angle);
  return unit(p.map((value, i) => a * value + b * q[i]));
}

// The smallest rotation that brings unit vector a to unit vector b.
export function leading(a, b) {
  const cosine = dot(a, b), axis = cross(a, b);
  if (norm(axis) < 1e-9) return cosine > 0 ? [1, 0, 0, 0] : null;
  return turn(unit(axis), Math.atan2(norm(axis), cosine));
}
