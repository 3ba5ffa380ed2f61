// How wholes stand to each other: the twin of query/relations.py. What follows from points that touch was computed
// when the page was made (`pairs`); all else follows from the bounds of the wholes in axes of which the last is up.

import { add, axes, inner } from "./camera.js";

// [page]
export class Space {
  // frame: rotation of the world into those axes, by rows; aside: of the mean size, what is closer is level.
  constructor({ counts, space }, { bodies, pairs }) {
    Object.assign(this, space, { bodies, first: counts[0] + counts[1] });
    const number = (i) =>
      `${space.kinds[pairs[i]]} ${this.first + pairs[i + 1]} ${this.first + pairs[i + 2]}`;
    this.pairs = new Set(Array.from({ length: pairs.length / 3 }, (_, pair) => number(3 * pair)));
  }

  body(whole) {
    const at = 6 * (whole - this.first);
    const [low, high] = [at, at + 3].map((from) => Array.from(this.bodies.subarray(from, from + 3)));
    const sides = add(high, low, -1);
    return { low, high, centre: add(low, sides, 0.5), size: Math.hypot(...sides) };
  }

  // A body's centre as a camera has it: right, down, ahead.
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

  above(what, anchor) {
    const over = [0, 1].every((k) => what.low[k] <= anchor.high[k] && anchor.low[k] <= what.high[k]);
    return over && what.centre[2] > anchor.high[2] && what.low[2] > anchor.centre[2];
  }

  stands(kind, thing, other, camera) {
    const [what, anchor] = [this.body(thing), this.body(other)];
    const reach = (what.size + anchor.size) / 2;
    const [z, anchorZ] = [what, anchor].map((body) => this.seen(body, camera)[2]);
    const aside = (this.right(what, camera) - this.right(anchor, camera)) * anchorZ;
    const facing = Math.abs(aside) <= reach;
    const ways = {
      above: () => this.above(what, anchor),
      below: () => this.above(anchor, what),
      "left of": () => -aside > this.aside * reach,
      "right of": () => aside > this.aside * reach,
      behind: () => facing && z - anchorZ > this.aside * reach,
      "in front of": () => facing && anchorZ - z > this.aside * reach,
    };
    return ways[kind]?.() ?? this.pairs.has(`${kind} ${thing} ${other}`);
  }

  // Those of some wholes that stand so to one of the others; of a superlative the `count` that are most so.
  chosen(kind, things, others, camera, count) {
    const gap = (a, b) =>
      Math.hypot(...a.low.map((low, k) => Math.max(0, low - b.high[k], b.low[k] - a.high[k])));
    const away = (body) =>
      others.length
        ? Math.min(...others.map((other) => gap(body, this.body(other))))
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
      return things.filter((thing) =>
        others.some((other) => other !== thing && this.stands(kind, thing, other, camera)),
      );
    }
    const value = (thing) => {
      const measured = sign * most(this.body(thing));
      return Number.isNaN(measured) ? -Infinity : measured;
    };
    return things.toSorted((a, b) => value(b) - value(a)).slice(0, count);
  }
}
