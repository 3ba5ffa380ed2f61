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
// [/page]

export { namedBy, phraseKey, thingAndPart, tidy, tokens };
