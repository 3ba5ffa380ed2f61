// Reads the scene in the page: base64 of a deflated safetensors file, as pipeline/webpage.py packs it.

// [page]
const HALVES = new Float32Array(65536).map((_, bits) => {
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  const sign = bits & 32768 ? -1 : 1;
  if (exponent === 0) {
    return sign * fraction * 2 ** -24;
  }
  return exponent === 31 ? NaN : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
});
const KINDS = {
  U8: Uint8Array,
  U16: Uint16Array,
  I32: Int32Array,
  U32: Uint32Array,
  F32: Float32Array,
  F64: Float64Array,
};

// Returns tensors by name as { values, shape }, half floats as Float32Array, and the JSON of the metadata.
// unpacked(share): called with the share that has been read.
export async function readPage(text, unpacked) {
  const letters = atob(text.trim());
  const packed = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; ++i) {
    packed[i] = letters.charCodeAt(i);
  }
  let read = 0;
  const counted = new TransformStream({
    transform(chunk, controller) {
      read += chunk.length;
      unpacked(read / packed.length);
      controller.enqueue(chunk);
    },
  });
  const deflated = new Blob([packed]).stream().pipeThrough(counted);
  const stream = deflated.pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const size = Number(new DataView(buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, size)));
  const tensors = {};
  const { __metadata__: metadata, ...listed } = header;
  for (const [name, { dtype, shape, data_offsets: offsets }] of Object.entries(listed)) {
    const [from, to] = offsets.map((offset) => 8 + size + offset);
    const bytes = buffer.slice(from, to);
    const values =
      dtype === "F16"
        ? Float32Array.from(new Uint16Array(bytes), (bits) => HALVES[bits])
        : new KINDS[dtype](bytes);
    tensors[name] = { values, shape };
  }
  return { tensors, meta: JSON.parse(metadata.page) };
}

const CHUNK = 256; // Gaussians that share the range of a column
const [MEAN, SCALE, QUATERNION, OPACITY, SH] = [0, 3, 6, 10, 11]; // the first column of each property

// Returns the Gaussians in the layout of textures: `means` (M, 3), relative to the page's origin; `geometry`, three
// layers of RGBA floats (mean and opacity, scales, unit quaternion); and `sh`, four coefficients per texel.
export function unpackGaussians({ low, high, ranges }, texels) {
  const [[columns, count], [wide], [, chunks]] = [low.shape, high.shape, ranges.shape];
  const value = (column, i) => {
    const at = column * count + i;
    const range = 2 * (column * chunks + Math.floor(i / CHUNK));
    const part = column < wide ? (low.values[at] + 256 * high.values[at]) / 65535 : low.values[at] / 255;
    return ranges.values[range] + part * (ranges.values[range + 1] - ranges.values[range]);
  };
  const layers = Math.ceil((columns - SH) / 4);
  const means = new Float32Array(3 * count);
  const geometry = new Float32Array(12 * texels);
  const sh = new Float32Array(4 * layers * texels);
  const quaternion = [0, 0, 0, 0];
  for (let i = 0; i < count; ++i) {
    for (let axis = 0; axis < 3; ++axis) {
      means[3 * i + axis] = geometry[4 * i + axis] = value(MEAN + axis, i);
      geometry[4 * (texels + i) + axis] = Math.exp(value(SCALE + axis, i));
    }
    geometry[4 * i + 3] = 1 / (1 + Math.exp(-value(OPACITY, i)));
    for (let k = 0; k < 4; ++k) {
      quaternion[k] = value(QUATERNION + k, i);
    }
    const length = Math.hypot(...quaternion) || 1;
    for (let k = 0; k < 4; ++k) {
      geometry[4 * (2 * texels + i) + k] = quaternion[k] / length;
    }
    for (let c = SH; c < columns; ++c) {
      sh[4 * (((c - SH) >> 2) * texels + i) + ((c - SH) & 3)] = value(c, i);
    }
  }
  return { count, means, geometry, sh, layers };
}
