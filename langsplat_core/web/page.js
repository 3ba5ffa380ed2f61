// The page: the panel, what is shown, and the marks over the image. All text from the scene is set as text.

import { readPage } from "./data.js";
import { Language, PhraseError } from "./language.js";
import { Controls, project } from "./camera.js";
import { Painter } from "./draw.js";

const at = (id) => document.getElementById(id);
const made = (tag, text, properties = {}) =>
  Object.assign(document.createElement(tag), { textContent: text }, properties);
const DISPLAYS = { rgb: "Colours", relevancy: "Relevancy", segmentation: "Found", latent: "Latent" };
const KEYS = { c: "rgb", r: "relevancy", s: "segmentation", l: "latent" };
const SLOW = 60; // ms between frames of a moving camera, above which fewer pixels are drawn until it rests
const COARSEST = 0.3;
const REST = 180; // ms
const MOST_BOXES = 24;
const FAINT = 0.1; // opacity, as of scene/surface.py
const INNER = [0.02, 0.98]; // quantiles that a box holds, as of query/instances.py
const EDGES = [
  [0, 1], [0, 2], [0, 4], [1, 3], [1, 5], [2, 3], [2, 6], [3, 7], [4, 5], [4, 6], [5, 7], [6, 7],
];

class Page {
  constructor(meta, tensors) {
    Object.assign(this, { meta, level: "auto", display: "rgb", answer: null, share: 1, last: 0, shown: [] });
    this.painter = new Painter(at("scene"), meta, tensors);
    this.painter.onorder = () => this.redraw();
    this.language = meta.language && new Language(meta.language, tensors);
    this.controls = new Controls(at("scene"), meta, () => this.free(), () => this.moved());
    this.fill();
    this.listen();
    this.update();
    this.view(0);
  }

  fill() {
    const radios = (id, entries, chosen) =>
      at(id).append(
        ...entries.map(([value, text]) => {
          const input = Object.assign(document.createElement("input"), {
            type: "radio", name: id, value, checked: value === chosen,
          });
          input.addEventListener("change", () => this.choose(id, value));
          const label = made("label", text);
          label.prepend(input);
          return label;
        }),
      );
    radios(
      "levels",
      [["auto", "Auto"], ["subpart", "Subpart"], ["part", "Part"], ["whole", "Whole"]],
      "auto",
    );
    radios("displays", Object.entries(DISPLAYS), "rgb");
    at("views").append(...this.meta.views.map(({ name }, value) => made("option", name, { value })));
    for (const id of ["before", "after", "views"]) at(id).hidden = this.meta.views.length < 2;
    const map = at("legend").querySelector("canvas").getContext("2d"),
      row = map.createImageData(256, 1), colours = this.meta.map;
    for (let i = 0; i < 256; ++i)
      row.data.set([colours[3 * i], colours[3 * i + 1], colours[3 * i + 2], 255], 4 * i);
    map.putImageData(row, 0, 0);
    const gaussians = `${this.painter.count.toLocaleString("en")} Gaussians`, { language } = this.meta;
    let about = `Nothing can be searched: ${this.meta.why_not}.`;
    if (language?.encoder) about = "The text encoder is in this page: ask any of its words, in any combination.";
    else if (language) about = `${this.language.keys.size.toLocaleString("en")} phrases can be asked.`;
    if (language) about += ` A phrase is asked whole. Answers: ${language.basis}.`;
    at("about").textContent = `${gaussians}. ${about} Made with the LangSplat viewer.`;
    for (const id of ["search", "examples", "levels", "displays", "verdict"]) at(id).hidden = !language;
    document.querySelector(".check").hidden = !language;
    if (language)
      at("examples").append(
        ...language.examples.map((phrase) => {
          const button = made("button", phrase, { type: "button" });
          button.addEventListener("click", () => this.search(phrase));
          return button;
        }),
      );
  }

  listen() {
    const input = at("phrase"), list = at("list");
    at("search").addEventListener("submit", (event) => {
      event.preventDefault();
      const chosen = list.querySelector("[aria-selected=true]");
      this.search(chosen ? chosen.textContent : input.value);
    });
    input.addEventListener("input", () => {
      this.offer(this.language.completions(input.value));
      at("clear").hidden = !input.value;
    });
    input.addEventListener("blur", () => this.offer([]));
    input.addEventListener("keydown", (event) => {
      const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (event.key === "Escape" && !list.hidden) this.offer([]);
      else if (event.key === "Escape") this.search("");
      else if (step && !list.hidden) this.mark(step);
      else return;
      event.preventDefault();
    });
    list.addEventListener("pointerdown", (event) => {
      event.preventDefault(); // the box keeps the focus
      if (event.target.role === "option") this.search(event.target.textContent);
    });
    at("clear").addEventListener("click", () => {
      this.search("");
      input.focus();
    });
    at("face").addEventListener("click", () => this.controls.face(this.shown[0]));
    at("boxes").addEventListener("change", () => this.redraw());
    at("views").addEventListener("change", () => this.view(+at("views").value));
    at("before").addEventListener("click", () => this.view(this.current - 1));
    at("after").addEventListener("click", () => this.view(this.current + 1));
    at("show").addEventListener("click", () => this.panel(true));
    addEventListener("resize", () => this.redraw());
    addEventListener("keydown", (event) => {
      const typing = event.target.matches("select, input[type=text]");
      if (event.ctrlKey || event.metaKey || event.altKey || typing) return;
      if (event.key === "[" || event.key === "]") this.view(this.current + (event.key === "]" ? 1 : -1));
      else if (event.key === "h") this.panel(at("panel").hidden);
      else if (!this.language) return;
      else if (event.key === "/") (this.panel(true), at("phrase").focus(), at("phrase").select());
      else if ("0123".includes(event.key))
        this.choose("levels", ["auto", ...this.meta.language.levels][event.key]);
      else if (KEYS[event.key]) this.choose("displays", KEYS[event.key]);
      else if (event.key === "b") at("boxes").click();
      else return;
      event.preventDefault();
    });
  }

  // Left, top, width and height of what the panel does not cover: it lies at the left, on phones below.
  free() {
    const { right, top, width } = at("panel").getBoundingClientRect();
    if (!width) return [0, 0, innerWidth, innerHeight];
    return right < 0.6 * innerWidth ? [right, 0, innerWidth - right, innerHeight] : [0, 0, innerWidth, top];
  }

  panel(shown) {
    at("panel").hidden = !shown;
    at("show").hidden = shown;
    (shown ? at("phrase") : at("show")).focus();
    this.redraw();
  }

  // Options under the search box; the arrow keys mark one, which enter then asks.
  offer(phrases) {
    const list = at("list"), input = at("phrase");
    list.replaceChildren(
      ...phrases.map((phrase, i) =>
        made("li", phrase, { role: "option", id: `option${i}`, ariaSelected: "false" }),
      ),
    );
    list.hidden = phrases.length === 0;
    input.setAttribute("aria-expanded", String(!list.hidden));
    input.removeAttribute("aria-activedescendant");
  }

  mark(step) {
    const options = [...at("list").children],
      now = options.findIndex((option) => option.ariaSelected === "true");
    const next = options[(now + step + options.length + (now < 0 && step < 0 ? 1 : 0)) % options.length];
    for (const option of options) option.ariaSelected = String(option === next);
    at("phrase").setAttribute("aria-activedescendant", next.id);
    next.scrollIntoView({ block: "nearest" });
  }

  search(phrase) {
    at("phrase").value = phrase;
    at("clear").hidden = !phrase;
    this.offer([]);
    this.phrase = phrase;
    if (!phrase.trim()) {
      this.answer = null;
      if (this.display === "relevancy" || this.display === "segmentation") this.display = "rgb";
    } else if (!this.answer && this.display === "rgb") this.display = "relevancy";
    this.ask();
  }

  ask() {
    this.problem = "";
    if (this.phrase?.trim()) {
      try {
        this.answer = this.language.ask(this.phrase, this.level);
      } catch (error) {
        if (!(error instanceof PhraseError)) throw error;
        this.answer = null;
        this.problem = error.message;
      }
    }
    this.shown = this.boxes(this.answer);
    this.update();
  }

  choose(what, value) {
    if (what === "levels") {
      this.level = value;
      return this.ask();
    }
    if (document.querySelector(`#displays [value=${value}]`).disabled) return;
    this.display = value;
    this.update();
  }

  // Bring panel and values of the Gaussians up to date with phrase, level and display.
  update() {
    const { answer } = this, said = at("verdict"), levels = this.meta.language?.levels ?? [];
    for (const [id, value] of [["levels", this.level], ["displays", this.display]])
      for (const input of document.querySelectorAll(`#${id} input`)) {
        input.checked = input.value === value;
        input.disabled = id === "displays" && ["relevancy", "segmentation"].includes(input.value) && !answer;
      }
    for (const button of at("examples").children)
      button.ariaPressed = String(Boolean(answer) && button.textContent === this.phrase);
    said.replaceChildren();
    said.className = "";
    at("answer").hidden = !answer || answer.top < 0;
    if (answer) {
      const sure = answer.probability === null ? "" : `, ${Math.round(100 * answer.probability)} %`;
      const { found, verdict } = answer, count = this.shown.length;
      said.className = { found: "found", "weak match": "weak", "not here": "none" }[verdict];
      const word = { found: "Found", "weak match": "Weak match", "not here": "Not here" }[verdict];
      const unit = this.meta.metres_per_unit === 1 ? " m" : "",
        place = answer.place?.map((v) => v.toFixed(2)).join(" ");
      const where =
        verdict === "not here"
          ? answer.phrase
          : `${count} ${count > 1 ? "places" : "place"}, level ${levels[answer.level]}; at ${place}${unit}`;
      said.append(made("b", word + sure), made("small", where), made("small", this.meta.language.guess));
      const [low, high] = this.look().ranges[0], spans = at("legend").querySelectorAll("span");
      spans[0].textContent = low.toFixed(2);
      spans[1].textContent = high.toFixed(2);
      at("face").hidden = verdict === "not here";
    } else if (this.problem) said.append(this.problem);
    if (this.display === "latent")
      this.painter.show(this.language.latents(this.level === "auto" ? 2 : levels.indexOf(this.level)), 3);
    else if (answer && this.display !== "rgb") {
      const { values, members } = this.language.spread(answer, answer.level);
      this.painter.show(
        this.look().strength === 0 ? values.fill(0) : this.display === "segmentation" ? members : values, 1,
      );
    }
    this.redraw();
  }

  // What the composing shader is told, as display/displays.py has it: a weak match is half as hot.
  look() {
    const nothing = [0.5, 1],
      { answer, display } = this, { picture } = this.meta, whole = display === "segmentation";
    const strength = answer ? picture.strength[answer.verdict] : 0;
    const [low, high] = !strength ? nothing : whole ? [0, 1] : answer.heat;
    const shown = answer || !["relevancy", "segmentation"].includes(display) ? display : "rgb";
    return {
      display: shown, strength, ranges: [[low, low + (high - low) / (strength || 1)], nothing, nothing],
    };
  }

  corners(region) {
    return this.language.t.corners
      .subarray(24 * region, 24 * region + 24)
      .map((v, i) => v - this.meta.origin[i % 3]);
  }

  // Corners of the boxes of an answer, the best first: one for each whole that answers or has parts that do.
  boxes(answer) {
    if (!answer || answer.verdict === "not here") return [];
    const { language } = this, { sizes, parents } = language.t, things = new Map();
    const solid = answer.inside.filter((r) => sizes[r] >= this.meta.language.rule.smallest);
    for (const r of (solid.length ? solid : answer.inside).toSorted(
      (a, b) => answer.values[b] - answer.values[a],
    )) {
      let whole = r;
      while (whole < language.firsts[2]) whole = parents[whole];
      things.set(whole, [...(things.get(whole) ?? []), r]);
    }
    return [...things.values()]
      .slice(0, MOST_BOXES)
      .map((own) => (own.length > 1 ? this.around(own, answer.level) : this.corners(own[0])));
  }

  // Corners of the box around several regions of a level, along the sides of the largest one's.
  around(regions, level) {
    const { language, painter } = this,
      { sizes, regions: of } = language.t, wanted = new Set(regions), { count, places } = painter;
    const largest = this.corners(regions.reduce((a, b) => (sizes[b] > sizes[a] ? b : a)));
    const edges = [4, 2, 1].map((k) => [0, 1, 2].map((axis) => largest[3 * k + axis] - largest[axis]));
    const sides = edges.map((edge) => edge.map((v) => v / (Math.hypot(...edge) || 1))), along = [[], [], []];
    for (let i = 0; i < count; ++i) {
      if (places[4 * i + 3] < FAINT || !wanted.has(language.firsts[level] + of[level * count + i])) continue;
      sides.forEach((side, k) =>
        along[k].push(side[0] * places[4 * i] + side[1] * places[4 * i + 1] + side[2] * places[4 * i + 2]),
      );
    }
    const ends = along.map((values) => {
      const sorted = Float64Array.from(values).sort();
      return INNER.map((share) => sorted[Math.round(share * (sorted.length - 1))]);
    });
    return Float32Array.from({ length: 24 }, (_, i) =>
      [0, 1, 2].reduce((sum, k) => sum + sides[k][i % 3] * ends[k][(Math.floor(i / 3) >> (2 - k)) & 1], 0),
    );
  }

  view(number) {
    const { views } = this.meta;
    this.current = (number + views.length) % views.length;
    at("views").value = this.current;
    this.controls.go(views[this.current]);
  }

  moved() {
    const now = performance.now();
    if (now - this.last < 2 * REST && now - this.last > SLOW)
      this.share = Math.max(this.share * 0.8, COARSEST);
    this.last = now;
    clearTimeout(this.rest);
    this.rest = setTimeout(() => {
      this.share = 1;
      this.redraw();
    }, REST);
    this.redraw();
  }

  redraw() {
    if (this.asked || !this.controls.view) return;
    this.asked = requestAnimationFrame(() => {
      this.asked = 0;
      const camera = this.controls.camera(devicePixelRatio * this.share);
      this.painter.sort(camera);
      this.painter.paint(camera, this.look());
      this.draw();
    });
  }

  // Boxes over the image, in pixels of the screen.
  draw() {
    const canvas = at("marks"),
      dots = devicePixelRatio, camera = this.controls.camera(dots), { width, height } = camera;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    context.clearRect(0, 0, width, height);
    if (!at("boxes").checked) return;
    for (const [rank, corners] of this.shown.entries()) {
      const seen = Array.from({ length: 8 }, (_, k) =>
        project(camera, Array.from(corners.slice(3 * k, 3 * k + 3))),
      );
      if (seen.some(([, , z]) => z < this.meta.raster.near)) continue;
      context.beginPath();
      for (const [a, b] of EDGES)
        (context.moveTo(seen[a][0], seen[a][1]), context.lineTo(seen[b][0], seen[b][1]));
      for (const [width, colour] of [[3.5, "#0009"], [1.5, rank ? "#ffffffb3" : "#ffffff"]]) {
        Object.assign(context, { lineWidth: width * dots, strokeStyle: colour });
        context.stroke();
      }
      if (rank === 0) this.tag(context, this.answer.phrase, seen, dots);
    }
  }

  tag(context, text, seen, dots) {
    const [x, y] = seen.reduce((top, point) => (point[1] < top[1] ? point : top));
    context.font = `600 ${13 * dots}px system-ui, "DejaVu Sans", sans-serif`;
    const shown = text.length > 40 ? `${text.slice(0, 39)}…` : text,
      width = context.measureText(shown).width, pad = 7 * dots;
    context.fillStyle = "#10141ce6";
    context.beginPath();
    context.roundRect(x - width / 2 - pad, y - 30 * dots, width + 2 * pad, 22 * dots, 6 * dots);
    context.fill();
    context.fillStyle = "#ffb454";
    context.fillText(shown, x - width / 2, y - 14.5 * dots);
  }
}

// For scripts: `await langsplat` has `ask(phrase, level)`, an answer without anything shown, and `image(camera,
// display, phrase)`, the bytes of an image of that camera's size, drawn as soon as its order is known.
globalThis.langsplat = (async () => {
  const { tensors, meta } = await readPage(at("data").textContent);
  at("data").remove();
  meta.map = tensors.colour_map.values;
  at("panel").hidden = false;
  const page = new Page(meta, tensors);
  at("loading").remove();
  const image = async (camera, display = "rgb", phrase = "") => {
    Object.assign(page, { display, phrase, level: "auto", answer: null });
    if (page.language) page.ask();
    while (!(await page.painter.sort(camera))); // the page's own camera may have come between
    page.painter.paint(camera, page.look());
    return page.painter.pixels();
  };
  return { page, image, ask: (phrase, level) => page.language.ask(phrase, level) };
})();
globalThis.langsplat.catch((error) => {
  at("loading").textContent = `This scene cannot be shown. ${error.message}`;
  throw error;
});
