// Spatial relations between instances: the twin of query/relations.py, where the numbers (`space`) come from.

import { add, axes, inner } from "./camera.js";
import { quantile } from "./rule.js";

// [page]
// Distances from points to the nearest of others, without zero distances of a point to itself.
const distances = (points, others) =>
  points.map((point) => {
    let least = Infinity;
    for (const other of others) {
      const square = (other[0] - point[0]) ** 2 + (other[1] - point[1]) ** 2 + (other[2] - point[2]) ** 2;
      least = square < least && other !== point ? square : least;
    }
    return Math.sqrt(least);
  });
// What boxes are apart at least.
const apart = (one, other) =>
  Math.hypot(
    ...[0, 1, 2].map((k) => Math.max(one.least[k] - other.most[k], other.least[k] - one.most[k], 0)),
  );
const gap = (one, other) => Math.min(...distances(one.points, other.points));
const between = (low, value, high) => low <= value && value <= high;

export class Space {
  // frame: rotation of the world into axes of which the last is up, by rows.
  constructor({ space, frame }) {
    Object.assign(this, space, { frame });
  }

  // The body of an instance's points, in these axes.
  body(points) {
    const rows = [0, 3, 6].map((row) => this.frame.slice(row, row + 3));
    const step = Math.max(1, Math.ceil(points.length / this.sample));
    const some = points.filter((_, i) => i % step === 0);
    const own = some.map((point) => rows.map((axis) => inner(axis, point)));
    const columns = [0, 1, 2].map((k) => own.map((point) => point[k]));
    const shares = [0, ...this.inner, 1];
    const [least, low, high, most] = shares.map((share) => columns.map((column) => quantile(column, share)));
    const sides = add(high, low, -1);
    return { points: own, least, low, high, most, centre: add(low, sides, 0.5), size: Math.hypot(...sides) };
  }

  // A body's centre in a camera's axes: right, down, ahead.
  seen({ centre }, camera) {
    const column = (axis) => [0, 3, 6].map((row) => this.frame[row + axis]);
    const place = [0, 1, 2].map((axis) => inner(column(axis), centre));
    return axes(camera).map((axis) => inner(axis, add(place, camera.position, -1)));
  }

  // The tangent of the angle to the right of the viewing direction; NaN behind the camera.
  right(body, camera) {
    const [x, , z] = this.seen(body, camera);
    return z > 0 ? x / z : NaN;
  }

  on(what, anchor) {
    anchor.spacing ??= quantile(distances(anchor.points, anchor.points), 0.5);
    const reach = this.touch * Math.min(what.size, anchor.size) + anchor.spacing;
    const away = apart(what, anchor) < reach ? distances(what.points, anchor.points) : [];
    const heights = what.points.filter((_, i) => away[i] < reach).map((point) => point[2]);
    const above = what.centre[2] > anchor.low[2] && this.over(what, anchor);
    const foot = what.low[2] + this.foot * (what.high[2] - what.low[2]);
    const stands = above && heights.reduce((sum, z) => sum + z, 0) <= foot * heights.length;
    const lies = heights.length >= this.flat * what.points.length;
    return heights.length > 0 && what.size <= anchor.size && (stands || lies);
  }

  // Whether the centre of one body, seen from above, lies within another.
  over({ centre }, { low, high }) {
    return [0, 1].every((k) => between(low[k], centre[k], high[k]));
  }

  in(what, anchor) {
    const height = what.high[2] - what.low[2];
    const rim = add(anchor.high, [0, 0, 0.5 * height]); // it may stick out of an open vessel
    const sunk = what.low[2] <= anchor.high[2] - this.sunk * height;
    const inside = what.points.filter((point) => point.every((x, k) => between(anchor.low[k], x, rim[k])));
    const held = sunk && inside.length >= this.held * what.points.length;
    return held && what.size < anchor.size && this.over(what, anchor);
  }

  above(what, anchor) {
    const over = [0, 1].every((k) => what.low[k] <= anchor.high[k] && anchor.low[k] <= what.high[k]);
    return over && what.centre[2] > anchor.high[2] && what.low[2] > anchor.centre[2];
  }

  stands(kind, what, anchor, camera) {
    const reach = (what.size + anchor.size) / 2;
    const [z, anchorZ] = [what, anchor].map((body) => this.seen(body, camera)[2]);
    const aside = (this.right(what, camera) - this.right(anchor, camera)) * anchorZ;
    const close = this.near * Math.min(what.size, anchor.size);
    const facing = Math.abs(aside) <= reach;
    const ways = {
      on: () => this.on(what, anchor),
      in: () => this.in(what, anchor),
      near: () => apart(what, anchor) <= close && gap(what, anchor) <= close,
      above: () => this.above(what, anchor),
      below: () => this.above(anchor, what),
      "left of": () => -aside > this.aside * reach,
      "right of": () => aside > this.aside * reach,
      behind: () => facing && z - anchorZ > this.aside * reach,
      "in front of": () => facing && anchorZ - z > this.aside * reach,
    };
    return ways[kind]();
  }

  // The instances in relation `kind` to one of the anchors; for a superlative the `count` most extreme.
  chosen(kind, some, anchors, camera, count) {
    const bodies = (things) => things.map((thing) => ({ ...thing, ...this.body(thing.points) }));
    const [things, others] = [some, anchors].map(bodies);
    const away = (body) =>
      others.length
        ? Math.min(...others.map((other) => gap(body, other)))
        : Math.hypot(...this.seen(body, camera));
    const [most, sign] = {
      biggest: [({ size }) => size, 1],
      smallest: [({ size }) => size, -1],
      highest: [({ centre }) => centre[2], 1],
      lowest: [({ centre }) => centre[2], -1],
      farthest: [away, 1],
      nearest: [away, -1],
      rightmost: [(body) => this.right(body, camera), 1],
      leftmost: [(body) => this.right(body, camera), -1],
    }[kind] ?? [null, 0];
    if (!most) {
      const same = ({ rows }, other) =>
        [...rows].filter((row) => other.rows.has(row)).length >= this.half * rows.size;
      return things.filter((thing) =>
        others.some((other) => this.stands(kind, thing, other, camera) && !same(thing, other)),
      );
    }
    const value = (thing) => {
      const measured = sign * most(thing);
      return Number.isNaN(measured) ? -Infinity : measured;
    };
    return things.toSorted((a, b) => value(b) - value(a)).slice(0, count);
  }
}
