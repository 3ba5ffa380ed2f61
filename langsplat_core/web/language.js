// Phrases asked of the scene: read, encoded, compared with the codebook and answered by regions. The plain
// twin of scene/language.py, query/grammar.py, query/answers.py and semantics/clip_plain.py.

const sigmoid = (x) => 1 / (1 + Math.exp(-x));
const dot = (a, at, b, size, from = 0) => {
  let sum = 0;
  for (let k = 0; k < size; ++k) sum += a[at + k] * b[from + k];
  return sum;
};

// Words without quotes and punctuation around them, and commas, none at the end (scene/language.py, tokens).
export function tokens(text) {
  const plain = text
    .replace(/[’‘ʼ′＇´`]/gu, "'")
    .replace(/[\p{Cc}\p{Cs}]/gu, " ")
    .replace(/([\p{L}\p{N}_])\s+'s\b/gu, "$1's");
  const found = (plain.match(/,|[^\s,;]+/gu) || [])
    .map((piece) => (piece === "," ? piece : bare(piece)))
    .filter(Boolean);
  while (found[found.length - 1] === ",") found.pop();
  return found;
}

function bare(word) {
  if (word === "&") return word;
  const letters = [...word], mark = (letter) => /[\p{P}\p{Z}\p{Cf}]/u.test(letter);
  const first = letters.findIndex((letter) => !mark(letter));
  if (first < 0) return "";
  const last = letters.length - letters.toReversed().findIndex((letter) => !mark(letter));
  if (letters.slice(first, last).every((letter) => /[\p{Cf}\p{Po}\p{Mn}]/u.test(letter))) return "";
  const owns = letters[last] === "'" && first === 0 && letters[last - 1] === "s";
  return letters.slice(first, last).join("") + (owns ? "'" : "");
}

export const tidy = (text) =>
  tokens(text)
    .join(" ")
    .replaceAll(" ,", ",")
    .replace(/^[, ]+/, "");
export const phraseKey = (text) =>
  tokens(text)
    .filter((token) => token !== ",")
    .join(" ")
    .toLowerCase();

// What a browser says of a phrase that cannot be asked.
export class PhraseError extends Error {}

export class Language {
  constructor(meta, tensors) {
    this.meta = meta;
    this.t = Object.fromEntries(Object.entries(tensors).map(([name, { values }]) => [name, values]));
    [this.codes, this.dim] = tensors.codebook.shape;
    this.firsts = meta.counts.reduce((found, count) => [...found, found[found.length - 1] + count], [0]);
    this.keys = new Map(meta.keys.map((key, row) => [key, row]));
    this.taught = new Map(meta.taught.map((word, row) => [phraseKey(word.name), { ...word, row }]));
    this.sets = Object.fromEntries(
      ["articles", "stop_words", "adjectives", "parts"].map((name) => [name, new Set(meta.grammar[name])]),
    );
    this.shapes = tensors;
  }

  // "thing", "part" or "part of a thing".
  named(phrase) {
    const words = phrase.split(" "),
      last = words.pop().toLowerCase(), { parts, adjectives, articles } = this.sets;
    if (![last, last.replace(/s$/, ""), last.replace(/es$/, "")].some((form) => parts.has(form)))
      return "thing";
    const plain = words.every(
      (word) => adjectives.has(word.toLowerCase()) || articles.has(word.toLowerCase()),
    );
    return plain ? "part" : "part of a thing";
  }

  // The answer to a phrase at "auto" or a level's name, with the fields of Python's QueryResult.
  ask(text, level = "auto") {
    const phrase = tidy(text), key = phraseKey(text);
    if (!key)
      throw new PhraseError("Type what to look for, such as “" + (this.meta.examples[0] || "cup") + "”.");
    const word = this.taught.get(key);
    return word ? this.shown(word, level) : this.answer(phrase, this.relevancies(this.vector(key)), level);
  }

  // (D) unit vector of a phrase. PhraseError where this page has none and cannot make one.
  vector(key) {
    if (this.keys.has(key))
      return this.t.vectors.subarray(this.keys.get(key) * this.dim, (this.keys.get(key) + 1) * this.dim);
    if (key.split(" ").every((word) => this.sets.stop_words.has(word)))
      throw new PhraseError(`“${key}” names nothing to look for.`);
    if (!this.meta.encoder)
      throw new PhraseError(
        `“${key}” is none of the ${this.keys.size} phrases in this page, which the box completes.`,
      );
    return this.encode(key);
  }

  relevancies(vector) {
    const { codebook, zero, rate } = this.t;
    return Float32Array.from({ length: this.codes + 1 }, (_, k) =>
      // the last: no meaning
      k < this.codes ? sigmoid(rate[k] * (dot(codebook, k * this.dim, vector, this.dim) - zero[k])) : 0,
    );
  }

  // Fits of all regions, subparts first: of each its own mean, and something of its best part's.
  fits(relevancies) {
    const { share, share_of, share_code, sizes, parents } = this.t, rules = this.meta.rule;
    const means = new Float64Array(sizes.length);
    for (let i = 0; i < share.length; ++i) means[share_of[i]] += share[i] * relevancies[share_code[i]];
    const own = means.map((mean) => {
      const clipped = Math.min(Math.max(mean, rules.narrowest), 1 - rules.narrowest);
      return Math.log(clipped / (1 - clipped));
    });
    const best = new Float64Array(sizes.length).fill(-Infinity);
    for (let r = 0; r < this.firsts[2]; ++r)
      if (own[r] > rules.nothing && sizes[r] >= rules.smallest)
        best[parents[r]] = Math.max(best[parents[r]], own[r]);
    return own.map((fit, r) => {
      if (best[r] === -Infinity)
        best[r] = fit > rules.nothing && sizes[r] >= rules.smallest ? fit : -Infinity;
      return best[r] === -Infinity ? fit : (1 - rules.part_share) * fit + rules.part_share * best[r];
    });
  }

  // Numbers [first, last) of a level's regions.
  range(level) {
    return [this.firsts[level], this.firsts[level + 1]];
  }

  // The best of a level's values: crumbs do not count where there are others.
  best(values, level) {
    const [first, last] = this.range(level), { sizes } = this.t;
    let solid = -Infinity, any = -Infinity;
    for (let r = first; r < last; ++r) {
      any = Math.max(any, values[r]);
      if (sizes[r] >= this.meta.rule.smallest) solid = Math.max(solid, values[r]);
    }
    return Math.max(solid > -Infinity ? solid : any, 0);
  }

  answer(phrase, relevancies, level) {
    const { rule: rules, levels, calibration } = this.meta, named = this.named(phrase);
    const every = this.fits(relevancies);
    const values = every.map((fit) => (fit > rules.nothing ? sigmoid(fit) : 0));
    const scores = levels.map((_, at) => this.best(values, at));
    const fits = scores.map((score) => {
      const clipped = Math.min(Math.max(score, rules.narrowest), 1 - rules.narrowest);
      return Math.log(clipped / (1 - clipped));
    });
    const given = fits.map((fit, at) => fit + rules.advantage[named][at]);
    const chosen = level === "auto" ? given.lastIndexOf(Math.max(...given)) : levels.indexOf(level);
    const { reach, nearest, farthest } = rules, best = fits[chosen];
    const least = best - Math.min(Math.max(reach * best, nearest), farthest);
    let probability = null, excess = null, found;
    if (calibration) {
      const odds = named === "thing" ? calibration.thing : calibration.part;
      probability = sigmoid(odds.constant + odds.whole * fits[2] + odds.finer * Math.max(fits[0], fits[1]));
      found = (level === "auto" || best >= 0) && probability >= odds.found;
    } else {
      excess = this.excess(fits, named, level);
      found = excess >= 0;
    }
    const [first, last] = this.range(chosen), inside = [];
    let top = -1;
    for (let r = first; r < last; ++r) {
      if (every[r] >= least) inside.push(r);
      if (values[r] > 0 && values[r] <= scores[chosen] && (top < 0 || values[r] > values[top])) top = r;
    }
    return this.result({
      phrase, level: chosen, scores, fits, probability, excess, found, inside, top, values: every,
      codes: relevancies,
    });
  }

  excess(fits, named, level) {
    const [whole, finer] = this.meta.rule.found[named].map((x) => (x === null ? Infinity : x)),
      { bars, rule: rules } = this.meta;
    const above = (bar, fit, spreads) => (fit - bar.median) / Math.max(bar.spread, rules.narrowest) - spreads;
    if (level !== "auto") {
      const at = this.meta.levels.indexOf(level);
      return above(bars[at], fits[at], Math.min(whole, finer));
    }
    return Math.max(above(bars[2], fits[2], whole), above(bars[3], Math.max(fits[0], fits[1]), finer));
  }

  // The answer to a taught word: its fits were computed when the page was made.
  shown(word, level) {
    const { rule: rules, levels } = this.meta, { sizes } = this.t, all = sizes.length;
    const every = this.t.taught_fits.subarray(word.row * all, (word.row + 1) * all);
    const above = this.t.taught_above.subarray(word.row * all, (word.row + 1) * all);
    const solid = levels.map((_, at) => {
      const [first, last] = this.range(at);
      const least = Math.min(rules.smallest, Math.max(0, ...sizes.subarray(first, last)));
      return Array.from({ length: last - first }, (_, i) => first + i).filter((r) => sizes[r] >= least);
    });
    const fits = solid.map((rows) => Math.max(rules.least_likeness[0], ...rows.map((r) => every[r])));
    const scores = solid.map((rows) => Math.max(0, ...rows.map((r) => sigmoid(every[r]))));
    const chosen = level === "auto" ? word.level : levels.indexOf(level), rows = solid[chosen];
    const excess = Math.max(rules.least_likeness[1], ...rows.map((r) => above[r]));
    const least = Math.min(0, Math.max(...rows.map((r) => every[r])));
    const inside = rows.filter((r) => every[r] >= least);
    const top = rows.reduce((best, r) => (best < 0 || every[r] > every[best] ? r : best), -1);
    return this.result({
      phrase: word.name, level: chosen, scores, fits, probability: null, excess, found: excess >= 0, inside,
      top, values: every, codes: null,
    });
  }

  result(answer) {
    const { rule: rules } = this.meta,
      { places, boxes } = this.t, { level, found, probability, excess, inside, top } = answer;
    const peak = answer.scores[level];
    let verdict = "not here";
    if (found) verdict = "found";
    else if (probability !== null ? probability >= rules.weak_probability : excess >= rules.weak_excess && inside.length)
      verdict = "weak match";
    let heat = [rules.floor, Math.max(peak, rules.floor + rules.heat_span)];
    if (found && peak < rules.floor + rules.heat_span) heat = [peak - rules.heat_span, peak];
    return {
      ...answer, peak, verdict, heat,
      place: top < 0 ? null : Array.from(places.subarray(3 * top, 3 * top + 3)),
      box: top < 0 ? null : Array.from(boxes.subarray(6 * top, 6 * top + 6)),
    };
  }

  // (M) relevancy of every Gaussian at a level, and (M) whether it is a member of the answer.
  spread(answer, level) {
    const count = this.shapes.codes.shape[1],
      values = new Float32Array(count), members = new Uint8Array(count);
    const regions = this.t.regions, inside = new Uint8Array(this.firsts[3]);
    for (const r of answer.inside) inside[r] = 1;
    for (let i = 0; i < count; ++i) {
      const own = regions[answer.level * count + i], other = regions[level * count + i];
      members[i] = own >= 0 ? inside[this.firsts[answer.level] + own] : 0;
      if (answer.codes) values[i] = answer.codes[this.t.codes[level * count + i]];
      else values[i] = other >= 0 ? sigmoid(answer.values[this.firsts[level] + other]) : 0;
    }
    return { values, members };
  }

  // (M, 3) colours in [0, 1] of what the Gaussians mean at a level; grey where nothing was observed.
  latents(level) {
    const count = this.shapes.codes.shape[1], colours = new Float32Array(3 * count).fill(0.5);
    for (let i = 0; i < count; ++i) {
      const code = this.t.codes[level * count + i];
      if (code < this.codes)
        for (let c = 0; c < 3; ++c) colours[3 * i + c] = this.t.palette[3 * code + c] / 255;
    }
    return colours;
  }

  // Phrases that go on from what was typed (query/describe.py, completions).
  completions(text, most = 7) {
    const typed = phraseKey(text);
    if (!typed || /\s$/.test(text)) return [];
    const phrases = [...this.taught.keys(), ...this.meta.phrases], cut = typed.lastIndexOf(" ");
    const whole = phrases.filter((phrase) => phrase.startsWith(typed) && phrase !== typed);
    if (cut < 0 || !this.meta.encoder) return whole.slice(0, most);
    const begun = typed.slice(0, cut), last = typed.slice(cut + 1);
    const words = Object.keys(this.meta.encoder.words).filter(
      (word) => word.startsWith(last) && word !== last,
    );
    return [...new Set([...whole, ...words.map((word) => `${begun} ${word}`)])].slice(0, most);
  }

  // The text half of CLIP (semantics/clip_plain.py): (D) unit vector of a phrase of words that it was taught.
  encode(key) {
    const { words, config, begin, end } = this.meta.encoder, ids = [begin];
    for (const word of key.match(/[\p{L}\p{N}]+(?:'[\p{L}\p{N}]+)?/gu) || []) {
      const known = [word, word.split("'")[0]].find((form) => Object.hasOwn(words, form));
      if (known === undefined)
        throw new PhraseError(`This page's encoder was never taught “${word}”${this.near(word)}.`);
      ids.push(...words[known]);
    }
    if (ids.length > config.max_position_embeddings - 1 || ids.length === 1)
      throw new PhraseError("Use fewer, plain words.");
    ids.push(end);
    const wide = config.hidden_size, w = (name) => this.t[`encoder.${name}`], length = ids.length;
    let x = new Float32Array(length * wide);
    ids.forEach((id, row) => {
      for (let k = 0; k < wide; ++k)
        x[row * wide + k] =
          w("text_model.embeddings.token_embedding.weight")[id * wide + k] +
          w("text_model.embeddings.position_embedding.weight")[row * wide + k];
    });
    const add = (a, b) => a.map((value, i) => value + b[i]);
    const gelu =
      config.hidden_act === "quick_gelu"
        ? (v) => v * sigmoid(1.702 * v)
        : (v) => 0.5 * v * (1 + erf(v * Math.SQRT1_2));
    for (let number = 0; number < config.num_hidden_layers; ++number) {
      const layer = (name) => `text_model.encoder.layers.${number}.${name}`;
      x = add(
        x, attention(w, layer("self_attn."), norm(w, layer("layer_norm1"), x, wide, config), length, config),
      );
      const inner = linear(w, layer("mlp.fc1"), norm(w, layer("layer_norm2"), x, wide, config), wide).map(
        gelu,
      );
      x = add(x, linear(w, layer("mlp.fc2"), inner, config.intermediate_size));
    }
    const last = norm(w, "text_model.final_layer_norm", x.subarray((length - 1) * wide), wide, config);
    const vector = Float32Array.from({ length: this.dim }, (_, d) =>
      dot(w("text_projection.weight"), d * wide, last, wide),
    );
    const size = Math.max(Math.sqrt(dot(vector, 0, vector, this.dim)), 1e-6);
    return vector.map((value) => value / size);
  }

  near(word) {
    const close = Object.keys(this.meta.encoder.words)
      .filter((known) => known.slice(0, 3) === word.slice(0, 3))
      .slice(0, 2);
    return close.length ? `; it knows ${close.map((known) => `“${known}”`).join(" and ")}` : "";
  }
}

// Error function to 1.5e-7 (Abramowitz and Stegun 1964, formula 7.1.26).
function erf(x) {
  const t = 1 / (1 + 0.3275911 * Math.abs(x));
  const tail =
    t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
  return Math.sign(x) * (1 - tail * Math.exp(-x * x));
}

function linear(w, name, x, wide) {
  const weight = w(`${name}.weight`), bias = w(`${name}.bias`), out = bias.length, rows = x.length / wide;
  const y = new Float32Array(rows * out);
  for (let row = 0; row < rows; ++row)
    for (let o = 0; o < out; ++o) y[row * out + o] = bias[o] + dot(weight, o * wide, x, wide, row * wide);
  return y;
}

function norm(w, name, x, wide, config) {
  const y = new Float32Array(x.length), weight = w(`${name}.weight`), bias = w(`${name}.bias`);
  for (let row = 0; row < x.length; row += wide) {
    const part = x.subarray(row, row + wide), mean = part.reduce((sum, v) => sum + v, 0) / wide;
    const spread = Math.sqrt(
      part.reduce((sum, v) => sum + (v - mean) ** 2, 0) / wide + config.layer_norm_eps,
    );
    for (let k = 0; k < wide; ++k) y[row + k] = ((part[k] - mean) / spread) * weight[k] + bias[k];
  }
  return y;
}

function attention(w, name, x, length, config) {
  const wide = config.hidden_size, size = wide / config.num_attention_heads;
  const [query, key, value] = ["q", "k", "v"].map((part) => linear(w, `${name}${part}_proj`, x, wide));
  const mixed = new Float32Array(x.length);
  for (let head = 0; head < wide; head += size)
    for (let i = 0; i < length; ++i) {
      const scores = Array.from(
        { length: i + 1 }, (_, j) => dot(query, i * wide + head, key, size, j * wide + head) * size ** -0.5,
      );
      const top = Math.max(...scores), shares = scores.map((score) => Math.exp(score - top));
      const total = shares.reduce((sum, share) => sum + share, 0);
      for (let j = 0; j <= i; ++j)
        for (let k = 0; k < size; ++k)
          mixed[i * wide + head + k] += (shares[j] / total) * value[j * wide + head + k];
    }
  return linear(w, `${name}out_proj`, mixed, wide);
}
