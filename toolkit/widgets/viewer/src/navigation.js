import { after, between, clamp, cross, dot, leading, minus, norm, plus, rotated, times, turn, unit } from "./vectors.js";

// Closer to the zenith than this an orbit would have no direction.
const STEEPEST = (89.5 * Math.PI) / 180;
// What a person comes near to, as a share of the scene's radius.
const NEAREST = 0.005;

// Where the viewer stands: position, rotation (world_from_cam: x right, y down, z forward), the distance of the
// point about which it turns, and the lens, that of a picture which is shown whole.
export class Navigation {
  constructor(up, radius, camera) {
    this.up = unit(up);
    this.radius = radius;
    this.stand(camera);
  }

  // Stand where a camera stood and look as it did.
  stand({ position, rotation, distance, lens }) {
    Object.assign(this, { position, rotation, distance, lens });
  }

  // A share (0 to 1) of the way from one view to another.
  standBetween(from, to, share) {
    const mixed = (a, b) => a + share * (b - a);
    const lens = {};
    // Fields of view change smoothly, whatever the pictures' sizes.
    const size = to.lens.width / from.lens.width;
    for (const key of ["fx", "fy", "cx", "cy", "width", "height"]) lens[key] = mixed(size * from.lens[key], to.lens[key]);
    this.stand({
      position: from.position.map((value, i) => mixed(value, to.position[i])),
      rotation: between(from.rotation, to.rotation, share),
      distance: mixed(from.distance, to.distance),
      lens,
    });
  }

  get view() {
    const { position, rotation, distance, lens } = this;
    return { position, rotation, distance, lens };
  }

  get forward() {
    return rotated(this.rotation, [0, 0, 1]);
  }

  get right() {
    return rotated(this.rotation, [1, 0, 0]);
  }

  get down() {
    return rotated(this.rotation, [0, 1, 0]);
  }

  get target() {
    return plus(this.position, times(this.distance, this.forward));
  }

  // Turn about the target: by yaw about the upright axis, and by pitch (radians), positive lowers the viewer.
  orbit(yaw, pitch) {
    const target = this.target, forward = this.forward;
    const height = Math.asin(clamp(dot(forward, this.up), -1, 1));
    // Who looks straight up or down already may only turn away from there.
    const beyond = Math.abs(height) > STEEPEST;
    const allowed = beyond
      ? Math.sign(pitch) === Math.sign(height) ? 0 : pitch
      : clamp(height + pitch, -STEEPEST, STEEPEST) - height;
    const level = cross(forward, this.up);
    const axis = norm(level) > 1e-2 ? unit(level) : this.right;
    this.rotation = after(after(turn(this.up, yaw), turn(axis, allowed)), this.rotation);
    this.position = minus(target, times(this.distance, this.forward));
  }

  // Shift by shares of the distance to the target.
  pan(right, down) {
    this.move(right * this.distance, down * this.distance, 0);
  }

  // Walk, in units of the scene; the target comes along.
  move(right, down, forward) {
    const sideways = plus(times(right, this.right), times(down, this.down));
    this.position = plus(this.position, plus(sideways, times(forward, this.forward)));
  }

  // Change the distance to the target. Who comes very near pushes it on.
  approach(factor) {
    const target = this.target, nearest = NEAREST * this.radius;
    const wanted = clamp(this.distance * factor, 0, 100 * this.radius);
    this.position = minus(target, times(wanted, this.forward));
    this.distance = Math.max(wanted, nearest);
  }

  // Bring the horizon to lie level.
  level() {
    const forward = this.forward, level = cross(forward, this.up);
    if (norm(level) < 1e-3) return;
    const target = this.target, roll = leading(this.right, unit(level));
    this.rotation = after(roll ?? turn(forward, Math.PI), this.rotation);
    this.position = minus(target, times(this.distance, this.forward));
  }

  // Focal lengths and principal point, in pixels, of a picture in which the lens's picture is seen whole.
  projection(width, height) {
    const { fx, fy, cx, cy, width: w, height: h } = this.lens;
    const scale = Math.min(width / w, height / h);
    return {
      fx: scale * fx,
      fy: scale * fy,
      cx: width / 2 + scale * (cx - w / 2),
      cy: height / 2 + scale * (cy - h / 2),
    };
  }
}
