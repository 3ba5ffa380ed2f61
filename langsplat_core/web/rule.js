// The rule that turns the fits of regions into an answer: the twin of query/rule.py, where the table of numbers
// (`rule`) comes from and says what each is for.
//
// Regions are { counts, parents, sizes }: of all levels one after the other, subparts first; `parents` is the
// region of the level above, -1 for none.

// [page]
const sigmoid = (x) => 1 / (1 + Math.exp(-x));
const logit = (share) => Math.log(share / (1 - share));

// The fit that a relevancy stands for; finite at 0 and 1.
function fitOf(rule, relevancy) {
  return logit(Math.min(Math.max(relevancy, rule.narrowest), 1 - rule.narrowest));
}

// Fits of regions, each mixed with that of its best part. own: fits of the mean relevancy of each.
function regionFits(rule, regions, own) {
  const { parents, sizes } = regions;
  const telling = (region) => own[region] > rule.nothing && sizes[region] >= rule.smallest;
  const best = new Float64Array(own.length).fill(-Infinity);
  for (let region = 0; region < own.length; ++region) {
    const parent = parents[region];
    if (parent >= 0 && telling(region)) {
      best[parent] = Math.max(best[parent], own[region]);
    }
  }
  return own.map((fit, region) => {
    const part = best[region] === -Infinity && telling(region) ? fit : best[region];
    return part === -Infinity ? fit : (1 - rule.part_share) * fit + rule.part_share * part;
  });
}

// Relevancies that fits stand for, 0 for what fits nothing.
function regionRelevancies(rule, fits) {
  return fits.map((fit) => (fit > rule.nothing ? sigmoid(fit) : 0));
}

// Numbers of the regions of a level, in their order.
function regionsAt({ counts }, level) {
  const first = counts.slice(0, level).reduce((sum, count) => sum + count, 0);
  return Array.from({ length: counts[level] }, (_, i) => first + i);
}

// The one of some regions that has the largest value, of equal ones the first; -1 of none.
function strongest(some, values) {
  return some.reduce((best, region) => (best < 0 || values[region] > values[best] ? region : best), -1);
}

// The best relevancy of a level; of crumbs only where it has no more.
function bestRelevancy(rule, regions, relevancies, level) {
  const every = regionsAt(regions, level);
  const solid = every.filter((region) => regions.sizes[region] >= rule.smallest);
  return Math.max(0, relevancies[strongest(solid.length ? solid : every, relevancies)] ?? 0);
}

// Where parts of a thing may be: in and below the wholes that fit it nearly as well as the best one does.
function onThings(rule, regions, thing) {
  const level = regions.counts.length - 1;
  const best = bestRelevancy(rule, regions, regionRelevancies(rule, thing), level);
  const least = leastFit(rule, fitOf(rule, best), rule.around);
  const [first] = regionsAt(regions, level);
  const on = Array.from(thing, (fit, region) => region >= first && fit >= least);
  for (let region = first - 1; region >= 0; --region) {
    on[region] = regions.parents[region] >= 0 && on[regions.parents[region]];
  }
  return on;
}

// The fit from which a region belongs to an answer; `share`: of the way that it reaches.
function leastFit(rule, best, share = 1) {
  return best - share * Math.min(Math.max(rule.reach * best, rule.nearest), rule.farthest);
}

// The mean fit of regions, without crumbs and nothing.
function commonFit(rule, regions, fits) {
  const heard = fits.filter((fit, region) => fit > rule.nothing && regions.sizes[region] >= rule.smallest);
  return heard.reduce((sum, fit) => sum + fit, 0) / Math.max(heard.length, 1);
}

// Spreads by which the best fits of the levels exceed those from which a phrase is found. level: number, or -1
// where it is free. bars: of each level, and of the better one of the finer two.
function excess(rule, fits, named, level, bars) {
  const [whole, finer] = rule.found[named].map((spreads) => spreads ?? Infinity);
  const above = (bar, fit, spreads) => (fit - bar.median) / Math.max(bar.spread, rule.narrowest) - spreads;
  if (level >= 0) {
    return above(bars[level], fits[level], Math.min(whole, finer));
  }
  return Math.max(above(bars[2], fits[2], whole), above(bars[3], Math.max(fits[0], fits[1]), finer));
}

// A verdict: `outcome` in words, how it was `reached`, `margin` above what counts as found, `probability`, and the
// share of phrases for nothing here that fit as well `byChance`.
function verdict(rule, found, reached, margin, probability = null) {
  const weak = probability === null ? margin >= rule.weak_excess : probability >= rule.weak_probability;
  const outcome = found ? "found" : weak ? "weak match" : "not here";
  const [atBar, slope] = rule.by_chance;
  const byChance = reached === "chance" ? sigmoid(logit(atBar) - slope * margin) : null;
  return { outcome, found, reached, margin, probability, byChance };
}

// The verdict on two things that are both needed, the weaker one; absent: nothing is both.
function combined(rule, one, other, absent) {
  const [probability, margin] = ["probability", "margin"].map((name) => {
    const unknown = one[name] === null || other[name] === null;
    const least = name === "margin" ? -Infinity : 0;
    return unknown ? null : absent ? least : Math.min(one[name], other[name]);
  });
  const reached = one.reached === other.reached ? one.reached : "several";
  return verdict(rule, !absent && one.found && other.found, reached, margin, probability);
}

// The verdict that the best fits of the levels stand for. level: number, or -1 where it is free. common: the
// phrase's mean fit.
function judge(rule, fits, named, level, { bars, calibration }, common) {
  if (!calibration) {
    const evidence = fits.map((fit) => fit - rule.common_share * common);
    const margin = excess(rule, evidence, named, level, bars);
    return verdict(rule, margin >= 0, "chance", margin);
  }
  const odds = calibration[named] ?? calibration.part;
  const logits = odds.constant + odds.whole * fits[2] + odds.finer * Math.max(fits[0], fits[1]);
  const probability = sigmoid(logits);
  const shown = level < 0 || named === "inside" || fits[level] >= 0;
  const margin = logits - logit(Math.min(odds.found, 1 - rule.narrowest));
  return verdict(rule, shown && probability >= odds.found, "calibration", margin, probability);
}

// The answer of the whole regions that fit nearly as well as the best one: its level, `scores` and `fits` of
// all levels, the regions that are `inside`, the `best` one that the place is of (-1: none), and the verdict.
// evidence: { bars, calibration }. thing, part: the same as `own` for the thing that the phrase names a part of,
// and for that part alone.
function decide(rule, regions, own, named, level, evidence, thing = null, part = null) {
  const anywhere = regionFits(rule, regions, own);
  const both = thing && part ? own.map((fit, region) => (fit + part[region]) / 2) : own;
  const on = thing && onThings(rule, regions, regionFits(rule, regions, thing));
  const every = regionFits(rule, regions, both).map((fit, region) =>
    !on || on[region] ? fit : rule.nothing,
  );
  const heard =
    named === "inside" ? anywhere.map((fit, region) => (on[region] ? fit : rule.nothing)) : anywhere;
  const bestOf = (relevancies) =>
    regions.counts.map((_, at) => bestRelevancy(rule, regions, relevancies, at));
  const fits = bestOf(regionRelevancies(rule, heard)).map((score) => fitOf(rule, score));
  const relevancies = regionRelevancies(rule, every);
  const scores = bestOf(relevancies);
  const bests = scores.map((score) => fitOf(rule, score));
  const given = bests.map(
    (fit, at) => fit + rule.advantage[named === "inside" ? "part of a thing" : named][at],
  );
  if (thing) {
    given[given.length - 1] = rule.nothing;
  }
  const chosen = level < 0 ? given.lastIndexOf(Math.max(...given)) : level; // of equal levels the coarsest
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
    verdict: judge(rule, fits, named, level, evidence, commonFit(rule, regions, anywhere)),
  };
}

// Relevancies at which a heat map of an answer is coldest and hottest. best: the highest of its members.
function heatRange(rule, peak, found, best) {
  const high = Math.max(peak, best);
  if (found && peak < rule.floor + rule.heat_span) {
    return [peak - rule.heat_span, high];
  }
  return [rule.floor, Math.max(high, rule.floor + rule.heat_span)];
}
// [/page]

export {
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
};
