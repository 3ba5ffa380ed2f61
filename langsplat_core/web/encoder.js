// The text half of CLIP for a closed vocabulary: the twin of semantics/clip_plain.py.

import { sigmoid } from "./rule.js";
import { nearest } from "./words.js";

// [page]
// Error for a phrase that cannot be searched: message, unknown word, and a known word like it.
export class PhraseError extends Error {
  constructor(message, word = "", near = "") {
    super(message);
    Object.assign(this, { word, near });
  }
}

// The dot product of `size` numbers of two arrays, from an offset in each.
export function dot(a, firstOfA, b, size, firstOfB = 0) {
  let sum = 0;
  for (let i = 0; i < size; ++i) {
    sum += a[firstOfA + i] * b[firstOfB + i];
  }
  return sum;
}

export class ClipText {
  // described: { words, config, begin, end }; weight(name): values of a tensor; dim: length of vectors.
  constructor(described, weight, dim) {
    Object.assign(this, described, { weight, dim, width: described.config.hidden_size });
  }

  // The unit vector of a phrase. PhraseError for words that it was never taught.
  encode(key) {
    const ids = this.tokenNumbers(key);
    const { config, width } = this;
    const gelu = (value) => value * sigmoid(1.702 * value);
    let states = this.embedded(ids);
    for (let number = 0; number < config.num_hidden_layers; ++number) {
      const layer = (name) => `text_model.encoder.layers.${number}.${name}`;
      const seen = this.normed(layer("layer_norm1"), states);
      const attended = this.attention(layer("self_attn."), seen, ids.length);
      states = states.map((value, i) => value + attended[i]);
      const inner = this.linear(layer("mlp.fc1"), this.normed(layer("layer_norm2"), states), width);
      const outer = this.linear(layer("mlp.fc2"), inner.map(gelu), config.intermediate_size);
      states = states.map((value, i) => value + outer[i]);
    }
    const end = states.subarray((ids.length - 1) * width);
    const last = this.normed("text_model.final_layer_norm", end);
    const projection = this.weight("text_projection.weight");
    const vector = Float32Array.from({ length: this.dim }, (_, i) => dot(projection, i * width, last, width));
    const length = Math.max(Math.sqrt(dot(vector, 0, vector, this.dim)), 1e-6);
    return vector.map((value) => value / length);
  }

  tokenNumbers(key) {
    const ids = [this.begin];
    for (const word of key.match(/[\p{L}\p{N}]+(?:'[\p{L}\p{N}]+)?/gu) || []) {
      const known = [word, word.split("'")[0]].find((form) => Object.hasOwn(this.words, form));
      if (known === undefined) {
        const near = nearest(word, Object.keys(this.words));
        throw new PhraseError(`This page's encoder was never taught “${word}”.`, word, near);
      }
      ids.push(...this.words[known]);
    }
    if (ids.length > this.config.max_position_embeddings - 1 || ids.length === 1) {
      throw new PhraseError("Use fewer, plain words.");
    }
    return [...ids, this.end];
  }

  embedded(ids) {
    const token = this.weight("text_model.embeddings.token_embedding.weight");
    const position = this.weight("text_model.embeddings.position_embedding.weight");
    const { width } = this;
    const one = (id, row) =>
      Array.from({ length: width }, (_, i) => token[id * width + i] + position[row * width + i]);
    return Float32Array.from(ids.flatMap(one));
  }

  linear(name, states, width) {
    const weight = this.weight(`${name}.weight`);
    const bias = this.weight(`${name}.bias`);
    const rows = states.length / width;
    const out = new Float32Array(rows * bias.length);
    for (let row = 0; row < rows; ++row) {
      for (let i = 0; i < bias.length; ++i) {
        out[row * bias.length + i] = bias[i] + dot(weight, i * width, states, width, row * width);
      }
    }
    return out;
  }

  // Layer normalisation of rows.
  normed(name, states) {
    const { width } = this;
    const weight = this.weight(`${name}.weight`);
    const bias = this.weight(`${name}.bias`);
    const out = new Float32Array(states.length);
    for (let row = 0; row < states.length; row += width) {
      const values = states.subarray(row, row + width);
      const mean = values.reduce((sum, value) => sum + value, 0) / width;
      const variance = values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / width;
      const spread = Math.sqrt(variance + this.config.layer_norm_eps);
      for (let i = 0; i < width; ++i) {
        out[row + i] = ((values[i] - mean) / spread) * weight[i] + bias[i];
      }
    }
    return out;
  }

  // Causal self-attention: each token attends to itself and to those before it.
  attention(name, states, length) {
    const { width } = this;
    const size = width / this.config.num_attention_heads;
    const [query, key, value] = [..."qkv"].map((part) => this.linear(`${name}${part}_proj`, states, width));
    const mixed = new Float32Array(states.length);
    for (let head = 0; head < width; head += size) {
      for (let row = 0; row < length; ++row) {
        const scores = Array.from({ length: row + 1 }, (_, other) => {
          return dot(query, row * width + head, key, size, other * width + head) * size ** -0.5;
        });
        const top = Math.max(...scores);
        const weights = scores.map((score) => Math.exp(score - top));
        const total = weights.reduce((sum, weight) => sum + weight, 0);
        for (let other = 0; other <= row; ++other) {
          for (let i = head; i < head + size; ++i) {
            mixed[row * width + i] += (weights[other] / total) * value[other * width + i];
          }
        }
      }
    }
    return this.linear(`${name}out_proj`, mixed, width);
  }
}
