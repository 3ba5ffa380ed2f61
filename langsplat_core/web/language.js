// Phrases asked of the scene: looked up or encoded, compared with the codebook, and answered by regions with
// the fields of Python's QueryResult.

import { ClipText, PhraseError, dot } from "./encoder.js";
import {
  combined,
  decide,
  fitOf,
  heatRange,
  leastFit,
  regionRelevancies,
  regionsAt,
  sigmoid,
  strongest,
  verdict,
} from "./rule.js";
import { Space, wholeOf } from "./space.js";
import { namedBy, nearest, parse, phraseKey, splitPhrases, thingAndPart, tidy } from "./words.js";

// [page]
const GRID = { neighbours: 16, most: 64, side: 5 }; // as of query/answers.py, smoothed

// Means of values (K) around points (3 K), smoothed on a grid that grows with them.
function smoothed(points, values) {
  const count = values.length;
  const axes = [0, 1, 2];
  const middle = axes.map((axis) => values.reduce((sum, _, i) => sum + points[3 * i + axis], 0) / count);
  const spreads = axes.map((axis) => {
    const squares = values.reduce((sum, _, i) => sum + (points[3 * i + axis] - middle[axis]) ** 2, 0);
    return Math.sqrt(squares / count);
  });
  const side = Math.trunc(Math.min(Math.max(Math.sqrt(count / GRID.neighbours), 2), GRID.most));
  const step = Math.max((GRID.side * Math.max(...spreads)) / side, 1e-30);
  const weights = new Float64Array((side + 1) ** 3);
  const totals = new Float64Array((side + 1) ** 3);
  const eachCorner = (i, visit) => {
    const at = axes.map((k) =>
      Math.min(Math.max((points[3 * i + k] - middle[k]) / step + side / 2, 0), side),
    );
    const low = at.map((place) => Math.min(Math.trunc(place), side - 1));
    for (let corner = 0; corner < 8; ++corner) {
      const bits = axes.map((k) => (corner >> k) & 1);
      const share = bits.reduce((product, bit, k) => product * Math.abs(1 - bit - (at[k] - low[k])), 1);
      const cell = bits.reduceRight((number, bit, k) => number * (side + 1) + low[k] + bit, 0);
      visit(cell, share);
    }
  };
  values.forEach((value, i) =>
    eachCorner(i, (cell, share) => {
      weights[cell] += share;
      totals[cell] += share * value;
    }),
  );
  return values.map((_, i) => {
    let [weight, total] = [0, 0];
    eachCorner(i, (cell, share) => {
      weight += share * weights[cell];
      total += share * totals[cell];
    });
    return total / weight;
  });
}

class Language {
  // meta: what pipeline/webpage.py says of the language field; tensors: { values, shape } by name; places: mean and
  // opacity of each Gaussian.
  constructor(meta, tensors, places) {
    Object.assign(this, { meta, places });
    this.tensors = Object.fromEntries(Object.entries(tensors).map(([name, { values }]) => [name, values]));
    [this.codewords, this.dim] = tensors.codebook.shape;
    this.gaussians = tensors.codes.shape[1];
    this.regions = { counts: meta.counts, parents: this.tensors.parents, sizes: this.tensors.sizes };
    this.space = new Space(meta, this.tensors);
    this.keys = new Map(meta.keys.map((key, row) => [key, row]));
    this.taught = new Map(meta.taught.map((word, row) => [phraseKey(word.name), { ...word, row }]));
    const { prepositions, articles } = meta.grammar;
    const table = (words) => (Array.isArray(words) ? new Set(words) : new Map(Object.entries(words)));
    this.lists = {
      ...Object.fromEntries(Object.entries(meta.grammar).map(([name, words]) => [name, table(words)])),
      leading: new RegExp(`^(?:(?:${articles.join("|")}) )+`, "i"),
      longest: Math.max(...Object.keys(prepositions).map((words) => words.split(" ").length)),
    };
    if (meta.encoder) {
      this.encoder = new ClipText(meta.encoder, (name) => this.tensors[`encoder.${name}`], this.dim);
    }
  }

  // Answers to the phrases of a line, in their order, three at most. camera: from where left, right, nearest and
  // so on are said. PhraseError where one of them cannot be asked.
  answers(line, levelName, camera) {
    return splitPhrases(line, this.lists)
      .slice(0, 3)
      .map((phrase) => {
        try {
          const tree = this.taught.has(phraseKey(phrase)) ? { text: phrase } : parse(phrase, this.lists);
          return { ...this.follow(tree, levelName, camera), phrase };
        } catch (error) {
          if (error instanceof PhraseError && this.keys.has(phraseKey(phrase))) {
            return this.ask(phrase, levelName);
          }
          throw error;
        }
      });
  }

  // The answer to a tree of phrases (words.js, parse): of what is asked for, the regions in whose wholes the
  // relation holds.
  follow({ text, kind, what, anchor, count }, levelName, camera, most = 1) {
    if (!kind) {
      return this.ask(text, levelName);
    }
    const other = anchor && this.thing(anchor, "auto", camera);
    const others = other ? this.wholesOf(other) : [];
    if (kind === "inside") {
      const part = what.text ? this.part(what.text, anchor, others, levelName) : this.follow(what, levelName);
      return this.restricted(part, what.text ? this.wholesOf(part) : others, other);
    }
    const asked = this.thing(what, levelName, camera, count);
    if (kind === "counted") {
      const { found, reached, margin, probability } = asked.verdict;
      const enough = found && this.count(asked) >= count;
      const judged = verdict(this.meta.rule, enough, reached, margin, probability);
      return this.answer(asked.phrase, { ...asked, verdict: judged }, asked.codes);
    }
    const things = this.wholesOf(asked);
    if (kind === "without") {
      const isPart = other.level + 1 < this.meta.levels.length;
      const left = things.filter((thing) => isPart || !others.includes(thing));
      const less = isPart ? this.spread(other).members.map((is, row) => is | asked.less?.[row]) : asked.less;
      return other.verdict.found ? this.restricted({ ...asked, less }, left, asked) : asked;
    }
    return this.restricted(asked, this.space.chosen(kind, things, others, camera, most), other ?? asked);
  }

  // The wholes that the regions of an answer are parts of, or are.
  wholesOf({ inside }) {
    return [...new Set(inside.map((region) => wholeOf(this.regions, region)))];
  }

  // The number of wholes that an answer has parts of or is, if it reached further down: a count needs as many.
  count({ inside, level, regionFits }) {
    const { rule, space } = this.meta;
    const least = leastFit(rule, Math.max(...inside.map((region) => regionFits[region])), rule.wide);
    const sizes = {};
    for (const region of regionsAt(this.regions, level)) {
      const whole = wholeOf(this.regions, region);
      sizes[whole] = (sizes[whole] ?? 0) + (regionFits[region] >= least ? this.regions.sizes[region] : 0);
    }
    const [fewest, share] = space.specks;
    const solid = Math.max(fewest, share * Math.max(...Object.values(sizes)));
    return Object.values(sizes).filter((size) => size >= solid).length;
  }

  // The answer to a part of a thing, or on the wholes of a thing with structure.
  part(name, thing, wholes, levelName) {
    const { rule, levels, calibration } = this.meta;
    const phrase = thing.kind ? name : `${thing.text} ${name}`;
    const whole = (_, region) => (wholes.includes(wholeOf(this.regions, region)) ? 1 : rule.nothing);
    const on = thing.kind ? Array.from(this.regions.sizes, whole) : this.knownFits(thing.text);
    const [own, both] = [name, phrase].map((text) => this.knownFits(text));
    if (!own || !on || !calibration) {
      return this.ask(phrase, levelName);
    }
    const level = levels.indexOf(levelName);
    const decision = decide(rule, this.regions, own, "inside", level, this.meta, on, both);
    return this.answer(phrase, decision, this.relevancies(this.vector(phraseKey(both ? phrase : name))));
  }

  // As `follow`, but a thing is looked for among wholes, unless it fits none.
  thing(tree, levelName, camera, most = 1) {
    const free = levelName === "auto" && !tree.kind && namedBy(tree.text, this.lists) === "thing";
    const whole = this.follow(tree, free ? "whole" : levelName, camera, most);
    return free && whole.peak < this.meta.rule.floor ? this.follow(tree, levelName, camera) : whole;
  }

  // An answer within some wholes; nothing is found where `needed` is not.
  restricted(answer, wholes, needed) {
    const { rule } = this.meta;
    const inside = answer.inside.filter((region) => wholes.includes(wholeOf(this.regions, region)));
    const within = new Set(inside);
    const regionFits = answer.regionFits.map((fit, region) => (within.has(region) ? fit : rule.nothing));
    const best = strongest(inside, regionFits);
    const verdict = combined(rule, answer.verdict, needed.verdict, best < 0);
    return this.answer(answer.phrase, { ...answer, inside, best, regionFits, verdict }, answer.codes);
  }

  // The answer to a phrase at "auto" or a level's name. PhraseError where it cannot be asked.
  ask(text, levelName = "auto") {
    const key = phraseKey(text);
    if (!key) {
      const [example] = this.meta.examples;
      throw new PhraseError(`Type what to look for${example ? `, such as “${example}”` : ""}.`);
    }
    const level = this.meta.levels.indexOf(levelName); // -1: free
    const word = this.taught.get(key);
    if (word) {
      return this.answerByExamples(word, level);
    }
    const phrase = tidy(text);
    const relevancies = this.relevancies(this.vector(key));
    const named = namedBy(phrase, this.lists);
    const others = thingAndPart(phrase, this.lists).map((name) => this.knownFits(name));
    const own = this.ownFits(relevancies);
    const decision = decide(this.meta.rule, this.regions, own, named, level, this.meta, ...others);
    return this.answer(phrase, decision, relevancies);
  }

  // The unit vector of a phrase. PhraseError where this page has none and cannot make one.
  vector(key) {
    if (this.keys.has(key)) {
      const row = this.keys.get(key);
      return this.tensors.vectors.subarray(row * this.dim, (row + 1) * this.dim);
    }
    if (key.split(" ").every((word) => this.lists.stop_words.has(word))) {
      throw new PhraseError(`“${key}” names nothing to look for.`);
    }
    if (!this.encoder) {
      const count = this.keys.size;
      const near = nearest(key, this.keys.keys());
      throw new PhraseError(`“${key}” is none of the ${count} phrases in this page.`, key, near);
    }
    return this.encoder.encode(key);
  }

  // Relevancies of the codewords, and 0 behind them for a Gaussian without one.
  relevancies(vector) {
    const { codebook, zero, rate } = this.tensors;
    const found = new Float32Array(this.codewords + 1);
    for (let code = 0; code < this.codewords; ++code) {
      const cosine = dot(codebook, code * this.dim, vector, this.dim);
      found[code] = sigmoid(rate[code] * (cosine - zero[code]));
    }
    return found;
  }

  // Fits of the mean relevancies of all regions.
  ownFits(relevancies) {
    const { share, share_of: region, share_code: code } = this.tensors;
    const means = new Float64Array(this.regions.sizes.length);
    for (let i = 0; i < share.length; ++i) {
      means[region[i]] += share[i] * relevancies[code[i]];
    }
    return means.map((mean) => fitOf(this.meta.rule, mean));
  }

  // Fits of the regions with a thing or part that a phrase names; null where it cannot be asked.
  knownFits(name) {
    const key = phraseKey(name);
    if (!key || this.taught.has(key)) {
      return null;
    }
    try {
      return this.ownFits(this.relevancies(this.vector(key)));
    } catch (error) {
      if (error instanceof PhraseError) {
        return null;
      }
      throw error;
    }
  }

  // The answer to a taught word: its fits were computed when the page was made (query/taught.py, by_showing).
  answerByExamples(word, level) {
    const { rule } = this.meta;
    const { sizes } = this.regions;
    const row = (tensor) => tensor.subarray(word.row * sizes.length, (word.row + 1) * sizes.length);
    const every = row(this.tensors.taught_fits);
    const margins = row(this.tensors.taught_above);
    const solid = this.meta.levels.map((_, at) => {
      const numbers = regionsAt(this.regions, at);
      const least = Math.min(rule.smallest, Math.max(0, ...numbers.map((region) => sizes[region])));
      return numbers.filter((region) => sizes[region] >= least);
    });
    const chosen = level < 0 ? word.level : level;
    const regions = solid[chosen];
    const least = Math.min(0, Math.max(...regions.map((region) => every[region])));
    const margin = Math.max(rule.least_likeness, ...regions.map((region) => margins[region]));
    const decision = {
      level: chosen,
      scores: solid.map((some) => Math.max(0, ...some.map((region) => sigmoid(every[region])))),
      fits: solid.map((some) => Math.max(rule.least_likeness, ...some.map((region) => every[region]))),
      regionFits: every,
      inside: regions.filter((region) => every[region] >= least),
      best: strongest(regions, every),
      verdict: verdict(rule, margin >= 0, "example", margin),
    };
    return this.answer(word.name, decision, null);
  }

  // codes: relevancies of the codewords; null for a taught word.
  answer(phrase, decision, codes) {
    const { places, boxes } = this.tensors;
    const { best } = decision;
    const peak = decision.scores[decision.level];
    const { values, members } = this.spread({ ...decision, codes });
    const rows = Uint32Array.from(members.keys()).filter((row) => members[row]);
    const part = (_, i) => this.places[4 * rows[Math.trunc(i / 3)] + (i % 3)];
    const points = Float32Array.from({ length: 3 * rows.length }, part);
    const own = Float32Array.from(rows, (row) => values[row]);
    const smooth = smoothed(points, own);
    const hottest = smooth.reduce((most, value) => Math.max(most, value), 0);
    return {
      ...decision,
      phrase,
      codes,
      peak,
      rows,
      smooth,
      heat: heatRange(this.meta.rule, peak, decision.verdict.found, hottest),
      place: best < 0 ? null : Array.from(places.subarray(3 * best, 3 * best + 3)),
      box: best < 0 ? null : Array.from(boxes.subarray(6 * best, 6 * best + 6)),
    };
  }

  // The relevancy of every Gaussian at the level of an answer, its region there (-1: none), and whether it is a
  // member: in the answer's regions and not in `less`, if there is that.
  spread({ level, inside, codes, regionFits, less }) {
    const [first] = regionsAt(this.regions, level);
    const row = (tensor) => tensor.subarray(level * this.gaussians, (level + 1) * this.gaussians);
    const owners = Int32Array.from(row(this.tensors.regions), (own) => (own < 0 ? -1 : first + own));
    const fit = (region) => (region < 0 ? 0 : sigmoid(regionFits[region]));
    const values = codes
      ? Float32Array.from(row(this.tensors.codes), (code) => codes[code])
      : Float32Array.from(owners, fit);
    const among = new Set(inside);
    const members = Uint8Array.from(owners, (region, row) => +(among.has(region) && !less?.[row]));
    return { values, owners, members };
  }

  // Values of the Gaussians as display/displays.py has them (heats): of an answer from `base` to 1 by what heat is
  // of, and 0 for all others; "everywhere" minus the relevancy of each.
  heats(answer, of, base) {
    const { values, owners } = this.spread(answer);
    if (of === "everywhere") {
      return values.map((value) => -value);
    }
    const [low, high] = answer.heat;
    const even = of === "node" ? regionRelevancies(this.meta.rule, answer.regionFits) : null;
    const heats = new Float32Array(this.gaussians);
    answer.rows.forEach((row, i) => {
      const node = even ? even[owners[row]] : values[row];
      const value = of === "smooth" ? answer.smooth[i] : node;
      heats[row] = base + (1 - base) * Math.min(Math.max((value - low) / (high - low), 0), 1);
    });
    return heats;
  }

  // The least relevancy of what is in an answer.
  cut(answer) {
    const even = regionRelevancies(this.meta.rule, answer.regionFits);
    return answer.inside.reduce((least, region) => Math.min(least, even[region]), answer.peak);
  }

  // Red, green and blue in [0, 1] of the language features at a level; grey where nothing was observed.
  latents(level) {
    const { codes, palette } = this.tensors;
    const own = codes.subarray(level * this.gaussians, (level + 1) * this.gaussians);
    const colour = (code, channel) => (code < this.codewords ? palette[3 * code + channel] / 255 : 0.5);
    return [0, 1, 2].map((channel) => Float32Array.from(own, (code) => colour(code, channel)));
  }
}
// [/page]

export { Language, PhraseError };
