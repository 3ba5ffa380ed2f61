// The rule that turns the fits of regions into an answer: the twin of query/rule.py, where the table of numbers
// (`rule`) comes from and is explained.
//
// Regions are { counts, parents, sizes } of all levels one after the other, subparts first; `parents` has the
// region of the level above, -1 for none; `touching` pairs of wholes of which the first may be a piece of the second.

// [page]
export const sigmoid = (x) => 1 / (1 + Math.exp(-x));
const logit = (share) => Math.log(share / (1 - share));

// The fit that a relevancy stands for; finite at 0 and 1.
export function fitOf(rule, relevancy) {
  return logit(Math.min(Math.max(relevancy, rule.narrowest), 1 - rule.narrowest));
}

// Means of arrays of the same length.
export function mean(arrays) {
  return arrays[0].map((_, i) => arrays.reduce((sum, values) => sum + values[i], 0) / arrays.length);
}

// Fits of regions, each mixed with that of its best part. own: fits of the regions' mean relevancies.
function regionFits(rule, regions, own) {
  const { parents, sizes } = regions;
  const counts = (region) => own[region] > rule.nothing && sizes[region] >= rule.smallest;
  const best = new Float64Array(own.length).fill(-Infinity);
  for (let region = 0; region < own.length; ++region) {
    const parent = parents[region];
    if (parent >= 0 && counts(region)) {
      best[parent] = Math.max(best[parent], own[region]);
    }
  }
  return own.map((fit, region) => {
    const part = best[region] === -Infinity && counts(region) ? fit : best[region];
    return part === -Infinity ? fit : (1 - rule.part_share) * fit + rule.part_share * part;
  });
}

// Relevancies that fits stand for, 0 for regions without a feature.
export function regionRelevancies(rule, fits) {
  return fits.map((fit) => (fit > rule.nothing ? sigmoid(fit) : 0));
}

// Numbers of the regions of a level, in their order.
export function regionsAt({ counts }, level) {
  const first = counts.slice(0, level).reduce((sum, count) => sum + count, 0);
  return Array.from({ length: counts[level] }, (_, i) => first + i);
}

// The region with the largest value, the first of equal ones; -1 for none.
export function strongest(some, values) {
  return some.reduce((best, region) => (best < 0 || values[region] > values[best] ? region : best), -1);
}

// The regions of a level that are no crumbs; all if there are only crumbs.
function solidAt(rule, regions, level) {
  const every = regionsAt(regions, level);
  const solid = every.filter((region) => regions.sizes[region] >= rule.smallest);
  return solid.length ? solid : every;
}

// The best relevancy of a level; crumbs count only if there are no other regions.
function bestRelevancy(rule, regions, relevancies, level) {
  return Math.max(0, relevancies[strongest(solidAt(rule, regions, level), relevancies)] ?? 0);
}

// A quantile of numbers, as in NumPy.
export function quantile(numbers, share) {
  const sorted = Float64Array.from(numbers).sort();
  const at = share * (sorted.length - 1);
  const [below, above] = [sorted[Math.floor(at)], sorted[Math.ceil(at)]];
  return below + (at % 1) * (above - below);
}

// Bars of the best fits of everyday phrases on one thing: of each level, and of the better of the two finer ones.
// chance: fits of each region, by phrase. on: whether each region is on the thing.
export function barsOn(rule, regions, chance, on) {
  const count = chance.length / regions.sizes.length;
  const best = regions.counts.map((_, level) => {
    const there = solidAt(rule, regions, level).filter((region) => on[region]);
    const most = (_, phrase) => Math.max(...there.map((region) => chance[region * count + phrase]));
    return Array.from({ length: count }, most);
  });
  const finer = best[0].map((fit, phrase) => Math.max(fit, best[1][phrase]));
  return [...best, finer].map((fits) => {
    const [low, median] = [rule.low, 0.5].map((share) => quantile(fits, share));
    const spread = median - low; // NaN if no region is on the thing
    return Number.isFinite(spread) ? { median, spread } : { median: Infinity, spread: 1 };
  });
}

// The whole that a region is a part of, or is.
export function wholeOf(regions, region) {
  const above = regions.parents[region];
  return above < 0 ? region : wholeOf(regions, above);
}

// Whether a region is one of a Set of others, or a part of one.
export function isWithin(regions, region, others) {
  return region >= 0 && (others.has(region) || isWithin(regions, regions.parents[region], others));
}

// Whether parts of a thing may be in each region: on the wholes that fit nearly as well as the best, or their pieces.
export function onThings(rule, regions, own) {
  const thing = regionFits(rule, regions, own);
  const level = regions.counts.length - 1;
  const best = bestRelevancy(rule, regions, regionRelevancies(rule, thing), level);
  const least = leastFit(rule, fitOf(rule, best), rule.around);
  const wholes = regionsAt(regions, level).filter((whole) => thing[whole] >= least);
  return withPieces(regions, wholes);
}

// Whether each region is one of others, a whole that touches one of them, or a part of these.
export function withPieces(regions, others) {
  const { sizes, touching } = regions;
  const pieces = touching.filter((_, i) => i % 2 === 0 && others.includes(touching[i + 1]));
  const on = new Set([...others, ...pieces]);
  return Array.from(sizes, (_, region) => isWithin(regions, region, on));
}

// The least fit of a member of an answer. share: factor of the reach.
export function leastFit(rule, best, share = 1) {
  return best - share * Math.min(Math.max(rule.reach * best, rule.nearest), rule.farthest);
}

// The mean fit of regions that have a feature and are no crumbs.
function commonFit(rule, regions, fits) {
  const counted = fits.filter((fit, region) => fit > rule.nothing && regions.sizes[region] >= rule.smallest);
  return counted.reduce((sum, fit) => sum + fit, 0) / Math.max(counted.length, 1);
}

// Spreads by which the best fits of the levels exceed the threshold. level: number, or -1 for "auto". bars: of each
// level, and of the better of the two finer ones.
function excess(rule, fits, named, level, bars) {
  const [whole, finer] = rule.found[named].map((spreads) => spreads ?? Infinity);
  const above = (bar, fit, spreads) => (fit - bar.median) / Math.max(bar.spread, rule.narrowest) - spreads;
  if (level >= 0) {
    return above(bars[level], fits[level], Math.min(whole, finer));
  }
  return Math.max(above(bars[2], fits[2], whole), above(bars[3], Math.max(fits[0], fits[1]), finer));
}

const IN_SPREADS = ["chance", "example"]; // bases of verdicts whose margins can be compared

// A verdict: `outcome` in words, basis (`reached`), `margin` above the threshold, `probability`, and `byChance`, the
// share of absent phrases that fit as well.
export function verdict(rule, found, reached, margin, probability = null) {
  const near = IN_SPREADS.includes(reached) && margin >= rule.weak_excess;
  const weak = probability === null ? near : probability >= rule.weak_probability;
  const outcome = found ? "found" : weak ? "weak match" : "not here";
  const [atBar, slope] = rule.by_chance;
  const byChance = reached === "chance" ? sigmoid(logit(atBar) - slope * margin) : null;
  return { outcome, found, reached, margin, probability, byChance };
}

// One verdict of several: the weakest if all are needed, else the strongest; absent: the answer has no members.
export function combined(rule, verdicts, all, absent = false) {
  const score = (name) => (all ? Math.min : Math.max)(...verdicts.map((one) => one[name]));
  const every = (holds) => verdicts.every(holds);
  const [{ reached }] = verdicts;
  const several = every((one) => IN_SPREADS.includes(one.reached)) ? "chance" : "several";
  const basis = every((one) => one.reached === reached) ? reached : several;
  const known = every((one) => one.probability !== null);
  const probability = !known ? null : absent ? 0 : score("probability");
  const found = !absent && (all ? every((one) => one.found) : verdicts.some((one) => one.found));
  return verdict(rule, found, basis, absent ? -Infinity : score("margin"), probability);
}

// The logistic function of a calibration for a phrase, or for one with a colour.
export function scalingOf(calibration, named, coloured = false) {
  const kind = named === "part of a thing" ? "part" : named;
  return calibration?.[coloured ? `coloured_${kind}` : kind];
}

// The verdict on the best fits of the levels. level: number, or -1 for "auto". common: the phrase's mean fit.
function judge(rule, fits, named, level, { bars, scaling }, common) {
  if (!scaling) {
    const share = named === "inside" ? 0 : rule.common_share; // as in `barsOn`
    const evidence = fits.map((fit) => fit - share * common);
    const margin = excess(rule, evidence, named, level, bars);
    return verdict(rule, margin >= 0, "chance", margin);
  }
  const { constant, whole, finer, found } = scaling;
  const logits = constant + whole * fits[2] + finer * Math.max(fits[0], fits[1]) + scaling.common * common;
  const probability = sigmoid(logits);
  const shown = level < 0 || named === "inside" || fits[level] >= 0;
  const margin = logits - logit(Math.min(found, 1 - rule.narrowest));
  return verdict(rule, shown && probability >= found, "calibration", margin, probability);
}

// The answer: the regions that fit nearly as well as the best one. Has level, `scores` and `fits` of all levels, the
// member regions (`inside`), the `best` region, whose position is the answer's (-1: none), and the verdict.
// evidence: { bars, scaling }. own: fits for every name of what is sought. on: for a part of a thing, whether each
// region is on the thing.
export function decide(rule, regions, own, named, level, evidence, on = null) {
  const anywhere = regionFits(rule, regions, own[0]);
  const there = (fits) => (on ? fits.map((fit, region) => (on[region] ? fit : rule.nothing)) : fits);
  const every = there(regionFits(rule, regions, mean(own)));
  const judged = named === "inside" ? there(anywhere) : anywhere;
  const bestOf = (relevancies) =>
    regions.counts.map((_, at) => bestRelevancy(rule, regions, relevancies, at));
  const fits = bestOf(regionRelevancies(rule, judged)).map((score) => fitOf(rule, score));
  const relevancies = regionRelevancies(rule, every);
  const scores = bestOf(relevancies);
  const bests = scores.map((score) => fitOf(rule, score));
  const given = bests.map(
    (fit, at) => fit + rule.advantage[named === "inside" ? "part of a thing" : named][at],
  );
  if (on) {
    given[given.length - 1] = rule.nothing;
  }
  const chosen = level < 0 ? given.lastIndexOf(Math.max(...given)) : level; // the coarsest of equal levels
  const least = leastFit(rule, bests[chosen]);
  const numbers = regionsAt(regions, chosen);
  const solid = numbers.filter((region) => relevancies[region] > 0 && relevancies[region] <= scores[chosen]);
  return {
    level: chosen,
    scores,
    fits,
    regionFits: every,
    inside: numbers.filter((region) => every[region] >= least),
    best: strongest(solid, relevancies),
    verdict: judge(rule, fits, named, level, evidence, commonFit(rule, regions, judged)),
  };
}

// The relevancies at the cold and hot end of an answer's heat map. best: the highest of its members.
export function heatRange(rule, peak, found, best) {
  const high = Math.max(peak, best);
  if (found && peak < rule.floor + rule.heat_span) {
    return [peak - rule.heat_span, high];
  }
  return [rule.floor, Math.max(high, rule.floor + rule.heat_span)];
}
