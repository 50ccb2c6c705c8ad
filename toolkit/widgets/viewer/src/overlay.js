import { minus, plus, reversed, rotated, times } from "./vectors.js";

// Readable on light and dark pictures alike.
export const COLOURS = { train: "#3b82f6", test: "#f59e0b", query: "#ec4899", start: "#a78bfa" };
// How far, in pixels, a click may be from a camera's centre.
const REACH = 12;

// Apex and corners of a camera's pyramid, in world axes.
function pyramid({ position, rotation, lens }, length) {
  const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([x, y]) => {
    const across = [(x * lens.width - lens.cx) / lens.fx, (y * lens.height - lens.cy) / lens.fy, 1];
    return plus(position, rotated(rotation, times(length, across)));
  });
  return [position, ...corners];
}

const EDGES = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]];

// The cameras as they are seen from a view: their points in camera axes.
function seen(cameras, length, view) {
  const inverse = reversed(view.rotation);
  return cameras.map((camera) => pyramid(camera, length).map((point) => rotated(inverse, minus(point, view.position))));
}

// The part of a line that is in front of the viewer, null where none is.
function inFront(a, b, near) {
  if (a[2] < near && b[2] < near) return null;
  const cut = (p, q) => (p[2] >= near ? p : plus(p, times((near - p[2]) / (q[2] - p[2]), minus(q, p))));
  return [cut(a, b), cut(b, a)];
}

// Draw all cameras; the chosen one is drawn thicker.
export function drawCameras(context, navigation, scene, chosen, width, height) {
  const { fx, fy, cx, cy } = navigation.projection(width, height);
  const pixel = ([x, y, z]) => [(fx * x) / z + cx, (fy * y) / z + cy];
  seen(scene.cameras, scene.frustum, navigation).forEach((points, number) => {
    const { use } = scene.cameras[number];
    context.strokeStyle = COLOURS[use];
    context.lineWidth = number === chosen ? 3 : use === "query" ? 2.5 : 1.2;
    context.globalAlpha = number === chosen || use === "query" ? 1 : 0.8;
    context.setLineDash(use === "start" ? [4, 4] : []);
    context.beginPath();
    for (const [i, j] of EDGES) {
      const line = inFront(points[i], points[j], 0.02 * scene.frustum);
      if (!line) continue;
      context.moveTo(...pixel(line[0]));
      context.lineTo(...pixel(line[1]));
    }
    context.stroke();
  });
  context.globalAlpha = 1;
  context.setLineDash([]);
}

function inside([x, y], polygon) {
  let odd = false;
  polygon.forEach(([ax, ay], i) => {
    const [bx, by] = polygon[(i + 1) % polygon.length];
    if (ay > y !== by > y && x < ax + ((y - ay) / (by - ay)) * (bx - ax)) odd = !odd;
  });
  return odd;
}

// The number of the nearest camera under a place of the picture, -1 where there is none. Whoever stands in a
// camera looks through it, and clicks on what is behind.
export function cameraAt(place, navigation, scene, width, height) {
  const { fx, fy, cx, cy } = navigation.projection(width, height);
  const pixel = ([x, y, z]) => [(fx * x) / z + cx, (fy * y) / z + cy];
  let found = -1, nearest = Infinity;
  seen(scene.cameras, scene.frustum, navigation).forEach((points, number) => {
    if (points.some((point) => point[2] < 0.1 * scene.frustum)) return;
    const [apex, ...corners] = points.map(pixel);
    const hit = Math.hypot(apex[0] - place[0], apex[1] - place[1]) < REACH || inside(place, corners);
    if (hit && points[0][2] < nearest) [found, nearest] = [number, points[0][2]];
  });
  return found;
}
