// Phrases as they are written: the twin of scene/language.py and of query/grammar.py.

// [page]
const APOSTROPHES = /[’‘ʼ′＇´`]/gu;
const CONTROL = /[\p{Cc}\p{Cs}]/gu;
const MARK = /[\p{P}\p{Z}\p{Cf}]/u; // punctuation, spaces and invisible letters around a word
const EMPTY = /[\p{Cf}\p{Po}\p{Mn}]/u; // letters that are no word alone

// Words without quotes and punctuation around them, and commas, none at the end.
function tokens(text) {
  const plain = text
    .replace(APOSTROPHES, "'")
    .normalize("NFKC")
    .replace(CONTROL, " ")
    .replace(/([\p{L}\p{N}_])\s+'s\b/gu, "$1's");
  const found = (plain.match(/,|[^\s,;]+/gu) || [])
    .map((piece) => (piece === "," ? piece : bareWord(piece)))
    .filter(Boolean);
  while (found[found.length - 1] === ",") {
    found.pop();
  }
  return found;
}

// A word without punctuation around it; a possessive's apostrophe stays. "" where it is nothing else.
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

// A phrase as it is shown.
function tidy(text) {
  return tokens(text)
    .join(" ")
    .replaceAll(" ,", ",")
    .replace(/^[, ]+/, "");
}

// The key by which a phrase is looked up and encoded.
function phraseKey(text) {
  return tokens(text)
    .filter((token) => token !== ",")
    .join(" ")
    .toLowerCase();
}

// What a phrase names: "thing", "part" or "part of a thing". lists: of Sets of words, by name.
function namedBy(phrase, { parts, adjectives, articles }) {
  const words = phrase.toLowerCase().split(" ");
  const noun = words.pop();
  const forms = [noun, noun.replace(/s$/, ""), noun.replace(/es$/, "")];
  if (!forms.some((form) => parts.has(form))) {
    return "thing";
  }
  return words.every((word) => adjectives.has(word) || articles.has(word)) ? "part" : "part of a thing";
}

// The thing that a phrase names a part of, and the part: "red mug" and "handle"; else "".
function thingAndPart(phrase, lists) {
  const words = namedBy(phrase, lists) === "part of a thing" ? phrase.split(" ") : [""];
  return [words.slice(0, -1).join(" "), words[words.length - 1]];
}

const SEPARATE = /[;\n]|,(?!\s*(?:(?:but|and)\s+)?(?:not|without|except)\b)/iu;
const JOIN = /\s(?:and|or|&|as well as)\s(?!not\b)/iu;
const EXCLUDE = /^(.+?),?\s(?:(?:but|and)\s)?(?:not|without|except|other than)\s(.+)$/iu;

// Whether words name a thing: more than stop words and descriptions.
function names(text, { stop_words: stops, adjectives, also_nouns: nouns }) {
  const words = text.toLowerCase().split(" ");
  return (
    words.some((word) => !stops.has(word) && !adjectives.has(word)) || nouns.has(words[words.length - 1])
  );
}

// The phrases of a line; what "and" and "or" join are phrases of their own.
function splitPhrases(line, lists) {
  return line.split(SEPARATE).flatMap((part) => {
    const phrases = tidy(part).split(JOIN);
    return phrases.every((phrase) => names(phrase, lists)) ? phrases : [tidy(part)];
  });
}

// A tree with what is asked for in the singular.
function oneOf(tree, lists) {
  if (tree.kind) {
    return { ...tree, what: oneOf(tree.what, lists) };
  }
  const words = tree.text.split(" ");
  const noun = words.pop();
  const { plurals, endings, always_plural: always } = lists;
  const one = [...endings].reduce((word, [end, by]) => word.replace(RegExp(end, "i"), by), noun);
  const low = noun.toLowerCase();
  return { text: [...words, plurals.get(low) ?? (always.has(low) ? noun : one)].join(" ") };
}

// What a phrase asks for: { text }, or { kind, what, anchor } of such, of a count { count, what }. A part of
// query/grammar.py's rules: things that others stand to are one level deep.
function parse(text, lists) {
  const bare = text.replace(lists.leading, "");
  const [, wanted, unwanted] = bare.match(EXCLUDE) ?? [];
  if (wanted && names(wanted, lists) && names(unwanted, lists) && namedBy(unwanted, lists) !== "part") {
    return { kind: "without", what: parse(wanted, lists), anchor: parse(unwanted, lists) };
  }
  const [first, ...rest] = bare.split(" ");
  const kind = lists.superlatives.get(first.toLowerCase());
  if (kind && names(rest.join(" "), lists)) {
    const what = parse(rest.join(" "), lists);
    const far = what.kind === "near" && ["nearest", "farthest"].includes(kind);
    return far ? { ...what, kind } : { kind, what, anchor: null };
  }
  const count = [...lists.numbers].indexOf(first.toLowerCase()) + 1 || (/^\d{1,3}$/.test(first) ? +first : 0);
  if (count && names(rest.join(" "), lists)) {
    const what = parse(rest.join(" "), lists);
    return { kind: "counted", count, what: count === 1 ? what : oneOf(what, lists) };
  }
  const [, those, side] = bare.match(/^(.+) on the (left|right)$/i) ?? [];
  if (those && names(those, lists)) {
    return { kind: `${side.toLowerCase()}most`, what: parse(those, lists), anchor: null };
  }
  const [, before, preposition, after] = bare.match(lists.related) ?? [];
  const relation = lists.prepositions.get(preposition?.toLowerCase());
  if (relation === "of" && namedBy(before, lists) === "part") {
    return { kind: "inside", what: { text: before }, anchor: parse(after, lists) };
  }
  if (!relation && namedBy(bare, lists) === "part of a thing") {
    const [thing, part] = thingAndPart(bare, lists);
    return { kind: "inside", what: { text: part }, anchor: { text: thing.replace(/'s$|(?<=s)'$/, "") } };
  }
  if (!relation || relation === "of" || !names(before, lists) || !names(after, lists)) {
    return { text: bare };
  }
  return { kind: relation, what: { text: before }, anchor: parse(after, lists) };
}

// Letters to insert, delete, replace or swap with the next, to make a word another.
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

// The known word that is written most like another one; "" where none is like it.
function nearest(word, known) {
  let [best, least] = ["", word.length / 3 + 1];
  for (const other of known) {
    const letters = distance(word, other) + (word[0] === other[0] ? 0 : 0.5);
    if (letters < least) {
      [best, least] = [other, letters];
    }
  }
  return best;
}
// [/page]

export { namedBy, nearest, parse, phraseKey, splitPhrases, thingAndPart, tidy, tokens };
