// Queries: phrases are looked up or encoded, compared with the codebook, and answered by regions, as in Python's
// query/engine.py and query/compose.py.

import { ClipText, PhraseError, dot } from "./encoder.js";
import {
  barsOn,
  combined,
  decide,
  fitOf,
  heatRange,
  isWithin,
  leastFit,
  mean,
  onThings,
  regionRelevancies,
  regionsAt,
  scalingOf,
  sigmoid,
  strongest,
  verdict,
  wholeOf,
  withPieces,
} from "./rule.js";
import { Space } from "./space.js";
import { namedBy, nearest, parse, phraseKey, splitPhrases, thingAndPart, tidy } from "./words.js";

// [page]
const GRID = { neighbours: 16, most: 64, side: 5 }; // as in `smoothed` of query/answers.py

// Means of (K) values around points, on a grid that grows with them. point(i, axis): a coordinate.
function smoothed(point, values) {
  const count = values.length;
  const axes = [0, 1, 2];
  const average = (of) => values.reduce((sum, _, i) => sum + of(i), 0) / count;
  const middle = axes.map((axis) => average((i) => point(i, axis)));
  const spreads = axes.map((axis) => Math.sqrt(average((i) => (point(i, axis) - middle[axis]) ** 2)));
  const side = Math.trunc(Math.min(Math.max(Math.sqrt(count / GRID.neighbours), 2), GRID.most));
  const step = Math.max((GRID.side * Math.max(...spreads)) / side, 1e-30);
  const weights = new Float64Array((side + 1) ** 3);
  const totals = new Float64Array((side + 1) ** 3);
  const eachCorner = (i, visit) => {
    const at = axes.map((k) => Math.min(Math.max((point(i, k) - middle[k]) / step + side / 2, 0), side));
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

export class Language {
  // meta: the language field's metadata from pipeline/webpage.py; tensors: { values, shape } by name; places: mean and
  // opacity of each Gaussian.
  constructor(meta, tensors, places) {
    Object.assign(this, { meta, places });
    this.tensors = Object.fromEntries(Object.entries(tensors).map(([name, { values }]) => [name, values]));
    [this.codewords, this.dim] = tensors.codebook.shape;
    this.gaussians = tensors.codes.shape[1];
    const { parents, sizes, touching } = this.tensors;
    this.regions = { counts: meta.counts, parents, sizes, touching };
    this.space = new Space(meta);
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

  // Answers to the phrases of a line, in order, three at most. camera: viewpoint for left, right, nearest and the
  // like. Throws PhraseError if one of them cannot be searched.
  answers(line, levelName, camera) {
    const phrases = splitPhrases(line);
    const answers = phrases.slice(0, 3).map((phrase) => {
      try {
        const tree = parse(this.withNames(phrase), this.lists);
        return this.drawn({ ...this.follow(tree, levelName, camera), phrase });
      } catch (error) {
        if (error instanceof PhraseError && this.keys.has(phraseKey(phrase))) {
          return this.drawn(this.ask(phrase, levelName));
        }
        throw error;
      }
    });
    return Object.assign(answers, { left: phrases.slice(3) });
  }

  // A phrase in which the words of each taught name are joined by no-break spaces, the longest name first.
  withNames(phrase) {
    const words = phrase.split(" ");
    for (let at = 0; at < words.length; ++at) {
      for (let count = words.length - at; count > 1; --count) {
        const name = words.slice(at, at + count).join(" ");
        if (this.taught.has(name.toLowerCase())) {
          words.splice(at, count, name.replaceAll(" ", "\u00a0"));
        }
      }
    }
    return words.join(" ");
  }

  // The answer to a tree from `parse`: regions of what is searched for, in wholes for which the relation holds.
  follow({ text, kind, what, anchor, items, count }, levelName, camera, most = 1) {
    if (!kind) {
      return this.ask(text, levelName);
    }
    if (items) {
      const answers = items.map((item) => this.thing(item, levelName, camera));
      return this.joined(answers, kind === "both");
    }
    const other = anchor && this.thing(anchor, "auto", camera);
    if (kind === "inside") {
      const plain = what.text && !this.taught.has(phraseKey(what.text));
      const part = plain && this.part(what.text, anchor, other, levelName);
      const asked = part || this.follow(what, levelName, camera);
      return this.restricted(asked, (part || other).inside, other);
    }
    const asked = this.thing(what, levelName, camera, count);
    if (kind === "counted") {
      const { found, reached, margin, probability } = asked.verdict;
      const enough = found && this.count(asked) >= count;
      return { ...asked, verdict: verdict(this.meta.rule, enough, reached, margin, probability) };
    }
    if (kind === "without") {
      const least = anchor.text ? this.reached(other, this.meta.rule.half) : -Infinity;
      const unwanted = other.inside.filter((region) => other.regionFits[region] >= least);
      return other.verdict.found ? this.restricted(asked, unwanted, asked, true) : asked;
    }
    const [things, others] = [asked, other].map((answer) => (answer ? this.things(answer.inside) : []));
    const chosen = this.space.chosen(kind, things, others, camera, most);
    const regions = chosen.flatMap(({ inside }) => inside);
    return this.restricted(asked, regions, other ?? asked);
  }

  // Groups of regions by the whole that they are in, the largest first, each with its Gaussians.
  things(regions) {
    const { fewest, speck } = this.meta.space;
    const { regions: own, surface } = this.tensors;
    const groups = [...Map.groupBy(regions, (region) => wholeOf(this.regions, region)).values()];
    const found = groups.map((inside) => {
      const size = inside.reduce((sum, region) => sum + this.regions.sizes[region], 0); // in the whole scene
      return { inside, size, rows: new Set() };
    });
    const rowsOf = []; // by region
    found.forEach(({ inside, rows }) => inside.forEach((region) => (rowsOf[region] = rows)));
    own.forEach((region, i) => surface[i % this.gaussians] && rowsOf[region]?.add(i % this.gaussians));
    found.sort((a, b) => b.size - a.size);
    const least = Math.max(fewest, speck * found[0]?.size);
    const point = (row) => this.places.subarray(4 * row, 4 * row + 3);
    const things = found.filter(({ rows, size }) => rows.size && size >= least);
    return things.map((thing) => ({ ...thing, points: Array.from(thing.rows, point) }));
  }

  // The least fit of a member of an answer with another factor `share` of the reach.
  reached({ inside, regionFits }, share) {
    return leastFit(this.meta.rule, Math.max(...inside.map((region) => regionFits[region])), share);
  }

  // The number of wholes in an answer with the wider reach of `rule.wide`.
  count(answer) {
    const { level, regionFits, inside } = answer;
    const least = this.reached(answer, this.meta.rule.wide);
    const more = regionsAt(this.regions, level).filter((region) => regionFits[region] >= least);
    return this.things([...new Set([...inside, ...more])]).length;
  }

  // The answer to a part of a thing, within the answer to the thing; for a thing without adjectives, also within
  // regions that fit it nearly as well; and within pieces of all these.
  part(name, thing, other, levelName) {
    const { rule, levels } = this.meta;
    const own = thing.text && !this.taught.has(phraseKey(thing.text));
    const phrase = own ? `${thing.text} ${name}` : name;
    const asked = [this.relevancies(this.vector(phraseKey(name))), this.known(phrase)].filter(Boolean);
    const plain = own && !thing.text.split(" ").some((word) => this.lists.adjectives.has(word.toLowerCase()));
    const least = plain ? this.reached(other, rule.around) : Infinity;
    const near = regionsAt(this.regions, other.level).filter((region) => other.regionFits[region] >= least);
    const on = withPieces(this.regions, [...other.inside, ...near]);
    const fits = asked.map((one) => this.ownFits(one));
    const evidence =
      other.verdict.probability === null
        ? { bars: barsOn(rule, this.regions, this.tensors.chance, on) }
        : { scaling: scalingOf(this.meta.calibration, "inside") };
    const decision = decide(rule, this.regions, fits, "inside", levels.indexOf(levelName), evidence, on);
    return this.answer(phrase, decision, mean(asked));
  }

  // As `follow`, but a thing is searched among wholes, unless it fits none.
  thing(tree, levelName, camera, most = 1) {
    const free = levelName === "auto" && !tree.kind && namedBy(tree.text, this.lists) === "thing";
    const whole = this.follow(tree, free ? "whole" : levelName, camera, most);
    return free && whole.peak < this.meta.rule.floor ? this.follow(tree, levelName, camera) : whole;
  }

  // An answer limited to some regions, or to those outside of them; it is found only if `needed` is found too.
  restricted(answer, regions, needed, outside = false) {
    const { rule } = this.meta;
    const [among, there] = [new Set(regions), this.covered(regions)];
    const inside = answer.inside.filter((region) => isWithin(this.regions, region, among) !== outside);
    const within = new Set(inside);
    const regionFits = answer.regionFits.map((fit, region) => (within.has(region) ? fit : rule.nothing));
    const best = strongest(inside, regionFits);
    const members = answer.members.map((is, row) => is & (there[row] ^ outside));
    const kept = (value, row) => members[row] * value;
    const [values, even] = [answer.values.map(kept), answer.even.map(kept)];
    const peak = best < 0 ? 0 : answer.peak;
    const verdict = combined(rule, [answer.verdict, needed.verdict], true, best < 0);
    return { ...answer, inside, regionFits, best, members, values, even, peak, verdict };
  }

  // The union of answers, found if all or any are found; alternatives not found are left out.
  joined(answers, all) {
    const found = answers.filter(({ verdict }) => all || verdict.found);
    const counting = (found.length ? found : answers).map((one) => this.restricted(one, one.inside, one));
    const most = (name) => counting[0][name].map((_, i) => Math.max(...counting.map((one) => one[name][i])));
    const [regionFits, members, values, even] = ["regionFits", "members", "values", "even"].map(most);
    const inside = [...new Set(counting.flatMap((one) => one.inside))];
    const peak = (all ? Math.min : Math.max)(...counting.map((one) => one.peak));
    const best = strongest(inside, regionFits);
    const verdicts = counting.map((one) => one.verdict);
    const verdict = combined(this.meta.rule, verdicts, all);
    return { ...counting[0], inside, regionFits, best, members, values, even, peak, verdict };
  }

  // The answer to a plain query at "auto" or a level's name. Throws PhraseError if it cannot be searched.
  ask(text, levelName = "auto") {
    const key = phraseKey(text);
    if (!key) {
      const [example] = this.meta.examples;
      throw new PhraseError(`Type what to look for${example ? `, such as “${example}”` : ""}.`);
    }
    const level = this.meta.levels.indexOf(levelName); // -1: free
    const word = this.taught.get(key);
    if (word) {
      const { margin, inside, ...decision } = word.answers[level + 1];
      const count = this.regions.sizes.length;
      const regionFits = this.tensors.taught_fits.subarray(word.row * count, (word.row + 1) * count);
      const judged = verdict(this.meta.rule, margin >= 0, "example", margin);
      const best = strongest(inside, regionFits);
      return this.answer(word.name, { ...decision, inside, regionFits, best, verdict: judged }, null);
    }
    const phrase = tidy(text);
    const relevancies = this.relevancies(this.vector(key));
    const named = namedBy(phrase, this.lists);
    const others = thingAndPart(phrase, this.lists).map((name) => this.known(name));
    const [own, thing, part] = [relevancies, ...others].map((one) => one && this.ownFits(one));
    const { rule, bars, calibration } = this.meta;
    const on = thing && onThings(rule, this.regions, thing);
    const fits = thing && part ? [own, part] : [own];
    const before = key.split(" ").slice(0, -1);
    const coloured = before.some((word) => this.lists.colours.has(word));
    const evidence = { bars, scaling: scalingOf(calibration, named, coloured) };
    const decision = decide(rule, this.regions, fits, named, level, evidence, on);
    return this.answer(phrase, decision, relevancies);
  }

  // The unit vector of a phrase. Throws PhraseError if this page has none and cannot encode it.
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

  // Relevancies of the codewords, followed by 0 for a Gaussian without one.
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

  // Relevancies of a thing or part that a phrase names; null if it cannot be searched.
  known(name) {
    const key = phraseKey(name);
    if (!key || this.taught.has(key)) {
      return null;
    }
    try {
      return this.relevancies(this.vector(key));
    } catch (error) {
      if (error instanceof PhraseError) {
        return null;
      }
      throw error;
    }
  }

  // codes: relevancies of the codewords; null for a taught word.
  answer(phrase, decision, codes) {
    const { level, inside, regionFits, scores } = decision;
    const row = (tensor) => tensor.subarray(level * this.gaussians, (level + 1) * this.gaussians);
    const relevancies = regionRelevancies(this.meta.rule, regionFits);
    const even = new Float32Array(row(this.tensors.regions)).map((region) => relevancies[region] ?? 0);
    const values = codes ? new Float32Array(row(this.tensors.codes)).map((code) => codes[code]) : even;
    return { ...decision, phrase, peak: scores[level], values, even, members: this.covered(inside) };
  }

  // An answer with the smoothed heat of its members, and position and box of its best region.
  drawn(answer) {
    const { places, boxes } = this.tensors;
    const { best, members, peak, values } = answer;
    const rows = new Uint32Array(members).map((_, row) => row).filter((row) => members[row]);
    const own = Float32Array.from(rows, (row) => values[row]);
    const smooth = smoothed((i, axis) => this.places[4 * rows[i] + axis], own);
    const hottest = smooth.reduce((most, value) => Math.max(most, value), 0);
    return {
      ...answer,
      rows,
      smooth,
      heat: heatRange(this.meta.rule, peak, answer.verdict.found, hottest),
      place: best < 0 ? null : Array.from(places.subarray(3 * best, 3 * best + 3)),
      box: best < 0 ? null : Array.from(boxes.subarray(6 * best, 6 * best + 6)),
    };
  }

  // Whether each Gaussian is in one of the given regions.
  covered(regions) {
    const { gaussians: count, tensors } = this;
    const [subpart, part, whole] = [0, 1, 2].map((k) => tensors.regions.subarray(k * count, (k + 1) * count));
    const among = new Uint8Array(this.regions.sizes.length);
    regions.forEach((region) => (among[region] = 1));
    return new Uint8Array(count).map((_, row) => among[subpart[row]] | among[part[row]] | among[whole[row]]);
  }

  // Values of the Gaussians as in `heats` of display/displays.py: from `base` to 1 for members of an answer, by the
  // kind of heat `of`, else 0; for "everywhere" minus the relevancy of each.
  heats(answer, of, base) {
    const { values, even } = answer;
    if (of === "everywhere") {
      return values.map((value) => -value);
    }
    const [low, high] = answer.heat;
    const heats = new Float32Array(this.gaussians);
    answer.rows.forEach((row, i) => {
      const value = of === "smooth" ? answer.smooth[i] : (of === "node" ? even : values)[row];
      heats[row] = base + (1 - base) * Math.min(Math.max((value - low) / (high - low), 0), 1);
    });
    return heats;
  }

  // The threshold of an answer: the least relevancy of its members' regions.
  cut(answer) {
    return answer.rows.reduce((least, row) => Math.min(least, answer.even[row]), answer.peak);
  }

  // Red, green and blue in [0, 1] of the language features at a level; grey without a feature.
  latents(level) {
    const { codes, palette } = this.tensors;
    const own = codes.subarray(level * this.gaussians, (level + 1) * this.gaussians);
    const colour = (code, channel) => (code < this.codewords ? palette[3 * code + channel] / 255 : 0.5);
    return [0, 1, 2].map((channel) => Float32Array.from(own, (code) => colour(code, channel)));
  }
}
