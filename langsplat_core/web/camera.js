// Cameras in OpenCV's frame (x right, y down, z forward) and their control by mouse, touch and keys.
// A camera is { width, height, fx, fy, cx, cy, rotation, position }: rotation is 3 x 3 world to camera, by
// rows; positions are relative to the page's origin.

// [page]
export const add = (a, b, times = 1) => a.map((value, i) => value + times * b[i]);
export const inner = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
export const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));
export const axes = ({ rotation }) => [rotation.slice(0, 3), rotation.slice(3, 6), rotation.slice(6, 9)];

// A vector rotated about a unit axis, by Rodrigues' formula.
function turned(vector, axis, angle) {
  const cosine = Math.cos(angle);
  const sine = Math.sin(angle);
  const along = inner(axis, vector) * (1 - cosine);
  const side = cross(axis, vector);
  return vector.map((value, i) => value * cosine + side[i] * sine + axis[i] * along);
}

// The rotation from six numbers: a direction down, which is made perpendicular, and the direction ahead.
function upright(directions) {
  const ahead = unit(directions.slice(3));
  const right = unit(cross(directions.slice(0, 3), ahead));
  return [...right, ...cross(ahead, right), ...ahead];
}

// The position of a point in a camera's image, pixels, and its depth.
export function project(camera, point) {
  const [x, y, z] = axes(camera).map((axis) => inner(axis, add(point, camera.position, -1)));
  return [(camera.fx * x) / z + camera.cx, (camera.fy * y) / z + camera.cy, z];
}

// The points of a box's (8, 3) corners.
export const cornersOf = (box) =>
  Array.from({ length: 8 }, (_, k) => Array.from(box.slice(3 * k, 3 * k + 3)));

const STEP = 24; // pixels of a drag that equals one press of an arrow key
const FLIGHT = 700; // ms
const FLYING = { w: [2, 1], s: [2, -1], a: [0, -1], d: [0, 1] }; // axis of the camera, and direction
const SPEED = 0.6; // radii per second
const TURN = 60; // speed of the turntable, pixels of a drag per second

export class Controls {
  // page.moved() is called when the camera's pose changes; page.free() returns left, top, width and height of the area
  // without a panel, in CSS pixels.
  constructor(element, page) {
    const { radius, up } = page.meta;
    Object.assign(this, { element, page, radius, up, moving: 0, pointers: new Map() });
    this.held = new Set(); // keys that fly, while they are pressed
    this.calm = matchMedia("(prefers-reduced-motion: reduce)");
    element.addEventListener("pointerdown", (event) => this.down(event));
    element.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      element.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    const wheel = (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
    };
    element.addEventListener("wheel", wheel, { passive: false });
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("keyup", (event) => this.held.delete(event.key.toLowerCase()));
    addEventListener("blur", () => this.held.clear());
  }

  // The camera that fills the window, at `dots` pixels per CSS pixel: the view's whole image is centred in the free
  // area.
  camera(dots) {
    const { view } = this;
    const [left, top, across, along] = this.page.free().map((length) => length * dots);
    const scale = Math.min(across / view.width, along / view.height);
    return {
      width: Math.max(Math.round(innerWidth * dots), 1),
      height: Math.max(Math.round(innerHeight * dots), 1),
      fx: view.fx * scale,
      fy: view.fy * scale,
      cx: (view.cx - view.width / 2) * scale + left + across / 2,
      cy: (view.cy - view.height / 2) * scale + top + along / 2,
      rotation: view.rotation,
      position: view.position,
    };
  }

  down(event) {
    this.element.setPointerCapture(event.pointerId);
    this.element.focus({ preventScroll: true });
    this.moving++;
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  move(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) {
      return;
    }
    const here = [event.clientX, event.clientY];
    const [dx, dy] = add(here, last, -1);
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, here);
    if (other) {
      this.pan(dx / 2, dy / 2);
      const [now, before] = [here, last].map((place) => Math.hypot(...add(place, other, -1)));
      this.zoom(now / Math.max(before, 1));
    } else if (event.shiftKey || event.buttons & 6) {
      this.pan(dx, dy);
    } else {
      this.orbit(dx, dy);
    }
  }

  // Move by a key; returns whether the key moves the camera.
  key(event) {
    const arrow = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (arrow) {
      this[event.shiftKey ? "pan" : "orbit"](STEP * arrow[0], STEP * arrow[1]);
    } else if (event.key === "+" || event.key === "=") {
      this.zoom(1.15);
    } else if (event.key === "-") {
      this.zoom(1 / 1.15);
    } else if (FLYING[event.key.toLowerCase()]) {
      this.held.add(event.key.toLowerCase());
      this.run();
    } else {
      return false;
    }
    return true;
  }

  // Start or stop the turntable; returns whether it turns.
  spin() {
    this.spinning = !this.spinning;
    this.run();
    return this.spinning;
  }

  // Move in every frame while the turntable is on or a key is held.
  run(last = performance.now()) {
    if (this.running) {
      return;
    }
    this.running = requestAnimationFrame(() => {
      const now = performance.now();
      const seconds = Math.min((now - last) / 1000, 0.2);
      this.running = 0;
      if (this.spinning && !this.pointers.size) {
        this.orbit(-TURN * seconds, 0);
      }
      for (const [axis, side] of Array.from(this.held, (key) => FLYING[key])) {
        const { rotation, position } = this.view;
        this.moving++;
        this.pose(rotation, add(position, axes(this.view)[axis], side * SPEED * this.radius * seconds));
      }
      if (this.spinning || this.held.size) {
        this.run(now);
      }
    });
  }

  pose(rotation, position) {
    this.view = this.end = { ...this.view, rotation, position };
    this.page.moved();
  }

  // Orbit around the pivot, `distance` ahead, by a drag in pixels; never over the pole.
  orbit(dx, dy) {
    this.moving++;
    const { up, view } = this;
    const pivot = this.pivot();
    const angle = Math.PI / Math.max(innerWidth, innerHeight);
    let rows = axes(view).map((axis) => turned(axis, up, -dx * angle));
    const right = rows[0];
    const lifted = rows.map((axis) => turned(axis, right, -dy * angle));
    const [before, after] = [rows, lifted].map(([, , ahead]) => Math.abs(inner(ahead, up)));
    if (after < 0.995 || after < before) {
      rows = lifted;
    }
    this.pose(rows.flat(), add(pivot, rows[2], -this.distance));
  }

  pan(dx, dy) {
    this.moving++;
    const [right, down] = axes(this.view);
    const { fx } = this.camera(1);
    const perPixel = this.distance / fx;
    const aside = add(this.view.position, right, -dx * perPixel);
    this.pose(this.view.rotation, add(aside, down, -dy * perPixel));
  }

  // Approach the pivot by a factor; close to it, move the pivot ahead.
  zoom(factor) {
    this.moving++;
    const ahead = axes(this.view)[2];
    const least = 0.05 * this.radius;
    const pivot = this.pivot();
    const distance = Math.min(this.distance / factor, 50 * this.radius);
    const step = distance < least ? (this.distance * (factor - 1)) / factor : 0;
    this.distance = Math.max(distance, least);
    const position = step ? add(this.view.position, ahead, step) : add(pivot, ahead, -this.distance);
    this.pose(this.view.rotation, position);
  }

  pivot() {
    return add(this.view.position, axes(this.view)[2], this.distance);
  }

  // Fly to a view, or to a pose: position, direction down, direction ahead, and distance of the pivot. For a view the
  // pivot is as far ahead as the centre of the scene.
  go(view, moved = null) {
    if (moved) {
      const pose = { rotation: upright(moved.slice(3, 9)), position: moved.slice(0, 3) };
      return this.fly({ ...view, ...pose }, Math.max(moved[9], 0.05 * this.radius));
    }
    const ahead = view.rotation.slice(6, 9);
    this.fly(view, Math.max(-inner(view.position, ahead), 0.3 * this.radius));
  }

  // Face a box's (8, 3) corners in the present direction, at the distance where they fill half of the view.
  face(corners) {
    const points = cornersOf(corners);
    const middle = points.reduce((sum, point) => add(sum, point, 1 / 8), [0, 0, 0]);
    const reach = Math.max(...points.map((point) => Math.hypot(...add(point, middle, -1))));
    const [, , width, height] = this.page.free();
    const { fx } = this.camera(1);
    const distance = Math.max((4 * reach * fx) / Math.min(width, height), 0.1 * this.radius);
    const [, , ahead] = axes(this.view);
    this.fly({ ...this.view, position: add(middle, ahead, -distance) }, distance);
  }

  fly(view, distance) {
    const from = this.view;
    const turn = ++this.moving;
    const begun = performance.now();
    Object.assign(this, { distance, end: view }); // end: the pose after the flight
    if (!from || this.calm.matches) {
      this.view = view;
      return this.page.moved();
    }
    const step = (now) => {
      if (turn !== this.moving) {
        return; // something else moves the camera
      }
      const time = Math.min((now - begun) / FLIGHT, 1);
      const share = time * time * (3 - 2 * time);
      const mixed = add(from.rotation, add(view.rotation, from.rotation, -1), share);
      const rotation = upright(mixed.slice(3));
      const position = add(from.position, add(view.position, from.position, -1), share);
      this.view = time === 1 ? view : { ...view, rotation, position };
      this.page.moved();
      if (time < 1) {
        requestAnimationFrame(step);
      }
    };
    requestAnimationFrame(step);
  }
}
