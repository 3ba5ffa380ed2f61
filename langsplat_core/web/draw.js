// The renderer: WebGL 2 with the shaders of the OpenGL backend, in three passes: project every Gaussian for a
// camera, splat a quad of each back to front, compose the displayed image.

import { add, inner } from "./camera.js";
import { unpackGaussians } from "./data.js";

// [page]
// In a worker: sorts Gaussians ahead of the near plane back to front by camera z, of equal ones the later first; for
// a coarse image only the large ones.
function sortWorker() {
  let means;
  let large;
  onmessage = ({ data }) => {
    if (data.means) {
      ({ means, large } = data);
      return;
    }
    const { plane, near, far, ticket, coarse } = data;
    const [a, b, c, d] = plane;
    const count = means.length / 3;
    const depth = new Float32Array(1);
    const bits = new Uint32Array(depth.buffer);
    let keys = new Uint32Array(count);
    let rows = new Int32Array(count);
    let ahead = 0;
    for (let i = count - 1; i >= 0; --i) {
      depth[0] = a * means[3 * i] + b * means[3 * i + 1] + c * means[3 * i + 2] + d;
      if (!(depth[0] > near && depth[0] <= far) || (coarse && !large[i])) {
        continue;
      }
      keys[ahead] = ~bits[0]; // positive floats have the order of their bits
      rows[ahead++] = i;
    }
    let otherKeys = new Uint32Array(ahead);
    let otherRows = new Int32Array(ahead);
    for (const shift of [0, 16]) {
      const places = new Uint32Array(65537);
      for (let i = 0; i < ahead; ++i) {
        places[((keys[i] >>> shift) & 65535) + 1]++;
      }
      for (let digit = 0; digit < 65536; ++digit) {
        places[digit + 1] += places[digit];
      }
      for (let i = 0; i < ahead; ++i) {
        const place = places[(keys[i] >>> shift) & 65535]++;
        otherKeys[place] = keys[i];
        otherRows[place] = rows[i];
      }
      [keys, otherKeys, rows, otherRows] = [otherKeys, keys, otherRows, rows];
    }
    const order = rows.slice(0, ahead);
    postMessage({ order, ticket }, [order.buffer]);
  };
}

// Marks the 40 % of the Gaussians that cover most, by opacity times the area of their faces.
function large(geometry, count, texels) {
  const covered = Float32Array.from({ length: count }, (_, i) => {
    const at = 4 * (texels + i); // its scales
    const [x, y, z] = [geometry[at], geometry[at + 1], geometry[at + 2]];
    return geometry[4 * i + 3] * (x * y + y * z + z * x);
  });
  const least = covered.toSorted()[Math.trunc(0.6 * count)];
  return Uint8Array.from(covered, (area) => (area >= least ? 1 : 0));
}

export class Painter {
  // Throws an Error with a message for the user if this browser cannot draw the scene.
  constructor(canvas, meta, tensors) {
    const options = { antialias: false, alpha: false, powerPreference: "high-performance" };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) {
      throw new Error("This browser offers no WebGL 2, which the scene is drawn with.");
    }
    if (!gl.getExtension("EXT_color_buffer_float")) {
      throw new Error("This browser's graphics cannot draw into float textures.");
    }
    Object.assign(this, { gl, canvas, meta });
    const count = tensors.low.shape[1];
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.columns = Math.min(4096, most, count);
    this.rows = Math.ceil(count / this.columns);
    if (this.rows > most) {
      throw new Error(
        `This browser's graphics hold ${most * most} Gaussians at most; the scene has ${count}.`,
      );
    }
    const texels = this.columns * this.rows;
    const scene = unpackGaussians(tensors, texels);
    this.count = count;
    this.places = scene.geometry.slice(0, 4 * count); // mean and opacity of each Gaussian
    this.geometry = this.layers(gl.RGBA32F, 3, scene.geometry);
    this.sh = this.layers(gl.RGBA16F, scene.layers, scene.sh);
    this.projected = this.target(this.columns, this.rows, Array(3).fill(gl.RGBA32F));
    this.extra = this.texture(gl.RGBA32F, this.columns, this.rows);
    this.values = new Float32Array(4 * texels);
    const maps = tensors.colour_maps.values;
    this.colourMaps = this.texture(gl.RGBA8, 256, maps.length / 768);
    const rgba = Uint8Array.from({ length: (4 * maps.length) / 3 }, (_, i) =>
      i % 4 === 3 ? 255 : maps[3 * (i >> 2) + (i % 4)],
    );
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, maps.length / 768, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    const programs = Object.entries(meta.shaders).map(([name, pair]) => [name, this.program(...pair)]);
    this.programs = Object.fromEntries(programs);
    this.quads = gl.createVertexArray();
    this.order = gl.createBuffer();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.bindVertexArray(null);
    this.drawn = 0; // Gaussians in `order`
    const code = URL.createObjectURL(new Blob([`(${sortWorker})()`], { type: "text/javascript" }));
    this.worker = new Worker(code);
    const given = { means: scene.means, large: large(scene.geometry, count, texels) };
    this.worker.postMessage(given, [scene.means.buffer]);
    this.worker.onmessage = ({ data }) => this.sorted(data);
    this.ticket = 0;
    this.waiting = [];
  }

  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const source of [vertex, fragment]) {
      const made = gl.createShader(source === vertex ? gl.VERTEX_SHADER : gl.FRAGMENT_SHADER);
      gl.shaderSource(made, source);
      gl.compileShader(made);
      gl.attachShader(program, made);
      if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) {
        throw new Error(gl.getShaderInfoLog(made));
      }
    }
    gl.bindAttribLocation(program, 0, "gaussian");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      throw new Error(gl.getProgramInfoLog(program));
    }
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); ++i) {
      const { name, type } = gl.getActiveUniform(program, i);
      uniforms[name.replace("[0]", "")] = { type, at: gl.getUniformLocation(program, name) };
    }
    return { program, uniforms };
  }

  // Use a program with these uniforms, arrays in memory order; names that it lacks are ignored.
  use(name, values) {
    const { gl } = this;
    const { program, uniforms } = this.programs[name];
    gl.useProgram(program);
    const floats = [gl.FLOAT, gl.FLOAT_VEC2, gl.FLOAT_VEC3, gl.FLOAT_VEC4]; // by length - 1
    for (const [key, value] of Object.entries(values)) {
      if (!uniforms[key]) {
        continue;
      }
      const { type, at } = uniforms[key];
      const list = [value].flat();
      if (type === gl.FLOAT_MAT3) {
        gl.uniformMatrix3fv(at, false, list);
      } else {
        gl[floats.includes(type) ? `uniform${floats.indexOf(type) + 1}fv` : "uniform1iv"](at, list);
      }
    }
  }

  bound(...textures) {
    const { gl } = this;
    textures.forEach(([target, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, texture);
    });
  }

  // size: width, height, and for an array texture the number of layers.
  texture(format, ...size) {
    const { gl } = this;
    const [kind, storage] = size[2] ? [gl.TEXTURE_2D_ARRAY, "texStorage3D"] : [gl.TEXTURE_2D, "texStorage2D"];
    const texture = gl.createTexture();
    gl.bindTexture(kind, texture);
    gl[storage](kind, 1, format, ...size);
    for (const key of ["MIN_FILTER", "MAG_FILTER", "WRAP_S", "WRAP_T"]) {
      gl.texParameteri(kind, gl[`TEXTURE_${key}`], key.endsWith("FILTER") ? gl.NEAREST : gl.CLAMP_TO_EDGE);
    }
    return texture;
  }

  layers(format, count, values) {
    const { gl } = this;
    const size = [this.columns, this.rows, count];
    const texture = this.texture(format, ...size);
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, 0, ...size, gl.RGBA, gl.FLOAT, values);
    return texture;
  }

  target(width, height, formats) {
    const { gl } = this;
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const textures = formats.map((format, i) => {
      const texture = this.texture(format, width, height);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
      return texture;
    });
    gl.drawBuffers(formats.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) {
      throw new Error("This browser's graphics refuse the images that the scene is drawn into.");
    }
    return { framebuffer, textures, width, height };
  }

  // Set up to three layers of values of the Gaussians to show besides colours.
  show(layers) {
    const { gl } = this;
    this.values.fill(0);
    layers.forEach((layer, c) => {
      for (let i = 0; i < this.count; ++i) {
        this.values[4 * i + c] = layer[i];
      }
    });
    gl.bindTexture(gl.TEXTURE_2D, this.extra);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, this.columns, this.rows, gl.RGBA, gl.FLOAT, this.values);
  }

  // Request the draw order for a camera; coarse: of large Gaussians only. One sort runs at a time, and only the newest
  // request waits. Resolves to true when the order of this camera has arrived, to false for that of a later one.
  sort(camera, coarse = false) {
    const { near, far } = this.meta.raster;
    const ahead = camera.rotation.slice(6, 9);
    const plane = [...ahead, -inner(ahead, camera.position)];
    if (this.coarse === coarse && plane.every((value, i) => value === this.plane[i])) {
      return this.last;
    }
    Object.assign(this, { plane, coarse });
    this.next = { plane, near, far: far ?? Infinity, ticket: ++this.ticket, coarse };
    if (!this.busy) {
      this.post();
    }
    this.last = new Promise((resolve) => this.waiting.push([this.ticket, resolve]));
    return this.last;
  }

  post() {
    this.busy = true;
    this.worker.postMessage(this.next);
    this.next = null;
  }

  sorted({ order, ticket }) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.drawn = order.length;
    this.busy = false;
    if (this.next) {
      this.post();
    }
    this.waiting = this.waiting.filter(([wanted, resolve]) => wanted > ticket || resolve(wanted === ticket));
    this.onorder?.();
  }

  // Draw into the canvas, which gets the camera's size, or into a part of a framebuffer: { framebuffer, x, y, width,
  // height }. appearance: { display, map, own, ranges, dim }.
  paint(camera, appearance, target = null) {
    const { width, height } = camera;
    if (!target && (this.canvas.width !== width || this.canvas.height !== height)) {
      Object.assign(this.canvas, { width, height });
    }
    this.resize(camera);
    this.project(camera);
    this.splat(camera);
    this.compose(target ?? { framebuffer: null, width, height }, appearance);
  }

  resize({ width, height }) {
    const { gl } = this;
    if (this.image?.width !== width || this.image?.height !== height) {
      if (this.image) {
        this.image.textures.forEach((texture) => gl.deleteTexture(texture));
        gl.deleteFramebuffer(this.image.framebuffer);
      }
      this.image = this.target(width, height, Array(2).fill(gl.RGBA16F));
    }
  }

  // Project every Gaussian into three textures: position, shape and colour.
  project(camera) {
    const { gl, meta } = this;
    const { width, height } = camera;
    const { raster } = meta;
    // As in raster.protocol.dilation.
    const ratio = raster.focal ? (camera.fx * camera.fy) / raster.focal ** 2 : 1;
    const growth = Math.abs(ratio - 1) < 1e-6 ? 1 : Math.min(ratio, 256);
    const fitted = raster.dilation * (raster.antialiased ? Math.max(growth, 1) : growth);
    const r = camera.rotation;
    const high = camera.position.map(Math.fround);
    const beyond = 0.5 * (raster.fov_clamp - 1); // of the image, on each side
    const tangents = [camera.cx, camera.cy, width - camera.cx, height - camera.cy].map((pixels, side) => {
      const [size, focal] = side % 2 ? [height, camera.fy] : [width, camera.fx];
      return (pixels + beyond * size) / focal;
    });
    this.use("project", {
      gaussians: 0,
      sh: 1,
      orthographic: 0,
      sh_count: meta.sh_count,
      dilation: raster.antialiased ? fitted : fitted + Math.max(1 - growth, 0) / 12,
      fitted: raster.antialiased ? 0 : fitted,
      alpha_min: raster.alpha_min,
      colour_max: 65504,
      focal: [camera.fx, camera.fy],
      principal: [camera.cx, camera.cy],
      world_to_camera: [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]],
      camera_high: high,
      camera_low: add(camera.position, high, -1),
      tangents,
    });
    this.bound([gl.TEXTURE_2D_ARRAY, this.geometry], [gl.TEXTURE_2D_ARRAY, this.sh]);
    this.pass(this.projected, null);
  }

  // Blend the quads of all Gaussians ahead.
  splat({ width, height }) {
    const { gl } = this;
    const { raster } = this.meta;
    this.use("splat", {
      placement: 0,
      shape: 1,
      values: [2, 3],
      columns: this.columns,
      image_size: [width, height],
      alpha_min: raster.alpha_min,
      alpha_max: raster.alpha_max,
    });
    const [placement, shape, colours] = this.projected.textures;
    this.bound(...[placement, shape, colours, this.extra].map((texture) => [gl.TEXTURE_2D, texture]));
    this.pass(this.image, this.quads);
  }

  // Turn blended values into the displayed image.
  compose(target, appearance) {
    const { gl, meta } = this;
    const { picture } = meta;
    this.use("compose", {
      colours: 0,
      extra: 1,
      colour_maps: 2,
      colour_map: appearance.map,
      query_colours: meta.query_colours.flat(),
      display: picture.displays[appearance.display],
      ranges: appearance.ranges.flat(),
      has_selection: 0,
      selection: 3,
      own_colours: +appearance.own,
      heat_opacity: picture.heat_opacity,
      dim: appearance.dim ?? picture.dim,
      threshold: picture.threshold,
      alpha_gate: picture.alpha_gate,
      background: picture.background,
      transparent: 0,
    });
    const textures = [...this.image.textures, this.colourMaps, this.colourMaps]; // nothing is selected
    this.bound(...textures.map((texture) => [gl.TEXTURE_2D, texture]));
    this.pass(target, null);
  }

  // Draw one triangle that covers a target, or blend the sorted quads.
  pass(target, quads) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(target.x ?? 0, target.y ?? 0, target.width, target.height);
    gl.bindVertexArray(quads);
    if (!quads) {
      return gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.drawn);
    gl.disable(gl.BLEND);
  }

  // The (height, width, 4) bytes of what `paint` drew in this task, bottom row first; waits until it is drawn.
  pixels({ width, height } = this.canvas) {
    const { gl } = this;
    const bytes = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return bytes;
  }
}
