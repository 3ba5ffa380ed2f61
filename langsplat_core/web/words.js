// Tokens and grammar of queries: the twin of scene/language.py and query/grammar.py.

// [page]
const APOSTROPHES = /[’‘ʼ′＇´`]/gu;
const CONTROL = /[\p{Cc}\p{Cs}]/gu;
const MARK = /[\p{P}\p{Z}\p{Cf}]/u; // punctuation, spaces and invisible characters around a word
const EMPTY = /[\p{Cf}\p{Po}\p{Mn}]/u; // characters that alone are no word

// Words without surrounding quotes and punctuation, and commas except at the end.
export function tokens(text) {
  const plain = text
    .replace(APOSTROPHES, "'")
    .normalize("NFKC")
    .replace(CONTROL, " ")
    .replace(/(?<=[\p{L}\p{N}_])\s+'s(?![\p{L}\p{N}_])/gu, "'s");
  const found = (plain.match(/,|[^\s,;]+/gu) || [])
    .map((piece) => (piece === "," ? piece : bareWord(piece)))
    .filter(Boolean);
  while (found[found.length - 1] === ",") {
    found.pop();
  }
  return found;
}

// A word without surrounding punctuation, except a possessive's apostrophe; "" if nothing remains.
function bareWord(word) {
  if (word === "&") {
    return word;
  }
  const letters = [...word];
  const first = letters.findIndex((letter) => !MARK.test(letter));
  if (first < 0) {
    return "";
  }
  const last = letters.length - letters.toReversed().findIndex((letter) => !MARK.test(letter));
  const inner = letters.slice(first, last);
  if (inner.every((letter) => EMPTY.test(letter))) {
    return "";
  }
  const possessive = letters[last] === "'" && first === 0 && letters[last - 1] === "s";
  return inner.join("") + (possessive ? "'" : "");
}

// A phrase in the form in which it is shown.
export function tidy(text) {
  return tokens(text)
    .join(" ")
    .replaceAll(" ,", ",")
    .replace(/^[, ]+/, "");
}

// The key by which a phrase is looked up and encoded.
export function phraseKey(text) {
  return tokens(text)
    .filter((token) => token !== ",")
    .join(" ")
    .toLowerCase();
}

// The singular of a noun; a word that is not plural is unchanged.
function singular(noun, { plurals, endings, own_singulars: own }) {
  const low = noun.toLowerCase();
  const one = [...endings].reduce((word, [end, by]) => word.replace(RegExp(end, "i"), by), noun);
  return plurals.get(low) ?? (own.has(low) ? noun : one);
}

// A word in lower case and its possible singulars.
function forms(word, lists) {
  const low = word.toLowerCase();
  return [low, singular(low, lists), low.replace(/s$/, ""), low.replace(/es$/, "")];
}

// The kind of a phrase: "thing", "part" or "part of a thing". lists: Sets of words by name.
export function namedBy(phrase, lists) {
  const { parts, adjectives, stop_words: stops } = lists;
  const words = phrase.toLowerCase().split(" ");
  if (!forms(words.pop(), lists).some((form) => parts.has(form))) {
    return "thing";
  }
  return words.every((word) => adjectives.has(word) || stops.has(word)) ? "part" : "part of a thing";
}

// Thing and part of a "part of a thing": "red mug" and "handle" of "red mug handle"; else "".
export function thingAndPart(phrase, lists) {
  const words = namedBy(phrase, lists) === "part of a thing" ? phrase.split(" ") : [""];
  return [words.slice(0, -1).join(" "), words[words.length - 1]];
}

const AND = /(?:^| )(?:and|&|as well as)(?= |$)/iu;
// Beginnings of questions: "where is the mug".
const QUESTION = /^(?:(?:where|which)(?:'s| is| are)|(?:is|are) there|find(?: me)?|show me|look for) (?=.)/iu;
const OR = /(?:^| )or(?= |$)/iu;
const EXCLUDE = /,?(?: (?:but|and))? (?:not|without|except|other than)(?= |$)/giu;
const UNWANTED = /^(?:(?:but|and) )?(?:not|without|except|other than)(?: .*)?$/iu;
const SEPARATE = /[;\n]|,(?!\s*(?:(?:but|and)\s+)?(?:not|without|except|other\s+than)\b)/iu;

// Whether words name a thing: not only stop words and adjectives, or one of `nouns` at the end.
function names(text, { stop_words: stops, adjectives, also_nouns }, nouns = also_nouns) {
  const words = text.toLowerCase().split(/[ ,]+/u).filter(Boolean);
  return words.some((word) => !stops.has(word) && !adjectives.has(word)) || nouns.has(words.at(-1));
}

// The phrases of a line; "" if it has no word.
export function splitPhrases(line) {
  const phrases = line.split(SEPARATE).map(tidy).filter(Boolean);
  return phrases.length ? phrases : [""];
}

// A text split at separators, or undivided if one side would name nothing.
function sidesOf(text, separator, lists) {
  const sides = text.split(separator).map((side) => side.trim());
  return sides.every((side) => names(side, lists)) ? sides : [text];
}

// A text split into what is wanted and what is excluded, if both sides name something.
function exclusions(text, lists) {
  for (const { index, 0: mark } of text.matchAll(EXCLUDE)) {
    const [before, after] = [text.slice(0, index), text.slice(index + mark.length).trim()];
    if (names(before, lists) && names(after, lists)) {
      return [before, ...exclusions(after, lists)];
    }
  }
  return [text];
}

// The tree of a phrase: { text }, { kind, what, anchor }, { kind: "counted", count, what } or, for several, { kind,
// items }. The rules are those of query/grammar.py.
export function parse(text, lists) {
  const group = (kind, items) => (items.length > 1 ? { kind, items } : items[0]);
  const one = (side) => clause(side, lists);
  const both = (side) => group("both", sidesOf(side, AND, lists).map(one));
  const either = (side) => group("either", sidesOf(side.replaceAll(",", ""), OR, lists).map(both));
  const isPart = (tree) => tree.text && namedBy(tree.text, lists) !== "thing";
  const asked = text.replace(QUESTION, "").replace(UNWANTED, ""); // of "not the cup" nothing
  const [what, ...others] = exclusions(asked, lists).map(either);
  const own = what.text && !isPart(what); // "mug without handle"
  const ofIt = (tree) => (own && isPart(tree) ? { kind: "inside", what: tree, anchor: what } : tree);
  return others.length ? { kind: "without", what, anchor: group("either", others.map(ofIt)) } : what;
}

function clause(text, lists) {
  const bare = text.replace(lists.leading, "");
  const [first, second, ...others] = bare.split(" ");
  const rest = bare.slice(first.length + 1);
  const kind = lists.superlatives.get(first.toLowerCase());
  if (kind && lists.numbers.has(second?.toLowerCase())) {
    return clause([second, first, ...others].join(" "), lists);
  }
  if (kind && names(rest, lists)) {
    const what = related(rest, lists);
    const far = ["nearest", "farthest"].includes(kind);
    const [, those, anchor] = (far && rest.match(/^(.+?) (?:to|from) (.+)$/i)) || [];
    if (far && what.kind === "near") {
      return { ...what, kind };
    }
    return those && names(those, lists) && names(anchor, lists)
      ? { kind, what: related(those, lists), anchor: related(anchor, lists) }
      : { kind, what };
  }
  const count = lists.numbers.get(first.toLowerCase());
  if (count && names(rest, lists)) {
    const what = clause(rest, lists);
    return { kind: "counted", count, what: count === 1 ? what : oneOf(what, lists) };
  }
  const [, those, side] = bare.match(/^(.+) on the (left|right)$/i) ?? [];
  if (those && names(those, lists)) {
    return { kind: `${side.toLowerCase()}most`, what: related(those, lists) };
  }
  return related(bare, lists);
}

// A tree with the searched noun in the singular.
function oneOf(tree, lists) {
  if (tree.kind) {
    return { ...tree, what: oneOf(tree.what, lists) };
  }
  return { text: tree.text.replace(/[^ ]+$/, (noun) => singular(noun, lists)) };
}

// The first preposition relates all that follows it.
function related(text, lists) {
  const words = text.split(" ");
  for (let at = 1; at < words.length; ++at) {
    for (let next = Math.min(at + lists.longest, words.length - 1); next > at; --next) {
      const kind = lists.prepositions.get(words.slice(at, next).join(" ").toLowerCase());
      const [before, after] = [words.slice(0, at), words.slice(next)].map((side) => side.join(" "));
      const isOf = kind === "of";
      const measures = isOf && forms(words[at - 1], lists).some((form) => lists.measures.has(form));
      const holds = measures && !names(words.slice(0, at - 1).join(" "), lists, new Set());
      const named = names(before, lists) || (isOf && namedBy(before, lists) !== "thing");
      if (kind && named && names(after, lists) && !holds) {
        return { kind: isOf ? "inside" : kind, what: thing(before, lists), anchor: clause(after, lists) };
      }
    }
  }
  return thing(text, lists);
}

function thing(text, lists) {
  const bare = text.replace(lists.leading, "");
  const inside = (what, anchor) => ({ kind: "inside", what, anchor });
  for (const { index, 0: mark } of bare.matchAll(/(?:'s|(?<=s)') /g)) {
    const [owner, rest] = [bare.slice(0, index), bare.slice(index + mark.length)];
    const who = owner.toLowerCase().split(" ").at(-1);
    const owns = !lists.owners.has(who) && names(owner, lists);
    if (owns && rest.split(" ").some((word) => !lists.stop_words.has(word.toLowerCase()))) {
      return inside(thing(rest, lists), thing(owner, lists));
    }
  }
  const [whole, part] = thingAndPart(bare, lists);
  return whole ? inside({ text: part }, { text: whole }) : { text: bare };
}

// Edit distance: letters to insert, delete, replace or swap with the next.
function distance(a, b) {
  let [before, row] = [[], Array.from({ length: b.length + 1 }, (_, j) => j)];
  for (let i = 1; i <= a.length; ++i) {
    const next = [i];
    for (let j = 1; j <= b.length; ++j) {
      const swapped = a[i - 1] === b[j - 2] && a[i - 2] === b[j - 1] ? before[j - 2] + 1 : Infinity;
      next[j] = Math.min(next[j - 1] + 1, row[j] + 1, row[j - 1] + (a[i - 1] === b[j - 1] ? 0 : 1), swapped);
    }
    [before, row] = [row, next];
  }
  return row[b.length];
}

// The known word that is spelt most like another word; "" if none is close.
export function nearest(word, known) {
  let [best, least] = ["", word.length / 3 + 1];
  for (const other of known) {
    const letters = distance(word, other) + (word[0] === other[0] ? 0 : 0.5);
    if (letters < least) {
      [best, least] = [other, letters];
    }
  }
  return best;
}
