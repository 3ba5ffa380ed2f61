// The scene in a headset (WebXR), drawn by the page's painter once per eye. The room of WebXR is in metres with y up;
// at the start the eyes are at its origin and look along -z.

import { add, axes, cross, unit } from "./camera.js";

// [page]
const FLY = 1.5; // metres per second at full deflection of a stick
const TURN_BY = 30; // degrees per push of the right stick to a side
const DEAD_ZONE = 0.2; // of a stick
const AWAY = 1.5; // metres to the pivot of the page's camera in a scene of unknown scale

export class Headset {
  constructor(page) {
    Object.assign(this, { page, session: null });
  }

  // Start a session at the page's camera, or end it; rejects if the browser or the user refuses.
  async toggle() {
    if (this.session) {
      return this.session.end();
    }
    const { painter, controls, meta } = this.page;
    await painter.gl.makeXRCompatible();
    const session = await navigator.xr.requestSession("immersive-vr");
    session.addEventListener("end", () => {
      this.session = null;
      this.page.redraw();
    });
    const layer = new XRWebGLLayer(session, painter.gl, { antialias: false, depth: false });
    session.updateRenderState({ baseLayer: layer });
    const room = await session.requestReferenceSpace("local");
    const [side, , ahead] = axes(controls.view);
    const right = unit(add(cross(ahead, meta.up), side, 1e-6)); // also if the camera looks straight down
    const frame = [right, 0, meta.up, 0, cross(right, meta.up), 0, controls.view.position, 1].flat();
    const metres = meta.metres_per_unit ?? AWAY / controls.distance;
    const toScene = new DOMMatrix(frame).scale3d(1 / metres); // from room to scene
    Object.assign(this, { session, layer, toScene, last: null, aside: 0 });
    const next = (now, frame) => {
      session.requestAnimationFrame(next);
      const pose = frame.getViewerPose(room); // null while the device is not tracked
      if (pose) {
        this.draw(pose, now);
      }
    };
    session.requestAnimationFrame(next);
  }

  // Fly in the direction of the head by the left stick, turn about the head by the right one.
  move(head, seconds) {
    for (const { handedness, gamepad } of this.session.inputSources) {
      const stick = gamepad?.axes.slice(-2) ?? [];
      const [x = 0, y = 0] = stick.map((part) => (Math.abs(part) > DEAD_ZONE ? part : 0));
      if (handedness === "right") {
        const eyes = Array.from(head.slice(12, 15));
        const turned = this.toScene.translate(...eyes).rotate(0, this.aside ? 0 : -TURN_BY * Math.sign(x), 0);
        this.toScene = turned.translate(...eyes.map((part) => -part));
        this.aside = x;
      } else {
        const step = [0, 1, 2].map((i) => FLY * seconds * (x * head[i] + y * head[8 + i]));
        this.toScene.translateSelf(...step);
      }
    }
  }

  // Rotation and position in the scene of a camera with a pose in the room.
  camera(pose) {
    const matrix = this.toScene.multiply(new DOMMatrix(pose)).scale(1, -1, -1).toFloat64Array();
    const [right, down, ahead, position] = [0, 4, 8, 12].map((k) => Array.from(matrix.slice(k, k + 3)));
    return { rotation: [right, down, ahead].flatMap(unit), position };
  }

  draw({ transform, views }, now) {
    const { page, layer } = this;
    this.move(transform.matrix, Math.min((now - (this.last ?? now)) / 1000, 0.1));
    this.last = now;
    page.painter.sort(this.camera(transform.matrix));
    for (const view of views) {
      const { x, y, width, height } = layer.getViewport(view);
      const p = view.projectionMatrix;
      const focal = { fx: (p[0] * width) / 2, fy: (p[5] * height) / 2 };
      const centre = { cx: ((1 - p[8]) * width) / 2, cy: ((1 + p[9]) * height) / 2 };
      const camera = { ...this.camera(view.transform.matrix), ...focal, ...centre, width, height };
      page.painter.paint(camera, page.appearance(), { framebuffer: layer.framebuffer, x, y, width, height });
    }
  }
}
